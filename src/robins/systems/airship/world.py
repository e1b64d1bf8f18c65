"""An airship in the wind: its motion, its inertial unit, and one run of all instruments.

A point mass carried by the wind, whose velocity follows with a time constant,
dv/dt = (v_air + w - v) / T. It holds its heading through the air, so in a gust it drifts sideways.
The motion gives the increments of an ideal inertial unit; the truth is their mechanisation, so an
error-free unit navigates to it exactly.

The paper does not state the dynamics (time constant, sway); they are assumptions of the
specification, and parameters here.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from robins import _float64  # noqa: F401
from robins.earth import Geodetic, curvature_radii
from robins.filters.values import Numbers
from robins.ins.imu_errors import ImuErrorModel, TriadErrors
from robins.ins.increments import Increments, joined
from robins.ins.mechanise import Nav, mechanise
from robins.rotation import Rotation, conjugate, from_euler, rotate
from robins.sim.air_data import wind_estimate_error
from robins.sim.ideal_imu import increments_between
from robins.sim.imu_sensor import corrupt
from robins.sim.random import Component, stream
from robins.sim.wind import (
    WindMotion,
    dryden,
    gusts,
    move_in_wind,
    von_karman,
    wind_at,
    wind_motion_at,
)
from robins.systems.airship.parameters import Airship, InstrumentRate
from robins.systems.parts import as_array, outside, signed
from robins.systems.study import Instrument

PARTS = 2  # increments between two star sights for filters with bias states
_BLEND_S = 20.0  # time over which sway grows at the onset of gusts

# Streams folded into the keys of a run; part of the file format, as `Component` is.
_GUSTS, _TURBULENCE = 0, 1  # of the wind
_BIASES, _SAMPLES = 0, 1  # of the inertial unit
AIR, WIND_ERROR = 0, 1  # of the air data


class Datum(NamedTuple):
    """Origin of horizontal positions, and the metres in a radian there."""

    lat: Array
    lon: Array
    metres: Array  # (2,) of latitude, longitude


class AirshipCourse(NamedTuple):
    """Data common to all runs."""

    epoch_s: np.ndarray  # (E,)
    sight_s: np.ndarray  # (E S,) of the stars, S in an epoch, the last at its end
    samples: int  # of the inertial unit between two of them
    parts: int  # a divisor of that
    start: Nav
    datum: Datum  # the start

    @property
    def sights(self) -> int:
        """Number of star sights in an epoch, S."""
        return len(self.sight_s) // len(self.epoch_s)


class AirshipWorld(NamedTuple):
    """One run; E epochs, NED/FRD."""

    epoch_increments: Increments  # (E,), (E, 3) as reported, one for an epoch
    parts: Increments  # (E, K), (E, K, 3) the same in K parts
    since: Array  # (E, S - 1, 3) rad, turn as reported from each early sight to the epoch's end
    path: Nav  # (E S,) true, at each sight of the stars
    truth: Nav  # (E,) at the end of each epoch
    start: Nav  # true, at time zero
    initial_error: Array  # (9,) true = retract(estimate, error)
    gyro_bias: Array  # (3,) rad/s
    accel_bias: Array  # (3,) m/s^2
    wind: Array  # (E, 2) m/s, north east, true
    steady_wind: Array  # (2,) m/s, its steady part
    wind_error: Array  # (E, 2) m/s, assumed minus true wind
    air_b: Array  # (E, 3) m/s, true velocity through the air, body axes
    readings: dict[str, Any]  # of each instrument, leading axis E; NaN where there is none


def lay_out(given: Airship) -> AirshipCourse:
    """Epochs, sights of the stars and the start, in NumPy.

    Raises:
        ValueError: the flight is shorter than two epochs.
    """
    count = math.floor(given.duration / given.epoch + 1e-9)
    if count < 2:
        raise ValueError(
            f"duration {given.duration:g} s holds {count} epoch(s) of {given.epoch:g} s: two at "
            "least are wanted"
        )
    sights = count * round(given.star.rate * given.epoch)
    place = given.place
    still = given.wind.constant * _towards(given.wind.towards)
    velocity = still + given.hull.air_speed * _towards(given.hull.course)
    angles = (a[0] for a in _attitude(given, np.zeros(1)))
    meridian, transverse = (float(r) for r in curvature_radii(place.latitude))
    start = Nav(
        Rotation(from_euler(*angles)),
        jnp.asarray([*velocity, 0.0]),
        Geodetic(*(jnp.asarray(x) for x in (place.latitude, place.longitude, place.height))),
    )
    samples = round(given.imu.rate / given.star.rate)
    north, east = meridian + place.height, transverse + place.height
    metres = jnp.array([north, east * math.cos(place.latitude)])
    return AirshipCourse(
        epoch_s=given.epoch * np.arange(1, count + 1),
        sight_s=np.arange(1, sights + 1) / given.star.rate,
        samples=samples,
        parts=max(k for k in range(1, PARTS + 1) if samples % k == 0),
        start=start,
        datum=Datum(start.position.lat, start.position.lon, metres),
    )


def _towards(direction: float) -> np.ndarray:
    return np.array([math.cos(direction), math.sin(direction)])


def sampled_at(time_s: np.ndarray, instrument: InstrumentRate) -> np.ndarray:
    """Mask of the times at which an instrument measures: at its own rate, outside its outages."""
    every = round(1.0 / (time_s[0] * instrument.rate))  # the first step is as long as all
    return (np.arange(1, len(time_s) + 1) % every == 0) & outside(instrument.lost, time_s)


def _attitude(given: Airship, time_s: Numbers):
    """Roll, pitch, heading [rad] at times, NumPy or JAX: sines that grow in gusts."""
    hull, wind = given.hull, given.wind
    xp = np if isinstance(time_s, np.ndarray) else jnp

    def rise(at: float):
        return 0.5 * (1.0 + xp.tanh((time_s - at) / (0.5 * _BLEND_S)))

    share = rise(wind.span.begin) - rise(wind.span.end) if wind.gusty else 0.0 * time_s
    out = []
    for i, mean in enumerate((0.0, 0.0, hull.course)):
        size = hull.sway_calm[i] + share * (hull.sway_gust[i] - hull.sway_calm[i])
        phase = 2.0 * math.pi * (time_s / hull.sway_period[i] + i / 3.0)
        out.append(mean + size * xp.sin(phase))
    return out


def draw_wind(given: Airship, key: Array) -> tuple[Array, float]:
    """Wind held over steps: (M, 2) m/s north east, and the length of a step [s]."""
    wind, g, t = given.wind, given.wind.gusts, given.wind.turbulence
    step = t.step if t is not None else g.every if g is not None else given.duration
    count, begin, end = _steps(given, step), wind.span.begin, wind.span.end
    towards = _towards(wind.towards)
    total = jnp.broadcast_to(jnp.asarray(wind.constant * towards), (count, 2))
    if g is not None:
        own, to = jax.random.fold_in(key, _GUSTS), (wind.towards, g.spread)
        drawn = gusts(own, _steps(given, g.every), begin, end, g.every, g.speed, to)
        total = total + jnp.repeat(drawn, round(g.every / step), axis=0)[:count]
    if t is not None:
        shape = dryden if t.spectrum == "dryden" else von_karman
        own = jax.random.fold_in(key, _TURBULENCE)
        along_across = shape(own, count, step, given.hull.air_speed, t.sigma, t.length)
        turn = jnp.asarray(np.stack([towards, [-towards[1], towards[0]]]))
        time = step * jnp.arange(count, dtype=float)
        inside = (time >= begin) & (time < end)
        total = total + jnp.where(inside[:, None], along_across @ turn, 0.0)
    return total, step


def _steps(given: Airship, step_s: float) -> int:
    return math.ceil(given.duration / step_s - 1e-9)


def _desired(
    given: Airship, course: AirshipCourse, carried: WindMotion, time_s: Float[Array, "n"]
) -> Nav:
    """The motion at times; position only as accurate as gravity and rates require."""
    velocity, moved, _ = wind_motion_at(carried, time_s)
    zero = jnp.zeros_like(time_s)
    start = course.start.position
    north, east = (moved[:, i] / course.datum.metres[i] for i in range(2))
    return Nav(
        Rotation(from_euler(*_attitude(given, time_s))),
        jnp.stack([velocity[:, 0], velocity[:, 1], zero], 1),
        Geodetic(start.lat + north, start.lon + east, zero + start.alt),
    )


def _between_sights(
    given: Airship,
    course: AirshipCourse,
    carried: WindMotion,
    errors: ImuErrorModel,
    noise: Array,
    k: Array,
) -> tuple[Increments, Increments, Increments]:
    """Increments from the k-th sight to the next: true ones joined, reported ones in parts and
    joined.
    """
    imu, n = given.imu, course.samples
    dt = jnp.full(n, 1.0 / imu.rate)
    time = (k * n + jnp.arange(n + 1)).astype(float) / imu.rate
    grid = _desired(given, course, carried, time)
    before, after = (
        jax.tree.map(lambda x, at=at: x[at], grid) for at in (slice(-1), slice(1, None))
    )
    true = increments_between(before, after, dt)
    gained = rotate(conjugate(before.q_nb.wxyz), after.v_n - before.v_n)
    felt = true.dv - imu.unsensed * gained
    theta, dv, _ = corrupt(dt, true.theta, felt, errors, jax.random.fold_in(noise, k))
    each = (course.parts, n // course.parts)
    cut = Increments(dt.reshape(each), theta.reshape(*each, 3), dv.reshape(*each, 3))
    parts = jax.vmap(joined)(cut)
    return joined(true), parts, joined(parts)


def simulate(
    instruments: Sequence[Instrument],
    given: Airship,
    course: AirshipCourse,
    seed: int,
    index: Array,
) -> AirshipWorld:
    """One run of all instruments, from its number, which may be traced; pure."""
    key = partial(stream, seed, index)
    wind, step = draw_wind(given, key(Component.WIND))
    commanded = jnp.asarray(given.hull.air_speed * _towards(given.hull.course))
    carried = move_in_wind(wind, step, commanded, given.hull.response, course.start.v_n[:2])
    imu = given.imu
    unit = key(Component.IMU)
    bias = jax.random.split(jax.random.fold_in(unit, _BIASES))
    gyro_bias = signed(bias[0], imu.gyro_bias, imu.draw)
    accel_bias = signed(bias[1], imu.accel_bias, imu.draw)
    errors = ImuErrorModel(
        TriadErrors(bias=gyro_bias, white=as_array(imu.gyro_noise)),
        TriadErrors(bias=accel_bias, white=as_array(imu.accel_noise)),
    )
    noise = jax.random.fold_in(unit, _SAMPLES)
    measured = partial(_between_sights, given, course, carried, errors, noise)
    count, sights = len(course.epoch_s), course.sights
    true, parts, single = jax.lax.map(measured, jnp.arange(count * sights))
    path = mechanise(course.start, true)

    def by_epoch(x: Array) -> Array:
        return x.reshape(count, sights, *x.shape[1:])

    parts = jax.tree.map(lambda x: by_epoch(x).reshape(count, -1, *x.shape[2:]), parts)
    single = jax.tree.map(by_epoch, single)
    truth = jax.tree.map(lambda x: by_epoch(x)[:, -1], path)
    blown = wind_at(wind, step, jnp.asarray(course.epoch_s) - 1e-6)  # at the end of the epoch
    through = jnp.concatenate([truth.v_n[:, :2] - blown, truth.v_n[:, 2:]], 1)
    a, of_wind = given.air_data, jax.random.fold_in(key(Component.AIR_DATA), WIND_ERROR)
    world = AirshipWorld(
        epoch_increments=jax.vmap(joined)(single),
        parts=parts,
        since=_turned_since(single),
        path=path,
        truth=truth,
        start=jax.tree.map(jnp.asarray, course.start),
        initial_error=signed(key(Component.INITIAL_STATE), start_sigma(given), given.start.draw),
        gyro_bias=gyro_bias,
        accel_bias=accel_bias,
        wind=blown,
        steady_wind=jnp.asarray(given.wind.constant * _towards(given.wind.towards)),
        wind_error=wind_estimate_error(of_wind, count, given.epoch, a.wind_error, a.wind_time),
        air_b=rotate(conjugate(truth.q_nb.wxyz), through),
        readings={},
    )
    drawn = {i.name: i.measure(given, course, key, world) for i in instruments if i.measure}
    return world._replace(readings=drawn)


def _turned_since(single: Increments) -> Array:
    """Turn from each early sight of an epoch to its end, (E, S - 1, 3), from (E, S) increments."""
    sights = single.dt.shape[1]
    late = (jax.tree.map(lambda x, j=j: x[:, j:], single) for j in range(1, sights))
    rest = [jax.vmap(joined)(block).theta for block in late]
    return jnp.stack(rest, 1) if rest else jnp.zeros((single.dt.shape[0], 0, 3))


def start_sigma(given: Airship) -> Numbers:
    """Initial standard deviations (9,) of attitude, velocity and position."""
    s = given.start
    return as_array([*s.attitude, *s.velocity, *s.position])
