"""Simulation of a rocket in free flight: truth, gyro, and both kinds of magnetometer.

The two studies share the body, the gyro and the disturbances. Their instruments are declared here.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from robins.earth.magnetic import field_along, wmm_for
from robins.filters import Sensor
from robins.manifold import Angle, wrap
from robins.rotation import conjugate, from_euler, multiply, rotate, to_euler, to_rotvec
from robins.sim.ballistic import ballistic
from robins.sim.free_body import FreeBody, coning_start, free_body
from robins.sim.gyro import MemsErrors, MemsGyro, delta_angles, integrate_angles
from robins.sim.magnetometer import (
    angle_bursts,
    bursts,
    field_bursts,
    observe_field,
    observe_magnetic_attitude,
)
from robins.sim.random import Component, stream
from robins.systems.parts import outside
from robins.systems.quantities import Three
from robins.systems.rocket.angles import GYRO, MAGNETIC, read_angles, read_rate
from robins.systems.rocket.field import FIELD, SNAPSHOT, field_sensor, plausible
from robins.systems.rocket.parameters import MagneticAttitude, RocketFlight
from robins.systems.study import Instrument, SensorAxes

PEAK_S = 3.0  # after the beginning of a disturbance: window of its largest error
EULER, BODY = ("roll", "pitch", "yaw"), ("x", "y", "z")
_SECONDS_A_YEAR = 365.25 * 86400.0
# Streams folded into the key of the magnetometer; the noise of the integrated gyro is one too.
_VECTOR, _ANGLES, _DISTURBED, _INTEGRATED = range(4)


class RocketCourse(NamedTuple):
    """Data common to all runs; E steps."""

    time_s: np.ndarray  # (E,) at the end of each step
    field_n: np.ndarray  # (E, 3) T, launch north-east-down, which is inertial
    alt_m: np.ndarray  # (E,)
    seen: np.ndarray  # (E,) bool, True where the magnetometer measures
    felt: np.ndarray  # (E,) bool, True where the gyro measures
    bursts: tuple[slice, ...]  # steps within 3 s of the beginning of a disturbance
    quiet: np.ndarray  # (E,) bool, long after one


class RocketWorld(NamedTuple):
    """One run; E steps. Measurements are NaN where there is none."""

    q_nb: Array  # (E + 1, 4) true attitude at the start and at the end of each step
    omega_b: Array  # (E + 1, 3) true rate [rad/s]
    errors: MemsErrors  # of the gyro
    start_q_nb: Array  # (4,) initial estimate of the filters
    start_omega_b: Array  # (3,)
    theta_b: Array  # (E, 3) reported gyro angle of each step [rad]
    readings: Mapping[str, Any] = {}  # of the instruments of the study, leading axis E
    field_n: Any = None  # (E, 3) T, the same in all runs: not simulated, but added by a case

    @property
    def bias(self) -> Array:
        """(E, 3) constant and slow error of the gyro in each step [rad/s]."""
        return self.errors.bias_rad_s[None] + self.errors.markov_rad_s


def lay_out(given: RocketFlight) -> RocketCourse:
    """Steps, path and field, in NumPy.

    Raises:
        ValueError: the flight ends on the ground, or its date is outside the magnetic model's.
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
    return RocketCourse(
        time_s=time,
        field_n=np.asarray(rotate(path.q_local, jnp.asarray(local))),
        alt_m=np.asarray(path.alt_m),
        seen=outside(given.magnetometer.lost, time),
        felt=outside(given.gyro.lost, time),
        bursts=tuple(slice(k, k + width) for k in first if k + width <= count),
        quiet=since > given.quiet_after - 1e-9,
    )


def _disturbed(given: RocketFlight, time_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Start times of disturbances, and (E,) time since the end of the last; infinite before one."""
    burst, since = given.magnetometer.disturbance, np.full(len(time_s), np.inf)
    if burst is None:
        return np.zeros(0), since
    begun = np.arange(burst.every, time_s[-1], burst.every)
    for begin in begun:
        after = np.maximum(time_s - begin - burst.length, 0.0)
        since = np.where(time_s >= begin - 1e-9, after, since)
    return begun, since


def faults(given: RocketFlight, time_s: np.ndarray, name: str) -> dict[str, np.ndarray]:
    """Masks (E,) of the disturbed magnetometer, by its name, and of a wrong motion model."""
    burst = given.magnetometer.disturbance
    disturbed = np.zeros(len(time_s), bool)
    if burst is not None:
        disturbed = np.asarray(bursts(time_s, burst.every, burst.length, None)[0])
    believed = isinstance(given, MagneticAttitude) and given.believed.error != 0.0
    return {name: disturbed, "motion": np.full(len(time_s), believed)}


def body_of(given: RocketFlight) -> FreeBody:
    """True coefficients of the body."""
    b = given.body
    return FreeBody(b.e1, *(0.0 if t is None else 1.0 / t for t in (b.spin_decay, b.cone_decay)))


def start_of(given: RocketFlight) -> tuple[Array, Array]:
    """True attitude q_nb (4,) and rate (3,) at the start."""
    b = given.body
    return coning_start(b.spin, b.cone, b.elevation, b.azimuth, body_of(given))


def with_angle_errors(q_nb: Array, error_rad: Three) -> Array:
    """An attitude with errors of its roll, pitch and yaw."""
    return from_euler(*(a + e for a, e in zip(to_euler(q_nb), error_rad, strict=True)))


def simulate(given: RocketFlight, course: RocketCourse, seed: int, index: Array) -> RocketWorld:
    """One run, from its number, which may be traced; pure."""
    key = partial(stream, seed, index)
    g, T, torque, count = given.gyro, given.step, given.body.torque, len(course.time_s)
    body, (q0, omega0) = body_of(given), start_of(given)
    q, omega = free_body(key(Component.TRAJECTORY), body, q0, omega0, T, count, torque)
    gyro = MemsGyro(g.bias, g.drift, g.drift_time, g.white, g.scale_factor)
    theta, errors = delta_angles(key(Component.IMU), q, T, gyro)
    start = with_angle_errors(q[0], given.start.attitude_error)
    wrong = given.start.rate * jax.random.normal(key(Component.INITIAL_STATE), (3,))
    world = RocketWorld(q, omega, errors, start, omega[0] + wrong, _felt(course, theta))
    it = given, course, key(Component.MAGNETOMETER), world
    return world._replace(
        readings={i.name: i.measure(*it) for i in instruments(given) if i.measure is not None}
    )


def _felt(course: RocketCourse, rows: Array) -> Array:
    return jnp.where(jnp.asarray(course.felt)[:, None], rows, jnp.nan)


def instruments(given: RocketFlight) -> tuple[Instrument, ...]:
    """Instruments whose readings are measurements; in "field-vector" the gyro drives the motion."""
    if isinstance(given, MagneticAttitude):
        return (RATE_GYRO if given.gyro_reads == "rate" else INTEGRATED_GYRO, MAGNETIC_ATTITUDE)
    taken = taken_field(given.magnetometer.full_scale)
    return (
        Instrument(FIELD, _FIELD_AXES, _field, _believed_field, taken),
        Instrument(SNAPSHOT, _FIELD_AXES, None, partial(_believed_field, name=SNAPSHOT), taken),
    )


def _rate(given: RocketFlight, course: RocketCourse, key: Array, world: RocketWorld) -> Array:
    """(E, 3) rate at the end of each step [rad/s]."""
    e = world.errors
    true = (1.0 + e.scale_factor)[None] * world.omega_b[1:]
    return _felt(course, true + world.bias + e.white_rad_s)


def _integrated(
    given: RocketFlight, course: RocketCourse, key: Array, world: RocketWorld
) -> tuple[Angle, ...]:
    """Roll, pitch, yaw (E, 3) [rad] of the integrated gyro: slow errors and white noise."""
    turned = to_rotvec(multiply(conjugate(world.q_nb[:-1]), world.q_nb[1:]))
    path = integrate_angles(world.start_q_nb, turned + given.step * world.bias)
    white = jax.random.normal(jax.random.fold_in(key, _INTEGRATED), turned.shape)
    angles = jnp.stack(to_euler(path[1:]), 1) + given.gyro.attitude_noise * white
    return _as_angles(_felt(course, wrap(angles)))


def _magnetic(
    given: RocketFlight, course: RocketCourse, key: Array, world: RocketWorld
) -> tuple[Angle, ...]:
    """Roll, pitch, yaw (E, 3) [rad] of the fictitious "magnetic attitude" sensor."""
    magnet, euler = given.magnetometer, jnp.stack(to_euler(world.q_nb[1:]), 1)
    wrong, seen = _burst(angle_bursts, given, course, key), jnp.asarray(course.seen)
    white = jax.random.fold_in(key, _ANGLES)
    return _as_angles(observe_magnetic_attitude(white, euler, magnet.noise, wrong, seen))


def _field(given: RocketFlight, course: RocketCourse, key: Array, world: RocketWorld) -> Array:
    """Measured field (E, 3) [T], body axes."""
    magnet, field_n = given.magnetometer, jnp.asarray(course.field_n)
    return observe_field(
        jax.random.fold_in(key, _VECTOR),
        world.q_nb[1:],
        field_n,
        jnp.sqrt(jnp.sum(field_n**2, axis=1)) * math.sin(magnet.noise),
        jnp.asarray(course.seen),
        turn=_burst(field_bursts, given, course, key),
        hard_iron_t=jnp.asarray(magnet.hard_iron),
        range_t=magnet.full_scale,
    )


def _burst(
    draw: Callable[..., Array], given: RocketFlight, course: RocketCourse, key: Array
) -> Array | None:
    """(E, 3) rad, disturbances of the magnetometer."""
    if (burst := given.magnetometer.disturbance) is None:
        return None
    sizes = burst.angle, burst.every, burst.length
    return draw(jax.random.fold_in(key, _DISTURBED), jnp.asarray(course.time_s), *sizes)


def _as_angles(rows: Array) -> tuple[Angle, ...]:
    return tuple(Angle(rows[:, i]) for i in range(3))


def _believed_field(given: RocketFlight, course: RocketCourse, name: str = FIELD) -> Sensor:
    return field_sensor(jnp.asarray(math.sin(given.magnetometer.noise)), name)


@lru_cache
def taken_field(full_scale_t: float | None) -> Callable[[RocketWorld], tuple[Array, Array]]:
    """Function to take plausible readings and the expected field; cached by full scale."""

    def taken(world: RocketWorld) -> tuple[Array, Array]:
        return plausible(world.readings[FIELD], world.field_n, full_scale_t), world.field_n

    return taken


_RATE_AXES = SensorAxes("rad/s", "FRD", ("p", "q", "r"), "deg/s")
_ANGLE_AXES = SensorAxes("rad", "launch NED", EULER, "deg")
_FIELD_AXES = SensorAxes("T", "FRD", BODY, "uT")
RATE_GYRO = Instrument(
    *(GYRO, _RATE_AXES, _rate),
    lambda given, course: Sensor(read_rate, jnp.full(3, given.gyro.white), 3, GYRO),
)
INTEGRATED_GYRO = Instrument(
    *(GYRO, _ANGLE_AXES, _integrated),
    lambda given, course: Sensor(read_angles, jnp.full(3, given.gyro.attitude_noise), 3, GYRO),
)
MAGNETIC_ATTITUDE = Instrument(
    *(MAGNETIC, _ANGLE_AXES, _magnetic),
    lambda given, course: Sensor(read_angles, jnp.full(3, given.magnetometer.noise), 3, MAGNETIC),
)
