"""Innovations in units of the noise, their power, and faded covariances, for fading rules."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike
from scipy.special import chdtri

from robins import linalg
from robins.errors import require
from robins.filters.belief import Belief, Number
from robins.filters.observation import Observation
from robins.filters.values import Numbers, number

Weights = ArrayLike | Sequence[Number] | None

_SOLID = 1e-6  # least pivot to divide by, as a share of a state's standard deviation
_FLOOR = 1e-10  # least deviation where pivots are smaller, as a share of the same


class WhitenedInnovation(NamedTuple):
    """Measurement whitened by R^-1/2, so that traces have no unit."""

    residual: Array  # (m,) R^-1/2 r
    spread: Array  # (m, n) R^-1/2 H S
    left_over: Array  # () trace of R^-1 Omega, the linearisation error
    counts: Array  # (m,) bool: used, and with noise of its own; the other rows are zero
    seen: Array  # (m, n) H S in the sensor's units
    size: Array  # (m,) magnitude of the summands of H S

    @property
    def predicted(self) -> Array:
        """Trace of R^-1 (H P H' + Omega)."""
        return jnp.sum(self.spread**2) + self.left_over

    @property
    def dof(self) -> Array:
        """Number of components, the trace of R^-1 R."""
        return jnp.sum(self.counts).astype(float)


def whitened(o: Observation) -> WhitenedInnovation:
    """Innovation and its predicted covariance in units of the noise, for components with noise."""
    root, counts = _root(o.noise, o.accepted & o.present)
    n = o.spread.shape[1]
    away = jnp.zeros_like(o.residual) if o.deficit is None else o.deficit
    columns = [o.residual[:, None], away[:, None], o.spread, o.excess]
    white = linalg.solve_lower(root, jnp.concatenate(columns, axis=1))
    left_over = jnp.sum(white[:, n + 2 :] ** 2) - jnp.sum(white[:, 1] ** 2)
    seen = jnp.where(counts[:, None], o.spread, 0.0)
    # A component may be a combination of others, as in a rotated vector: in units of the noise its
    # rounding is that of the largest.
    deviation = jnp.where(counts, jnp.sqrt(jnp.sum(o.noise**2, axis=1)), 1.0)
    largest = jnp.max(jnp.where(counts, o.size / deviation, 0.0))
    size = jnp.where(counts, jnp.maximum(o.size, largest * deviation), o.size)
    return WhitenedInnovation(white[:, 0], white[:, 2 : n + 2], left_over, counts, seen, size)


def _root(noise: Array, taken: Array) -> tuple[Array, Array]:
    """Factor of R without the rows not taken, safe to solve with, and the independent rows."""
    m = len(noise)
    kept = jnp.where(taken[:, None], noise, 0.0)
    if noise.shape[1] < m:
        return linalg.guard(kept)
    # The usual noise is a triangle, uncorrelated with missing components.
    square = kept[:, :m] + jnp.diag(jnp.where(taken, 0.0, 1.0))
    whole = jnp.concatenate([square, kept[:, m:]], axis=1)
    apart = ~jnp.any((kept[:, :m] != 0.0) & ~taken[None, :])
    pivots = jnp.where(jnp.eye(m, dtype=bool) & ~taken[None, :], jnp.inf, square)
    return jax.lax.cond(
        linalg.plainly_independent(whole) & apart,
        lambda: (pivots, taken),
        lambda: linalg.guard(kept),
    )


def averaged(power: Array, white: WhitenedInnovation, keep: Number) -> Array:
    """Exponential average of squared residuals; components that do not count are unchanged."""
    fresh = keep * power + (1.0 - keep) * white.residual**2
    return jnp.where(white.counts, fresh, power)


def significant(power: Array, white: WhitenedInnovation, keep: Number, sigmas: Number) -> Array:
    """() bool: averaged squares exceed their expectation by ``sigmas`` standard deviations.

    An average with weights (1 - keep) keep^i of squares of m unit normals has mean m and relative
    variance 2 (1 - keep) / ((1 + keep) m).
    """
    dof = jnp.maximum(white.dof, 1.0)
    deviation = jnp.sqrt(2.0 * (1.0 - keep) / (1.0 + keep)) / jnp.sqrt(dof)
    return exceeds(power, white, 1.0 + sigmas * deviation)


def exceeds(power: Array, white: WhitenedInnovation, level: Array) -> Array:
    """() bool: averaged squares exceed ``level`` times their expectation."""
    return power > level * (white.predicted + white.dof)


def chance_levels(keep: float, most: int, probability: float) -> np.ndarray:
    """(most + 1,) levels that the average of `significant` exceeds with a given probability.

    Entry m is for m squares, over their expectation. With weights w = (1 - keep) keep^i the first
    three cumulants follow from c_s = m sum w^s, s = 1, 2, 3. A chi-square variable of
    h = c_2^3 / c_3^2 degrees of freedom, shifted and scaled to the first two, has the third as well
    (Imhof, Biometrika 48, 1961, after Pearson 1959):

        level = 1 + (chi2_h^-1(1 - probability) - h) sqrt(c_2 / h) / m
    """
    m = np.arange(1.0, most + 1.0)
    if keep == 1.0:  # the average never moves
        return np.ones(most + 1)
    variance = (1.0 - keep) / (1.0 + keep)  # c_2 / m
    h = m * variance**3 * (1.0 + keep + keep**2) ** 2 / (1.0 - keep) ** 4
    levels = 1.0 + (chdtri(h, probability) - h) * np.sqrt(variance / (h * m))
    return np.concatenate([[np.inf], levels])


def total(power: Array, white: WhitenedInnovation) -> Array:
    """Trace of the averaged power."""
    return jnp.sum(jnp.where(white.counts, power, 0.0))


def fading_factor(N: Array, M: Array, limit: Number) -> Array:
    """Fading factor max(1, N / M), at most ``limit``; 1 where M is 0."""
    solid = M > 0.0
    return jnp.where(solid, jnp.clip(N / jnp.where(solid, M, 1.0), 1.0, limit), 1.0)


def seen_by(spread: Array, S: Array) -> Array:
    """H from S and the spread H S.

    If S is nearly singular, H = (H S) S' (S S')^-1 is computed with a floor under small deviations:
    for A in the range of S, H A errs by at most 1e-10 of a state's standard deviation. States may
    be known exactly.
    """
    sigma = jnp.sqrt(jnp.sum(S**2, axis=1))

    def solid():
        return linalg.solve_lower_transposed(S, spread.T).T

    def singular():
        L = linalg.tria(S, jnp.diag(jnp.where(sigma > 0.0, _FLOOR * sigma, 1.0)))
        return linalg.solve_lower_transposed(L, linalg.solve_lower(L, S) @ spread.T).T

    pivots = jnp.abs(jnp.diagonal(S))
    return jax.lax.cond(jnp.all(pivots > _SOLID * sigma), solid, singular)


def faded(
    S: Array, white: WhitenedInnovation, N: Array, form: str, weights: Numbers | None, limit: Number
) -> tuple[Array, Array]:
    """Factor S of P faded so that its share of the innovation has the power N, and lambda.

    Args:
        S: (n, n) factor of P.
        white: the measurement relative to S.
        N: () power of the whitened innovation beyond that of the noise.
        form: "lumped" lambda P, "multiple" Lam^1/2 P Lam^1/2, or "projected"
            P + (lambda - 1) P H' (H P H')^+ H P, by which only H P H' grows.
        weights: (n,) of states for "multiple", greatest 1; None: equal.
        limit: upper bound of lambda.
    """

    def wider() -> Array:
        # The added part is S T'T S' with T the orthonormal rows that span those of H S. `guard`
        # drops rows within rounding, such as the third of a unit vector.
        root, _ = linalg.guard(white.seen, white.size)
        T = linalg.solve_lower(root, white.seen)
        return linalg.tria(S + (jnp.sqrt(factor) - 1.0) * ((S @ T.T) @ T))

    if form != "multiple" or weights is None:
        factor = fading_factor(N, white.predicted, limit)
        if form != "projected":
            return jnp.sqrt(factor) * S, factor
        return jax.lax.cond(factor > 1.0, wider, lambda: S), factor
    each = jnp.sum((S @ white.spread.T) * seen_by(white.spread, S).T, axis=1)  # (P H' H)_jj
    factor = fading_factor(N, jnp.sum(weights * each) + white.left_over, limit)
    return jnp.sqrt(jnp.maximum(weights * factor, 1.0))[:, None] * S, factor


def checked_weights(rule: str, weights: Weights, form: str) -> Numbers | None:
    """Weights a_j of the states for the form "multiple", scaled so that the greatest is 1."""
    if weights is None:
        return None
    require(form == "multiple", f"{rule} weights are for 'multiple', not {form!r}")

    def sound(a: Numbers) -> bool:
        return bool(a.ndim == 1 and np.all(np.isfinite(a) & (a >= 0.0)) and np.any(a > 0.0))

    a = number(f"{rule} weights must be (n,) numbers >= 0, not all 0", weights, sound)
    return a / a.max()


def check_size(rule: str, a: Numbers | None, belief: Belief) -> None:
    """Refuse weights whose number is not that of the state's components."""
    n = belief.factor.shape[0]
    count = n if a is None else len(a)
    require(count == n, f"{rule} weights are {count}, the state has {n} components")
