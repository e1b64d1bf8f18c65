"""Factor algebra on ordinary arrays, one small matrix at a time (batch with `jax.vmap`)."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.scipy.linalg import expm, solve_triangular
from jaxtyping import Array, ArrayLike, Bool, Float

from robins import _float64  # noqa: F401  # pyright: ignore[reportUnusedImport]  for its effect
from robins.errors import require

# A residual below this share of a row's norm is rounding: the row depends on those above it.
# Orthogonalisation errs by a few 1e-16 of the norm; 1e-14 leaves room for sizes up to about 50.
DEPENDENT = 1e-14

# Rows up to which a loop is unrolled: faster for a measurement, slow to compile for a state.
UNROLLED = 4


def block_diagonal(a: Float[Array, "m k"], b: Float[Array, "n l"]) -> Float[Array, "m+n k+l"]:
    """Block-diagonal matrix: factor of independent states, or transition of uncoupled ones."""
    right, left = jnp.zeros((a.shape[0], b.shape[1])), jnp.zeros((b.shape[0], a.shape[1]))
    return jnp.concatenate(
        [jnp.concatenate([a, right], axis=1), jnp.concatenate([left, b], axis=1)]
    )


def _require_square(name: str, given: ArrayLike, rows: int | None = None) -> None:
    shape = np.shape(given)
    wanted = "a square matrix" if rows is None else f"({rows}, {rows})"
    fits = len(shape) == 2 and shape[0] == shape[1] and rows in (None, shape[0])
    require(fits, f"{name} has shape {shape}; {wanted} is wanted")


def tria(*blocks: Float[Array, "n _"]) -> Float[Array, "n n"]:
    """Lower-triangular L, diagonal not negative, with ``L L' = sum of B B'`` over the blocks.

    One QR of the transposed row of blocks: no product is formed, so a covariance keeps full
    relative accuracy down to factors 1e-16 apart (Bierman 1977, ch. 4; Kaminski et al. 1971).
    Derivatives stay finite where the covariance is singular.
    """
    wide = blocks[0] if len(blocks) == 1 else jnp.concatenate(blocks, axis=1)
    n, k = wide.shape
    if k < n:
        wide = jnp.concatenate([wide, jnp.zeros((n, n - k))], axis=1)
    return _triangle(wide)


@jax.custom_jvp
def _triangle(wide: Array) -> Array:
    upper = jnp.linalg.qr(wide.T, mode="r")
    return upper.T * _signs(upper)[None, :]


def _signs(upper: Array) -> Array:
    return jnp.where(jnp.diagonal(upper) < 0.0, -1.0, 1.0)


@_triangle.defjvp
def _triangle_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    # With A = L Q' the change is dL = dA Q + L W, W = Q' dQ skew and such that dL is lower
    # triangular. Pivots lost in rounding contribute no rotation; JAX's own rule divides by them.
    (wide,), (slope,) = primals, tangents
    Q, upper = jnp.linalg.qr(wide.T)
    sign = _signs(upper)[None, :]
    L = upper.T * sign
    slide = slope @ (Q * sign)
    length = jnp.sqrt(jnp.sum(L * L, axis=1))
    solid = jnp.abs(jnp.diagonal(L)) > DEPENDENT * length
    pivot = jnp.where(solid, jnp.diagonal(L), jnp.inf)
    ratio = solve_lower(_with_diagonal(L, pivot), slide)
    turn = jnp.triu(ratio, 1)
    return L, jnp.tril(slide + L @ (turn.T - turn))


def _with_diagonal(L: Array, diagonal: Array) -> Array:
    return jnp.where(jnp.eye(L.shape[0], dtype=bool), diagonal[:, None], L)


def independent_rows(
    rows: Float[Array, "m k"], size: Float[Array, "m"] | None = None
) -> Bool[Array, "m"]:
    """Mask of the rows independent of those above them, to rounding; a zero row is dependent.

    A row that is not finite counts as independent, so that a fault is not taken for a dependence.
    Gram-Schmidt, each row twice (Parlett 1998, sec. 6.9). QR without row exchange cannot decide:
    past a lost pivot its later ones are arbitrary.

    Args:
        rows: (m, k), each with its own scale.
        size: (m,) magnitude of the terms summed into each row, if larger than the row.
    """
    m = rows.shape[0]
    rows = jax.lax.stop_gradient(rows)
    length = jnp.max(jnp.abs(rows), axis=1, initial=0.0)
    unit = jnp.where(length > 0.0, length, 1.0)
    rows = rows / unit[:, None]
    floor = jnp.full(m, DEPENDENT)
    if size is not None:
        floor = jnp.maximum(DEPENDENT, DEPENDENT * jax.lax.stop_gradient(size) / unit)

    def orthogonalise(row: Array, least: Array, basis: Array, weight: Array):
        rest = row
        for _ in range(2):
            rest = rest - (weight * (basis @ rest)) @ basis
        left = rest @ rest
        solid = ~(left <= least**2)
        return rest, jnp.where(solid, 1.0 / jnp.where(solid, left, 1.0), 0.0), solid

    if m > UNROLLED:

        def body(i: Array, state: tuple[Array, Array, Array]) -> tuple[Array, ...]:
            found = orthogonalise(rows[i], floor[i], *state[:2])
            return tuple(x.at[i].set(f) for x, f in zip(state, found, strict=True))

        state = jnp.zeros_like(rows), jnp.zeros(m), jnp.zeros(m, dtype=bool)
        return jax.lax.fori_loop(0, m, body, state)[2]

    basis, weight, independent = rows[:0], jnp.zeros(0), []
    for row, least in zip(rows, floor, strict=True):
        rest, share, solid = orthogonalise(row, least, basis, weight)
        basis = jnp.concatenate([basis, rest[None]])
        weight = jnp.append(weight, share)
        independent.append(solid)
    return jnp.stack(independent)


def plainly_independent(rows: Float[Array, "m k"]) -> Bool[Array, ""]:
    """True if rows are lower triangular with a solid diagonal, and so plainly independent."""
    m, k = rows.shape
    if k < m:
        return jnp.zeros((), bool)
    rows = jax.lax.stop_gradient(rows)
    pivot = jnp.abs(jnp.diagonal(rows))
    solid = pivot > DEPENDENT * jnp.max(jnp.abs(rows), axis=1, initial=0.0)
    return jnp.all(solid) & ~jnp.any(jnp.triu(rows, 1) != 0.0)


def lost_in_rounding(rows: Float[Array, "m k"], size: Float[Array, "m"]) -> Bool[Array, "m k"]:
    """Mask of entries that are rounding relative to the terms summed into their row (`size`)."""
    return jnp.abs(rows) <= DEPENDENT * size[:, None]


def block_factor(
    spread: Float[Array, "m n"],
    noise: Sequence[Float[Array, "m _"]],
    S: Float[Array, "n n"],
    deficit: Float[Array, "m"] | None = None,
) -> tuple[Float[Array, "m m"], Float[Array, "n m"], Float[Array, "n n"]]:
    """Triangularise ``[[spread, noise], [S, 0]]`` and return the blocks of ``[[X, 0], [Y, Z]]``.

    With spread = H S and noise = R^1/2 this is one square-root Kalman update: X is the factor of
    the innovation covariance, Y X^-1 the gain, Z the posterior factor (Kaminski, Bryson, Schmidt
    1971). A deficit v is subtracted: ``[spread, noise][..]' - v v'``.
    """
    m, n = spread.shape
    blank = jnp.zeros((n, sum(block.shape[1] for block in noise)))
    top = jnp.concatenate([spread, *noise], axis=1)
    bottom = jnp.concatenate([S, blank], axis=1)
    full = tria(jnp.concatenate([top, bottom], axis=0))
    if deficit is not None:
        full = downdate(full, jnp.concatenate([deficit, jnp.zeros(n)]))
    return full[:m, :m], full[m:, :m], full[m:, m:]


@jax.custom_jvp
def cholesky(P: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Lower Cholesky factor; all NaN, its derivatives zero, where P is not positive definite.

    Raises:
        ValueError: P is not square.
    """
    _require_square("P", P)
    n = P.shape[0]
    if n > UNROLLED:
        return jnp.linalg.cholesky(P)
    L: list[list[Array]] = []
    pivots = []
    for i in range(n):
        row: list[Array] = []
        for j in range(i + 1):
            rest = P[i, j] - sum((a * b for a, b in zip(row, (*L, row)[j], strict=False)), 0.0)
            row.append(jnp.sqrt(rest) if i == j else rest / L[j][j])
            pivots += [rest] if i == j else []
        L.append(row)
    blank = jnp.zeros(())
    lower = jnp.stack([jnp.stack([*row, *[blank] * (n - len(row))]) for row in L])
    positive = jnp.all(jnp.stack(pivots) > 0.0)
    return jnp.where(positive, lower, jnp.nan)


@cholesky.defjvp
def _cholesky_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    # dL = L W, W the lower half of L^-1 dP L'^-1 (Murray 2016). A failed factorisation must not
    # make other gradients NaN: there L is replaced before it is divided by.
    (P,), (slope,) = primals, tangents
    L = cholesky(P)
    sound = jnp.all(jnp.isfinite(L))
    solid = jnp.where(sound, L, jnp.eye(P.shape[0]))
    W = solve_lower(solid, solve_lower(solid, 0.5 * (slope + slope.T)).T)
    W = jnp.tril(W) - 0.5 * jnp.diag(jnp.diagonal(W))
    return L, jnp.where(sound, solid @ W, 0.0)


def symmetric_root(P: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Symmetric positive semidefinite square root of P; negative eigenvalues become zero.

    Raises:
        ValueError: P is not square.
    """
    _require_square("P", P)
    value, vector = jnp.linalg.eigh(P)
    return (vector * jnp.sqrt(jnp.maximum(value, 0.0))[None, :]) @ vector.T


def downdate(L: Float[Array, "n n"], v: Float[Array, "n"]) -> Float[Array, "n n"]:
    """Lower factor of ``L L' - v v'``; all NaN if that is not a covariance.

    Computed as ``L chol(I - p p')`` with L p = v: the subtraction is between numbers of order one
    however badly L is scaled, and L may be singular as long as v is in its range.
    """
    solid, _ = guard(L)
    p = solve_lower(solid, L).T @ solve_lower(solid, v[:, None])
    beyond = jnp.abs(v - (L @ p)[:, 0]) > 1e-10 * jnp.sqrt(jnp.sum(L * L, axis=1))
    root = cholesky(jnp.eye(L.shape[0]) - p @ p.T)
    # Replaced before the product, whose gradient it would make NaN.
    sound = jnp.all(jnp.isfinite(root))
    lower = L @ jnp.where(sound, root, jnp.eye(L.shape[0]))
    return jnp.where(jnp.any(beyond) | ~sound, jnp.nan, lower)


def solve_lower(L: Float[Array, "n n"], B: Float[Array, "n k"]) -> Float[Array, "n k"]:
    """``L^-1 B`` for lower-triangular L."""
    n = L.shape[0]
    if n > UNROLLED:
        return solve_triangular(L, B, lower=True)
    X: list[Array] = []
    for i in range(n):
        X.append((B[i] - sum((L[i, j] * x for j, x in enumerate(X)), 0.0)) / L[i, i])
    return jnp.stack(X)


def solve_lower_transposed(L: Float[Array, "n n"], B: Float[Array, "n k"]) -> Float[Array, "n k"]:
    """``L^-T B`` for lower-triangular L."""
    n = L.shape[0]
    if n > UNROLLED:
        return solve_triangular(L, B, lower=True, trans=1)
    X: dict[int, Array] = {}
    for i in reversed(range(n)):
        X[i] = (B[i] - sum((L[j, i] * x for j, x in X.items()), 0.0)) / L[i, i]
    return jnp.stack([X[i] for i in range(n)])


def solve_spd(L: Float[Array, "n n"], B: Float[Array, "n k"]) -> Float[Array, "n k"]:
    """``(L L')^-1 B`` for lower-triangular L."""
    return solve_lower_transposed(L, solve_lower(L, B))


def guard(
    factor: Float[Array, "n k"], size: Float[Array, "n"] | None = None
) -> tuple[Float[Array, "n n"], Bool[Array, "n"]]:
    """Lower factor of a perhaps singular covariance, safe to solve with.

    A row that depends on those above it carries no information of its own. It is left out: its
    pivot is infinite, so that solving gives exactly zero there, which is the limit of a
    pseudo-inverse; the second result is the mask of independent rows.

    Args:
        factor: (n, k), each row with its own scale.
        size: (n,) magnitude of the terms summed into each row, if larger than the row.
    """
    independent = independent_rows(factor, size)
    kept = jnp.where(independent[:, None], factor, 0.0)
    # A column of its own for a row left out, so that it stays uncorrelated with the rest.
    L = tria(kept, jnp.diag(jnp.where(independent, 0.0, 1.0)))
    return _with_diagonal(L, jnp.where(independent, jnp.diagonal(L), jnp.inf)), independent


def log_diagonal(L: Float[Array, "n n"], include: Array) -> Float[Array, ""]:
    """Sum of the logarithms of the chosen diagonal entries (half a log-determinant)."""
    pivot = jnp.where(include, jnp.abs(jnp.diagonal(L)), 1.0)
    return jnp.sum(jnp.log(pivot))


def eigenvalue_bounds(P: Float[Array, "n n"]) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Least and greatest eigenvalue of a symmetric matrix.

    Raises:
        ValueError: P is not square, or has no rows.
    """
    _require_square("P", P)
    require(P.shape[0], "P has no rows, so no eigenvalue")
    value = jnp.linalg.eigvalsh(P)
    return value[0], value[-1]


def as_factor(noise: Array) -> Array:
    """Diagonal factor of a vector of standard deviations; a matrix is returned unchanged."""
    return jnp.diag(noise) if jnp.ndim(noise) == 1 else noise


def factor(P: ArrayLike, name: str = "covariance") -> Float[Array, "n n"]:
    """Lower factor of a symmetric positive *semi*definite matrix from a user, checked.

    Not for compiled code: it reads the numbers. Zero rows and exactly dependent rows are allowed (Q
    of rank one, P0 = 0). The matrix is scaled to unit diagonal first, so that variances in very
    different units do not swamp each other.

    Args:
        P: (n, n) covariance.
        name: name of the matrix in errors.

    Raises:
        TypeError: P is not of real numbers.
        ValueError: P is not square, finite and symmetric, or has a negative eigenvalue.
    """
    try:
        given = np.asarray(P)
    except ValueError as error:
        raise ValueError(f"{name} is no matrix: its rows differ in length") from error
    if given.dtype.kind not in "biuf":
        raise TypeError(f"{name} holds {given.dtype}, real numbers are wanted")
    P_ = given.astype(float)
    _require_square(name, P_)
    if not np.all(np.isfinite(P_)):
        raise ValueError(f"{name} has entries that are not finite numbers")
    if np.any(negative := np.diag(P_) < 0.0):
        i = int(np.argmax(negative))
        raise ValueError(
            f"{name} is not positive semidefinite: its variance at ({i}, {i}), counted from 0, is "
            f"{P_[i, i]:.3g}; if this is rounding, zero is meant"
        )
    size = np.sqrt(np.diag(P_))
    scale = np.where(size > 0.0, size, 1.0)
    unit = P_ / np.outer(scale, scale)
    if np.max(np.abs(unit - unit.T), initial=0.0) > 1e-9:
        raise ValueError(f"{name} is not symmetric: mend it with (P + P.T) / 2 if this is rounding")
    unit = (unit + unit.T) / 2.0
    value, vector = np.linalg.eigh(unit)
    greatest = np.max(value, initial=1.0)
    if value.size and value[0] < -1e-10 * greatest:
        raise ValueError(
            f"{name} is not positive semidefinite: scaled to variances of one, its least "
            f"eigenvalue is {value[0]:.3g}"
        )
    # The rounding of a zero eigenvalue would be a standard deviation of 1e-8: set it to zero.
    rounding = len(P_) * np.finfo(float).eps * greatest
    if np.all(value > 10.0 * rounding):
        root = np.linalg.cholesky(unit)
    else:
        root = vector * np.sqrt(np.where(value > rounding, value, 0.0))
    return tria(jax.device_put(scale[:, None] * root))


_DOUBLINGS = 20  # limit of the halvings of a step: enough for |A| dt = 1e6


def van_loan(
    A: Float[Array, "n n"], Qc: Float[Array, "n n"], dt: float | Float[Array, ""]
) -> tuple[Float[Array, "n n"], Float[Array, "n n"]]:
    """Discretise ``dx = A x dt + dw``, ``E[dw dw'] = Qc dt`` over a step (Van Loan 1978).

    Van Loan's exponential also contains exp(-A dt), which swamps the rest where A dt is large (fast
    sensor dynamics over a long step). So it is computed for a step h with |A| h of order one, then
    doubled: Q(2h) = Q(h) + Phi(h) Q(h) Phi(h)'.

    Returns:
        Phi = exp(A dt), and Qd, the covariance that the noise adds over dt [s].

    Raises:
        ValueError: a shape does not fit, dt is negative, or a number is not finite; in compiled
            code only the first.
    """
    A, Qc = jnp.asarray(A, float), jnp.asarray(Qc, float)
    _require_square("A", A)
    n = A.shape[0]
    require(n, "A has no rows: there is nothing to discretise")
    _require_square("Qc", Qc, n)
    for name, value in (("A", A), ("Qc", Qc), ("dt", dt)):
        sound = isinstance(value, Tracer) or np.all(np.isfinite(value))
        require(sound, f"{name} has entries that are not finite numbers")
    require(
        isinstance(dt, Tracer) or np.all(np.asarray(dt) >= 0.0), "dt must be zero or positive", dt
    )
    size = jax.lax.stop_gradient(jnp.max(jnp.sum(jnp.abs(A), axis=0)) * jnp.abs(dt))
    halvings = jnp.clip(jnp.ceil(jnp.log2(jnp.maximum(size, 1.0))), 0, _DOUBLINGS)
    top = jnp.concatenate([-A, Qc], axis=1)
    bottom = jnp.concatenate([jnp.zeros((n, n)), A.T], axis=1)
    G = expm(jnp.concatenate([top, bottom], axis=0) * (dt * 2.0**-halvings))
    Phi = G[n:, n:].T
    Qd = Phi @ G[:n, n:]

    def double(i: Array, pair: tuple[Array, Array]) -> tuple[Array, Array]:
        Phi, Qd = pair
        wanted = i < halvings
        longer = Qd + Phi @ Qd @ Phi.T
        return jnp.where(wanted, Phi @ Phi, Phi), jnp.where(wanted, longer, Qd)

    Phi, Qd = jax.lax.fori_loop(0, _DOUBLINGS, double, (Phi, Qd))
    return Phi, 0.5 * (Qd + Qd.T)
