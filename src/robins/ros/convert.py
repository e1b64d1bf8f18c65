"""Conversion of quantities in the frames of robins to messages of ROS, in the frames of ROS.

ROS has bodies forward-left-up and the Earth east-north-up (REP-103, REP-105); robins has FRD and
NED, or RFU and ENU. Quantities whose frames are named become FLU and ENU:

    v_FLU = (x, -y, -z) of FRD = (y, -x, z) of RFU        v_ENU = (y, x, -z) of NED

Without a name (a body in space, an inertial frame) axes are unchanged. Components are only permuted
and change sign, so each NaN stays NaN; quaternions are rounded. A quantity that is not given is
marked as the message defines: -1 in the covariance of an Imu, else NaN.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from robins.dataset import BodyFrame, NavFrame
from robins.ros.messages import (
    DIAGONAL_KNOWN,
    FIX,
    KNOWN,
    NO_FIX,
    UNKNOWN,
    Floats,
    Imu,
    MagneticField,
    NavSatFix,
    Odometry,
)


class _Axes(NamedTuple):
    """Map of a frame to that of ROS: component k there is `sign[k]` times `order[k]` here."""

    order: tuple[int, int, int]
    sign: tuple[float, float, float]
    q: tuple[float, float, float, float]  # the same as a quaternion, scalar first


_HALF = math.sqrt(0.5)
_SAME = _Axes((0, 1, 2), (1.0, 1.0, 1.0), (1.0, 0.0, 0.0, 0.0))
_AXES: dict[str | None, _Axes] = {
    None: _SAME,
    "ENU": _SAME,
    "NED": _Axes((1, 0, 2), (1.0, 1.0, -1.0), (0.0, _HALF, _HALF, 0.0)),
    "FRD": _Axes((0, 1, 2), (1.0, -1.0, -1.0), (0.0, 1.0, 0.0, 0.0)),
    "RFU": _Axes((1, 0, 2), (1.0, -1.0, 1.0), (_HALF, 0.0, 0.0, -_HALF)),
}
_NOT_KNOWN = (-1.0, *(0.0,) * 8)  # covariance of a quantity that an Imu does not measure
_NO_COVARIANCE = (0.0,) * 9
_NO_VECTOR = (math.nan,) * 3


def imu(
    omega_b: ArrayLike | None = None,
    f_b: ArrayLike | None = None,
    q_nb: ArrayLike | None = None,
    *,
    omega_covariance: ArrayLike | None = None,
    f_covariance: ArrayLike | None = None,
    q_covariance: ArrayLike | None = None,
    body: BodyFrame | None = None,
    nav: NavFrame | None = None,
) -> Imu:
    """Imu message of a sample of inertial sensors.

    Args:
        omega_b: (3,) turn rate against inertial space [rad/s].
        f_b: (3,) specific force [m/s^2].
        q_nb: (4,) attitude, scalar first, body to nav.
        omega_covariance: (3, 3) [(rad/s)^2].
        f_covariance: (3, 3) [(m/s^2)^2].
        q_covariance: (3, 3) of small rotations about the body's axes [rad^2].
        body: frame of the vectors and of the attitude; None: axes are unchanged.
        nav: frame to which the attitude maps; None: axes are unchanged.
    """
    to_b = _AXES[body]
    none = _NOT_KNOWN
    return Imu(
        (0.0, 0.0, 0.0, 1.0) if q_nb is None else _quaternion(q_nb, to_b, _AXES[nav]),
        none if q_nb is None else _covariance(q_covariance, to_b),
        (0.0, 0.0, 0.0) if omega_b is None else _vector(omega_b, to_b),
        none if omega_b is None else _covariance(omega_covariance, to_b),
        (0.0, 0.0, 0.0) if f_b is None else _vector(f_b, to_b),
        none if f_b is None else _covariance(f_covariance, to_b),
    )


def magnetic_field(
    field_t: ArrayLike, *, covariance: ArrayLike | None = None, body: BodyFrame | None = None
) -> MagneticField:
    """MagneticField message of a sample of a magnetometer.

    Args:
        field_t: (3,) [T], along the body's axes.
        covariance: (3, 3) [T^2].
        body: its axes; None: they stay.
    """
    return MagneticField(_vector(field_t, _AXES[body]), _covariance(covariance, _AXES[body]))


def nav_sat_fix(
    lat_rad: float,
    lon_rad: float,
    alt_m: float,
    *,
    covariance: ArrayLike | None = None,
    nav: NavFrame = "NED",
    status: int | None = None,
    service: int = 0,
) -> NavSatFix:
    """NavSatFix message of a fix of a GNSS receiver.

    Args:
        lat_rad: latitude.
        lon_rad: longitude.
        alt_m: above the WGS-84 ellipsoid.
        covariance: (3, 3) of the position along the axes of ``nav`` [m^2]; type "unknown" if one of
            its numbers is missing.
        nav: axes of the covariance.
        status: of ROS; None: a fix where latitude and longitude are numbers.
        service: of ROS.
    """
    if status is None:
        status = FIX if math.isfinite(lat_rad) and math.isfinite(lon_rad) else NO_FIX
    kind, spread = UNKNOWN, _covariance(covariance, _AXES[nav])
    if covariance is not None and all(map(math.isfinite, spread)):
        kind = KNOWN if any(x for k, x in enumerate(spread) if k % 4) else DIAGONAL_KNOWN
    place = math.degrees(lat_rad), math.degrees(lon_rad), float(alt_m)
    return NavSatFix(status, service, *place, spread, kind)


def odometry(
    *,
    r_n_m: ArrayLike | None = None,
    q_nb: ArrayLike | None = None,
    v_b_mps: ArrayLike | None = None,
    omega_b: ArrayLike | None = None,
    pose_covariance: ArrayLike | None = None,
    twist_covariance: ArrayLike | None = None,
    child_frame_id: str = "base_link",
    body: BodyFrame | None = None,
    nav: NavFrame | None = None,
) -> Odometry:
    """Odometry message of a pose and a velocity; quantities not given are NaN.

    Args:
        r_n_m: (3,) position along the axes of nav [m].
        q_nb: (4,) attitude, scalar first, body to nav.
        v_b_mps: (3,) velocity along the body's axes [m/s].
        omega_b: (3,) turn rate [rad/s], body axes.
        pose_covariance: (6, 6) of position [m] and of small rotations [rad] about the axes of nav.
        twist_covariance: (6, 6) of velocity [m/s] and turn rate [rad/s], body axes.
        child_frame_id: name of the body's frame.
        body: its axes; None: they stay.
        nav: frame of the position, to which the attitude maps; None: axes are unchanged.
    """
    to_b, to_n = _AXES[body], _AXES[nav]
    return Odometry(
        child_frame_id,
        _NO_VECTOR if r_n_m is None else _vector(r_n_m, to_n),
        (math.nan,) * 4 if q_nb is None else _quaternion(q_nb, to_b, to_n),
        _covariance(pose_covariance, to_n, 2),
        _NO_VECTOR if v_b_mps is None else _vector(v_b_mps, to_b),
        _NO_VECTOR if omega_b is None else _vector(omega_b, to_b),
        _covariance(twist_covariance, to_b, 2),
    )


def _vector(v: Any, axes: _Axes) -> Floats:
    (i, j, k), (a, b, c) = axes.order, axes.sign
    x = [float(one) for one in v]
    return a * x[i], b * x[j], c * x[k]


def _covariance(spread: ArrayLike | None, axes: _Axes, vectors: int = 1) -> Floats:
    """Covariance by rows, of one vector or of two in one matrix; zeros where it is not known."""
    size = 3 * vectors
    if spread is None:
        return _NO_COVARIANCE if vectors == 1 else (0.0,) * size**2
    order = [3 * k + i for k in range(vectors) for i in axes.order]
    sign = np.array(axes.sign * vectors)
    matrix = np.asarray(spread, np.float64).reshape(size, size)
    turned = matrix[np.ix_(order, order)] * np.outer(sign, sign)
    return (turned + 0.0).ravel().tolist()  # no -0.0


def _quaternion(q_nb: Any, body: _Axes, nav: _Axes) -> Floats:
    """Quaternion in the order of ROS, x, y, z, w."""
    w, x, y, z = (float(one) for one in q_nb)
    if body is not _SAME or nav is not _SAME:
        a, b, c, d = body.q
        w, x, y, z = _product(nav.q, _product((w, x, y, z), (a, -b, -c, -d)))
    return x, y, z, w


def _product(p: Floats, q: Floats) -> Floats:
    """The product, scalar first; that of `robins.rotation` is slow for one quaternion."""
    (a, b, c, d), (w, x, y, z) = p, q
    return (
        a * w - b * x - c * y - d * z,
        a * x + b * w + c * z - d * y,
        a * y - b * z + c * w + d * x,
        a * z + b * y - c * x + d * w,
    )
