"""Refuse a measurement whose innovation is too large to be chance."""

from __future__ import annotations

import jax.numpy as jnp
from scipy import stats

from robins.filters.belief import Belief, StepInfo
from robins.filters.observation import Observation, normalised
from robins.filters.rule import Rule


def gate(probability: float = 0.9999, patience: int = 10) -> Rule:
    """Chi-square gate on the whole innovation of a sensor (Bar-Shalom et al. 2001, sec. 2.3.2).

    A measurement is refused when its NIS exceeds the chi-square quantile for the components
    present. Noted as ``gate.ratio``, NIS over that quantile: above 1 means refused, as on the
    innovation test ratio scale of autopilots.

    A filter that has gone wrong refuses for ever, so after ``patience`` refusals of a sensor in a
    row its next measurement is used whatever its size.

    Args:
        probability: share of right measurements that pass.
        patience: refusals in a row that are believed.

    Raises:
        ValueError: the probability is not between 0 and 1, or patience is negative.
    """
    if not 0.0 < probability < 1.0:
        raise ValueError(f"gate probability must lie between 0 and 1, got {probability}")
    if patience < 0:
        raise ValueError(f"gate patience must not be negative, got {patience}")

    def init(belief, dims):
        return {name: (jnp.zeros((), int), jnp.zeros(())) for name in dims}

    def before(memory, prior: Belief, o: Observation):
        seen = normalised(o)
        # quantile by number of components used; none used passes
        table = [jnp.inf, *stats.chi2.ppf(probability, range(1, len(o.residual) + 1))]
        ratio = jnp.minimum(seen.nis / jnp.asarray(table)[seen.dof], jnp.finfo(float).max)
        refused, _ = memory[o.sensor]
        passed = (ratio <= 1.0) | (refused >= patience)
        refused = jnp.where(seen.dof == 0, refused, jnp.where(passed, 0, refused + 1))
        memory = {**memory, o.sensor: (refused, ratio)}
        return memory, prior, o._replace(accepted=o.accepted & passed)

    def after(memory, posterior: Belief, info: StepInfo, o: Observation):
        notes = {**info.notes, "gate.ratio": memory[o.sensor][1]}
        return memory, posterior, info._replace(notes=notes)

    return Rule(init=init, before=before, after=after, name="gate")
