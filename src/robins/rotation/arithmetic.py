"""Quaternions, direction cosine matrices and Euler angles: what NumPy computes as well as JAX.

Each function computes by NumPy where NumPy is given, with nothing to compile, else by JAX.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from robins.errors import require
from robins.linalg import scalars
from robins.linalg.library import Each, Real, is_traced, library

SMALL = 1e-3  # rad^2; below it, series whose dropped terms are below 1e-18
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
    if not is_traced(q):
        with np.errstate(all="ignore"):
            size = np.linalg.norm(np.asarray(q), axis=-1)
            worst = np.max(np.abs(size - 1.0), initial=0.0, where=~np.isnan(size))
        require(
            worst <= _SKEWED,
            f"no rotation: the length of a quaternion differs from 1 by {worst:.3g}; "
            "rotation.normalise makes it 1",
        )


def _components(q):
    return q[..., 0], q[..., 1], q[..., 2], q[..., 3]


def skew(v: Float[Real, "*b 3"]) -> Float[Real, "*b 3 3"]:
    """Cross-product matrix: ``skew(a) @ b == cross(a, b)``."""
    xp = library(v)
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    o = xp.zeros_like(x)
    rows = [xp.stack(r, -1) for r in ((o, -z, y), (z, o, -x), (-y, x, o))]
    return xp.stack(rows, -2)


def multiply(p: Float[Real, "*#b 4"], q: Float[Real, "*#b 4"]) -> Float[Real, "*b 4"]:
    """Hamilton product p q: rotate by q first, then by p."""
    factors = (_components(a) for a in _same_rank(p, q))
    return library(p, q).stack(scalars.product(*factors), -1)


def conjugate(q: Float[Real, "*b 4"]) -> Float[Real, "*b 4"]:
    """Inverse of a unit quaternion."""
    return library(q).concatenate([q[..., :1], -q[..., 1:]], -1)


def normalise(q: Float[Real, "*b 4"]) -> Float[Real, "*b 4"]:
    """Scale to unit length.

    Raises:
        ValueError: a length is zero or not finite; not in compiled code.
    """
    if not is_traced(q):
        with np.errstate(all="ignore"):
            size = np.linalg.norm(np.asarray(q), axis=-1)
        require(
            not np.any((size == 0.0) | np.isinf(size)),
            "no rotation: a quaternion of length zero, or of none that is a finite number",
        )
    return q / library(q).linalg.norm(q, axis=-1, keepdims=True)


def rotate(q: Float[Real, "*#b 4"], v: Float[Real, "*#b 3"]) -> Float[Real, "*b 3"]:
    """Rotate vectors; with q_nb, body components become navigation components.

    Raises:
        ValueError: q is not a unit quaternion (to 0.05; compiled code does not check the norm).
    """
    _refuse_no_quaternion(q)
    xp = library(q, v)
    q, v = _same_rank(q, v)
    w, u = q[..., :1], q[..., 1:]
    t = 2.0 * xp.cross(u, v)
    return v + w * t + xp.cross(u, t)


def to_rotvec(q: Float[Real, "*b 4"]) -> Float[Real, "*b 3"]:
    """Rotation vector [rad] of length at most pi; q and -q give the same, and so does 2 q."""
    xp = library(q)
    q = xp.where(q[..., :1] < 0.0, -q, q)
    w, u = q[..., :1], q[..., 1:]
    s_sq = xp.sum(u * u, -1, keepdims=True)
    small = s_sq < SMALL
    safe = xp.where(small, 1.0, s_sq)
    s = xp.sqrt(safe)
    x = xp.where(small, s_sq / xp.where(small, w * w, 1.0), 0.0)
    # 2 atan2(s, w)/s; the series is that of 2 atan(t)/t with t = s/w, over w
    series = 2.0 * (1.0 - x * (1 / 3 - x * (1 / 5 - x * (1 / 7 - x * (1 / 9 - x / 11)))))
    series = series / xp.where(small, w, 1.0)
    return xp.where(small, series, 2.0 * xp.arctan2(s, xp.where(small, 1.0, w)) / s) * u


def to_dcm(q: Float[Real, "*b 4"]) -> Float[Real, "*b 3 3"]:
    """Direction cosine matrix: ``v_n = C_nb @ v_b``.

    Raises:
        ValueError: as `rotate`.
    """
    _refuse_no_quaternion(q)
    xp = library(q)
    return xp.stack([xp.stack(row, -1) for row in scalars.dcm(_components(q))], -2)


def from_dcm(C: Float[Real, "*b 3 3"]) -> Float[Real, "*b 4"]:
    """Quaternion of a direction cosine matrix, scalar part not negative (Shepperd 1978).

    Shepperd's method divides by the largest of the four components, so no case is ill-conditioned.

    Raises:
        ValueError: C is not a rotation: a reflection, or not orthogonal to 0.05. In compiled code,
            which cannot raise, a reflection gives NaN.
    """
    shape = np.shape(C)
    require(shape[-2:] == (3, 3), f"a direction cosine matrix is 3 x 3, got {shape}")
    reflected, xp = _refuse_no_rotation(C), library(C)
    c = [[C[..., i, j] for j in range(3)] for i in range(3)]
    trace = c[0][0] + c[1][1] + c[2][2]
    d = xp.stack([trace, c[0][0], c[1][1], c[2][2]], -1)
    cand = (
        (1 + trace, c[2][1] - c[1][2], c[0][2] - c[2][0], c[1][0] - c[0][1]),
        (c[2][1] - c[1][2], 1 + 2 * c[0][0] - trace, c[0][1] + c[1][0], c[0][2] + c[2][0]),
        (c[0][2] - c[2][0], c[0][1] + c[1][0], 1 + 2 * c[1][1] - trace, c[1][2] + c[2][1]),
        (c[1][0] - c[0][1], c[0][2] + c[2][0], c[1][2] + c[2][1], 1 + 2 * c[2][2] - trace),
    )
    table = xp.stack([xp.stack(k, -1) for k in cand], -2)
    best = xp.argmax(d, -1)
    q = xp.take_along_axis(table, best[..., None, None], -2)[..., 0, :]
    q = normalise(q)
    q = xp.where(q[..., :1] < 0.0, -q, q)
    return q if reflected is None else xp.where(reflected[..., None], xp.nan, q)


def _refuse_no_rotation(C: Real) -> Real:
    """Refuse a matrix that is not a rotation; return the mask of reflections if it is traced, else
    None.
    """
    if is_traced(C):
        jnp = library(C)
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
    angles = [
        np.asarray(a) if isinstance(a, np.generic) else a
        for a in (roll_rad, pitch_rad, heading_rad)
    ]
    xp = library(*angles)
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


def to_euler(q: Float[Real, "*b 4"]) -> tuple[Each, Each, Each]:
    """Roll, pitch, heading [rad] of q_nb (NED from FRD): in [-pi, pi], [-pi/2, pi/2], [-pi, pi].

    At pitch = +-90 deg roll and heading are not distinct: roll is then set to zero and the heading
    takes the whole rotation. The angles follow from the half sum and the half difference of roll
    and heading (Bernardes & Viollet 2022), of which only one is lost near the vertical: so they
    describe the rotation to rounding at every pitch.

    Raises:
        ValueError: as `rotate`.
    """
    _refuse_no_quaternion(q)
    xp = library(q)
    w, x, y, z = _components(q)
    # Cosine and sine of (roll - heading)/2 and of (roll + heading)/2, each pair times sqrt(2) and
    # times the sine of half the angle between the pitch and -90 or +90 deg.
    nose_up, nose_down = (w + y, x - z), (w - y, x + z)
    up, difference, at_bottom = _polar(xp, *nose_up)
    down, total, at_top = _polar(xp, *nose_down)
    pitch = xp.arctan2(2.0 * (w * y - x * z), up * down)
    total = xp.where(at_top, -difference, total)
    difference = xp.where(at_bottom, -total, difference)
    return (
        _within_half_turn(xp, total + difference),
        pitch,
        _within_half_turn(xp, total - difference),
    )


def _polar(xp, c, s):
    """Length and angle of (c, s) and whether it is too short to have an angle (then both zero)."""
    length_sq = c * c + s * s
    short = length_sq < _LOCK**2
    # Double `where`, as above: the derivatives at the origin are infinite.
    length = xp.sqrt(xp.where(short, 1.0, length_sq))
    angle = xp.arctan2(xp.where(short, 0.0, s), xp.where(short, 1.0, c))
    return xp.where(short, 0.0, length), angle, short


def _within_half_turn(xp, angle):
    return angle - 2.0 * np.pi * xp.round(angle / (2.0 * np.pi))
