"""Projection of the state on a constraint whose numbers come with the data."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import jax.numpy as jnp

from robins import linalg
from robins.filters.belief import Belief, StepInfo
from robins.filters.checks import sensor_names
from robins.filters.limits.constrain import Weight, as_weight, check_size, metric_of, nearest
from robins.filters.observation import Observation
from robins.filters.rule import Memory, Rule
from robins.filters.values import kind, value


@value
class Projection(Rule):
    """Rule of `projection`: x - G (D x - d), G = V D' (D V D')^-1."""

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
        S = o.prior.factor
        metric, root = metric_of(o.prior, self.weight)
        spread = o.spread
        if root is not None:  # D = D S S' (S S')^-1
            solid, _ = linalg.guard(S)
            spread = linalg.solve_spd(solid, S @ o.spread.T).T @ metric.factor
        nothing = jnp.zeros((len(o.residual), 0))
        exact = o._replace(spread=spread, excess=nothing, noise=nothing, deficit=None)
        mean, gain, used, wrong = nearest(metric, exact)
        factor = S
        if self.project_covariance:
            error = jnp.concatenate([o.excess, o.noise], axis=1)
            factor = linalg.tria(S - gain @ jnp.where(used[:, None], o.spread, 0.0), gain @ error)
            # no rounding is left across an exact constraint
            clean = jnp.any(used & ~jnp.any(error != 0.0, axis=1))
            lost = linalg.lost_in_rounding(factor, o.prior.sigma)
            factor = jnp.where(clean & lost, 0.0, factor)
        belief = Belief(mean, jnp.where(jnp.any(used), factor, S))
        info = info._replace(gain=jnp.where(used[None, :], gain, 0.0))
        info = info.contradicted_where(jnp.any(wrong))
        return memory, belief, info.noted("projection", residual=jnp.max(jnp.abs(o.residual)))


def projection(
    sensors: str | Sequence[str], weight: Weight = "covariance", project_covariance: bool = True
) -> Rule:
    """Use measurements of the named sensors as constraints, by projection.

    With the measurement linearised as d = D x + error, error ~ N(0, R_d), the projection (Simon &
    Chia 2002, sec. II) replaces the Kalman update,

        G = V D' (D V D')^-1,   x* = x - G (D x - d),   P* = (I - G D) P (I - G D)' + G R_d G'

    with V = P, or W^-1. The gain treats the constraint as exact; its noise and the linearisation
    error enter P* only. For a constraint that is the same throughout a run use `equality`.

    If R_d is zero, P* is *singular*. Later updates, predictions and sigma points then need
    ``form="sqrt"``: ``form="joseph"`` returns `Code.INDEFINITE`, and the information sum of
    `distributed` does not take the step, since P* has no inverse: give the sensor a small noise
    (1e-3 m/s), or use `at_master`. Components already satisfied are left out. A weight other than
    "covariance" needs a prior that is not singular, to recover D.

    Put it before rules that use the posterior: changes of the posterior by earlier rules are lost.
    A constraint that contradicts exact knowledge makes the update `Code.CONTRADICTED`.

    Notes: ``projection.residual``, the greatest component of |d - D x|.

    Args:
        sensors: a name, or several.
        weight: metric W in which the change of the state is least: "covariance" for P^-1,
            "identity", or a positive definite (n, n) matrix in tangent coordinates.
        project_covariance: False keeps P, which is better if errors of the constraint are not
            white.

    Raises:
        ValueError: no sensor is named, the weight is not valid; at `init`, sizes do not fit.
    """
    names = sensor_names("projection", sensors)
    return Projection(as_weight("projection", weight), names, project_covariance)
