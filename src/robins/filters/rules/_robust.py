"""Parts of an innovation covariance, weights, refusals and recovery, shared by robust rules."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike

from robins import linalg
from robins.filters.belief import Belief, Number
from robins.filters.observation import Normalised, Observation, left_out, normalised, whiten
from robins.filters.rule import Memory, Rule
from robins.filters.rules._variances import ratio, variance
from robins.filters.trees import select
from robins.filters.values import Numbers, number, value


class Shares(NamedTuple):
    """Parts of S = H P H' + Omega + R in units of S = L L', where they sum to the identity.

    If R and P are rescaled, L^-1 S L^-T is a weighted sum of these m x m parts: no subtraction.
    """

    seen: Normalised  # the innovation, with L and w = L^-1 r
    noise: Array  # (m, q) factor N of R, zero where not used
    white_noise: Array  # (m, q) L^-1 N
    prior: Array  # (m, m) L^-1 (H P H' + Omega) L^-T
    idle: Array  # (m, m) ones on the diagonal where not used


def shares(o: Observation) -> Shares:
    """Parts of the covariance of an innovation."""
    # `normalised` inlined, since `left_out` costs time and its blocks are needed here
    spread, excess, padded, deficit, used = left_out(o)
    L = linalg.tria(spread, excess, padded)
    if deficit is not None:
        L = linalg.downdate(L, deficit)
    seen, noise = whiten(L, used, o.residual), padded[:, : o.noise.shape[1]]
    columns = [spread, excess, noise] + ([] if deficit is None else [deficit[:, None]])
    white = linalg.solve_lower(L, jnp.concatenate(columns, axis=1))
    known = spread.shape[1] + excess.shape[1]
    W, rest = white[:, :known], white[:, known : known + noise.shape[1]]
    prior = W @ W.T
    if deficit is not None:
        prior = prior - white[:, -1:] @ white[:, -1:].T
    return Shares(seen, noise, rest, prior, jnp.diag(jnp.where(used, 0.0, 1.0)))


MOST = 1e12  # greatest factor of a noise: practically infinite, yet without loss of all digits
PATIENCE = 30  # measurements in a row with a weight below HARDLY before one is used
HARDLY = 1e-2  # negligible weight: an innovation beyond some 30 standard deviations has less
_STEPS = 40  # limit of Newton's iterations; about four are needed
_CLOSE = 1e-13  # relative tolerance of Newton's iterations


def scale_to_quantile(o: Observation, limit: ArrayLike, seen: Normalised | None = None) -> Array:
    r"""Factor s >= 1 of R such that the normalised innovation squared equals a limit.

    Solves r' (H P H' + s R)^-1 r = limit, the joint Mahalanobis distance of Chang (2014); exactly 1
    where the NIS is not above the limit. With S = H P H' + R = L L', w = L^-1 r, B = L^-1 R L^-T

        g(s) = w' (I + (s - 1) B)^-1 w,

    and 1 / g is concave in s, so that Newton's steps on it increase s from 1 to the root without
    overshoot (the secular equation of trust regions; Moré & Sorensen 1983), in a single step if
    there is one component.

    The result is at most `MOST`, which is reached if the excess is in components without noise;
    components not used do not count. The limit is () and positive; ``seen`` is `normalised` of o if
    already computed. The derivative is that of the root.
    """
    seen = normalised(o) if seen is None else seen
    noise = jnp.where(seen.used[:, None], o.noise, 0.0)
    W = linalg.solve_lower(seen.factor, noise)
    B = W @ W.T
    beyond = seen.nis >= MOST * limit  # g(s) >= NIS / s, so that s is `MOST` at least
    above = (seen.nis > limit) & ~beyond
    nis = jnp.where(above, seen.nis, 1.0)
    ratio = jnp.where(above, nis / limit, 1.0)
    unit = jnp.where(above, seen.white, 0.0) / jnp.sqrt(nis)
    B_, unit_, ratio_ = jax.lax.stop_gradient((B, unit, ratio))

    def at(s: Array) -> tuple[Array, Array, Array]:
        """(I + (s-1) B)^-1 u, g and -g' of the unit innovation u."""
        L = linalg.cholesky(jnp.eye(len(unit_)) + (s - 1.0) * B_)
        v = linalg.solve_spd(L, unit_[:, None])[:, 0]
        return v, unit_ @ v, v @ (B_ @ v)

    def unfinished(state: tuple[Array, tuple[Array, Array, Array], Numbers]) -> Array:
        s, (_, g, _), count = state
        return (g * ratio_ > 1.0 + _CLOSE) & (s < MOST) & (count < _STEPS)

    def newton(state: tuple[Array, tuple[Array, Array, Array], Numbers]):
        s, (_, g, slope), count = state
        step = (g * ratio_ - 1.0) * g / jnp.where(slope > 0.0, slope, 1.0)
        s = jnp.minimum(jnp.where(slope > 0.0, s + step, MOST), MOST)
        return s, at(s), count + 1

    first = jnp.ones(()), (unit_, jnp.sum(unit_**2), unit_ @ (B_ @ unit_)), 0
    s, (v, g, slope), _ = jax.lax.while_loop(unfinished, newton, first)
    # One more step changes s by rounding only, but has the derivative of the root: dg is 2 v'du -
    # (s-1) v'dB v, independent of dv.
    again = 2.0 * (v @ unit) - v @ v - (s - 1.0) * (v @ (B @ v))
    free = above & (s < MOST) & (slope > 0.0)
    turn = jnp.where(free, g / jnp.where(free, slope, 1.0), 0.0)
    return jnp.where(above, s + turn * (again * ratio - 1.0), jnp.where(beyond, MOST, 1.0))


def weighed(o: Observation, scale: Array) -> tuple[Observation, Array]:
    """Measurement with noise R_ij sqrt(s_i s_j), and its weights 1 / s.

    s is (), or (m,) for the components. Below a weight of 1 / `MOST` the correction would grow with
    the innovation again: there a component with noise is refused, with weight 0.
    """
    lost = scale >= (1.0 - 1e-9) * MOST
    refused = lost & jnp.any(o.noise != 0.0, axis=1)
    root = jnp.sqrt(jnp.where(lost, 1.0, scale))
    noise = jnp.broadcast_to(root, refused.shape)[:, None] * o.noise
    return o.raised(noise, o.accepted & ~refused), jnp.where(lost, 0.0, 1.0 / scale)


def reweighted(o: Observation, weight: Callable[[Array], Array], iterations: int) -> Array:
    """(m,) weights w(e_i) with which R_ij becomes R_ij / sqrt(w_i w_j), iterated from w = 1.

    e are the (m,) residuals *after* the update with these weights, in standard deviations of their
    own noise; 0 for components without noise.
    """
    of = shares(o)
    L, white, R = of.seen.factor, of.seen.white[:, None], variance(of.noise)
    own = jnp.where(R > 0.0, jnp.sqrt(jnp.where(R > 0.0, R, 1.0)), jnp.inf)

    def better(_, w: Array) -> Array:
        scaled = of.noise / jnp.sqrt(w)[:, None]
        W = linalg.solve_lower(L, scaled)
        root = linalg.cholesky(of.prior + W @ W.T + of.idle)
        # residual after the update, R S^-1 r
        e = scaled @ (W.T @ linalg.solve_spd(root, white))
        return weight(e[:, 0] / own)

    return jax.lax.fori_loop(0, iterations, better, jnp.ones(len(own)))


@value
class PatientRule(Rule):
    """Rule of `with_recovery`."""

    inner: Rule
    patience: Numbers  # () measurements in a row

    @property
    def name(self) -> str:
        return self.inner.name

    def init(self, belief: Belief, dims: Mapping[str, int]) -> Memory:
        # memory of the inner rule, and measurements in a row with negligible weight
        return self.inner.init(belief, dims), {name: jnp.zeros((), int) for name in dims}

    def before(self, memory: Memory, prior: Belief, o: Observation):
        inner, counts = memory
        inner, faded, given = self.inner.before(inner, prior, o)
        R, raised = variance(o.noise), variance(given.noise)
        weighable = o.accepted & o.present & (R > 0.0)
        hopeless = jnp.all(~weighable | ~given.accepted | (ratio(R, raised) < HARDLY))
        counting, hopeless = jnp.any(weighable), jnp.any(weighable) & hopeless
        due = hopeless & (counts[o.sensor].astype(float) >= self.patience)
        wide = widened_to_dof(due, prior, o, normalised(o))
        count = jnp.where(hopeless & ~due, counts[o.sensor] + 1, 0)
        count = jnp.where(counting, count, counts[o.sensor])
        given = given._replace(
            noise=jnp.where(due, o.noise, given.noise),
            accepted=jnp.where(due, o.accepted, given.accepted),
        )
        given = given.noted(self.name, recovered=due)
        memory = inner, {**counts, o.sensor: count}
        return memory, select(due, wide, Belief(*faded)), given


def with_recovery(rule: Rule, patience: Number | None) -> Rule:
    r"""Wrap a robust rule so that it recovers from refusals in a row, as in a diverged filter.

    After ``patience`` measurements of a sensor in a row that were refused or had a weight below
    1e-2, the next such one is used with full weight, and the prior is first widened along the
    innovation r until the NIS equals m, its mean for m components (`widened` by a r r',
    a = 1 / m - 1 / NIS). Only the hook `before` of the rule is used; the note ``recovered`` is
    added. With patience None the rule itself is returned.
    """
    if patience is None:
        return rule
    negative = f"{rule.name} patience must not be negative"
    return PatientRule(rule, number(negative, patience, lambda p: p >= 0))


def widened_to_dof(due: Array, prior: Belief, o: Observation, seen: Normalised) -> Belief:
    """Prior `widened` along the innovation, if due, until the NIS is at most its dof."""
    a = ratio(jnp.ones(()), seen.dof.astype(float)) - ratio(jnp.ones(()), seen.nis)
    due = due & (a > 0.0)
    return widened(due, prior, o, seen.used, jnp.sqrt(jnp.where(due, a, 1.0)) * o.residual[:, None])


def widened(due: Array, prior: Belief, o: Observation, chosen: Array, root: Array) -> Belief:
    r"""Prior with a covariance D added in the measurement space of chosen components, if due.

        P' = P + G D G' + E,   G = P H' (H P H')^-1,   H G = I,   so that H P' H' >= H P H' + D,

    H being the rows of those components. The correction also moves states correlated with them, in
    proportion to the error: after a position jump the velocity would be far off, with its old
    variance. So the covariance conditioned on the components, P_c = P - G H P, grows by the share
    of each state that they determine,

        E = k V P_c V,   V_ii^2 = (G H P)_ii / P_ii,   k = max_i r_i^2 / (H P H')_ii

    r being the innovation. Uncorrelated states do not change, nor does an exactly known component:
    its column of G is 0. ``due`` is () bool, ``chosen`` (m,) bool, ``root`` an (m, k) root of D.
    """

    def wider() -> Belief:
        S, spread = prior.factor, jnp.where(chosen[:, None], o.spread, 0.0)
        solid, independent = linalg.guard(spread, o.size)
        G_root = S @ (spread.T @ linalg.solve_spd(solid, root))
        T = jnp.where(independent[:, None], linalg.solve_lower(solid, spread), 0.0)
        known = S @ T.T
        growth = jnp.where(chosen & independent, ratio(o.residual**2, variance(spread)), 0.0)
        share = jnp.max(growth) * ratio(variance(known), variance(S))
        some = share > 0.0  # twice: the slope of a root at 0 is infinite
        share = jnp.where(some, jnp.sqrt(jnp.where(some, share, 1.0)), 0.0)
        rest = share[:, None] * (S - known @ T)
        return prior._replace(factor=linalg.tria(S, G_root, rest))

    return jax.lax.cond(due, wider, lambda: Belief(*prior))
