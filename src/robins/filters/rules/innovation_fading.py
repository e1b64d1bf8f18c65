"""Fading of the prior while the innovations of a sensor are larger than expected."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

from robins.errors import require
from robins.filters.belief import Belief, Number
from robins.filters.linearise import Transition
from robins.filters.observation import Observation
from robins.filters.rule import Rule
from robins.filters.rules._variances import ratio, reading_variance, variance
from robins.filters.values import Numbers, is_factor, kind, number, value


class Window(NamedTuple):
    """Last samples of each component of a sensor, newest first."""

    surplus: Array  # (window, m) e_i^2 / R_ii - 1; 0 where not filled yet
    filled: Array  # (m,) int, number of samples


class InnovationMemory(NamedTuple):
    """Windows by sensor, and state of the step."""

    windows: dict[str, Window]
    faded: Array  # () bool, the prior of this step has been faded
    start: Array  # (n,) standard deviations at the start, the unit of `reach`


@value
class InnovationFading(Rule):
    """Rule of `innovation_fading`: lambda P- from the mean squared innovations of a window."""

    limit: Numbers  # () greatest lambda
    reach: Numbers  # () greatest standard deviation, over the one at the start
    window: int = kind()  # samples

    name = "innovation_fading"

    def init(self, belief: Belief, dims: Mapping[str, int]) -> InnovationMemory:
        windows = {
            name: Window(jnp.zeros((self.window, m)), jnp.zeros(m, int)) for name, m in dims.items()
        }
        return InnovationMemory(windows, jnp.zeros((), bool), belief.sigma)

    def process(self, memory: InnovationMemory, transition: Transition):
        return memory._replace(faded=jnp.zeros((), bool)), transition

    def before(self, memory: InnovationMemory, prior: Belief, o: Observation):
        R, old = variance(o.noise), memory.windows[o.sensor]
        here = o.accepted & o.present & (R > 0.0)
        e = jnp.where(here, o.residual, 0.0)
        rolled = jnp.concatenate([(ratio(e**2, R) - 1.0)[None, :], old.surplus[:-1]])
        surplus = jnp.where(here[None, :], rolled, old.surplus)
        filled = jnp.minimum(old.filled + here.astype(int), self.window)
        window, counts = Window(surplus, filled), here & (filled == self.window)
        mean = jnp.sum(window.surplus, axis=0) / self.window
        unexplained = jnp.sum(jnp.where(counts, mean, 0.0))
        explained = jnp.sum(jnp.where(counts, ratio(reading_variance(o), R), 0.0))
        factor = jnp.clip(ratio(unexplained, explained), 1.0, self.limit)
        # a state known exactly at the start has no scale
        scaled = memory.start > 0.0
        most = self.reach * jnp.where(scaled, memory.start, 1.0)
        too_far = jnp.any(scaled & (jnp.sqrt(factor) * prior.sigma > most))
        factor = jnp.where(memory.faded | too_far, 1.0, factor)
        windows = {**memory.windows, o.sensor: window}
        memory = memory._replace(windows=windows, faded=memory.faded | (factor > 1.0))
        prior = prior._replace(factor=jnp.sqrt(factor) * prior.factor)
        return memory, prior, o.noted(self.name, lambda_=factor)


def innovation_fading(window: int = 10, limit: Number = 5.0, reach: Number = float("inf")) -> Rule:
    """One fading factor from the innovations of a window (Mehra 1972, covariance matching).

    This is the form of robust adaptive filters of integrated navigation (RAUKF), normalised by R so
    that terms of radians and metres can be added. With e the innovation and the mean over the last
    ``window`` samples of the sensor:

        lambda = clip( sum_i (mean e_i^2 / R_ii - 1) / sum_i (H P- H')_ii / R_ii,  1,  limit )
        P-  :=  lambda P-

    R is the noise after earlier rules: with a robust weight w the terms are w_i e_i^2 / R_ii, so
    that an outlier does not cause fading. A component that is missing or refused, or whose window
    is not full, does not count. The prior of a step is faded once, at the first of its sensors with
    a lambda above 1.

    One factor for all states also fades those that no sensor observes, and no measurement reduces
    their covariance again: with a star sensor alone the covariance of the position grows until the
    linearisation is invalid over it. So no fading is done in a step in which it would take any
    standard deviation beyond ``reach`` times its initial value.

    Notes: ``innovation_fading.lambda``. limit = 1 is the Kalman filter, bit for bit.

    Args:
        window: number of samples in the mean.
        limit: greatest lambda.
        reach: greatest standard deviation after fading, over that at the start.

    Raises:
        ValueError: a parameter is out of its range.
    """
    require(window >= 1, "innovation_fading window must be 1 sample or more", window)
    most = number("innovation_fading limit must be finite and not below 1", limit, is_factor)
    farthest = number("innovation_fading reach must be at least 1", reach, lambda x: x >= 1.0)
    return InnovationFading(most, farthest, window)
