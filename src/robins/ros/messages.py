"""Four messages of ROS 2: their fields without the header, and their definitions.

Fields, names and constants are those of the packages sensor_msgs, nav_msgs, geometry_msgs and
std_msgs (github.com/ros2/common_interfaces, branch humble). Vectors are x, y, z, quaternions x, y,
z, w, covariances row-major. Angles are radians, except latitude and longitude: degrees.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, TypeAlias

Floats: TypeAlias = Sequence[float]

UNKNOWN, DIAGONAL_KNOWN, KNOWN = 0, 2, 3  # types of the covariance of a NavSatFix
NO_FIX, FIX = -1, 0  # values of `NavSatFix.status`


class Imu(NamedTuple):
    """sensor_msgs/msg/Imu, along the axes of the header's frame, which is the sensor's.

    All zeros in a covariance: it is not known. -1 in its first element: the quantity is not known.
    """

    orientation: Floats  # (4,) from the header's frame to east-north-up
    orientation_covariance: Floats  # (9,) rad^2
    angular_velocity: Floats  # (3,) rad/s
    angular_velocity_covariance: Floats  # (9,) (rad/s)^2
    linear_acceleration: Floats  # (3,) m/s^2 specific force: +9.8 up at rest (REP-145)
    linear_acceleration_covariance: Floats  # (9,) (m/s^2)^2


class MagneticField(NamedTuple):
    """sensor_msgs/msg/MagneticField, along the axes of the header's frame; NaN: not measured."""

    magnetic_field: Floats  # (3,) T
    magnetic_field_covariance: Floats  # (9,) T^2; all zeros: not known


class NavSatFix(NamedTuple):
    """sensor_msgs/msg/NavSatFix; the header's frame is that of the antenna."""

    status: int  # `FIX` or `NO_FIX`, or 1 and 2 with augmentation
    service: int  # bits of the systems used; 0: not reported
    latitude: float  # deg
    longitude: float  # deg
    altitude: float  # m above the WGS-84 ellipsoid
    position_covariance: Floats  # (9,) m^2 along east, north, up
    position_covariance_type: int


class Odometry(NamedTuple):
    """nav_msgs/msg/Odometry: a pose in the header's frame, a velocity in the child's."""

    child_frame_id: str
    position: Floats  # (3,) m
    orientation: Floats  # (4,) from the child's frame to the header's
    pose_covariance: Floats  # (36,) m, rad; of position, then of rotation about its axes
    linear: Floats  # (3,) m/s
    angular: Floats  # (3,) rad/s
    twist_covariance: Floats  # (36,) m/s, rad/s


Message: TypeAlias = Imu | MagneticField | NavSatFix | Odometry

TYPES: dict[str, type[Message]] = {
    "sensor_msgs/msg/Imu": Imu,
    "sensor_msgs/msg/MagneticField": MagneticField,
    "sensor_msgs/msg/NavSatFix": NavSatFix,
    "nav_msgs/msg/Odometry": Odometry,
}
_NAMES = {kind: name for name, kind in TYPES.items()}


def name_of(kind: type[Message]) -> str:
    """The name of a type in ROS."""
    return _NAMES[kind]


_DEFINITIONS: dict[str, str] = {  # in the order in which each names others
    "sensor_msgs/Imu": """\
std_msgs/Header header
geometry_msgs/Quaternion orientation
float64[9] orientation_covariance
geometry_msgs/Vector3 angular_velocity
float64[9] angular_velocity_covariance
geometry_msgs/Vector3 linear_acceleration
float64[9] linear_acceleration_covariance
""",
    "sensor_msgs/MagneticField": """\
std_msgs/Header header
geometry_msgs/Vector3 magnetic_field
float64[9] magnetic_field_covariance
""",
    "sensor_msgs/NavSatFix": """\
std_msgs/Header header
sensor_msgs/NavSatStatus status
float64 latitude
float64 longitude
float64 altitude
float64[9] position_covariance
uint8 COVARIANCE_TYPE_UNKNOWN=0
uint8 COVARIANCE_TYPE_APPROXIMATED=1
uint8 COVARIANCE_TYPE_DIAGONAL_KNOWN=2
uint8 COVARIANCE_TYPE_KNOWN=3
uint8 position_covariance_type
""",
    "sensor_msgs/NavSatStatus": """\
int8 STATUS_NO_FIX=-1
int8 STATUS_FIX=0
int8 STATUS_SBAS_FIX=1
int8 STATUS_GBAS_FIX=2
int8 status
uint16 SERVICE_GPS=1
uint16 SERVICE_GLONASS=2
uint16 SERVICE_COMPASS=4
uint16 SERVICE_GALILEO=8
uint16 service
""",
    "nav_msgs/Odometry": """\
std_msgs/Header header
string child_frame_id
geometry_msgs/PoseWithCovariance pose
geometry_msgs/TwistWithCovariance twist
""",
    "geometry_msgs/PoseWithCovariance": "geometry_msgs/Pose pose\nfloat64[36] covariance\n",
    "geometry_msgs/Pose": ("geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n"),
    "geometry_msgs/Point": "float64 x\nfloat64 y\nfloat64 z\n",
    "geometry_msgs/Quaternion": "float64 x 0\nfloat64 y 0\nfloat64 z 0\nfloat64 w 1\n",
    "geometry_msgs/TwistWithCovariance": "geometry_msgs/Twist twist\nfloat64[36] covariance\n",
    "geometry_msgs/Twist": "geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular\n",
    "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z\n",
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id\n",
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec\n",
}


def definition(kind: type[Message]) -> str:
    """Definition of a type and of the types in it, in the format of MCAP's schema "ros2msg".

    Source: registry of MCAP (mcap.dev/spec/registry), schema encoding ros2msg.
    """
    name = name_of(kind).replace("/msg/", "/")
    needed = [name]
    for one in needed:  # grows while it is read
        words = (line.split()[0] for line in _DEFINITIONS[one].splitlines())
        needed += [word for word in words if word in _DEFINITIONS and word not in needed]
    rest = (f"{'=' * 80}\nMSG: {other}\n{_DEFINITIONS[other]}" for other in needed[1:])
    return _DEFINITIONS[name] + "".join(rest)
