"""Chi-square gate on innovations, with recovery of a diverged filter."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from robins import linalg
from robins.errors import require
from robins.filters.belief import Belief
from robins.filters.checks import one_of
from robins.filters.chi_square import limits, within
from robins.filters.observation import Observation, normalised
from robins.filters.rule import Memory, Rule
from robins.filters.rules._robust import widened
from robins.filters.values import Numbers, is_probability, kind, number, value

Recovery = Literal["accept", "inflate", "reinitialise"]
Scope = Literal["joint", "component"]

# Covariance added on re-initialisation, in units of R: H K is then at least 0.99.
_OPEN = 100.0


class _SensorMemory(NamedTuple):
    """Gate memory of a sensor; g is () for a joint gate, (m,) for one by component."""

    refused: Array  # (g) refusals in a row
    ratio: Array  # () greatest test ratio of the last measurement
    residual: Array  # (k, m) the last innovations that were too large, newest last
    known: Array  # (k, m) bool, components of these that were used


@value
class Gate(Rule):
    """Rule of `gate`."""

    limit: Numbers  # (MOST + 1,) q by the number of components used
    scatter: Numbers | None  # (MOST + 1,) limit of the scatter of refusals; None: not tested
    patience: Numbers  # () refusals in a row before recovery
    kept: int = kind()  # number of stored innovations; 0 if refusals need not agree
    recovery: Recovery = kind()
    joint: bool = kind()

    name = "gate"

    def init(self, belief: Belief, dims: Mapping[str, int]) -> Memory:
        def channel(m: int) -> _SensorMemory:
            shape, residual = () if self.joint else (m,), jnp.zeros((self.kept, m))
            return _SensorMemory(jnp.zeros(shape, int), jnp.zeros(()), residual, residual > 0.0)

        return {name: channel(m) for name, m in dims.items()}

    def before(self, memory: Memory, prior: Belief, o: Observation):
        was = memory[o.sensor]
        q, ratio, judged, used = self.judge(o)
        over = judged & ~(ratio <= 1.0)
        due, residual, known = self.due(was, over, used, o)
        passed = ~over | due
        refused = jnp.where(judged, jnp.where(passed, 0, was.refused + 1), was.refused)
        worst = jnp.max(jnp.where(over, 1.0, ratio), initial=0.0)
        worst = jnp.where(jnp.any(judged), worst, was.ratio)
        if self.recovery != "accept":
            prior = self.recovered(due, due & used, ratio, q, prior, o)
        most = jnp.max(refused, initial=0)
        o = o.noted("gate", ratio=worst, refused=most, recovered=jnp.any(due))
        memory = {**memory, o.sensor: _SensorMemory(refused, worst, residual, known)}
        return memory, prior, o._replace(accepted=o.accepted & passed)

    def judge(self, o: Observation):
        """Limit q, ratio of the test to it, mask of tests made, and mask of components used."""
        seen = normalised(o)
        if self.joint:
            q = within(self.limit, o.residual)[seen.dof]
            return q, seen.nis / q, seen.dof > 0, seen.used
        variance = jnp.sum(seen.factor**2, axis=1)
        square = jnp.where(seen.used, o.residual, 0.0) ** 2
        return self.limit[1], square / variance / self.limit[1], seen.used, seen.used

    def due(
        self, was: _SensorMemory, over: Array, used: Array, o: Observation
    ) -> tuple[Array, Array, Array]:
        """Mask of recoveries due, and the stored innovations with their components."""
        due, scatter = over & (was.refused.astype(float) >= self.patience), self.scatter
        if scatter is None:
            return due, was.residual, was.known
        fresh = jnp.broadcast_to(over, used.shape)[None, :]
        residual = jnp.where(fresh, _push(was.residual, o.residual), was.residual)
        known = jnp.where(fresh, _push(was.known, used), was.known)
        agree = _agree_as_one if self.joint else _agree_each
        due = jax.lax.cond(
            jnp.any(due), lambda: due & agree(scatter, residual, known, o.noise), lambda: due
        )
        return due, residual, known

    def recovered(
        self, due: Array, chosen: Array, ratio: Array, q: Numbers, prior: Belief, o: Observation
    ) -> Belief:
        """Prior, widened if recovery is due."""
        jump = jnp.where(chosen, o.residual, 0.0)
        if not self.kept:
            # keeps the root off 0 if no recovery is due: its derivative in q would be NaN
            excess = 1.0 - 1.0 / jnp.where(due, ratio, 2.0)
            jump = jump * jnp.where(due, jnp.sqrt(excess / q), 0.0)
        root = jump[:, None] if self.joint else jnp.diag(jump)
        if self.kept:
            root = jnp.concatenate([root, _OPEN**0.5 * o.noise], axis=1)
        return widened(jnp.any(due), prior, o, chosen, root)


def gate(
    probability: float = 0.9999,
    patience: int = 10,
    recovery: Recovery = "inflate",
    scope: Scope = "joint",
) -> Rule:
    r"""Chi-square gate on the innovation of a sensor (Bar-Shalom et al. 2001, sec. 2.3.2).

    A measurement is refused if its NIS r' S^-1 r exceeds q, the chi-square quantile for the
    components present; with scope "component", if r_i^2 / S_ii exceeds that of one. A diverged
    filter would refuse all measurements, so after ``patience`` refusals of a sensor in a row the
    next measurement that is too large recovers it:

    - ``accept`` uses it with the present gain; after a jump of many standard deviations the state
      then converges only within hundreds of measurements;
    - ``inflate`` first widens the prior covariance along the innovation until the NIS is q or
      less, by D = a r r', a = 1 / q - 1 / NIS; with scope "component" by D = diag(a_i r_i^2),
      a_i = 1 / q - S_ii / r_i^2 (`robins.filters.rules._robust.widened`);
    - ``reinitialise`` uses it only if it and the refused ones before it *agree*: their scatter
      about their mean, sum (r_k - mean)' R^-1 (r_k - mean), is within the chi-square quantile of
      patience times m degrees of freedom. It then widens the measured components by
      D = r r' + 100 R, so that the state follows the measurement. Otherwise it is refused.

    Notes: ``gate.ratio``, min(NIS / q, 1), where 1 is refused or recovered (the innovation test
    ratio of autopilots; the greatest of the components), ``gate.refused``, refusals in a row (the
    greatest number), and ``gate.recovered``.

    Args:
        probability: share of correct measurements that pass.
        patience: refusals in a row before recovery; at least 1 to ``reinitialise``.
        recovery: one of the above.
        scope: "joint" tests the measurement as a whole, "component" each component separately.

    Raises:
        ValueError: an argument is out of its range.
    """
    chance = number("gate probability must lie between 0 and 1", probability, is_probability)
    one_of("gate recovery", recovery, Recovery)
    one_of("gate scope", scope, Scope)
    agreeing = recovery == "reinitialise"
    least = int(agreeing)
    require(patience >= least, f"gate patience must be at least {least} to {recovery}", patience)
    return Gate(
        limit=limits(chance),
        scatter=limits(chance, patience) if agreeing else None,
        patience=np.asarray(float(patience)),
        kept=patience + 1 if agreeing else 0,
        recovery=recovery,
        joint=scope == "joint",
    )


def _push(rows: Array, newest: Array) -> Array:
    return jnp.concatenate([rows[1:], newest[None]])


def _scatter(residual: Array, known: Array) -> Array:
    """Deviations of residuals from their mean; 0 in components that were not always present."""
    shared = jnp.all(known, axis=0, keepdims=True)
    return jnp.where(shared, residual - jnp.mean(residual, axis=0, keepdims=True), 0.0)


def _agree_as_one(table: Array, residual: Array, known: Array, noise: Array) -> Array:
    shared = jnp.all(known, axis=0)
    N = jnp.where(shared[:, None], noise, 0.0)
    L = linalg.tria(N, jnp.diag(jnp.where(shared, 0.0, 1.0)))
    # A component without noise agrees only if it repeats exactly: any other deviation is huge when
    # divided by the tiny pivot.
    L = L + jnp.diag(jnp.where(jnp.diagonal(L) == 0.0, jnp.finfo(float).tiny, 0.0))
    white = linalg.solve_lower(L, _scatter(residual, known).T)
    count = jnp.sum(shared)
    return (count > 0) & (jnp.sum(white**2) <= table[: len(shared) + 1][count])


def _agree_each(table: Array, residual: Array, known: Array, noise: Array) -> Array:
    scatter = jnp.sum(_scatter(residual, known) ** 2, axis=0)
    return jnp.all(known, axis=0) & (scatter <= table[1] * jnp.sum(noise**2, axis=1))
