"""Inertial navigation: frames, increments, mechanisation, error dynamics.

- `frames`: NED/FRD and ENU/RFU, the same thing relabelled.
"""

from robins.ins.frames import swap, swap_q, to_enu_rfu, to_ned_frd

__all__ = [
    "swap",
    "swap_q",
    "to_enu_rfu",
    "to_ned_frd",
]
