"""Rotations as elements of a state, and the exponential map with its Jacobians; by JAX.

Small-angle series are exact to rounding on both sides of their switch and have finite derivatives
at zero. The exponential map to first order is ``I + skew(phi)``, its Jacobians are
`left_jacobian(phi)` and, on the right, `left_jacobian(-phi)`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from robins.rotation.arithmetic import (
    SMALL,
    conjugate,
    from_dcm,
    from_euler,
    multiply,
    normalise,
    rotate,
    skew,
    to_dcm,
    to_euler,
    to_rotvec,
)

_SMALL_TURN = 1e-2  # rad^2; as `SMALL`, for `turn_coefficients`: 1e-16 of the first term


def _sinc_cos(angle_sq):
    """Return ``sin(a)/a`` and ``cos(a)`` for a = sqrt(angle_sq), smooth at zero."""
    # Double `where`: on the unused branch the square root is taken of a safe number, else its
    # infinite derivative at zero would enter the gradient as 0 * inf = NaN.
    small = angle_sq < SMALL
    safe = jnp.where(small, 1.0, angle_sq)
    angle = jnp.sqrt(safe)
    x = jnp.where(small, angle_sq, 0.0)
    sinc_series = 1.0 - x / 6.0 * (1.0 - x / 20.0 * (1.0 - x / 42.0))
    cos_series = 1.0 - x / 2.0 * (1.0 - x / 12.0 * (1.0 - x / 30.0 * (1.0 - x / 56.0)))
    sinc = jnp.where(small, sinc_series, jnp.sin(angle) / angle)
    return sinc, jnp.where(small, cos_series, jnp.cos(angle))


def from_rotvec(phi: Float[Array, "*b 3"]) -> Float[Array, "*b 4"]:
    """Quaternion exp(phi/2) of a rotation vector [rad]."""
    sinc, cos = _sinc_cos(jnp.sum(phi * phi, -1, keepdims=True) / 4.0)
    return jnp.concatenate([cos, 0.5 * sinc * phi], -1)


def turn_coefficients(phi: Float[Array, "*b 3"]) -> tuple[Array, Array, Array]:
    """(1 - cos a)/a^2, (a - sin a)/a^3 and (1 - (a/2) cot(a/2))/a^2, each (...), for a = |phi|."""
    sq = jnp.sum(phi * phi, -1)
    # Double `where`, as above: the root is not differentiable at zero.
    small = sq < _SMALL_TURN
    a = jnp.sqrt(jnp.where(small, 1.0, sq))
    x = jnp.where(small, sq, 0.0)
    half = jnp.sin(0.5 * a) / a
    once = 0.5 - x / 24.0 * (1.0 - x / 30.0 * (1.0 - x / 56.0 * (1.0 - x / 90.0)))
    twice = 1.0 / 6.0 - x / 120.0 * (1.0 - x / 42.0 * (1.0 - x / 72.0 * (1.0 - x / 110.0)))
    # 1/12 and the next Bernoulli numbers over factorials
    back = 1.0 / 12.0 + x * (1 / 720 + x * (1 / 30240 + x * (1 / 1209600 + x / 47900160)))
    return (
        jnp.where(small, once, 2.0 * half**2),
        jnp.where(small, twice, (a - jnp.sin(a)) / a**3),
        jnp.where(small, back, (1.0 - 0.5 * jnp.cos(0.5 * a) / half) / a**2),
    )


def left_jacobian(
    phi: Float[Array, "*b 3"], *, first_order: bool = False
) -> Float[Array, "*b 3 3"]:
    """J(phi): exp((phi + d) x) = exp((J d) x) exp(phi x) to first order in d (Sola 2017, eq. 145).

    The right Jacobian, exp((phi + d) x) = exp(phi x) exp((J_r d) x), is J(-phi). To first order in
    phi too, J = I + skew(phi) / 2.
    """
    turn = skew(phi)
    unit = jnp.broadcast_to(jnp.eye(3), turn.shape)
    if first_order:
        return unit + 0.5 * turn
    once, twice, _ = (c[..., None, None] for c in turn_coefficients(phi))
    return unit + once * turn + twice * turn @ turn


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Rotation:
    """A rotation as an element of a state: one or many, ``wxyz`` of shape (..., 4).

    `retract` perturbs on the left, ``exp(delta x) C``: delta is seen in the frame the rotation maps
    *to*. For ``q_nb`` this is the platform misalignment phi of inertial navigation.
    """

    wxyz: Any  # (..., 4) array; unannotated, for JAX rebuilds the class with stand-ins

    dim = 3
    units: ClassVar[dict[str, str]] = {
        "wxyz": "unit quaternion, scalar first; error: that of the rotation"
    }

    @classmethod
    def identity(cls) -> Rotation:
        """No rotation."""
        return cls(jnp.array([1.0, 0.0, 0.0, 0.0]))

    @classmethod
    def from_rotvec(cls, phi) -> Rotation:
        """From a rotation vector [rad]."""
        return cls(from_rotvec(jnp.asarray(phi, float)))

    @classmethod
    def from_dcm(cls, C) -> Rotation:
        """From a direction cosine matrix."""
        return cls(from_dcm(jnp.asarray(C, float)))

    @classmethod
    def from_euler(cls, roll_rad, pitch_rad, heading_rad) -> Rotation:
        """From roll, pitch, heading [rad] (NED from FRD)."""
        return cls(from_euler(roll_rad, pitch_rad, heading_rad))

    def as_rotvec(self) -> Float[Array, "*b 3"]:
        """Rotation vector [rad]."""
        return to_rotvec(self.wxyz)

    def as_dcm(self) -> Float[Array, "*b 3 3"]:
        """Direction cosine matrix."""
        return to_dcm(self.wxyz)

    def as_euler(self) -> tuple[Array, Array, Array]:
        """Roll, pitch, heading [rad] (NED from FRD)."""
        return to_euler(self.wxyz)

    def __matmul__(self, other: Rotation) -> Rotation:
        """Compose: ``(C_ab @ C_bc)`` maps c to a."""
        return Rotation(multiply(self.wxyz, other.wxyz))

    def inverse(self) -> Rotation:
        """Inverse rotation."""
        return Rotation(conjugate(self.wxyz))

    def apply(self, v) -> Float[Array, "*b 3"]:
        """Rotate vectors."""
        return rotate(self.wxyz, jnp.asarray(v, float))

    def retract(self, delta: Float[Array, "*b 3"]) -> Rotation:
        """``exp(delta x) C``, renormalised so that rounding cannot accumulate."""
        return Rotation(normalise(multiply(from_rotvec(delta), self.wxyz)))

    def local(self, other: Rotation) -> Float[Array, "*b 3"]:
        """The delta for which ``self.retract(delta) == other``."""
        return to_rotvec(multiply(other.wxyz, conjugate(self.wxyz)))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class BodyRotation(Rotation):
    """A rotation whose error is seen in the frame it maps *from*: ``C exp(delta x)``.

    For ``q_ib`` of a spacecraft this is the attitude error in body axes, the error state of the
    multiplicative extended Kalman filter (Lefferts, Markley & Shuster 1982). Composing and
    inverting give plain rotations.
    """

    def retract(self, delta: Float[Array, "*b 3"]) -> BodyRotation:
        """``C exp(delta x)``, renormalised so that rounding cannot accumulate."""
        return BodyRotation(normalise(multiply(self.wxyz, from_rotvec(delta))))

    def local(self, other: Rotation) -> Float[Array, "*b 3"]:
        """The delta for which ``self.retract(delta) == other``."""
        return to_rotvec(multiply(conjugate(self.wxyz), other.wxyz))
