"""Vectors, matrices and quaternions as tuples of scalars: faster than arrays in a compiled loop.

A scan over small arrays spends its time launching kernels; scalar operations are fused into few.
Under `vmap` each scalar is an array over the batch. Long chains of them need `behind_barrier` in
between.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from jaxtyping import Shaped

from robins.linalg.library import ArrayLike, Real

if TYPE_CHECKING:  # stubs lack operators between a scalar of NumPy and an array of JAX
    Scalar = Any
else:
    Scalar = ArrayLike
Three = Sequence[Scalar]
Matrix = Sequence[Three]


def scalars(v: Shaped[Real, "n"]) -> tuple[Scalar, ...]:
    """Components of a vector."""
    return tuple(v[i] for i in range(v.shape[0]))


def matrix(m: Shaped[Real, "n m"]) -> Matrix:
    """Rows of a matrix, each a tuple of its components."""
    return tuple(scalars(m[i]) for i in range(m.shape[0]))


def behind_barrier(*vectors: Three) -> list[tuple[Scalar, ...]]:
    """Same vectors behind a fusion barrier, so that each is computed once.

    Otherwise XLA would recompute a component wherever it is used.
    """
    import jax

    return [scalars(v) for v in jax.lax.optimization_barrier([jax.numpy.stack(v) for v in vectors])]


def plus(a: Three, b: Three, *more: Three) -> Three:
    """Sum of vectors."""
    total = tuple(x + y for x, y in zip(a, b, strict=True))
    return plus(total, *more) if more else total


def minus(a: Three, b: Three) -> Three:
    """Difference of two vectors."""
    return tuple(x - y for x, y in zip(a, b, strict=True))


def times(s: Scalar, a: Three) -> Three:
    """Product of a scalar and a vector."""
    return tuple(s * x for x in a)


def dot(a: Three, b: Three) -> Scalar:
    """Scalar product of two vectors of any length."""
    products = [x * y for x, y in zip(a, b, strict=True)]
    return sum(products[1:], products[0]) if products else 0.0


def cross(a: Three, b: Three) -> Three:
    """Vector product of two 3-vectors."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def apply(m: Matrix, v: Three) -> Three:
    """Matrix times vector."""
    return tuple(dot(row, v) for row in m)


def transposed(m: Matrix) -> Matrix:
    """Transpose of a matrix."""
    return tuple(zip(*m, strict=True))


def dcm(q: Three) -> Matrix:
    """Direction cosine matrix of a unit quaternion, scalar first."""
    w, x, y, z = q
    return (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
        (2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
        (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)),
    )


def product(p: Three, q: Three) -> tuple[Scalar, Scalar, Scalar, Scalar]:
    """Hamilton product of quaternions, scalar first."""
    pw, px, py, pz = p
    qw, qx, qy, qz = q
    return (
        pw * qw - px * qx - py * qy - pz * qz,
        pw * qx + px * qw + py * qz - pz * qy,
        pw * qy - px * qz + py * qw + pz * qx,
        pw * qz + px * qy - py * qx + pz * qw,
    )


def rotate(q: Three, v: Three) -> Three:
    """Rotate a 3-vector by a unit quaternion, scalar first."""
    t = times(2.0, cross(q[1:], v))
    return plus(v, times(q[0], t), cross(q[1:], t))


def symmetric_inverse(m: Matrix) -> Matrix:
    """Inverse of a symmetric 3x3 matrix by its cofactors."""
    (a, b, c), (_, d, e), (_, _, f) = m
    aa, bb, cc = d * f - e * e, c * e - b * f, b * e - c * d
    dd, ee, ff = a * f - c * c, b * c - a * e, a * d - b * b
    scale = 1.0 / (a * aa + b * bb + c * cc)
    return tuple(times(scale, row) for row in ((aa, bb, cc), (bb, dd, ee), (cc, ee, ff)))
