r"""Fusion of beliefs, sharing of one belief among filters, and covariance intersection.

**Fuse** independent beliefs in information form, Y = P^-1 (Carlson 1990; Zhao, Li & Wang 2016,
eq. 3-4):

    Y_g = sum_i Y_i        x_g = Y_g^-1 sum_i Y_i x_i

solved as a least squares problem, min over x of sum_i |S_i^-1 (x - x_i)|^2: one QR of the rows
S_i^-1 and their right-hand sides, and triangular solves. Means are expressed as deviations from the
first one, so angles may lie on either side of +-pi.

**Share** so that fusion restores the belief. With shares A_i = diag(a_i), sum_i A_i = I:

    scalar   P_i = P / b_i                     one share b_i for all states
    root     P_i = B A_i^-1 B',  B B' = P      sum_i Y_i = Y for any shares
    half     P_i = A_i^-1/2 P A_i^-1/2         keeps the diagonal of Y only, adds information

Any root B conserves the information. Here B = D C^1/2 with D the standard deviations and C the
correlation matrix: the result is independent of units, and each share acts on its own state as
nearly as a root allows (C^1/2 is the root of C nearest to the identity).

**Intersect** beliefs whose errors have an unknown correlation (Julier & Uhlmann 1997):
Y = sum_i w_i Y_i, sum_i w_i = 1; Y^-1 is an upper bound of the covariance for every correlation.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike

from robins import linalg, manifold
from robins.errors import require
from robins.filters.belief import Belief
from robins.filters.checks import one_of
from robins.filters.model import Given
from robins.filters.values import is_known

Sharing = Literal["scalar", "root", "half"]
Criterion = Literal["trace", "det"]

NAIVE = (
    "sharing='naive', P_i = A_i^-1 P, is no covariance: A_i^-1 P is asymmetric, and often "
    "indefinite once made symmetric; use 'root', or 'scalar' with one share for all states"
)


# ------------------------------------------------------------------------------------------- fuse


def fuse(beliefs: Sequence[Belief]) -> Belief:
    """Belief from several with independent errors, by an information sum.

    Each covariance is used in the tangent space of its own mean without transport, as in an update;
    where means differ by a rotation of d [rad], its relative error is of order d^2.

    Args:
        beliefs: beliefs of the same state at the same time.

    Raises:
        ValueError: there is none, or a covariance is singular: infinite information has no sum.
    """
    beliefs = _checked_beliefs(beliefs, "fuse")
    return information_sum(beliefs)


def _checked_beliefs(beliefs: Sequence[Belief], doing: str) -> list[Belief]:
    beliefs = list(beliefs)
    require(beliefs, f"nothing to {doing}: at least one belief is wanted")
    if is_known(beliefs):
        for i, belief in enumerate(beliefs):
            if bool(is_singular(belief)):
                raise ValueError(
                    f"cannot {doing} belief {i}: its covariance is singular, so its information "
                    "is infinite; where a constraint made it so, give the constraint noise or "
                    "apply it after fusion"
                )
    return beliefs


def is_singular(belief: Belief) -> Array:
    """True if a combination of states is known exactly, to rounding."""
    pivots = jnp.diagonal(linalg.lost_in_rounding(belief.factor, belief.sigma))
    return jnp.any(pivots)


@jax.jit
def information_sum(beliefs: Sequence[Belief], weights: Array | None = None) -> Belief:
    """`fuse` without checks, each information matrix times its weight if weights are given.

    A singular covariance gives infinities or NaN.
    """
    first = beliefs[0]
    aways = [manifold.local(first.mean, belief.mean) for belief in beliefs]
    away, factor = _summed([belief.factor for belief in beliefs], aways, weights)
    return Belief(manifold.retract(first.mean, away), factor)


@partial(jax.jit, static_argnames="common")
def common_information_sum(beliefs: Sequence[Belief], common: int) -> Belief:
    """`information_sum` of the first ``common`` tangent components; the others from ``beliefs[0]``.

    The marginals x_ic, P_icc of all beliefs are summed. The other components of the first belief,
    x_w, keep their conditional distribution given the common components c:

        G = P_1wc P_1cc^-1,   x_w = x_1w + G (x_c - x_1c),   P_w = G P_c G' + (P_1ww - G P_1cw)

    With a lower factor [[S_c, 0], [S_wc, S_w]] that is G = S_wc S_c^-1, and S_w stays.
    """
    first = beliefs[0]
    aways = [manifold.local(first.mean, belief.mean)[:common] for belief in beliefs]
    factors = [belief.factor[:common, :common] for belief in beliefs]
    away, factor = _summed(factors, aways, None)
    S = first.factor
    G = linalg.solve_lower_transposed(S[:common, :common], S[common:, :common].T).T
    top = jnp.concatenate([factor, jnp.zeros_like(S[:common, common:])], axis=1)
    rest = jnp.concatenate([G @ factor, S[common:, common:]], axis=1)
    mean = manifold.retract(first.mean, jnp.concatenate([away, G @ away]))
    return Belief(mean, jnp.concatenate([top, rest]))


def _summed(
    factors: Sequence[Array], aways: Sequence[Array], weights: Array | None
) -> tuple[Array, Array]:
    """Deviation (n,) and factor (n, n) of an information sum, from those of its terms."""
    n = factors[0].shape[0]
    columns = []
    for i, (factor, away) in enumerate(zip(factors, aways, strict=True)):
        wide = jnp.concatenate([jnp.eye(n), away[:, None]], axis=1)
        rows = linalg.solve_lower(factor, wide)  # S^-1 and S^-1 times the deviation
        if weights is not None:
            rows = rows * jnp.sqrt(weights[i])
        # States in reverse, so that the triangle's inverse, turned back, is lower again.
        columns.append(jnp.concatenate([rows[:, n - 1 :: -1], rows[:, n:]], axis=1).T)
    triangle = linalg.tria(*columns)
    wide = jnp.concatenate([jnp.eye(n), triangle[n, :n, None]], axis=1)
    solved = linalg.solve_lower_transposed(triangle[:n, :n], wide)
    return solved[::-1, n], solved[::-1, n - 1 :: -1]


# ------------------------------------------------------------------------------------------ share


def share(belief: Belief, shares: Given, sharing: Sharing = "root") -> tuple[Belief, ...]:
    """Divide a belief into N with the same mean, each with its share of the information.

    Args:
        belief: belief to divide.
        shares: (N,), or (N, n) for one share per state; positive, without unit. `fuse` restores the
            belief if they sum to one, except with ``sharing="half"``.
        sharing: "root", "scalar" or "half" (module docstring).

    Raises:
        ValueError: the sharing is unknown or "naive", shares are of another shape or not positive,
            or scalar sharing was given shares per state.
    """
    check_sharing(sharing)
    n = belief.factor.shape[0]
    if is_known(shares):
        shares = np.asarray(shares, dtype=float)
        if not np.all((shares > 0.0) & (shares < np.inf)):
            raise ValueError(f"shares must be positive numbers, got {shares.tolist()}")
    a = jnp.asarray(shares, float)
    a = a[:, None] if a.ndim == 1 else a
    if a.ndim != 2 or a.shape[1] not in (1, n):
        raise ValueError(f"shares have shape {a.shape}: (N,) or (N, {n}) is wanted")
    if sharing == "scalar" and a.shape[1] != 1:
        raise ValueError("scalar sharing takes one share a filter: use 'root' for one a state")
    parts = part(belief.factor, a, sharing)
    return tuple(Belief(belief.mean, factor) for factor in parts)


def check_sharing(sharing: str) -> None:
    """Refuse an unknown way of sharing, or "naive"."""
    require(sharing != "naive", NAIVE)
    one_of("sharing", sharing, Sharing)


def part(factor: Array, shares: Array, sharing: Sharing) -> list[Array]:
    """Factors of the parts of a covariance of a belief or of noise.

    Args:
        factor: (n, k).
        shares: (N, 1) or (N, n).
        sharing: "root", "scalar" or "half".
    """
    if shares.shape[1] == 1 or sharing == "half":
        # Scale the rows; with one share for all states every way of sharing is this one.
        return [factor / jnp.sqrt(a)[:, None] for a in shares]
    n, k = factor.shape
    square = factor if n == k else linalg.tria(factor)
    root = square @ _to_symmetric(square)
    return [linalg.tria(root / jnp.sqrt(a)[None, :]) for a in shares]


def _halley_weights(least: float) -> list[tuple[float, float, float]]:
    """Weights (a, b, c) of Halley's iterations that bring singular values in [least, 1] to one."""
    weights = []
    while least < 1.0 - 1e-15:
        d = (4.0 * (1.0 - least**2) / least**4) ** (1.0 / 3.0)
        s = math.sqrt(1.0 + d)
        a = s + 0.5 * math.sqrt(8.0 - 4.0 * d + 8.0 * (2.0 - least**2) / (least**2 * s))
        b = (a - 1.0) ** 2 / 4.0
        c = a + b - 1.0
        weights.append((a, b, c))
        least = min(1.0, least * (a + b * least**2) / (1.0 + c * least**2))
    return weights


# A smaller singular value stems from a correlation that differs from one by rounding alone.
_WEIGHTS = _halley_weights(1e-10)


@jax.jit
def _to_symmetric(factor: Array) -> Array:
    """Orthogonal matrix W that makes D^-1 factor W symmetric, D the norms of the rows.

    It is the orthogonal polar factor of (D^-1 factor)', found by Halley's iteration with dynamic
    weights (Nakatsukasa, Bai & Gygi 2010) for three reasons: W is orthogonal to rounding, so that
    no information is lost even for a nearly singular covariance; its derivatives do not divide by
    differences of eigenvalues, which are zero for P = I; and it needs only Cholesky factors.
    """
    n = factor.shape[0]
    square = jnp.sum(factor**2, axis=1)
    length = jnp.sqrt(jnp.where(square > 0.0, square, 1.0))
    X = (factor / length[:, None]).T / math.sqrt(n)  # rows of length one: |X| <= 1

    def step(X: Array, weights: Array) -> tuple[Array, None]:
        a, b, c = weights
        lower = linalg.cholesky(jnp.eye(n) + c * (X.T @ X))
        return (b / c) * X + (a - b / c) * linalg.solve_spd(lower, X.T).T, None

    return jax.lax.scan(step, X, jnp.asarray(_WEIGHTS))[0]


# -------------------------------------------------------------------------------------- intersect

_BARRIERS = [10.0**-k for k in range(11) for _ in range(2)]


def covariance_intersection(
    beliefs: Sequence[Belief], criterion: Criterion | ArrayLike | Sequence[float] = "trace"
) -> Belief:
    """Belief from several, consistent whatever the correlation of their errors.

    Weights are found by Newton's method with a logarithmic barrier, in a fixed number of steps;
    both criteria are convex in them. A belief that another one dominates keeps a weight of about
    1e-10.

    Args:
        beliefs: beliefs of the same state at the same time.
        criterion: quantity to minimise: "trace" of the covariance, in units of the smallest
            standard deviation of each state in any belief; "det", its determinant; or (N,) weights,
            not negative, which sum to one.

    Raises:
        ValueError: there is no belief, one is singular, or the criterion is none of these.
    """
    beliefs = _checked_beliefs(beliefs, "intersect")
    return information_sum(beliefs, intersection_weights(beliefs, criterion))


def intersection_weights(
    beliefs: Sequence[Belief], criterion: str | ArrayLike | Sequence[float]
) -> Array:
    """(N,) weights of `covariance_intersection`."""
    check_criterion(criterion, len(beliefs))
    if not isinstance(criterion, str):
        return jnp.asarray(criterion, float)
    return _best_weights(list(beliefs), criterion)


@partial(jax.jit, static_argnames="criterion")
def _best_weights(beliefs: list[Belief], criterion: Criterion) -> Array:
    slopes = _SLOPES[criterion]
    count, n = len(beliefs), beliefs[0].factor.shape[0]
    unit = jnp.min(jnp.stack([b.sigma for b in beliefs]), axis=0)
    inverse = [linalg.solve_lower(b.factor / unit[:, None], jnp.eye(n)) for b in beliefs]
    Y = jnp.stack([one.T @ one for one in inverse])

    def newton(w: Array, barrier: Array) -> Array:
        lower = linalg.cholesky(jnp.einsum("i,ijk->jk", w, Y))
        half = jax.vmap(lambda one: linalg.solve_lower(lower, one))(Y)
        X = jax.vmap(lambda one: linalg.solve_lower(lower, one.T))(half)
        slope, bend = slopes(X, lower)
        slope = slope - barrier / w
        both = linalg.solve_spd(
            linalg.cholesky(bend + jnp.diag(barrier / w**2)), jnp.stack([slope, jnp.ones(count)], 1)
        )
        move = -both[:, 0] + both[:, 1] * jnp.sum(both[:, 0]) / jnp.sum(both[:, 1])
        longest = 0.9 / jnp.maximum(jnp.max(-move / w), 0.9)
        w = w + longest * move
        return w / jnp.sum(w)

    steps = jnp.asarray(_BARRIERS)
    return jax.lax.scan(lambda w, b: (newton(w, b), None), jnp.full(count, 1.0 / count), steps)[0]


def check_criterion(criterion: str | Given, count: int) -> None:
    """Refuse an unknown criterion, or weights that are negative or do not sum to one."""
    if isinstance(criterion, str):
        if criterion not in _SLOPES:
            raise ValueError(f"criterion must be 'trace', 'det' or weights, got {criterion!r}")
        return
    if np.shape(criterion) != (count,):
        raise ValueError(
            f"weights have shape {np.shape(criterion)}: one for each of {count} beliefs is wanted"
        )
    if is_known(criterion):
        w = np.asarray(criterion, dtype=float)
        if not (np.all(w >= 0.0) and abs(w.sum() - 1.0) < 1e-9):
            raise ValueError(f"weights must not be negative and must sum to one, got {w.tolist()}")


def _det_slopes(X: Array, lower: Array) -> tuple[Array, Array]:
    """First and second derivatives of log det P, X_i = L^-1 Y_i L'^-1 with L L' = P^-1."""
    return -jnp.trace(X, axis1=1, axis2=2), jnp.einsum("ijk,ljk->il", X, X)


def _trace_slopes(X: Array, lower: Array) -> tuple[Array, Array]:
    """First and second derivatives of trace P, divided by its present value."""
    inverse = linalg.solve_lower(lower, jnp.eye(lower.shape[0]))
    K = inverse @ inverse.T
    size = jnp.trace(K)
    slope = -jnp.einsum("ijk,jk->i", X, K) / size
    bend = 2.0 * jnp.einsum("ijk,lkm,jm->il", X, X, K) / size
    return slope, 0.5 * (bend + bend.T)


_SLOPES: dict[str, Callable[[Array, Array], tuple[Array, Array]]] = {
    "trace": _trace_slopes,
    "det": _det_slopes,
}
