"""Rotations: unit quaternions, rotation vectors, direction cosine matrices, Euler angles.

Quaternions are scalar first (w, x, y, z), Hamilton product; ``q_nb`` maps body coordinates to
navigation coordinates, ``v_n = rotate(q_nb, v_b)``. All functions work on one or many alike: the
last axis holds the components, leading axes broadcast. Euler angles are roll, pitch, heading of
the aerospace (Z-Y-X) sequence between an NED navigation frame and an FRD body frame. Functions
that take `Real` compute by NumPy where NumPy is given, with nothing to compile, else by JAX.

Small-angle series live here; they are exact to rounding on both sides of their switch and have
finite derivatives at zero. The exponential map to first order is ``I + skew(phi)``, its Jacobians
are `left_jacobian(phi)` and, on the right, `left_jacobian(-phi)`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from robins import _float64  # noqa: F401
from robins.errors import require
from robins.linalg import scalars

if TYPE_CHECKING:
    Real = Any  # NumPy or JAX array; the result is of the same library
else:
    Real = Array | np.ndarray

_SMALL = 1e-3  # rad^2; below it, series whose dropped terms are below 1e-18
_SMALL_TURN = 1e-2  # rad^2; the same for `turn_coefficients`: 1e-16 of the first term

_SKEWED = 0.05  # tolerance of orthogonality and unit norm: accepts numbers of two digits
_LOCK = 1e-14  # rad from the vertical, about; a unit quaternion is rounded to 3e-16


def _same_rank(*arrays):
    """Prepend axes of length one to arrays of lower rank, so that they broadcast."""
    most = max(a.ndim for a in arrays)
    return [a.reshape((1,) * (most - a.ndim) + a.shape) for a in arrays]


def _refuse_no_quaternion(q):
    """Refuse an array that is not a unit quaternion; compiled code checks only for four components.

    Raises:
        ValueError: it has not four components, or not unit norm. NaN means missing, and passes.
    """
    shape = np.shape(q)
    require(shape[-1:] == (4,), f"a quaternion has 4 components along its last axis, got {shape}")
    if not isinstance(q, Tracer):
        with np.errstate(all="ignore"):
            size = np.linalg.norm(np.asarray(q), axis=-1)
            worst = np.max(np.abs(size - 1.0), initial=0.0, where=~np.isnan(size))
        require(
            worst <= _SKEWED,
            f"no rotation: the length of a quaternion differs from 1 by {worst:.3g}; "
            "rotation.normalise makes it 1",
        )


def _library(*arrays):
    return np if all(isinstance(a, np.ndarray) for a in arrays) else jnp


def _components(q):
    return q[..., 0], q[..., 1], q[..., 2], q[..., 3]


def _sinc_cos(angle_sq):
    """Return ``sin(a)/a`` and ``cos(a)`` for a = sqrt(angle_sq), smooth at zero."""
    # Double `where`: on the unused branch the square root is taken of a safe number, else its
    # infinite derivative at zero would enter the gradient as 0 * inf = NaN.
    small = angle_sq < _SMALL
    safe = jnp.where(small, 1.0, angle_sq)
    angle = jnp.sqrt(safe)
    x = jnp.where(small, angle_sq, 0.0)
    sinc_series = 1.0 - x / 6.0 * (1.0 - x / 20.0 * (1.0 - x / 42.0))
    cos_series = 1.0 - x / 2.0 * (1.0 - x / 12.0 * (1.0 - x / 30.0 * (1.0 - x / 56.0)))
    sinc = jnp.where(small, sinc_series, jnp.sin(angle) / angle)
    return sinc, jnp.where(small, cos_series, jnp.cos(angle))


def skew(v: Float[Real, "*b 3"]) -> Float[Real, "*b 3 3"]:
    """Cross-product matrix: ``skew(a) @ b == cross(a, b)``."""
    xp = _library(v)
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    o = xp.zeros_like(x)
    rows = [xp.stack(r, -1) for r in ((o, -z, y), (z, o, -x), (-y, x, o))]
    return xp.stack(rows, -2)


def multiply(p: Float[Real, "*#b 4"], q: Float[Real, "*#b 4"]) -> Float[Real, "*b 4"]:
    """Hamilton product p q: rotate by q first, then by p."""
    factors = (_components(a) for a in _same_rank(p, q))
    return _library(p, q).stack(scalars.product(*factors), -1)


def conjugate(q: Float[Real, "*b 4"]) -> Float[Real, "*b 4"]:
    """Inverse of a unit quaternion."""
    return _library(q).concatenate([q[..., :1], -q[..., 1:]], -1)


def normalise(q: Float[Array, "*b 4"]) -> Float[Array, "*b 4"]:
    """Scale to unit length.

    Raises:
        ValueError: a length is zero or not finite; not in compiled code.
    """
    if not isinstance(q, Tracer):
        with np.errstate(all="ignore"):
            size = np.linalg.norm(np.asarray(q), axis=-1)
        require(
            not np.any((size == 0.0) | np.isinf(size)),
            "no rotation: a quaternion of length zero, or of none that is a finite number",
        )
    return q / jnp.linalg.norm(q, axis=-1, keepdims=True)


def rotate(q: Float[Real, "*#b 4"], v: Float[Real, "*#b 3"]) -> Float[Real, "*b 3"]:
    """Rotate vectors; with q_nb, body components become navigation components.

    Raises:
        ValueError: q is no unit quaternion (to 0.05; compiled code does not check the norm).
    """
    _refuse_no_quaternion(q)
    xp = _library(q, v)
    q, v = _same_rank(q, v)
    w, u = q[..., :1], q[..., 1:]
    t = 2.0 * xp.cross(u, v)
    return v + w * t + xp.cross(u, t)


def from_rotvec(phi: Float[Array, "*b 3"]) -> Float[Array, "*b 4"]:
    """Quaternion exp(phi/2) of a rotation vector [rad]."""
    sinc, cos = _sinc_cos(jnp.sum(phi * phi, -1, keepdims=True) / 4.0)
    return jnp.concatenate([cos, 0.5 * sinc * phi], -1)


def to_rotvec(q: Float[Real, "*b 4"]) -> Float[Real, "*b 3"]:
    """Rotation vector [rad] of length at most pi; q and -q give the same, and so does 2 q."""
    xp = _library(q)
    q = xp.where(q[..., :1] < 0.0, -q, q)
    w, u = q[..., :1], q[..., 1:]
    s_sq = xp.sum(u * u, -1, keepdims=True)
    small = s_sq < _SMALL
    safe = xp.where(small, 1.0, s_sq)
    s = xp.sqrt(safe)
    x = xp.where(small, s_sq / xp.where(small, w * w, 1.0), 0.0)
    # 2 atan2(s, w)/s; the series is that of 2 atan(t)/t with t = s/w, over w
    series = 2.0 * (1.0 - x * (1 / 3 - x * (1 / 5 - x * (1 / 7 - x * (1 / 9 - x / 11)))))
    series = series / xp.where(small, w, 1.0)
    return xp.where(small, series, 2.0 * xp.arctan2(s, xp.where(small, 1.0, w)) / s) * u


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


def to_dcm(q: Float[Real, "*b 4"]) -> Float[Real, "*b 3 3"]:
    """Direction cosine matrix: ``v_n = C_nb @ v_b``.

    Raises:
        ValueError: as `rotate`.
    """
    _refuse_no_quaternion(q)
    xp = _library(q)
    return xp.stack([xp.stack(row, -1) for row in scalars.dcm(_components(q))], -2)


def from_dcm(C: Float[Array, "*b 3 3"]) -> Float[Array, "*b 4"]:
    """Quaternion of a direction cosine matrix, scalar part not negative (Shepperd 1978).

    Shepperd's method divides by the largest of the four components, so no case is ill-conditioned.

    Raises:
        ValueError: C is no rotation: a reflection, or not orthogonal to 0.05. In compiled code,
            which cannot raise, a reflection gives NaN.
    """
    shape = np.shape(C)
    require(shape[-2:] == (3, 3), f"a direction cosine matrix is 3 x 3, got {shape}")
    reflected = _refuse_no_rotation(C)
    c = [[C[..., i, j] for j in range(3)] for i in range(3)]
    trace = c[0][0] + c[1][1] + c[2][2]
    d = jnp.stack([trace, c[0][0], c[1][1], c[2][2]], -1)
    cand = (
        (1 + trace, c[2][1] - c[1][2], c[0][2] - c[2][0], c[1][0] - c[0][1]),
        (c[2][1] - c[1][2], 1 + 2 * c[0][0] - trace, c[0][1] + c[1][0], c[0][2] + c[2][0]),
        (c[0][2] - c[2][0], c[0][1] + c[1][0], 1 + 2 * c[1][1] - trace, c[1][2] + c[2][1]),
        (c[1][0] - c[0][1], c[0][2] + c[2][0], c[1][2] + c[2][1], 1 + 2 * c[2][2] - trace),
    )
    table = jnp.stack([jnp.stack(k, -1) for k in cand], -2)
    best = jnp.argmax(d, -1)
    q = jnp.take_along_axis(table, best[..., None, None], -2)[..., 0, :]
    q = normalise(q)
    q = jnp.where(q[..., :1] < 0.0, -q, q)
    return q if reflected is None else jnp.where(reflected[..., None], jnp.nan, q)


def _refuse_no_rotation(C: Array) -> Array | None:
    """Refuse a matrix that is no rotation; for traced matrices, return the mask of reflections."""
    if isinstance(C, Tracer):
        return jnp.sum(jnp.cross(C[..., 0, :], C[..., 1, :]) * C[..., 2, :], axis=-1) <= 0.0
    with np.errstate(all="ignore"):
        M = np.asarray(C)
        off = np.abs(M @ np.swapaxes(M, -1, -2) - np.eye(3))
        if np.any(off > _SKEWED):  # false for NaN, which stays NaN
            raise ValueError(
                "no direction cosine matrix: C C' differs from the identity by "
                f"{np.nanmax(off):.3g}"
            )
        if np.any(np.linalg.det(M) < 0.0):
            raise ValueError(
                "no direction cosine matrix: its determinant is -1, so it is a reflection; one "
                "axis, or the order of two, is the wrong way round"
            )
    return None


def from_euler(roll_rad, pitch_rad, heading_rad) -> Float[Real, "*b 4"]:
    """Quaternion q_nb (NED from FRD): C_nb = Rz(heading) Ry(pitch) Rx(roll)."""
    angles = roll_rad, pitch_rad, heading_rad
    xp = np if all(isinstance(a, np.ndarray | np.generic) for a in angles) else jnp
    roll, pitch, heading = xp.broadcast_arrays(*(xp.asarray(a, float) for a in angles))
    cr, sr = xp.cos(roll / 2), xp.sin(roll / 2)
    cp, sp = xp.cos(pitch / 2), xp.sin(pitch / 2)
    ch, sh = xp.cos(heading / 2), xp.sin(heading / 2)
    return xp.stack(
        [
            cr * cp * ch + sr * sp * sh,
            sr * cp * ch - cr * sp * sh,
            cr * sp * ch + sr * cp * sh,
            cr * cp * sh - sr * sp * ch,
        ],
        -1,
    )


def to_euler(q: Float[Array, "*b 4"]) -> tuple[Array, Array, Array]:
    """Roll, pitch, heading [rad] of q_nb (NED from FRD): in [-pi, pi], [-pi/2, pi/2], [-pi, pi].

    At pitch = +-90 deg roll and heading are not distinct: roll is then set to zero and the heading
    takes the whole rotation. The angles follow from the half sum and the half difference of roll
    and heading (Bernardes & Viollet 2022), of which only one is lost near the vertical: so they
    describe the rotation to rounding at every pitch.

    Raises:
        ValueError: as `rotate`.
    """
    _refuse_no_quaternion(q)
    w, x, y, z = _components(q)
    # Cosine and sine of (roll - heading)/2 and of (roll + heading)/2, each pair times sqrt(2) and
    # times the sine of half the angle between the pitch and -90 or +90 deg.
    nose_up, nose_down = (w + y, x - z), (w - y, x + z)
    up, difference, at_bottom = _polar(*nose_up)
    down, total, at_top = _polar(*nose_down)
    pitch = jnp.arctan2(2.0 * (w * y - x * z), up * down)
    total = jnp.where(at_top, -difference, total)
    difference = jnp.where(at_bottom, -total, difference)
    return _within_half_turn(total + difference), pitch, _within_half_turn(total - difference)


def _polar(c, s):
    """Length and angle of (c, s) and whether it is too short to have an angle (then both zero)."""
    length_sq = c * c + s * s
    short = length_sq < _LOCK**2
    # Double `where`, as above: the derivatives at the origin are infinite.
    length = jnp.sqrt(jnp.where(short, 1.0, length_sq))
    angle = jnp.arctan2(jnp.where(short, 0.0, s), jnp.where(short, 1.0, c))
    return jnp.where(short, 0.0, length), angle, short


def _within_half_turn(angle):
    return angle - 2.0 * jnp.pi * jnp.round(angle / (2.0 * jnp.pi))


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
