"""Widen the prior while the innovations of a sensor are larger than expected."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

from robins.errors import require
from robins.filters.belief import Belief, Number
from robins.filters.linearise import Transition
from robins.filters.observation import Observation
from robins.filters.rule import Rule, hooks
from robins.filters.rules._variances import ratio, reading_variance, variance


class Window(NamedTuple):
    """The last samples of a sensor, newest first; each component has its own."""

    surplus: Array  # (window, m) e_i^2 / R_ii - 1; 0 where not filled yet
    filled: Array  # (m,) int, samples in it


class Memory(NamedTuple):
    """Windows by sensor, and whether this step has been faded already."""

    windows: dict[str, Window]
    faded: Array  # () bool
    start: Array  # (n,) standard deviations at the start, which `reach` is counted in


def innovation_fading(window: int = 10, limit: Number = 5.0, reach: Number = float("inf")) -> Rule:
    """One fading factor from the mean innovation of a window (Mehra 1972, covariance matching).

    The form that robust adaptive filters of integrated navigation pair with robust weights
    (RAUKF), whitened by R so that radians and metres may be added. With e the innovation and the
    mean taken over the last ``window`` samples of the sensor:

        lambda = clip( sum_i (mean e_i^2 / R_ii - 1) / sum_i (H P- H')_ii / R_ii,  1,  limit )
        P-  :=  lambda P-

    R is the noise as the rules before this one leave it: behind a robust weight w the terms are
    w_i e_i^2 / R_ii, so that an outlier does not fade. A component that is missing or refused is
    left out of the sums, and its window does not move; it does not count before its window is full.

    A step is faded once: by the first of its sensors whose lambda exceeds 1; those after it see the
    prior that this one has left.

    One factor for all states also fades those that no sensor of the filter sees, and no measurement
    reduces their covariance again: with a star sensor alone the covariance of the position grows
    until the model is no longer linear over it. So a step that would take any standard deviation
    beyond ``reach`` times what it was at the start is not faded.

    Notes: ``innovation_fading.lambda``. limit = 1 is the Kalman filter, bit for bit.

    Args:
        window: samples in the mean.
        limit: greatest lambda.
        reach: greatest standard deviation that fading leads to, over the one at the start.

    Raises:
        ValueError: a parameter is not of its range.
    """
    require(window >= 1, "innovation_fading window must be 1 sample or more", window)
    if not 1.0 <= limit < float("inf"):
        raise ValueError(f"innovation_fading limit must be finite and not below 1, got {limit}")
    require(reach >= 1.0, "innovation_fading reach must be at least 1", reach)

    def init(belief: Belief, dims) -> Memory:
        windows = {
            name: Window(jnp.zeros((window, m)), jnp.zeros(m, int)) for name, m in dims.items()
        }
        return Memory(windows, jnp.zeros((), bool), belief.sigma)

    def process(memory: Memory, transition: Transition):
        return memory._replace(faded=jnp.zeros((), bool)), transition

    def before(memory: Memory, prior: Belief, o: Observation):
        R = variance(o.noise)
        here = o.accepted & o.present & (R > 0.0)
        e = jnp.where(here, o.residual, 0.0)
        old = memory.windows[o.sensor]
        rolled = jnp.concatenate([(ratio(e**2, R) - 1.0)[None, :], old.surplus[:-1]])
        surplus = jnp.where(here[None, :], rolled, old.surplus)
        filled = jnp.minimum(old.filled + here.astype(int), window)
        counts = here & (filled == window)
        mean = jnp.sum(surplus, axis=0) / window
        unexplained = jnp.sum(jnp.where(counts, mean, 0.0))
        explained = jnp.sum(jnp.where(counts, ratio(reading_variance(o), R), 0.0))
        factor = jnp.clip(ratio(unexplained, explained), 1.0, limit)
        # a state known exactly at the start has no scale to hold it to
        scaled = memory.start > 0.0
        most = reach * jnp.where(scaled, memory.start, 1.0)
        beyond = jnp.any(scaled & (jnp.sqrt(factor) * prior.sigma > most))
        factor = jnp.where(memory.faded | beyond, 1.0, factor)
        windows = {**memory.windows, o.sensor: Window(surplus, filled)}
        memory = memory._replace(windows=windows, faded=memory.faded | (factor > 1.0))
        prior = prior._replace(factor=jnp.sqrt(factor) * prior.factor)
        return memory, prior, o.noted("innovation_fading", lambda_=factor)

    return hooks(init=init, process=process, before=before, name="innovation_fading")
