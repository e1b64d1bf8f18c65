"""Inertial navigation: frames, increments, mechanisation, error dynamics.

- `frames`: NED/FRD and ENU/RFU, and the conversion between them.
- `increments`: IMU samples to rotation vectors and velocity increments.
- `mechanise`: attitude, velocity and position from increments (``step``, ``mechanise``).
- `state`: the state of an aided INS, propagated over a block, with or without its transition.
- `errors`: the error dynamics F and G.
- `imu_errors`: error models of gyros and accelerometers, from data sheets.
- `allan`: Allan deviation with bounds, and the noises fitted to it (import it by its name).
- `magnetometer_calibration`: hard and soft iron from rotations (import it by its name).
- `vector_attitude`: attitude from stars; `star_identification`: their identification, lost in space
  or with an approximate attitude (import them by their names).
- `alignment`: attitude at rest, from gravity, Earth rate or velocity; `rest`: detection of rest.
"""

from typing import TYPE_CHECKING

from robins.errors import lazy, places

if TYPE_CHECKING:
    from robins.ins.alignment import (
        Alignment,
        StaticCheck,
        align,
        gyrocompass,
        heading_from_velocity,
        is_static,
        level,
    )
    from robins.ins.extended_pose import ExtendedPose
    from robins.ins.frames import swap, swap_q, to_enu_rfu, to_ned_frd
    from robins.ins.imu_errors import ImuErrorModel, TriadErrors, grade
    from robins.ins.increments import Increments, from_imu
    from robins.ins.invariant import (
        InvariantState,
        direction_sensor,
        invariant_motion,
        landmark_sensor,
        position_sensor,
        velocity_sensor,
    )
    from robins.ins.mechanise import Nav, as_trajectory, nav_at, refuse_polar
    from robins.ins.state import InsNoise, InsState, propagate, propagate_linear

__all__ = [
    "Alignment",
    "ExtendedPose",
    "ImuErrorModel",
    "Increments",
    "InsNoise",
    "InsState",
    "InvariantState",
    "Nav",
    "StaticCheck",
    "TriadErrors",
    "align",
    "as_trajectory",
    "direction_sensor",
    "from_imu",
    "grade",
    "gyrocompass",
    "heading_from_velocity",
    "invariant_motion",
    "is_static",
    "landmark_sensor",
    "level",
    "nav_at",
    "position_sensor",
    "propagate",
    "propagate_linear",
    "refuse_polar",
    "swap",
    "swap_q",
    "to_enu_rfu",
    "to_ned_frd",
    "velocity_sensor",
]

_FILES = {
    "alignment": "Alignment StaticCheck align gyrocompass heading_from_velocity is_static level",
    "extended_pose": "ExtendedPose",
    "frames": "swap swap_q to_enu_rfu to_ned_frd",
    "imu_errors": "ImuErrorModel TriadErrors grade",
    "increments": "Increments from_imu",
    "invariant": "InvariantState direction_sensor invariant_motion landmark_sensor position_sensor "
    "velocity_sensor",
    "mechanise": "Nav as_trajectory nav_at refuse_polar",
    "state": "InsNoise InsState propagate propagate_linear",
}

__getattr__ = lazy(__name__, places(__name__, _FILES))
