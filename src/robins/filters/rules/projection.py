"""Put the state on a constraint whose numbers come with the data."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import jax.numpy as jnp
from jaxtyping import Array

from robins import linalg
from robins.filters.belief import Belief, StepInfo
from robins.filters.checks import sensor_names
from robins.filters.limits.constrain import Weight, as_weight, check_size, metric_of, nearest
from robins.filters.observation import Observation
from robins.filters.rule import Memory, Rule
from robins.filters.values import kind, value


@value
class Projection(Rule):
    """The rule of `projection`: x - G (D x - d), G = V D' (D V D')^-1."""

    weight: Weight
    names: tuple[str, ...] = kind()
    project_covariance: bool = kind()

    name = "projection"

    def init(self, belief: Belief, dims: Mapping[str, int]) -> Memory:
        n = belief.factor.shape[0]
        check_size("projection", self.weight, n)
        for name, m in dims.items():
            if name in self.names and m > n:
                raise ValueError(f"sensor '{name}' has {m} components, the state only {n} to move")
        return ()

    def after(self, memory: Memory, posterior: Belief, info: StepInfo, o: Observation):
        if o.sensor not in self.names:
            return memory, posterior, info
        belief, gain, used, wrong = projected(o, self.weight, self.project_covariance)
        info = info._replace(gain=jnp.where(used[None, :], gain, 0.0))
        info = info.contradicted_where(jnp.any(wrong))
        return memory, belief, info.noted("projection", residual=jnp.max(jnp.abs(o.residual)))


def projection(
    sensors: str | Sequence[str], weight: Weight = "covariance", project_covariance: bool = True
) -> Rule:
    """Measurements of the named sensors are constraints, and are met instead of weighed.

    With the measurement linearised as d = D x + error, error ~ N(0, R_d), the Kalman update gives
    way to the projection (Simon & Chia 2002, sec. II)

        G = V D' (D V D')^-1,   x* = x - G (D x - d),   P* = (I - G D) P (I - G D)' + G R_d G'

    with V = P, or W^-1. The gain takes the constraint for exact; its noise, and what the
    linearisation leaves over, is counted in P* alone. `equality` is for a constraint whose numbers
    are the same throughout a run; to weigh the measurement, leave the rule out.

    Where R_d is zero P* is *singular*: nothing is uncertain across the constraint. Updates that
    follow, predictions and sigma points are sound with ``form="sqrt"``; ``form="joseph"`` says
    `Code.INDEFINITE`, and the information sum of `distributed` does not take the step, since there
    is nothing to invert: give the sensor a noise far below what matters (1e-3 m/s), or apply it
    ``at_master``. What was met already is left out. A weight other than "covariance" wants a prior
    that is not singular: of a combination that is known exactly D is not seen.

    It goes before rules that look at the posterior: what rules before it did to that is lost.

    A constraint that contradicts what is known exactly cannot be met: `Code.CONTRADICTED`.

    Notes: ``projection.residual``, the greatest component of d - D x.

    Args:
        sensors: a name, or several.
        weight: metric W in which the state is moved least: "covariance" for P^-1, "identity", or a
            positive definite (n, n) matrix in tangent coordinates.
        project_covariance: False leaves P as it was: the mean is on the constraint, and the filter
            does not know it. Better where the error of the constraint lasts from step to step.

    Raises:
        ValueError: no sensor is named, or the weight is none; by `init`, it is not of the state's
            dimension, or a sensor has more components than the state.
    """
    names = sensor_names("projection", sensors)
    return Projection(as_weight("projection", weight), names, project_covariance)


def projected(
    o: Observation, weight: Weight, project_covariance: bool = True
) -> tuple[Belief, Array, Array, Array]:
    """The belief on the constraint that an observation is, and the rest of `nearest`."""
    prior, S = o.prior, o.prior.factor
    metric, root = metric_of(prior, weight)
    spread = o.spread if root is None else _slope(o) @ metric.factor
    nothing = jnp.zeros((len(o.residual), 0))
    exact = o._replace(spread=spread, excess=nothing, noise=nothing, deficit=None)
    mean, G, used, wrong = nearest(metric, exact)
    factor = S
    if project_covariance:
        error = jnp.concatenate([o.excess, o.noise], axis=1)
        factor = linalg.tria(S - G @ jnp.where(used[:, None], o.spread, 0.0), G @ error)
        # Across an exact constraint nothing is left, not even rounding.
        clean = jnp.any(used & ~jnp.any(error != 0.0, axis=1))
        lost = linalg.lost_in_rounding(factor, prior.sigma)
        factor = jnp.where(clean & lost, 0.0, factor)
    some = jnp.any(used)
    return Belief(mean, jnp.where(some, factor, S)), G, used, wrong


def _slope(o: Observation) -> Array:
    """D, of which the spread D S is known: D = D S S' (S S')^-1."""
    solid, _ = linalg.guard(o.prior.factor)
    return linalg.solve_spd(solid, o.prior.factor @ o.spread.T).T
