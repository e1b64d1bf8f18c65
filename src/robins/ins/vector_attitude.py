"""Attitude from at least two directions, as of stars, measured in body and known in inertial axes.

With directions b_k in body axes, r_k in inertial axes and weights w_k = 1/sigma_k^2 the most likely
attitude minimises Wahba's loss (Wahba 1965)::

    loss = 1/2 sum_k w_k |b_k - C_bi r_k|^2  =  sum_k w_k - q' K q

where q is q_ib, body to inertial, and, with B = sum w b r', S = B + B', s = tr B, z = sum w b x r::

    K = [s  z'; z  S - s I]

Three methods give the same result: `davenport` takes the eigenvector of K (q-method; Keat 1977),
`svd` the singular vectors of B (Markley 1988), `quest` the largest root of the characteristic
polynomial of K and then q in closed form (Shuster & Oh 1981). `triad` uses two directions only and
takes the first as exact (Black 1964). The error is dtheta of ``q_true = q exp(dtheta)``, in
body axes; its covariance is that of Shuster (1989), the Cramer-Rao bound, for the three and that of
two directions for TRIAD. Twice the loss is chi-square with 2 n - 3 degrees of freedom.

A weight of zero means no star, so sets of different size share one shape; leading axes are a batch.
Fewer than two stars, or stars along one line, leave the rotation about that line undetermined: the
result is then NaN, `solved` False.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from robins import _float64  # noqa: F401
from robins.errors import require
from robins.filters.belief import Number
from robins.rotation import from_dcm, multiply, normalise, rotate

LEAST_SEPARATION_RAD = float(np.radians(0.5))
"""Least angle between two stars, or between one and the opposite of another, for an attitude."""

_STEPS = 20  # of Newton's method; two suffice for good vectors, contradictory ones need more
# Quaternions of identity and of half a turn about each axis, and their effect on a vector.
_HALF_TURNS = np.eye(4)
_SIGNS = np.array([[1.0, 1.0, 1.0], [1.0, -1.0, -1.0], [-1.0, 1.0, -1.0], [-1.0, -1.0, 1.0]])


class VectorAttitude(NamedTuple):
    """Attitude from directions; NaN if undetermined."""

    q_ib: Any  # (..., 4) body to inertial, scalar first and not negative
    covariance: Any  # (..., 3, 3) rad^2 of dtheta, body axes
    loss: Any  # (...) Wahba's
    stars: Any  # (...) int, directions of a weight above zero
    solved: Any  # (...) bool


def quest(
    vectors_b: Float[Array, "*b n 3"],
    vectors_i: Float[Array, "*b n 3"],
    weight: Float[Array, "*b n"],
    least_separation_rad: Number = LEAST_SEPARATION_RAD,
) -> VectorAttitude:
    """QUEST: no eigenvectors, a polynomial of fourth degree (Shuster & Oh 1981, section VI).

    The closed form divides by the scalar part of q. Their remedy, the method of sequential
    rotations, turns the references by half a turn about an axis; here all four forms are computed
    and the one with the largest scalar part is used.

    Args:
        vectors_b: unit vectors in body axes; arbitrary where the weight is zero.
        vectors_i: the same directions in inertial axes.
        weight: 1/sigma^2 [1/rad^2], sigma of each of the two angles of a direction; zero: no star.
        least_separation_rad: least angle between stars for a solution [rad].
    """
    seen = _seen(vectors_b, vectors_i, weight, least_separation_rad)
    B = seen.profile
    s, S, z = _parts(B)
    zz, Sz = jnp.sum(z * z, -1), jnp.einsum("...ij,...j->...i", S, z)
    a, b = s**2 - _adjugate_trace(S), s**2 + zz
    c = _det(S) + jnp.sum(z * Sz, -1)
    d = jnp.sum(Sz * Sz, -1)

    # Newton's method descends monotonically from above all roots: no root exceeds sum w = 1.
    def descend(_, root):
        sq = root * root
        value = (sq - a) * (sq - b) + c * (s - root) - d
        slope = 2.0 * root * (2.0 * sq - a - b) - c
        return root - value / jnp.where(slope == 0.0, 1.0, slope)

    largest = jax.lax.fori_loop(0, _STEPS, descend, jnp.ones_like(s))

    turned = jnp.einsum("...ij,kj->...kij", B, _SIGNS)
    s, S, z = _parts(turned)
    root = largest[..., None]
    alpha = root**2 - s**2 + _adjugate_trace(S)
    gamma = (root + s) * alpha - _det(S)
    Sz = jnp.einsum("...ij,...j->...i", S, z)
    SSz = jnp.einsum("...ij,...j->...i", S, Sz)
    x = alpha[..., None] * z + (root - s)[..., None] * Sz + SSz
    candidates = multiply(jnp.asarray(_HALF_TURNS), jnp.concatenate([gamma[..., None], x], -1))
    best = jnp.argmax(gamma, -1)[..., None, None]
    return _answer(seen, normalise(jnp.take_along_axis(candidates, best, -2)[..., 0, :]))


def davenport(
    vectors_b: Float[Array, "*b n 3"],
    vectors_i: Float[Array, "*b n 3"],
    weight: Float[Array, "*b n"],
    least_separation_rad: Number = LEAST_SEPARATION_RAD,
) -> VectorAttitude:
    """Davenport's q-method: the eigenvector of K for its largest eigenvalue; arguments as `quest`.

    It has no singularity, at half a turn or anywhere.
    """
    seen = _seen(vectors_b, vectors_i, weight, least_separation_rad)
    s, S, z = _parts(seen.profile)
    eye = jnp.broadcast_to(jnp.eye(3), S.shape)
    right = jnp.concatenate([z[..., None, :], S - s[..., None, None] * eye], -2)
    left = jnp.concatenate([s[..., None], z], -1)[..., None]
    return _answer(seen, jnp.linalg.eigh(jnp.concatenate([left, right], -1))[1][..., -1])


def svd(
    vectors_b: Float[Array, "*b n 3"],
    vectors_i: Float[Array, "*b n 3"],
    weight: Float[Array, "*b n"],
    least_separation_rad: Number = LEAST_SEPARATION_RAD,
) -> VectorAttitude:
    """Markley's SVD: C_bi = U diag(1, 1, det U det V) V' of B = U diag(.) V'; arguments as `quest`.

    The determinants keep it a rotation where noise would make it a reflection.
    """
    seen = _seen(vectors_b, vectors_i, weight, least_separation_rad)
    U, _, Vt = jnp.linalg.svd(seen.profile)
    sign = _det(U) * _det(Vt)
    U = jnp.concatenate([U[..., :2], U[..., 2:] * sign[..., None, None]], -1)
    return _answer(seen, from_dcm(jnp.swapaxes(U @ Vt, -1, -2)))


def triad(
    vectors_b: Float[Array, "*b n 3"],
    vectors_i: Float[Array, "*b n 3"],
    weight: Float[Array, "*b n"],
    least_separation_rad: Number = LEAST_SEPARATION_RAD,
) -> VectorAttitude:
    """TRIAD: frames from two directions in body and inertial axes; arguments as `quest`.

    The first direction is that of the largest weight, the earliest if there are several; the
    second is that farthest from the line of the first. The others are not used, and of the second
    only the rotation about the first. The loss is that of all directions.
    """
    seen = _seen(vectors_b, vectors_i, weight, least_separation_rad)
    first = jnp.argmax(seen.weight, -1)
    b1, r1 = _pick(seen.b, first), _pick(seen.r, first)
    across = jnp.sum(jnp.cross(b1[..., None, :], seen.b) ** 2, -1)
    second = jnp.argmax(jnp.where(seen.weight > 0.0, across, -1.0), -1)
    b2, r2 = _pick(seen.b, second), _pick(seen.r, second)
    var1, var2 = (
        1.0 / jnp.where(seen.solved, _pick(seen.weight[..., None], k)[..., 0], 1.0)
        for k in (first, second)
    )
    # without a solution any two directions, to avoid division by zero
    b1, r1, b2, r2 = (
        jnp.where(seen.solved[..., None], v, jnp.broadcast_to(jnp.eye(3)[k], v.shape))
        for v, k in ((b1, 0), (r1, 0), (b2, 1), (r2, 1))
    )
    in_body, in_inertial = _frame(b1, b2), _frame(r1, r2)
    q = from_dcm(in_inertial @ jnp.swapaxes(in_body, -1, -2))

    # Rotations about the axes of the frame. Those about the second and third are errors of b1; that
    # about b1 is the error of b2 out of the plane, over its distance s from the line of b1.
    c, s = jnp.sum(b1 * b2, -1), jnp.sqrt(jnp.sum(jnp.cross(b1, b2) ** 2, -1))
    about, mixed = (var2 + c**2 * var1) / s**2, c * var1 / s
    zero = jnp.zeros_like(about)
    rows = [(about, mixed, zero), (mixed, var1, zero), (zero, zero, var1)]
    local = jnp.stack([jnp.stack(row, -1) for row in rows], -2)
    return _answer(seen, q, in_body @ local @ jnp.swapaxes(in_body, -1, -2))


METHODS = {"quest": quest, "davenport": davenport, "svd": svd, "triad": triad}
"""Methods by name."""

_compiled = jax.jit(lambda way, *given: METHODS[way](*given), static_argnums=0)


def attitude_from_vectors(
    vectors_b: ArrayLike,
    vectors_i: ArrayLike,
    sigma_rad: ArrayLike | float,
    method: str = "quest",
    least_separation_rad: float = LEAST_SEPARATION_RAD,
) -> VectorAttitude:
    """One attitude from n directions, checked, as NumPy arrays.

    Args:
        vectors_b: (n, 3) unit vectors in body axes; NaN: missing.
        vectors_i: (n, 3) the same directions in inertial axes.
        sigma_rad: of each of the two angles of a direction [rad], a number or (n,).
        method: of `METHODS`.
        least_separation_rad: least angle between directions for a solution [rad].

    Raises:
        ValueError: shapes that do not fit together, vectors not of unit length (to 1e-3), a sigma
            not positive, an unknown method; fewer than two directions, or no two of them far enough
            apart.
    """
    b, r = np.asarray(vectors_b, float), np.asarray(vectors_i, float)
    require(method in METHODS, f"method must be one of {', '.join(METHODS)}, got {method!r}")
    if b.ndim != 2 or b.shape[1] != 3 or r.shape != b.shape:
        raise ValueError(
            f"vectors_b and vectors_i must have one shape (n, 3), got {b.shape} and {r.shape}"
        )
    there = np.asarray(~np.isnan(b).any(1))
    sigma = checked_sigma(sigma_rad, there, vectors_b=b, vectors_i=r)
    rows = -(-max(len(b), 1) // 32) * 32  # so that few shapes are compiled
    filled = np.zeros((2, rows, 3))
    filled[:, : len(b)] = b, r
    weight = np.zeros(rows)
    weight[: len(b)] = np.where(there, 1.0 / sigma**2, 0.0)
    answer = _compiled(method, *filled, weight, float(least_separation_rad))
    if not answer.solved:
        count = int(answer.stars)
        raise ValueError(
            f"an attitude needs two directions that are {np.degrees(least_separation_rad):g} deg "
            f"apart: got {count}" + (" of less separation" if count > 1 else "")
        )
    return VectorAttitude(*(np.asarray(x) for x in answer))


def checked_sigma(
    sigma_rad: ArrayLike | float, there: np.ndarray, **vectors: np.ndarray
) -> np.ndarray:
    """Sigma of directions, a number or (n,), if it and they can be used.

    Args:
        sigma_rad: as given [rad].
        there: (n,) bool, the direction is not missing.
        vectors: (n, 3) directions, by the name of the argument.

    Raises:
        ValueError: a sigma of another shape or not positive; a direction that is there and not of
            unit length (to 1e-3).
    """
    sigma = np.asarray(sigma_rad, float)
    if sigma.shape not in ((), there.shape):
        raise ValueError(f"sigma_rad must be a number or of shape {there.shape}, got {sigma.shape}")
    sound = np.all((sigma > 0.0) & np.isfinite(sigma))
    require(sound, "sigma_rad must be positive and finite", sigma_rad)
    for name, v in vectors.items():
        off = np.flatnonzero(there & ~(np.abs(np.linalg.norm(v, axis=1) - 1.0) < 1e-3))
        if off.size:
            raise ValueError(
                f"{name}[{off[0]}] is {v[off[0]]}: directions must be unit vectors, to 1e-3"
            )
    return sigma


class _Solution(NamedTuple):
    b: Any  # (..., n, 3), zero where there is no star
    r: Any  # (..., n, 3), likewise
    weight: Any  # (..., n)
    profile: Any  # (..., 3, 3) B over the sum of the weights; arbitrary without a solution
    solved: Any  # (...)


def _seen(vectors_b, vectors_i, weight, least_separation_rad) -> _Solution:
    there = weight > 0.0
    b, r = (jnp.where(there[..., None], jnp.asarray(v, float), 0.0) for v in (vectors_b, vectors_i))
    w = jnp.where(there, weight, 0.0)
    cosine = jnp.einsum("...ni,...mi->...nm", b, b)
    pair = there[..., :, None] & there[..., None, :]
    apart = pair & (jnp.abs(cosine) < jnp.cos(jnp.asarray(least_separation_rad, float)))
    solved = jnp.any(apart, (-1, -2))
    total = jnp.sum(w, -1)
    share = w / jnp.where(total > 0.0, total, 1.0)[..., None]
    profile = jnp.einsum("...n,...ni,...nj->...ij", share, b, r)
    some = jnp.broadcast_to(jnp.diag(jnp.array([0.5, 0.3, 0.2])), profile.shape)
    return _Solution(b, r, w, jnp.where(solved[..., None, None], profile, some), solved)


def _answer(seen: _Solution, q, covariance=None) -> VectorAttitude:
    q = jnp.where(q[..., :1] < 0.0, -q, q)
    if covariance is None:
        outer = jnp.einsum("...n,...ni,...nj->...ij", seen.weight, seen.b, seen.b)
        eye = jnp.broadcast_to(jnp.eye(3), outer.shape)
        information = jnp.sum(seen.weight, -1)[..., None, None] * eye - outer
        covariance = _inverse(jnp.where(seen.solved[..., None, None], information, eye))
    off = rotate(q[..., None, :], seen.b) - seen.r
    loss = 0.5 * jnp.sum(seen.weight * jnp.sum(off * off, -1), -1)

    def kept(x):
        return jnp.where(
            seen.solved.reshape(seen.solved.shape + (1,) * (x.ndim - seen.solved.ndim)), x, jnp.nan
        )

    stars = jnp.sum(seen.weight > 0.0, -1)
    return VectorAttitude(kept(q), kept(covariance), kept(loss), stars, seen.solved)


def _parts(B):
    """Trace s, S = B + B' and z of Davenport's K."""
    s = B[..., 0, 0] + B[..., 1, 1] + B[..., 2, 2]
    twisted = [
        B[..., 1, 2] - B[..., 2, 1],
        B[..., 2, 0] - B[..., 0, 2],
        B[..., 0, 1] - B[..., 1, 0],
    ]
    return s, B + jnp.swapaxes(B, -1, -2), jnp.stack(twisted, -1)


def _det(M: Float[Array, "*b 3 3"]) -> Float[Array, "*b"]:
    return jnp.sum(M[..., 0, :] * jnp.cross(M[..., 1, :], M[..., 2, :]), -1)


def _adjugate_trace(S: Float[Array, "*b 3 3"]) -> Float[Array, "*b"]:
    """Sum of the principal minors of a symmetric matrix."""
    return (
        S[..., 1, 1] * S[..., 2, 2]
        - S[..., 1, 2] ** 2
        + S[..., 0, 0] * S[..., 2, 2]
        - S[..., 0, 2] ** 2
        + S[..., 0, 0] * S[..., 1, 1]
        - S[..., 0, 1] ** 2
    )


def _inverse(M: Float[Array, "*b 3 3"]) -> Float[Array, "*b 3 3"]:
    """Inverse of a symmetric matrix, by its cofactors."""
    x, y, z = M[..., 0, :], M[..., 1, :], M[..., 2, :]
    cofactors = jnp.stack([jnp.cross(y, z), jnp.cross(z, x), jnp.cross(x, y)], -2)
    return cofactors / jnp.sum(x * jnp.cross(y, z), -1)[..., None, None]


def _frame(first: Float[Array, "*b 3"], second: Float[Array, "*b 3"]) -> Float[Array, "*b 3 3"]:
    """Orthonormal axes in columns: along the first, towards the second, perpendicular to both."""
    across = jnp.cross(first, second)
    across = across / jnp.sqrt(jnp.sum(across**2, -1, keepdims=True))
    along = first / jnp.sqrt(jnp.sum(first**2, -1, keepdims=True))
    return jnp.stack([along, jnp.cross(across, along), across], -1)


def _pick(rows, index):
    return jnp.take_along_axis(rows, index[..., None, None], -2)[..., 0, :]
