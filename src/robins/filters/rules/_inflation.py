"""Weights, local bounds and inflation of a factor, shared by the H-infinity rules."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float

from robins import linalg
from robins.errors import require
from robins.filters.belief import Belief
from robins.filters.checks import finite_numbers
from robins.filters.model import Given
from robins.filters.values import Numbers, is_known
from robins.manifold import State

Weight = Numbers | Callable[[State], ArrayLike]  # (q, n) L, or mean -> (q, n) or (n,)
GivenWeight = Weight | Given


def as_weight(weight: GivenWeight, whose: str) -> Weight:
    """Checked weight L, the rows whose error is bounded, as a leaf; ``whose`` names it in errors.

    From a (q, n) matrix, an (n,) diagonal, or ``mean -> `` one of these, which is kept as it is.
    """
    if callable(weight):
        return weight
    if not is_known(weight):
        return _rows(jnp.asarray(weight, float), whose)
    numbers = finite_numbers(f"{whose}: weight", weight)
    require(np.any(numbers), f"{whose}: weight is zero, so no error would count")
    _check_shape(numbers, whose)
    numbers = np.diag(numbers) if numbers.ndim == 1 else numbers
    return numbers[np.any(numbers != 0.0, axis=1)]


def rows_of(weight: Weight, mean: State, whose: str) -> Array:
    """(q, n) L at a mean."""
    if callable(weight):
        return _rows(jnp.asarray(weight(mean), float), whose)
    return jnp.asarray(weight)


def _rows(L: Array, whose: str) -> Array:
    _check_shape(L, whose)
    return linalg.as_factor(L)


def _check_shape(L: Numbers, whose: str) -> None:
    if jnp.ndim(L) not in (1, 2):
        raise ValueError(
            f"{whose}: weight has shape {jnp.shape(L)}; a (q, n) matrix or an (n,) diagonal is "
            "wanted, in the units in which an error is to count"
        )


def weighted_factor(weight: Weight, belief: Belief, whose: str) -> Float[Array, "q n"]:
    """(q, n) L S, whose greatest singular value is the local bound."""
    L, n = rows_of(weight, belief.mean, whose), belief.factor.shape[0]
    if L.shape[1] != n:
        raise ValueError(f"{whose}: weight has {L.shape[1]} columns, the state has {n} components")
    return L @ belief.factor


def local_bound(weighted: Float[Array, "q n"]) -> Float[Array, ""]:
    """sqrt(lambda_max(L P L')), the infimum of gamma for this step alone; it has no derivative."""
    B = jax.lax.stop_gradient(weighted)
    gram = B @ B.T if B.shape[0] <= B.shape[1] else B.T @ B
    return jnp.sqrt(jnp.maximum(linalg.eigenvalue_bounds(gram)[1], 0.0))


def inflated(
    factor: Float[Array, "n n"], A: Float[Array, "q n"]
) -> tuple[Float[Array, "n n"], Bool[Array, ""]]:
    """Factor of ``S (I - A'A)^-1 S'`` for A = L S / gamma, and () bool: it exists.

    It exists when I - A'A has a Cholesky factor; otherwise S is returned.
    """
    return _divided(factor, jnp.eye(factor.shape[0]) - A.T @ A)


def deflated(
    factor: Float[Array, "n n"], A: Float[Array, "q n"], share: ArrayLike
) -> tuple[Float[Array, "n n"], Bool[Array, ""]]:
    """Factor of P reduced so that L P L' is within share gamma^2, and () bool: it was reduced.

    With A'A = S'L'LS / gamma^2 = U diag(a) U' the result is S U diag(min(1, share / a)) U'S'. The
    inverse of the middle is I + U diag((a - share)_+ / share) U', so that a root is needed of the
    excess only. Derivatives treat the excess as constant.
    """
    n = factor.shape[0]
    excess = linalg.symmetric_root(jax.lax.stop_gradient(A.T @ A - share * jnp.eye(n)))
    lower, _ = _divided(factor, jnp.eye(n) + excess @ excess.T / share)
    return lower, jnp.any(excess != 0.0)


def _divided(factor: Array, M: Array) -> tuple[Array, Array]:
    """Lower factor of S M^-1 S', and () bool: M is positive definite.

    With N upper triangular, N N' = M, the product S N^-T is lower triangular as S is. N is the
    Cholesky factor of M with rows and columns in reverse.
    """
    C = _root(M[::-1, ::-1])
    exists = C[0, 0] > 0.0
    divided = linalg.solve_lower(jnp.where(exists, C, jnp.eye(C.shape[0])), factor.T[::-1])
    return divided[::-1].T, exists


@jax.custom_jvp
def _root(M: Array) -> Array:
    """Cholesky factor, zero where there is none, so that derivatives are never NaN."""
    C = linalg.cholesky(M)
    return jnp.where(jnp.all(jnp.isfinite(C)), C, 0.0)


@_root.defjvp
def _root_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    # C C' = M gives dC = C half(C^-1 dM C^-T), half being the lower triangle with half a diagonal.
    C = _root(*primals)
    solid = jnp.where(C[0, 0] > 0.0, C, jnp.eye(C.shape[0]))
    inner = linalg.solve_lower(solid, linalg.solve_lower(solid, tangents[0]).T)
    half = jnp.tril(inner) - 0.5 * jnp.diag(jnp.diagonal(inner))
    return C, C @ half
