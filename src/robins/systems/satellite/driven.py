"""What drives the loop from outside, step by step, and how a star camera knows its stars."""

from __future__ import annotations

from typing import NamedTuple

from jaxtyping import Array

from robins.earth.stars import StarIndex
from robins.sim.star_sensor import StarCamera


class StarSays(NamedTuple):
    """What the star sensor makes of the truth at the end of a step, besides noise."""

    seen: Array  # () bool, whether there is a frame
    stuck: Array  # () bool, whether it is the last one again
    turn: Array  # (3,) rad, rotation vector in sensor axes
    factor: Array  # () of the components of the quaternion: 1, -1, or wrong


class Step(NamedTuple):
    """What acts in a step, from outside; with leading axis E in a course."""

    ref_q_ib: Array  # (4,) wanted attitude at its beginning
    ref_omega_b: Array  # (3,) its rate
    ref_alpha_b: Array  # (3,) and angular acceleration
    ref_end_q_ib: Array  # (4,) wanted attitude at its end
    r_i_m: Array  # (3,) place in the middle of it
    field_i_t: Array  # (3,) magnetic field there
    disturbance_b: Array  # (3,) N m
    wheel_works: Array  # (W,) 1, or 0 for a wheel that gives no torque
    star: StarSays
    number: Array  # () of the step, from 0


class Lens(NamedTuple):
    """The camera of a star sensor, and how it knows its stars."""

    camera: StarCamera
    sky: StarIndex
    match_rad: Array  # () how near a star must be to where it is expected
