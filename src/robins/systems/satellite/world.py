"""One run: what the sensors will be off by, drawn beforehand, and how it begins."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from robins.ins.imu_errors import TriadErrors
from robins.rotation import from_rotvec, multiply
from robins.sim.gyro import gyro_errors
from robins.sim.random import Component, stream
from robins.sim.spacecraft import CraftState, craft_state
from robins.sim.star_sensor import star_errors
from robins.systems.satellite.course import Course
from robins.systems.satellite.parameters import AttitudeLoop, Gyro

# Folded into the key of the gyro beside the streams of `robins.sim.gyro`.
_BIAS, _RAMP = 16, 17
_CAMERA = 16  # into that of the star sensor, beside the streams of `robins.sim.star_sensor`


class World(NamedTuple):
    """One run; E steps."""

    gyro_angle: Array  # (E, 3) error of the angle of each sample [rad]
    gyro_bias: Array  # (E, 3) its slow part, as a rate [rad/s]
    gyro_matrix: Array  # (3, 3) scale factor errors and misalignments
    star_error: Array  # (E, 3) error of the star sensor at the end of each step [rad]
    star_key: Array  # of what a camera sees
    craft: CraftState  # at the beginning
    start_q_ib: Array  # (4,) attitude that filters begin with


def true_errors(gyro: Gyro, bias: Array, ramp: Array) -> TriadErrors:
    """The gyro as it is; what the parameters give as a half-width of a uniform error is drawn."""
    return TriadErrors(
        bias=bias,
        ramp=ramp,
        markov_sigma=gyro.markov,
        markov_tau_s=gyro.markov_time,
        walk=gyro.rate_walk,
        white=gyro.random_walk,
        scale_sigma=gyro.scale_factor,
        misalignment_sigma=gyro.misalignment * (1.0 - np.eye(3)),
    )


def simulate(given: AttitudeLoop, course: Course, seed: int, index: Array) -> World:
    """One run, from its number, which may be traced; pure."""
    key = partial(stream, seed, index)
    unit, begin = key(Component.IMU), key(Component.INITIAL_STATE)

    def uniform(number: int) -> Array:
        return jax.random.uniform(jax.random.fold_in(unit, number), (3,), minval=-1.0)

    drawn = true_errors(
        given.gyro, given.gyro.bias * uniform(_BIAS), given.gyro.ramp * uniform(_RAMP)
    )
    count = len(course.time_s)
    gyro = gyro_errors(unit, drawn, count, given.step)
    s, frames = given.star, np.flatnonzero(course.due)
    eye = key(Component.STAR_SENSOR)
    errors = star_errors(
        eye,
        s.noise if s.camera is None else 0.0,
        s.period,
        len(frames),
        s.low_frequency,
        s.low_frequency_period,
    )
    first = course.steps
    q0 = first.ref_q_ib[0]
    off = given.believed.attitude * jax.random.normal(begin, (3,))
    return World(
        gyro_angle=gyro.angle,
        gyro_bias=gyro.bias,
        gyro_matrix=gyro.matrix,
        star_error=jnp.zeros((count, 3)).at[frames].set(errors),
        star_key=jax.random.fold_in(eye, _CAMERA),
        craft=craft_state(course.craft, q0, first.ref_omega_b[0], given.wheels.start),
        start_q_ib=multiply(q0, from_rotvec(off)),
    )
