"""Bounds on a belief: clip its mean to the nearest state inside, or truncate its density."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from robins import linalg, manifold
from robins.filters.belief import Belief
from robins.filters.limits.constrain import Function, Weight, as_sensor, metric_of, nearest
from robins.filters.linearise import taylor
from robins.filters.model import Data, Given
from robins.filters.observation import CONTRADICTS, Observation
from robins.filters.trees import select

# Gauss-Legendre nodes, and the number of e-folds of a density that they span: moments to 1e-15.
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(64)
_FOLDS = 40.0


class Bounded(NamedTuple):
    """Belief within bounds on c components."""

    belief: Belief
    outside: Array  # (c,) bool: the mean violated these bounds
    # () bool: no state satisfies all bounds, and the belief is unchanged; or an exactly known
    # component violates its bound
    infeasible: Array


def _observed(belief: Belief, g: Function) -> Observation:
    """Observation of g(x) with the measurement zero: its residual is -g(x)."""
    sensor, zero = as_sensor(belief.mean, g, None, None)
    return taylor().observation(belief, sensor, zero, None)


def clip(
    belief: Belief, g: Function, lower: Given, upper: Given, weight: Weight = "covariance"
) -> Bounded:
    """Move the mean m to the nearest state within ``lower <= g(x) <= upper``; P is kept.

        x* = argmin (x - m)' W (x - m)   subject to   lower <= D x <= upper

    solved exactly by the dual active-set method (Goldfarb & Idnani 1983), as a projection on the
    active rows. Functions are linearised once, about the mean.

    Args:
        belief: belief to constrain.
        g: (c, n) matrix or function of the state with values in an array, as in `constrain`.
        lower: (c,) lower bounds; -inf for none.
        upper: (c,) upper bounds; inf for none.
        weight: W, as in `constrain`.

    Raises:
        ValueError: shapes do not fit.
    """
    metric, _ = metric_of(belief, weight)
    o = _observed(metric, g)
    value = -o.residual
    low, high = jnp.asarray(lower, float), jnp.asarray(upper, float)
    at_low, at_high, infeasible, denied = _active(o, low - value, high - value)
    # The active rows are locally constant, so they have no derivative.
    shift = jnp.where(at_low, low - value, jnp.where(at_high, high - value, 0.0))
    moved = nearest(metric, o._replace(residual=shift, accepted=at_low | at_high))[0]
    mean = select(infeasible, belief.mean, moved)
    outside = (value < low) | (value > high)
    return Bounded(belief._replace(mean=mean), outside, infeasible | denied)


def _active(o: Observation, low: Array, high: Array) -> tuple[Array, Array, Array, Array]:
    """Lower and upper bounds that are active at the nearest state.

    Returns:
        (c,) bool, active lower bounds; (c,) bool, active upper bounds; () bool, no state satisfies
        the bounds of components that can move; () bool, an exactly known component violates its
        bound.

    In units of the belief: the shortest t with N t >= b, rows of N of unit length. Each step
    satisfies one violated row while the active ones stay satisfied; a row whose multiplier would
    become negative on the way is dropped first.
    """
    spread, size, low, high = jax.lax.stop_gradient((o.spread, o.size, low, high))
    c = len(low)
    free = ~jnp.all(linalg.lost_in_rounding(spread, size), axis=1)  # others cannot be moved
    length = jnp.where(free, jnp.sqrt(jnp.sum(spread**2, axis=1)), 1.0)
    rows = jnp.where(free[:, None], spread / length[:, None], 0.0)
    N = jnp.concatenate([rows, -rows])
    b = jnp.concatenate([low / length, -high / length])
    b = jnp.where(jnp.concatenate([free, free]), b, -jnp.inf)
    rounding = 1e-12 * (1.0 + jnp.where(jnp.isfinite(b), jnp.abs(b), 0.0))
    no_row = jnp.full((), -1)

    def slack(t: Array) -> Array:
        return N @ t - b + rounding

    def go_on(state: Data) -> Array:
        t, active, _, entering, infeasible, count = state
        violated = (entering >= 0) | jnp.any(jnp.where(active, 0.0, slack(t)) < 0.0)
        return violated & ~infeasible & (count < 20 * c)

    def step(state: Data) -> Data:
        t, active, u, entering, _, count = state
        worst = jnp.argmin(jnp.where(active, jnp.inf, slack(t)))
        p = jnp.where(entering >= 0, entering, worst)
        L = linalg.tria(jnp.where(active[:, None], N, 0.0), jnp.diag(jnp.where(active, 0.0, 1.0)))
        z, r = N[p], jnp.zeros(2 * c)
        for _ in range(2):  # twice, so that z is orthogonal to the active rows
            share = linalg.solve_spd(L, jnp.where(active, N @ z, 0.0)[:, None])[:, 0]
            z, r = z - share @ N, r + share
        open_ = z @ z > 1e-14
        partial = jnp.where(active & (r > 1e-14), u / jnp.where(r > 1e-14, r, 1.0), jnp.inf)
        leaving = jnp.argmin(partial)
        full = jnp.where(open_, (b[p] - N[p] @ t) / jnp.where(open_, z @ z, 1.0), jnp.inf)
        length = jnp.minimum(full, partial[leaving])
        infeasible = jnp.isinf(length)
        length = jnp.where(infeasible, 0.0, length)
        t = t + jnp.where(open_, length, 0.0) * z
        u = (u - length * r).at[p].add(length)
        enters = full <= partial[leaving]
        active = jnp.where(enters, active.at[p].set(True), active.at[leaving].set(False))
        u = jnp.where(active | (jnp.arange(2 * c) == p), u, 0.0)
        return t, active, u, jnp.where(enters, no_row, p), infeasible, count + 1

    none = jnp.zeros(2 * c, bool)
    start = jnp.zeros(N.shape[1]), none, jnp.zeros(2 * c), no_row, jnp.zeros((), bool), 0
    end = jax.lax.while_loop(go_on, step, start)
    beyond = jnp.maximum(low, -high) > CONTRADICTS * size
    return end[1][:c], end[1][c:], end[4] | go_on((*end[:5], 0)), jnp.any(~free & beyond)


def truncate(belief: Belief, g: Function, lower: Given, upper: Given) -> Bounded:
    """Truncate the density to ``lower <= g(x) <= upper``; keep its mean and covariance.

    Row by row: z = D_i x is N(mu, s^2), truncated it has mean mu + s alpha and variance s^2 v, and
    the regression of the state on z stays (Simon & Simon 2010, sec. 2.4),

        x := x + P D_i' alpha / s,   S := S (I - (1 - v^1/2) a a'),   a = S' D_i' / s

    whose square is P - (1 - v) P D_i' D_i P / s^2: no variance grows. This is exact for one row and
    for uncorrelated rows; otherwise it depends on the order of rows. If no state is inside all
    bounds the belief is unchanged. Arguments and errors are those of `clip`.
    """
    o = _observed(belief, g)
    low = jnp.asarray(lower, float) + o.residual
    high = jnp.asarray(upper, float) + o.residual

    def scaled(bound: Array, mean: Array, s: Array) -> Array:
        finite = jnp.isfinite(bound)  # the derivative of inf / s is NaN
        return jnp.where(finite, (jnp.where(finite, bound, 0.0) - mean) / s, bound)

    def cut(state: tuple[Array, Array], row: tuple[Array, Array, Array, Array]):
        t, M = state
        reading, size, low, high = row
        a = reading @ M
        known = jnp.all(linalg.lost_in_rounding(a[None], size[None]))
        s = jnp.sqrt(jnp.where(known, 1.0, a @ a))
        a = jnp.where(known, 0.0, a / s)
        at = reading @ t
        alpha, v = truncated_moments(scaled(low, at, s), scaled(high, at, s))
        solid = v > 0.0
        root = jnp.where(solid, jnp.sqrt(jnp.where(solid, v, 1.0)), 0.0)
        column = M @ a
        return (t + alpha * column, M - (1.0 - root) * jnp.outer(column, a)), None

    n = belief.factor.shape[0]
    start = jnp.zeros(n), jnp.eye(n)
    (t, M), _ = jax.lax.scan(cut, start, (o.spread, o.size, low, high))
    S = belief.factor
    cut_belief = Belief(manifold.retract(belief.mean, S @ t), linalg.tria(S @ M))
    *_, infeasible, denied = _active(o, low, high)
    kept = select(infeasible, belief, cut_belief)
    return Bounded(kept, (low > 0.0) | (high < 0.0), infeasible | denied)


def truncated_moments(low: Array, high: Array) -> tuple[Array, Array]:
    """Mean and variance of a standard normal variable truncated to low <= z <= high.

    Computed by quadrature about the greatest density inside: the closed forms in erf obtain a
    variance of 1/low^2 from terms of low^2, and lose all digits at a hundred standard deviations.
    """
    peak = jnp.clip(0.0, low, high)
    reach = 2.0 * _FOLDS / (jnp.abs(peak) + jnp.sqrt(peak**2 + 2.0 * _FOLDS))
    left, right = jnp.maximum(low - peak, -reach), jnp.minimum(high - peak, reach)
    z = 0.5 * (left + right) + 0.5 * (right - left) * jnp.asarray(_NODES)
    mass = jnp.asarray(_WEIGHTS) * jnp.exp(-peak * z - 0.5 * z**2)
    mass = mass / jnp.sum(mass)
    mean = jnp.sum(mass * z)
    return peak + mean, jnp.minimum(jnp.sum(mass * (z - mean) ** 2), 1.0)
