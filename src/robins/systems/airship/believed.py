"""What each filter of the airship study believes: the noise of its sensors, and its model."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial
from jaxtyping import Array

from robins.filters import Model, Sensor
from robins.ins.frames import swap
from robins.ins.state import InsNoise
from robins.systems.airship.error_form import error_states
from robins.systems.airship.filters import FLOOR, Firm, Kind
from robins.systems.airship.measurement_rows import (
    error_from_tangent,
    printed_air_speed_error,
    printed_attitude_rows_ned,
    printed_constraint,
)
from robins.systems.airship.model import (
    SAR,
    STAR,
    WIND,
    WIND_OF_STAR,
    Air,
    Datum,
    Sigmas,
    WindNoise,
    nine_states,
    product_states,
    read_euler,
    read_sar,
    sensors,
    wind_states,
)
from robins.systems.airship.parameters import Airship
from robins.systems.airship.world import Course


def believed_sigmas(given: Airship) -> Sigmas:
    """Of the sensors, as their data sheets state."""
    s = given.sar
    return Sigmas(
        jnp.array([s.position, s.position, s.heading, given.barometer.height]),
        jnp.full(3, given.star.attitude),
    )


def wind_sigma(given: Airship, firm: Firm) -> float:
    """How firmly the constraint is believed, each axis [m/s]."""
    a = given.air_data
    return {"exact": FLOOR, "white": float(np.hypot(a.noise, a.wind_error)), "noise": a.noise}[firm]


def looks_of(given: Airship, course: Course, kind: Kind) -> tuple[Sensor, ...]:
    """The sensors that a kind of filter uses, as printed where it takes the paper to the letter."""
    start = course.start.position
    datum = Datum(start.lat, start.lon, jnp.asarray(course.metres_per_radian))
    sigmas = believed_sigmas(given)
    looks = {s.name: s for s in sensors(datum, sigmas, course.sights - 1)}
    if kind.printed == "rows":
        looks[SAR] = Sensor(looks[SAR].read, sigmas.sar, 4, SAR, Partial(_printed_sar, datum))
        looks[STAR] = Sensor(looks[STAR].read, sigmas.euler, 3, STAR, _printed_euler)
    if kind.printed == "constraint":
        for name in (WIND, WIND_OF_STAR):  # what d leaves over should be zero
            looks[name] = Sensor(_printed_zero, looks[name].noise, 2, name, _printed_wind)
    return tuple(s for s in looks.values() if s.name in kind.sensors and s.dim > 0)


def _printed_sar(datum: Datum, x: Any, aux: Any):
    """(45): the heading's row as printed."""
    heading = printed_attitude_rows_ned(x.q_nb.wxyz)[2]
    H = jnp.zeros((4, 9)).at[[0, 1, 3], [6, 7, 8]].set(jnp.array([1.0, 1.0, -1.0]))
    return read_sar(datum, x, aux), H.at[2, :3].set(heading)


def _printed_euler(x: Any, aux: Any):
    """(48)."""
    rows = printed_attitude_rows_ned(x.q_nb.wxyz)
    return read_euler(x, aux), jnp.concatenate([rows, jnp.zeros((3, 6))], 1)


def _printed_zero(x: Any, air: Air) -> Array:
    return _printed_wind(x, air)[0]


def _printed_wind(x: Any, air: Air):
    """(49), (50): D x = d with x computed minus true.

    Read with d's wind error as zero, and its air speed error as what velocity less wind differs
    from the measured air speed by.
    """
    heading = x.q_nb.as_euler()[2]
    speed = jnp.linalg.norm(jnp.asarray(air.v_air_b))
    wind = jnp.concatenate([jnp.asarray(air.wind)[::-1], jnp.zeros(1)])  # east north up
    error = printed_air_speed_error(swap(x.v_n), wind, speed)
    D, d = printed_constraint(heading, error, jnp.zeros(2))
    p = x.position
    return -d, D @ error_from_tangent(p.lat, p.alt)


def believed_model(given: Airship, course: Course, kind: Kind) -> Model:
    """The model of a kind of filter."""
    looks, b, a = looks_of(given, course, kind), given.believed, given.air_data
    wind = WindNoise(jnp.asarray(a.wind_error), jnp.asarray(a.wind_time))
    if kind.states == "nine":
        return nine_states(b.gyro_noise, b.accel_noise, looks)
    if kind.states == "errors":
        return error_states(b.gyro_noise, b.accel_noise, course.metres_per_radian, looks)
    if kind.states == "wind":
        return wind_states(b.gyro_noise, b.accel_noise, wind, looks)
    imu = given.imu
    shaken = b.accel_noise_factor * jnp.asarray(imu.accel_noise)
    return product_states(InsNoise(jnp.asarray(imu.gyro_noise), shaken), wind, looks)
