"""Refuse a measurement whose innovation is too large to be chance, with a way to recover."""

from __future__ import annotations

from functools import partial
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from robins import linalg
from robins.errors import require
from robins.filters.belief import Belief
from robins.filters.checks import one_of
from robins.filters.chi_square import quantiles
from robins.filters.observation import Observation, normalised
from robins.filters.rule import Rule
from robins.filters.rules._robust import widened

Recovery = Literal["accept", "inflate", "reinitialise"]
Scope = Literal["joint", "component"]

# Covariance added on re-initialisation, in units of R: the gain is then at least 0.99 of a copy.
_OPEN = 100.0


class _Channel(NamedTuple):
    """What a gate remembers of a sensor; g is () for a joint gate, (m,) for one by component."""

    refused: Array  # (g) refusals in a row
    ratio: Array  # () greatest test ratio of the last measurement
    residual: Array  # (k, m) the last innovations that were too large, newest last
    known: Array  # (k, m) bool, components they had


def gate(
    probability: float = 0.9999,
    patience: int = 10,
    recovery: Recovery = "inflate",
    scope: Scope = "joint",
) -> Rule:
    r"""Chi-square gate on the innovation of a sensor (Bar-Shalom et al. 2001, sec. 2.3.2).

    A measurement is refused when its NIS r' S^-1 r exceeds q, the chi-square quantile for the
    components present; by component, when r_i^2 / S_ii exceeds that of one. A filter that has gone
    wrong would refuse for ever, so after ``patience`` refusals of a sensor in a row the next
    measurement that is too large recovers it:

    - ``accept`` uses it with the gain there is, which follows a jump of many deviations only in
      hundreds of measurements;
    - ``inflate`` first widens the prior covariance along the innovation until the NIS is q or
      less, by D = a r r', a = 1 / q - 1 / NIS; by component by D = diag(a_i r_i^2), with a_i =
      1 / q - S_ii / r_i^2 (`robins.filters.rules._robust.widened`);
    - ``reinitialise`` uses it only if it and the refused ones before it *agree*: their scatter
      about their mean, sum (r_k - mean)' R^-1 (r_k - mean), is within the chi-square quantile of
      patience times m degrees of freedom. It then widens what is seen by D = r r' + 100 R, and
      the state follows the measurement. Refusals that disagree go on being refused.

    Notes: ``gate.ratio``, min(NIS / q, 1), where 1 is refused or recovered (the innovation test
    ratio of autopilots; by component the greatest), ``gate.refused``, refusals in a row (the most),
    and ``gate.recovered``.

    Args:
        probability: share of right measurements that pass.
        patience: refusals in a row before recovery.
        recovery: what then happens.
        scope: judge the measurement as a whole, or each component by itself.

    Raises:
        ValueError: the probability is not between 0 and 1, patience is negative or too short to
            agree in, or recovery or scope is none of those above.
    """
    require(0.0 < probability < 1.0, "gate probability must lie between 0 and 1", probability)
    one_of("gate recovery", recovery, Recovery)
    one_of("gate scope", scope, Scope)
    agreeing = recovery == "reinitialise"
    least = int(agreeing)
    require(patience >= least, f"gate patience must be at least {least} to {recovery}", patience)
    joint = scope == "joint"
    kept = patience + 1 if agreeing else 0

    def init(belief, dims):
        def channel(m):
            shape = () if joint else (m,)
            residual = jnp.zeros((kept, m))
            return _Channel(jnp.zeros(shape, int), jnp.zeros(()), residual, residual > 0.0)

        return {name: channel(m) for name, m in dims.items()}

    def before(memory, prior: Belief, o: Observation):
        was: _Channel = memory[o.sensor]
        q, ratio, judged, used = _judge(o, probability, joint)
        over = judged & ~(ratio <= 1.0)
        due = over & (was.refused >= patience)
        residual, known = was.residual, was.known
        if agreeing:
            fresh = jnp.broadcast_to(over, used.shape)[None, :]
            residual = jnp.where(fresh, _push(residual, o.residual), residual)
            known = jnp.where(fresh, _push(known, used), known)
            agree = partial(_agree_as_one if joint else _agree_each, probability)
            due = jax.lax.cond(
                jnp.any(due), lambda: due & agree(residual, known, o.noise), lambda: due
            )
        passed = ~over | due
        refused = jnp.where(judged, jnp.where(passed, 0, was.refused + 1), was.refused)
        worst = jnp.max(jnp.where(over, 1.0, ratio), initial=0.0)
        worst = jnp.where(jnp.any(judged), worst, was.ratio)
        now = _Channel(refused, worst, residual, known)

        if recovery != "accept":
            chosen = due & used
            jump = jnp.where(chosen, o.residual, 0.0)
            if not agreeing:
                excess = jnp.where(due, 1.0 - 1.0 / jnp.where(due, ratio, 2.0), 0.0)
                jump = jump * jnp.sqrt(excess / q)
            root = jump[:, None] if joint else jnp.diag(jump)
            if agreeing:
                root = jnp.concatenate([root, _OPEN**0.5 * o.noise], axis=1)
            prior = widened(jnp.any(due), prior, o, chosen, root)
        most = jnp.max(refused, initial=0)
        o = o.noted("gate", ratio=worst, refused=most, recovered=jnp.any(due))
        return {**memory, o.sensor: now}, prior, o._replace(accepted=o.accepted & passed)

    return Rule(init=init, before=before, name="gate")


def _judge(o: Observation, probability: float, joint: bool):
    """Limit, ratio to it, whether there is something to judge, and the components used."""
    seen = normalised(o)
    if joint:
        table = jnp.asarray(quantiles(probability, len(o.residual)))
        q = table[seen.dof]
        return q, seen.nis / q, seen.dof > 0, seen.used
    q = quantiles(probability, 1)[1]
    variance = jnp.sum(seen.factor**2, axis=1)
    square = jnp.where(seen.used, o.residual, 0.0) ** 2
    return q, square / variance / q, seen.used, seen.used


def _push(rows: Array, newest: Array) -> Array:
    return jnp.concatenate([rows[1:], newest[None]])


def _scatter(residual: Array, known: Array) -> Array:
    """Deviations from the mean, 0 in components that were not always there."""
    shared = jnp.all(known, axis=0, keepdims=True)
    return jnp.where(shared, residual - jnp.mean(residual, axis=0, keepdims=True), 0.0)


def _agree_as_one(probability: float, residual: Array, known: Array, noise: Array) -> Array:
    shared = jnp.all(known, axis=0)
    N = jnp.where(shared[:, None], noise, 0.0)
    L = linalg.tria(N, jnp.diag(jnp.where(shared, 0.0, 1.0)))
    # A component without noise agrees only if it repeats: the least pivot makes all else huge.
    L = L + jnp.diag(jnp.where(jnp.diagonal(L) == 0.0, jnp.finfo(float).tiny, 0.0))
    white = linalg.solve_lower(L, _scatter(residual, known).T)
    table = quantiles(probability, len(shared), len(residual) - 1)
    count = jnp.sum(shared)
    return (count > 0) & (jnp.sum(white**2) <= jnp.asarray(table)[count])


def _agree_each(probability: float, residual: Array, known: Array, noise: Array) -> Array:
    limit = quantiles(probability, 1, len(residual) - 1)[1]
    scatter = jnp.sum(_scatter(residual, known) ** 2, axis=0)
    return jnp.all(known, axis=0) & (scatter <= limit * jnp.sum(noise**2, axis=1))
