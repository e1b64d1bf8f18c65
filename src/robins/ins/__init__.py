"""Inertial navigation: frames, increments, mechanisation, error dynamics.

- `frames`: NED/FRD and ENU/RFU, the same thing relabelled.
- `increments`: IMU samples to rotation vectors and velocity increments.
- `mechanise`: attitude, velocity and position from increments (``step``, ``mechanise``).
"""

from robins.ins.frames import swap, swap_q, to_enu_rfu, to_ned_frd
from robins.ins.increments import Increments, from_imu, thin
from robins.ins.mechanise import Nav, as_trajectory, nav_at, refuse_polar

__all__ = [
    "Increments",
    "Nav",
    "as_trajectory",
    "from_imu",
    "nav_at",
    "refuse_polar",
    "swap",
    "swap_q",
    "thin",
    "to_enu_rfu",
    "to_ned_frd",
]
