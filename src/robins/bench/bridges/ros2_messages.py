"""Three messages of ROS 2: made of what robins has, read into it, and as bytes.

    sensor_msgs/msg/Imu        `ImuSample`; FLU, orientation FLU to ENU, scalar last
    sensor_msgs/msg/NavSatFix  `NavSatFix`; degrees, height above WGS-84, covariance ENU
    nav_msgs/msg/Odometry      `Odometry`; pose ENU, twist FLU, so the velocity too

(ROS, common_interfaces; REP 103 for axes, REP 145 for IMUs.) Here everything is in SI and radians,
in NED and FRD. A covariance that is not known is all zeros in ROS and None here; an IMU without an
attitude says -1 in the first element of its covariance.

On the wire a message is CDR (OMG, DDS-XTypes 1.3, encoding version 1), which `encode` and `decode`
leave to rosbags: nothing else here knows bytes.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from robins.bench.bridges import frames
from robins.bench.bridges.errors import BridgeError, needed
from robins.rotation import to_dcm

Vector = Float[np.ndarray, "3"]
Quaternion = Float[np.ndarray, "4"]
Square = Float[np.ndarray, "3 3"]
Pose = Float[np.ndarray, "6 6"]

DISTRO = "jazzy"  # whose definitions are used
GPS_SERVICE = 1
_NO_ATTITUDE = np.array([1.0, 0.0, 0.0, 0.0])  # in the place of one; its covariance says so


@dataclass(frozen=True, kw_only=True)
class ImuSample:
    """A sample of an inertial unit.

    Attributes:
        time_ns: of the sample.
        omega_ib_b_rad_s: rate, FRD.
        f_b_m_s2: specific force, FRD.
        q_nb: FRD to NED, scalar first; None: the unit determines no attitude.
        attitude_covariance: (3, 3) [rad^2], of a rotation vector in NED.
        omega_covariance: (3, 3) [rad^2/s^2], FRD.
        f_covariance: (3, 3) [m^2/s^4], FRD.
        frame: name of the body axes.
    """

    time_ns: int
    omega_ib_b_rad_s: Vector
    f_b_m_s2: Vector
    q_nb: Quaternion | None = None
    attitude_covariance: Square | None = None
    omega_covariance: Square | None = None
    f_covariance: Square | None = None
    frame: str = "base_link"


@dataclass(frozen=True, kw_only=True)
class NavSatFix:
    """A fix of a GNSS receiver.

    Attributes:
        time_ns: of the fix.
        lat_rad, lon_rad: geodetic, WGS-84.
        alt_m: above the ellipsoid, not above mean sea level.
        covariance_n_m2: (3, 3) of the position, NED.
        valid: whether the receiver has a fix.
        frame: name of the antenna's place.
    """

    time_ns: int
    lat_rad: float
    lon_rad: float
    alt_m: float
    covariance_n_m2: Square | None = None
    valid: bool = True
    frame: str = "gps"


@dataclass(frozen=True, kw_only=True)
class Odometry:
    """A pose and its rates.

    Attributes:
        time_ns: of the pose.
        position_n_m: north, east, down of the origin.
        q_nb: FRD to NED, scalar first.
        v_n_m_s: north, east, down.
        omega_nb_b_rad_s: rate against the local level, FRD.
        pose_covariance: (6, 6) of the position [m] and of a rotation vector [rad], both NED.
        twist_covariance: (6, 6) of velocity [m/s] and rate [rad/s], both FRD.
        frame: name of the local-level frame.
        child: name of the body axes.
    """

    time_ns: int
    position_n_m: Vector
    q_nb: Quaternion
    v_n_m_s: Vector
    omega_nb_b_rad_s: Vector
    pose_covariance: Pose | None = None
    twist_covariance: Pose | None = None
    frame: str = "odom"
    child: str = "base_link"


RosRecord = ImuSample | NavSatFix | Odometry


@functools.cache
def typestore(distro: str = DISTRO) -> Any:
    """The definitions of messages of a distribution of ROS 2, as rosbags has them.

    Raises:
        BridgeError: rosbags does not know the distribution.
        MissingPackage: rosbags is not installed.
    """
    known = needed("rosbags.typesys", "ros")
    try:
        return known.get_typestore(known.Stores(f"ros2_{distro}"))
    except ValueError:
        names = [s.value.removeprefix("ros2_") for s in known.Stores if "ros2" in s.value]
        raise BridgeError(
            f"no distribution '{distro}' of ROS 2", fix=f"there are {', '.join(names)}"
        ) from None


def encode(record: RosRecord) -> bytes:
    """A record as CDR, with its header of four bytes.

    Raises:
        MissingPackage: rosbags is not installed.
    """
    form = FORMS[type(record)]
    return bytes(typestore().serialize_cdr(form.message(record), form.name))


def decode(kind: type[RosRecord], data: bytes) -> RosRecord:
    """The record of bytes of CDR.

    Raises:
        BridgeError: they are no such message.
        MissingPackage: rosbags is not installed.
    """
    form = FORMS[kind]
    store = typestore()
    try:
        return form.record(store.deserialize_cdr(data, form.name))
    except Exception as error:  # rosbags has no error of its own for bytes that end too soon
        raise BridgeError(f"{len(data)} bytes are no {form.name}: {error!r}") from error


# ------------------------------------------------------------------------------------------ parts


def _make(name: str, *values: Any) -> Any:
    return typestore().types[name](*values)


def _header(time_ns: int, frame: str) -> Any:
    stamp = _make("builtin_interfaces/msg/Time", *divmod(time_ns, 1_000_000_000))
    return _make("std_msgs/msg/Header", stamp, frame)


def _time_ns(header: Any) -> int:
    return header.stamp.sec * 1_000_000_000 + header.stamp.nanosec


def _vector(v: np.ndarray, name: str = "Vector3") -> Any:
    return _make(f"geometry_msgs/msg/{name}", *(float(x) for x in v))


def _quaternion(q_nb: np.ndarray) -> Any:
    return _vector(frames.xyzw(frames.enu_flu_from_ned_frd(q_nb)), "Quaternion")


def _array(v: Any) -> np.ndarray:
    return np.array([v.x, v.y, v.z])


def _q_nb(q: Any) -> np.ndarray:
    return frames.ned_frd_from_enu_flu(np.array([q.w, q.x, q.y, q.z]))


def _flat(P: np.ndarray | None, turn: Callable[[np.ndarray], np.ndarray], size: int = 3) -> Any:
    """A covariance in the frame of the message, by rows, its 3 x 3 blocks turned alike."""
    if P is None:
        return np.zeros(size * size)
    return _by_blocks(P, turn).ravel()


def _square(flat: Any, turn: Callable[[np.ndarray], np.ndarray], size: int = 3) -> Any:
    """The covariance of a message, None where it tells none."""
    P = np.array(flat, float).reshape(size, size)
    return _by_blocks(P, turn) if P.any() else None


def _by_blocks(P: np.ndarray, turn: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    places = range(0, len(P), 3)
    return np.block([[turn(P[i : i + 3, j : j + 3]) for j in places] for i in places])


# --------------------------------------------------------------------------------------- messages


def _imu(s: ImuSample) -> Any:
    if s.q_nb is None:
        orientation, covariance = _NO_ATTITUDE, np.array([-1.0] + [0.0] * 8)
    else:
        orientation = s.q_nb
        covariance = _flat(s.attitude_covariance, frames.enu_covariance_from_ned)
    return _make(
        FORMS[ImuSample].name,
        _header(s.time_ns, s.frame),
        _quaternion(orientation),
        covariance,
        _vector(frames.flu_from_frd(s.omega_ib_b_rad_s)),
        _flat(s.omega_covariance, frames.flu_covariance_from_frd),
        _vector(frames.flu_from_frd(s.f_b_m_s2)),
        _flat(s.f_covariance, frames.flu_covariance_from_frd),
    )


def _imu_record(m: Any) -> ImuSample:
    attitude = m.orientation_covariance[0] != -1.0
    turn, same = frames.ned_covariance_from_enu, frames.frd_covariance_from_flu
    return ImuSample(
        time_ns=_time_ns(m.header),
        omega_ib_b_rad_s=frames.frd_from_flu(_array(m.angular_velocity)),
        f_b_m_s2=frames.frd_from_flu(_array(m.linear_acceleration)),
        q_nb=_q_nb(m.orientation) if attitude else None,
        attitude_covariance=_square(m.orientation_covariance, turn) if attitude else None,
        omega_covariance=_square(m.angular_velocity_covariance, same),
        f_covariance=_square(m.linear_acceleration_covariance, same),
        frame=m.header.frame_id,
    )


def _fix(s: NavSatFix) -> Any:
    known = s.covariance_n_m2 is not None
    return _make(
        FORMS[NavSatFix].name,
        _header(s.time_ns, s.frame),
        _make("sensor_msgs/msg/NavSatStatus", 0 if s.valid else -1, GPS_SERVICE),
        math.degrees(s.lat_rad),
        math.degrees(s.lon_rad),
        s.alt_m,
        _flat(s.covariance_n_m2, frames.enu_covariance_from_ned),
        3 if known else 0,  # COVARIANCE_TYPE_KNOWN, _UNKNOWN
    )


def _fix_record(m: Any) -> NavSatFix:
    known = m.position_covariance_type != 0
    turn = frames.ned_covariance_from_enu
    return NavSatFix(
        time_ns=_time_ns(m.header),
        lat_rad=math.radians(m.latitude),
        lon_rad=math.radians(m.longitude),
        alt_m=m.altitude,
        covariance_n_m2=_square(m.position_covariance, turn) if known else None,
        valid=m.status.status >= 0,
        frame=m.header.frame_id,
    )


def _odometry(s: Odometry) -> Any:
    v_b = to_dcm(s.q_nb).T @ s.v_n_m_s
    pose = _make(
        "geometry_msgs/msg/Pose",
        _vector(frames.enu_from_ned(s.position_n_m), "Point"),
        _quaternion(s.q_nb),
    )
    twist = _make(
        "geometry_msgs/msg/Twist",
        _vector(frames.flu_from_frd(v_b)),
        _vector(frames.flu_from_frd(s.omega_nb_b_rad_s)),
    )
    pose_covariance = _flat(s.pose_covariance, frames.enu_covariance_from_ned, 6)
    twist_covariance = _flat(s.twist_covariance, frames.flu_covariance_from_frd, 6)
    return _make(
        FORMS[Odometry].name,
        _header(s.time_ns, s.frame),
        s.child,
        _make("geometry_msgs/msg/PoseWithCovariance", pose, pose_covariance),
        _make("geometry_msgs/msg/TwistWithCovariance", twist, twist_covariance),
    )


def _odometry_record(m: Any) -> Odometry:
    pose, twist = m.pose.pose, m.twist.twist
    q_nb = _q_nb(pose.orientation)
    return Odometry(
        time_ns=_time_ns(m.header),
        position_n_m=frames.ned_from_enu(_array(pose.position)),
        q_nb=q_nb,
        v_n_m_s=to_dcm(q_nb) @ frames.frd_from_flu(_array(twist.linear)),
        omega_nb_b_rad_s=frames.frd_from_flu(_array(twist.angular)),
        pose_covariance=_square(m.pose.covariance, frames.ned_covariance_from_enu, 6),
        twist_covariance=_square(m.twist.covariance, frames.frd_covariance_from_flu, 6),
        frame=m.header.frame_id,
        child=m.child_frame_id,
    )


class RosForm(NamedTuple):
    """How a record and its message become each other."""

    name: str
    message: Callable[[Any], Any]
    record: Callable[[Any], RosRecord]


FORMS: dict[type, RosForm] = {
    ImuSample: RosForm("sensor_msgs/msg/Imu", _imu, _imu_record),
    NavSatFix: RosForm("sensor_msgs/msg/NavSatFix", _fix, _fix_record),
    Odometry: RosForm("nav_msgs/msg/Odometry", _odometry, _odometry_record),
}
