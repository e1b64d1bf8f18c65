"""Factor algebra on ordinary arrays, one small matrix at a time (batch with `jax.vmap`)."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, ArrayLike, Float

from robins import _float64  # noqa: F401

# A pivot below this share of its row's length is rounding: the row depends on those above it.
# QR errs by a few 1e-16 of the row's length; 1e-14 leaves room for sizes up to about 50.
DEPENDENT = 1e-14


def identity(n: int) -> Float[Array, "n n"]:
    """The n x n identity."""
    return jnp.eye(n)


def zeros(m: int, n: int) -> Float[Array, "m n"]:
    """An m x n matrix of zeros."""
    return jnp.zeros((m, n))


def where(condition, a, b):
    """Choose a or b by one scalar condition."""
    return jnp.where(condition, a, b)


def tria(*blocks: Float[Array, "n _"]) -> Float[Array, "n n"]:
    """Lower-triangular L, diagonal not negative, with ``L L' = sum of B B'`` over the blocks.

    One QR of the transposed row of blocks: no product is formed, so a covariance keeps full
    relative accuracy down to factors 1e-16 apart (Bierman 1977, ch. 4; Kaminski et al. 1971).
    """
    wide = blocks[0] if len(blocks) == 1 else jnp.concatenate(blocks, axis=1)
    n, k = wide.shape
    if k < n:
        wide = jnp.concatenate([wide, jnp.zeros((n, n - k))], axis=1)
    upper = jnp.linalg.qr(wide.T, mode="r")
    sign = jnp.where(jnp.diagonal(upper) < 0.0, -1.0, 1.0)
    return upper.T * sign[None, :]


def block_factor(
    spread: Float[Array, "m n"],
    noise: Sequence[Float[Array, "m _"]],
    S: Float[Array, "n n"],
    deficit: Float[Array, "m"] | None = None,
) -> tuple[Float[Array, "m m"], Float[Array, "n m"], Float[Array, "n n"]]:
    """Triangularise ``[[spread, noise], [S, 0]]`` and return the blocks of ``[[X, 0], [Y, Z]]``.

    With spread = H S and noise = R^1/2 this is one square-root Kalman update: X is the factor of
    the innovation covariance, Y X^-1 the gain, Z the posterior factor (Kaminski, Bryson, Schmidt
    1971). A deficit v is taken away again: ``[spread, noise][..]' - v v'``.
    """
    m, n = spread.shape
    blank = jnp.zeros((n, sum(block.shape[1] for block in noise)))
    top = jnp.concatenate([spread, *noise], axis=1)
    bottom = jnp.concatenate([S, blank], axis=1)
    full = tria(jnp.concatenate([top, bottom], axis=0))
    if deficit is not None:
        full = downdate(full, jnp.concatenate([deficit, jnp.zeros(n)]))
    return full[:m, :m], full[m:, :m], full[m:, m:]


def cholesky(P: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Lower Cholesky factor; all NaN where P is not positive definite."""
    return jnp.linalg.cholesky(P)


def symmetric_root(P: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """The symmetric positive semidefinite root of P; negative rounding becomes zero."""
    value, vector = jnp.linalg.eigh(P)
    return (vector * jnp.sqrt(jnp.maximum(value, 0.0))) @ vector.T


def downdate(L: Float[Array, "n n"], v: Float[Array, "n"]) -> Float[Array, "n n"]:
    """Lower factor of ``L L' - v v'``; all NaN where that is not positive definite.

    Written as ``L chol(I - p p')`` with p = L^-1 v: the subtraction meets numbers of order one
    however badly L is scaled.
    """
    p = solve_lower(L, v[:, None])
    return L @ jnp.linalg.cholesky(jnp.eye(L.shape[0]) - p @ p.T)


def solve_lower(L: Float[Array, "n n"], B: Float[Array, "n k"]) -> Float[Array, "n k"]:
    """``L^-1 B`` for lower-triangular L."""
    return solve_triangular(L, B, lower=True)


def solve_lower_transposed(L: Float[Array, "n n"], B: Float[Array, "n k"]) -> Float[Array, "n k"]:
    """``L^-T B`` for lower-triangular L."""
    return solve_triangular(L, B, lower=True, trans=1)


def solve_spd(L: Float[Array, "n n"], B: Float[Array, "n k"]) -> Float[Array, "n k"]:
    """``(L L')^-1 B`` for lower-triangular L."""
    return solve_lower_transposed(L, solve_lower(L, B))


def guard(L: Float[Array, "n n"]) -> tuple[Float[Array, "n n"], Array]:
    """Make a lower factor of a perhaps singular covariance safe to solve with.

    A row that depends on those above it (pivot lost in rounding) carries no information of its own.
    Its pivot becomes infinite, so that solving gives exactly zero there, which is the limit of a
    pseudo-inverse; the second result says which rows are independent.
    """
    pivot = jnp.abs(jnp.diagonal(L))
    length = jnp.sqrt(jnp.sum(L * L, axis=1))
    independent = pivot > DEPENDENT * length
    safe = jnp.where(independent, jnp.diagonal(L), jnp.inf)
    n = L.shape[0]
    return jnp.where(jnp.eye(n, dtype=bool), safe[:, None], L), independent


def log_diagonal(L: Float[Array, "n n"], include: Array) -> Float[Array, ""]:
    """Sum of the logarithms of the chosen diagonal entries (half a log-determinant)."""
    pivot = jnp.where(include, jnp.abs(jnp.diagonal(L)), 1.0)
    return jnp.sum(jnp.log(pivot))


def eigenvalue_bounds(P: Float[Array, "n n"]) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Least and greatest eigenvalue of a symmetric matrix."""
    value = jnp.linalg.eigvalsh(P)
    return value[0], value[-1]


def as_factor(noise: Array) -> Array:
    """A vector of standard deviations becomes a diagonal factor; a matrix passes."""
    return jnp.diag(noise) if jnp.ndim(noise) == 1 else noise


def factor(P: ArrayLike, name: str = "covariance") -> Float[Array, "n n"]:
    """Lower factor of a symmetric positive *semi*definite matrix, at the boundary.

    For use outside compiled code: it looks at the numbers. Zero rows and exactly dependent rows are
    welcome (Q of rank one, P0 = 0). The matrix is scaled to unit diagonal first, so variances of
    very different units do not drown each other.

    Args:
        P: (n, n) covariance.
        name: what to call it in an error.

    Raises:
        ValueError: P is not square, finite and symmetric, or has a negative eigenvalue.
    """
    P_ = np.asarray(P, dtype=float)
    if P_.ndim != 2 or P_.shape[0] != P_.shape[1]:
        raise ValueError(f"{name} has shape {P_.shape}; a square matrix is wanted")
    if not np.all(np.isfinite(P_)):
        raise ValueError(f"{name} has entries that are not finite numbers")
    size = np.sqrt(np.abs(np.diag(P_)))
    scale = np.where(size > 0.0, size, 1.0)
    unit = P_ / np.outer(scale, scale)
    if np.max(np.abs(unit - unit.T), initial=0.0) > 1e-9:
        raise ValueError(f"{name} is not symmetric: mend it with (P + P.T) / 2 if this is rounding")
    value, vector = np.linalg.eigh((unit + unit.T) / 2.0)
    if value.size and value[0] < -1e-10 * max(1.0, value[-1]):
        raise ValueError(
            f"{name} is not positive semidefinite: its least scaled eigenvalue is {value[0]:.3g}"
        )
    try:
        root = np.linalg.cholesky((unit + unit.T) / 2.0)
    except np.linalg.LinAlgError:
        root = vector * np.sqrt(np.maximum(value, 0.0))
    return tria(jax.device_put(scale[:, None] * root))
