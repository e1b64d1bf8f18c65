"""A rocket in free flight as it is simulated: truth, gyro, magnetometer in both of its readings."""

from __future__ import annotations

import math
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from robins.earth.magnetic import field_along, wmm_for
from robins.manifold import wrap
from robins.rotation import conjugate, from_euler, multiply, rotate, to_euler, to_rotvec
from robins.scenario import Span
from robins.sim.ballistic import ballistic
from robins.sim.free_body import FreeBody, coning_start, free_body
from robins.sim.gyro import MemsGyro, delta_angles, integrate_angles
from robins.sim.magnetometer import (
    angle_bursts,
    field_bursts,
    observe_field,
    observe_magnetic_attitude,
)
from robins.sim.random import Component, stream
from robins.systems.rocket.parameters import Flight

PEAK_S = 3.0  # after the beginning of a disturbance, in which its largest error is looked for
_SECONDS_A_YEAR = 365.25 * 86400.0
# Streams folded into the keys of a run.
_VECTOR, _ANGLES, _DISTURBED, _INTEGRATED = range(4)


class Course(NamedTuple):
    """What is the same in all runs; E steps."""

    time_s: np.ndarray  # (E,) at the end of each step
    field_n: np.ndarray  # (E, 3) T, launch north-east-down, which is inertial
    alt_m: np.ndarray  # (E,)
    seen: np.ndarray  # (E,) bool, whether the magnetometer measures
    felt: np.ndarray  # (E,) bool, whether the gyro does
    bursts: tuple[slice, ...]  # steps within 3 s of the beginning of a disturbance
    quiet: np.ndarray  # (E,) bool, long after one


class World(NamedTuple):
    """One run; E steps. Measurements are NaN where there is none."""

    q_nb: Array  # (E, 4) true attitude at the end of each step
    omega_b: Array  # (E, 3) true rate [rad/s]
    start_q_nb: Array  # (4,) that filters begin with
    start_omega_b: Array  # (3,)
    bias: Array  # (E, 3) constant and slow error of the gyro in each step [rad/s]
    scale: Array  # (3,)
    theta: Array  # (E, 3) what the gyro turned by in each step [rad]
    rate: Array  # (E, 3) rate at the end of each step [rad/s]
    integrated: Array  # (E, 3) roll, pitch, yaw that the gyro has been integrated to [rad]
    angles: Array  # (E, 3) "magnetic attitude" [rad]
    field_b: Array  # (E, 3) measured field [T]


def lay_out(given: Flight) -> Course:
    """Steps, path and field, in NumPy.

    Raises:
        ValueError: the flight ends on the ground, or leaves the life of the magnetic model.
    """
    count = math.floor(given.duration / given.step + 1e-9)
    time = given.step * np.arange(1, count + 1)
    launch = given.launch
    where = launch.latitude, launch.longitude, launch.height
    try:
        path = ballistic(*where, launch.speed, launch.elevation, launch.azimuth, time)
    except ValueError as error:
        raise ValueError(f"launch and duration do not fit together: {error}") from error
    year = launch.year + time / _SECONDS_A_YEAR
    place = path.lat_rad, path.lon_rad, path.alt_m
    local = field_along(wmm_for(launch.year), *place, year, time)
    begun, since = _disturbed(given, time)
    first = np.searchsorted(time, begun - 1e-9)
    width = round(PEAK_S / given.step)
    return Course(
        time_s=time,
        field_n=np.asarray(rotate(path.q_local, jnp.asarray(local))),
        alt_m=np.asarray(path.alt_m),
        seen=_there(time, given.magnetometer.lost),
        felt=_there(time, given.gyro.lost),
        bursts=tuple(slice(k, k + width) for k in first if k + width <= count),
        quiet=since > given.quiet_after - 1e-9,
    )


def _disturbed(given: Flight, time_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """When disturbances begin, and (E,) the time since the end of the last; infinite before one."""
    burst, since = given.magnetometer.disturbance, np.full(len(time_s), np.inf)
    if burst is None:
        return np.zeros(0), since
    begun = np.arange(burst.every, time_s[-1], burst.every)
    for begin in begun:
        after = np.maximum(time_s - begin - burst.length, 0.0)
        since = np.where(time_s >= begin - 1e-9, after, since)
    return begun, since


def _there(time_s: np.ndarray, lost: tuple[Span, ...]) -> np.ndarray:
    there = np.ones(len(time_s), dtype=bool)
    for span in lost:
        there &= ~span.holds(time_s)
    return there


def body_of(given: Flight) -> FreeBody:
    """The coefficients of the body as it truly is."""
    b = given.body
    return FreeBody(b.e1, *(0.0 if t is None else 1.0 / t for t in (b.spin_decay, b.cone_decay)))


def simulate(given: Flight, course: Course, seed: int, index: Array) -> World:
    """One run, from its number, which may be traced; pure."""
    key = partial(stream, seed, index)
    count = len(course.time_s)
    q, omega = _moved(given, key(Component.TRAJECTORY), count)
    unit = key(Component.IMU)
    g = given.gyro
    theta, errors = delta_angles(
        unit,
        q,
        given.step,
        MemsGyro(g.bias, g.drift, g.drift_time, g.white, g.scale_factor),
    )
    bias = errors.bias_rad_s[None] + errors.markov_rad_s
    rate = (1.0 + errors.scale_factor)[None] * omega[1:] + bias + errors.white_rad_s
    felt = jnp.asarray(course.felt)[:, None]
    begin, m = key(Component.INITIAL_STATE), key(Component.MAGNETOMETER)
    start = wrong_by(q[0], given.start.attitude_error)
    vector, angles, disturbed, integrated = (
        jax.random.fold_in(m, i) for i in (_VECTOR, _ANGLES, _DISTURBED, _INTEGRATED)
    )
    magnet, time = given.magnetometer, jnp.asarray(course.time_s)
    seen = jnp.asarray(course.seen)
    field_n = jnp.asarray(course.field_n)
    euler = jnp.stack(to_euler(q[1:]), 1)
    wrong = turn = None
    if (burst := magnet.disturbance) is not None:
        sizes = (burst.angle, burst.every, burst.length)
        wrong = angle_bursts(disturbed, time, *sizes)
        turn = field_bursts(disturbed, time, *sizes)
    size = jnp.sqrt(jnp.sum(field_n**2, axis=1))
    white = jax.random.normal(integrated, (count, 3))
    drifted = _integrated(given, start, q, bias)
    return World(
        q_nb=q[1:],
        omega_b=omega[1:],
        start_q_nb=start,
        start_omega_b=omega[0] + given.start.rate * jax.random.normal(begin, (3,)),
        bias=bias,
        scale=errors.scale_factor,
        theta=jnp.where(felt, theta, jnp.nan),
        rate=jnp.where(felt, rate, jnp.nan),
        integrated=jnp.where(felt, wrap(drifted + given.gyro.attitude_noise * white), jnp.nan),
        angles=observe_magnetic_attitude(angles, euler, magnet.noise, wrong, seen),
        field_b=observe_field(
            vector,
            q[1:],
            field_n,
            size * math.sin(magnet.noise),
            seen,
            turn=turn,
            hard_iron_t=jnp.asarray(magnet.hard_iron),
            range_t=magnet.full_scale,
        ),
    )


def _moved(given: Flight, key: Array, count: int) -> tuple[Array, Array]:
    """Attitude (E + 1, 4) and rate (E + 1, 3) of the body."""
    b, body = given.body, body_of(given)
    q0, omega0 = coning_start(b.spin, b.cone, b.elevation, b.azimuth, body)
    return free_body(key, body, q0, omega0, given.step, count, b.torque)


def wrong_by(q_nb: Array, error_rad: tuple[float, float, float]) -> Array:
    """An attitude with errors of its roll, pitch and yaw."""
    return from_euler(*(a + e for a, e in zip(to_euler(q_nb), error_rad, strict=True)))


def _integrated(given: Flight, start: Array, q: Array, bias: Array) -> Array:
    """Roll, pitch, yaw (E, 3) by a gyro integrated from a start, with its slow errors alone."""
    turned = to_rotvec(multiply(conjugate(q[:-1]), q[1:]))
    path = integrate_angles(start, turned + given.step * bias)
    return jnp.stack(to_euler(path[1:]), 1)
