"""The group SE_2(3): attitude, velocity and position as one element.

Barrau & Bonnabel, *The invariant extended Kalman filter as a stable observer*, IEEE Trans.
Automatic Control 62 (2017), sec. IV; Hartley, Ghaffari, Eustice & Grizzle, *Contact-aided invariant
extended Kalman filtering for robot state estimation*, Int. J. Robotics Research 39 (2020). An
element is the matrix

        [C v p]
    X = [0 1 0],   xi = (phi, nu, rho):   exp(xi) = (exp(phi x), J(phi) nu, J(phi) rho)
        [0 0 1]

with J the left Jacobian of the rotations. In these coordinates the error of strapdown navigation
obeys a linear law independent of the trajectory, however large the error (`ins.invariant`).
"""

from __future__ import annotations

from typing import Any, ClassVar, Literal

import jax.numpy as jnp
from jaxtyping import Array, Float

from robins import _float64  # noqa: F401
from robins.filters.values import kind, value
from robins.rotation import Rotation, skew, turn_coefficients

Side = Literal["right", "left"]


def _turn(phi: Array, v: Array, once: Array, twice: Array) -> Array:
    """(I + once phi x + twice phi x phi x) v."""
    cross = jnp.cross(phi, v)
    return v + once[..., None] * cross + twice[..., None] * jnp.cross(phi, cross)


@value
class ExtendedPose:
    """Attitude, velocity and position; tangent order phi [rad], nu [m/s], rho [m].

    ``error`` is the side of the error:

    - "right" invariant: ``true = exp(xi) estimate``, xi in the frame the attitude maps *to*. Its
      attitude part is the error of `robins.rotation`, ``C_true = exp(phi x) C``.
    - "left" invariant: ``true = estimate exp(xi)``, xi in body axes.
    """

    rotation: Rotation  # body to navigation
    velocity: Any  # (..., 3) m/s, navigation axes
    position: Any  # (..., 3) m, navigation axes
    error: Side = kind(default="right")

    dim = 9
    units: ClassVar[dict[str, str]] = {"velocity": "m/s", "position": "m"}

    @classmethod
    def identity(cls, error: Side = "right") -> ExtendedPose:
        """Identity: zero rotation, velocity and position."""
        return cls(Rotation.identity(), jnp.zeros(3), jnp.zeros(3), error)

    @classmethod
    def exp(cls, xi: Float[Array, "*b 9"], error: Side = "right") -> ExtendedPose:
        """The group exponential."""
        phi = xi[..., :3]
        once, twice, _ = turn_coefficients(phi)
        velocity, position = (_turn(phi, v, once, twice) for v in (xi[..., 3:6], xi[..., 6:]))
        return cls(Rotation.from_rotvec(phi), velocity, position, error)

    def log(self) -> Float[Array, "*b 9"]:
        """Logarithm: xi, of attitude part at most pi, for which ``exp(xi)`` is this element."""
        phi = self.rotation.as_rotvec()
        _, _, twice = turn_coefficients(phi)
        half = jnp.full_like(twice, -0.5)
        parts = [phi, *(_turn(phi, v, half, twice) for v in (self.velocity, self.position))]
        return jnp.concatenate(parts, -1)

    def __matmul__(self, other: ExtendedPose) -> ExtendedPose:
        """The group product."""
        return ExtendedPose(
            self.rotation @ other.rotation,
            self.rotation.apply(other.velocity) + self.velocity,
            self.rotation.apply(other.position) + self.position,
            self.error,
        )

    def inverse(self) -> ExtendedPose:
        """Inverse element."""
        back = self.rotation.inverse()
        return ExtendedPose(
            back, -back.apply(self.velocity), -back.apply(self.position), self.error
        )

    def adjoint(self) -> Float[Array, "9 9"]:
        """Ad with ``X exp(xi) = exp(Ad xi) X``: left-invariant errors to right-invariant ones."""
        C, zero = self.rotation.as_dcm(), jnp.zeros((3, 3))
        rows = (
            (C, zero, zero),
            (skew(self.velocity) @ C, C, zero),
            (skew(self.position) @ C, zero, C),
        )
        return jnp.block([list(row) for row in rows])

    def retract(self, delta: Float[Array, "*b 9"]) -> ExtendedPose:
        """Element corrected by the error delta; the quaternion is renormalised."""
        step = ExtendedPose.exp(delta, self.error)
        moved = step @ self if self.error == "right" else self @ step
        wxyz = moved.rotation.wxyz
        unit = wxyz / jnp.linalg.norm(wxyz, axis=-1, keepdims=True)
        return ExtendedPose(Rotation(unit), moved.velocity, moved.position, self.error)

    def local(self, other: ExtendedPose) -> Float[Array, "*b 9"]:
        """The delta for which ``self.retract(delta) == other``.

        Raises:
            ValueError: the two have errors on different sides.
        """
        if other.error != self.error:
            raise ValueError(f"a pose of {self.error} error against one of {other.error} error")
        back = self.inverse()
        return (other @ back if self.error == "right" else back @ other).log()
