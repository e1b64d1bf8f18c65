"""What each filter of the airship study is given of a run, and what it reports."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from robins.filters import Belief
from robins.ins.frames import swap
from robins.ins.state import InsState
from robins.manifold import Angle, retract, wrap
from robins.systems.airship.believed import believed_model, wind_sigma
from robins.systems.airship.error_form import Fed
from robins.systems.airship.filters import COMMON, KINDS, Given, States, make_filter
from robins.systems.airship.model import (
    SAR,
    STAR,
    STAR_EARLY,
    WIND,
    WIND_OF_STAR,
    Air,
    Early,
    WindIns,
    WindNav,
)
from robins.systems.airship.parameters import Airship
from robins.systems.airship.world import Course, World, start_sigma
from robins.systems.recipes import recipe
from robins.systems.study import Case, Contender


class Numbers(NamedTuple):
    """Data of a contender, so that contenders that differ in these alone compile once."""

    sigma: Array  # (n,) initial
    wind_sigma: Array  # (2,) m/s, believed of the constraint
    constant: Array  # (2,) m/s, the wind that always blows
    metres: Array  # (2,) in a radian of latitude, longitude
    origin: Array  # (2,) rad


def as_case(
    states: States,
    given: Given,
    sensors_: tuple[str, ...],
    printed: bool,
    n: Numbers,
    world: World,
) -> Case:
    """What a filter takes of a run; pure."""
    start: Any = retract(world.start, -world.initial_error)
    truth: Any = world.truth
    count = world.wind.shape[0]
    if states == "errors":
        start, truth = Fed(start, jnp.zeros(9)), Fed(truth, jnp.zeros((count, 9)))
    if states == "wind":
        start, truth = WindNav(start, jnp.zeros(2)), WindNav(truth, world.wind_error)
    if states == "product":
        zero = jnp.zeros(3)
        gyro, accel = (jnp.tile(b, (count, 1)) for b in (world.gyro_bias, world.accel_bias))
        start = WindIns(InsState(start.q_nb, start.v_n, start.position, zero, zero), jnp.zeros(2))
        own = InsState(truth.q_nb, truth.v_n, truth.position, gyro, accel)
        truth = WindIns(own, world.wind_error)
    p = world.sar_position
    away = jnp.stack([p.lat - n.origin[0], wrap(p.lon - n.origin[1])], 1)
    thought, air_b = air_and_wind(given, n, world)
    y: dict[str, Any] = {
        SAR: (away * n.metres[None], Angle(world.sar_heading), world.height[:, None]),
        STAR: tuple(Angle(world.euler[:, -1, i]) for i in range(3)),
        WIND: thought,
        WIND_OF_STAR: thought,
    }
    air = Air(air_b, jnp.broadcast_to(n.wind_sigma, (count, 2)), jnp.nan_to_num(thought))
    if printed:
        y[WIND] = y[WIND_OF_STAR] = 0.0 * thought
    aux: dict[str, Any] = {name: air for name in (WIND, WIND_OF_STAR) if name in sensors_}
    early = world.since.shape[1]
    if early and STAR_EARLY in sensors_:
        sights = world.euler[:, :-1].reshape(count, -1)
        y[STAR_EARLY] = tuple(Angle(sights[:, i]) for i in range(3 * early))
        dt = world.whole.dt[:, None] / (early + 1.0)
        aux[STAR_EARLY] = Early(world.since, dt * jnp.arange(early, 0, -1).astype(float)[None])
    return Case(
        start=Belief(start, jnp.diag(n.sigma)),
        u=world.parts if states == "product" else world.whole,
        y={name: y[name] for name in y if name in sensors_},
        aux=aux,
        truth=truth,
    )


def air_and_wind(given: Given, n: Numbers, world: World) -> tuple[Array, Array]:
    """What is taken for the wind (E, 2), NaN where no air data come, and for the air velocity."""
    measured, thought = world.air_measured_b, world.wind + world.wind_error
    if given == "exact":
        measured, thought = world.air_b, world.wind
    if given == "constant":
        thought = jnp.broadcast_to(n.constant, thought.shape)
    if given == "sideslip":
        speed = jnp.linalg.norm(measured, axis=1)
        measured = speed[:, None] * jnp.array([[1.0, 0.0, 0.0]])
    there = jnp.isfinite(world.air_measured_b[:, :1])
    return jnp.where(there, thought, jnp.nan), jnp.where(there, measured, 0.0)


def contender(given: Airship, course: Course, name: str) -> Contender:
    """A filter with its model, its data, and what it reports.

    Raises:
        ValueError: there is no filter of this name.
    """
    filter_, kind = make_filter(name), KINDS[name]
    wind = given.wind.constant * np.array([np.cos(given.wind.towards), np.sin(given.wind.towards)])
    sigma, rows = [start_sigma(given)], None
    if kind.states == "errors":
        rows = reported_errors(course.metres_per_radian)
        sigma = [np.abs(np.linalg.inv(rows) @ reported(COMMON)) @ sigma[0]]
    if kind.states == "product":
        sigma += [np.asarray(given.imu.gyro_bias), np.asarray(given.imu.accel_bias)]
    if kind.states in ("wind", "product"):
        sigma.append(np.full(2, given.air_data.wind_error))
    origin = course.start.position
    numbers = Numbers(
        jnp.asarray(np.concatenate(sigma)),
        jnp.full(2, wind_sigma(given, kind.firm)),
        jnp.asarray(wind),
        jnp.asarray(course.metres_per_radian),
        jnp.stack([origin.lat, origin.lon]),
    )
    printed = kind.printed == "constraint"
    return Contender(
        filter=filter_,
        model=believed_model(given, course, kind),
        case=recipe(as_case, kind.states, kind.given, kind.sensors, printed, numbers=numbers),
        reported=reported(len(numbers.sigma)) if rows is None else rows,
    )


def reported(n: int) -> np.ndarray:
    """(9, n) attitude, velocity and position, turned from north east down to east north up."""
    enu = np.asarray(swap(np.eye(3)))
    out = np.zeros((COMMON, n))
    for i in range(3):
        out[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = enu
    return out


def reported_errors(metres_per_radian: np.ndarray) -> np.ndarray:
    """(9, 9) the same of `Fed`: errors of velocity and position are the other way round."""
    north, east = metres_per_radian
    return np.diag([1.0, 1.0, 1.0, -1.0, -1.0, -1.0, -east, -north, -1.0])
