"""Messages of ROS 2 for other tools: their fields, axes, bytes and definitions.

- `messages`: four messages for a vehicle's sensors and estimates, and their definitions.
- `convert`: from the frames of robins to those of ROS (REP-103, REP-105).
- `cdr`: the bytes of a message.
"""

from robins.ros.cdr import NUMBERS, RosError, Stamped, decode, encode, numbers
from robins.ros.convert import imu, magnetic_field, nav_sat_fix, odometry
from robins.ros.messages import (
    TYPES,
    Imu,
    MagneticField,
    Message,
    NavSatFix,
    Odometry,
    definition,
    name_of,
)

__all__ = [
    "NUMBERS",
    "TYPES",
    "Imu",
    "MagneticField",
    "Message",
    "NavSatFix",
    "Odometry",
    "RosError",
    "Stamped",
    "decode",
    "definition",
    "encode",
    "imu",
    "magnetic_field",
    "name_of",
    "nav_sat_fix",
    "numbers",
    "odometry",
]
