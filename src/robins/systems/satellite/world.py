"""Data of all runs (orbit, field, reference, star frames), and draws for one of them."""

from __future__ import annotations

import math
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from robins.earth.stars import hipparcos, synthetic
from robins.ins.imu_errors import TriadErrors
from robins.rotation import from_rotvec, multiply
from robins.sim.attitude_control import allocation_matrix, controller
from robins.sim.attitude_reference import Reference, inertial, nadir, slews
from robins.sim.gyro import gyro_errors
from robins.sim.orbit import circular_orbit, field_along_orbit
from robins.sim.random import Component, stream
from robins.sim.spacecraft import CraftState, craft_state, spacecraft
from robins.sim.star_sensor import StarCamera, index_for, star_errors
from robins.systems.parts import outside
from robins.systems.satellite.nodes import (
    CameraOptics,
    LoopConstants,
    NoiseFreeInputs,
    StarSensorFault,
)
from robins.systems.satellite.parameters import (
    AttitudeLoop,
    Craft,
    ReactionWheels,
    SatelliteGyro,
    StarSensor,
)

# Folded into the key of the gyro next to the streams of `robins.sim.gyro`.
_BIAS, _RAMP = 16, 17
_CAMERA = 16  # into that of the star sensor, next to the streams of `robins.sim.star_sensor`


class SatelliteCourse(NamedTuple):
    """Data common to all runs; E steps."""

    time_s: np.ndarray  # (E,) at the end of each step
    steps: NoiseFreeInputs
    due: np.ndarray  # (E,) bool, True where a step ends with a star frame
    given: LoopConstants  # numbers of the loop


def inertia(craft: Craft) -> np.ndarray:
    """Inertia matrix (3, 3) [kg m^2], body axes."""
    xy, xz, yz = craft.products
    off = np.array([[0.0, xy, xz], [xy, 0.0, yz], [xz, yz, 0.0]])
    return np.diag(craft.moments) + off


def wheel_axes(wheels: ReactionWheels) -> np.ndarray:
    """Wheel axes (3, W) as unit columns, body axes."""
    axes = np.array(wheels.axes, float).T.reshape(3, len(wheels.axes))
    return axes / np.linalg.norm(axes, axis=0)


def lay_out(given: AttitudeLoop) -> SatelliteCourse:
    """Orbit, field and reference.

    Raises:
        ImportError: the Hipparcos catalogue without the extra "stars".
        ValueError: an impossible inertia, wheels that do not span three axes, or a date outside
            the validity of the magnetic model.
    """
    dt, o, control = given.step, given.orbit, given.control
    count = math.floor(given.duration / dt + 1e-9)
    edges = dt * np.arange(count + 1)
    where = o.altitude, o.inclination, o.node, o.latitude_argument
    middle = circular_orbit(*where, edges[:-1] + 0.5 * dt)
    field = field_along_orbit(middle, o.field, decimal_year=o.year)
    base = nadir(circular_orbit(*where, edges))
    if given.points == "inertial":
        base = inertial(base.q_ib[0], edges)
    wanted = _rotated(given, base, edges)
    frame = round(given.star.period / dt)
    due = np.arange(1, count + 1) % frame == 0
    time = edges[1:]
    moments, wheels, axes = inertia(given.craft), given.wheels, wheel_axes(given.wheels)
    works = np.ones((count, len(wheels.axes)))
    left = np.array([float(i not in wheels.lost) for i in range(len(wheels.axes))])
    works[edges[:-1] > wheels.lost_at - 1e-9] = left
    return SatelliteCourse(
        time_s=time,
        steps=NoiseFreeInputs(
            wanted.q_ib[:-1],
            wanted.omega_b[:-1],
            wanted.alpha_b[:-1],
            wanted.q_ib[1:],
            middle.r_i_m,
            field,
            jnp.asarray(_disturbance(given, np.asarray(middle.time_s))),
            jnp.asarray(works),
            _star_sensor_faults(given.star, due, time),
            jnp.arange(count),
        ),
        due=due,
        given=LoopConstants(
            spacecraft(
                moments, axes, wheels.torque, wheels.momentum, control.dipole, given.craft.dipole
            ),
            controller(moments, control.frequency, control.damping, control.unloading),
            pinv=jnp.asarray(allocation_matrix(axes, left if wheels.loss_known else 1.0)),
            step_s=jnp.asarray(dt),
            quantum_rad=jnp.asarray(given.gyro.quantum),
            lens=_camera_optics(given.star),
        ),
    )


def _rotated(given: AttitudeLoop, base: Reference, time_s: np.ndarray) -> Reference:
    if (slew := given.slew) is None:
        return base
    return slews(base, slew.angle, slew.period, time_s, fade_in_s=slew.grows)


def _camera_optics(star: StarSensor) -> CameraOptics | None:
    """The camera of a star sensor, if it has one, and the index of its stars."""
    if (given := star.camera) is None:
        return None
    camera = StarCamera(
        field_rad=given.field,
        magnitude_limit=given.magnitude,
        sigma_rad=given.noise,
        missed=given.missed,
        false_stars=given.false_stars,
    )
    stars = {"synthetic": synthetic, "hipparcos": hipparcos}[given.catalogue](given.magnitude)
    return CameraOptics(camera, index_for(camera, stars), jnp.asarray(given.tolerance))


def _star_sensor_faults(star: StarSensor, due: np.ndarray, time_s: np.ndarray) -> StarSensorFault:
    seen, stuck = due & outside(star.lost, time_s), np.zeros(len(due), dtype=bool)
    turn, factor = np.zeros((len(due), 3)), np.ones(len(due))
    for fault in star.faults:
        here = fault.holds(time_s)
        if fault.kind == "stuck":
            stuck |= here
        elif fault.kind == "turned":
            turn[here, 2] += fault.angle
        elif fault.kind == "sign":
            factor[here & (np.floor(time_s + 1e-9) % 2 == 1)] *= -1.0
        else:
            factor[here] *= 0.99
    return StarSensorFault(*(jnp.asarray(x) for x in (seen, stuck, turn, factor)))


def _disturbance(given: AttitudeLoop, time_s: np.ndarray) -> np.ndarray:
    """(E, 3) N m, a sine of the orbital period about each axis, a third of a turn apart."""
    turn = circular_orbit(given.orbit.altitude, 0.0, 0.0, 0.0, np.zeros(1))
    rate = np.linalg.norm(turn.v_i_m_s[0]) / np.linalg.norm(turn.r_i_m[0])
    phase = 2.0 * np.pi / 3.0 * np.arange(3.0)
    return given.craft.disturbance * np.sin(rate * time_s[:, None] + phase)


class SatelliteWorld(NamedTuple):
    """One run; E steps."""

    gyro_angle: Array  # (E, 3) error of the angle of each sample [rad]
    gyro_bias: Array  # (E, 3) its slow part, as a rate [rad/s]
    gyro_matrix: Array  # (3, 3) scale factor errors and misalignments
    star_error: Array  # (E, 3) error of the star sensor at the end of each step [rad]
    star_key: Array  # key of a camera's images
    craft: CraftState  # at the beginning
    start_q_ib: Array  # (4,) initial attitude of the filters


def true_errors(gyro: SatelliteGyro, bias: Array, ramp: Array) -> TriadErrors:
    """True error model of the gyro; half-widths of uniform errors come as drawn values."""
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


def simulate(
    given: AttitudeLoop, course: SatelliteCourse, seed: int, index: Array
) -> SatelliteWorld:
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
    return SatelliteWorld(
        gyro_angle=gyro.angle,
        gyro_bias=gyro.bias,
        gyro_matrix=gyro.matrix,
        star_error=jnp.zeros((count, 3)).at[frames].set(errors),
        star_key=jax.random.fold_in(eye, _CAMERA),
        craft=craft_state(course.given.craft, q0, first.ref_omega_b[0], given.wheels.start),
        start_q_ib=multiply(q0, from_rotvec(off)),
    )
