"""An airship in the wind: its motion, and what its sensors make of it.

A mass without much inertia of its own: it is carried by the wind, towards which its velocity
settles with a time constant, and holds a course through the air, so in a gust it drifts sideways.
The motion gives the increments that an ideal inertial unit would report; the truth is what the
mechanisation makes of these, so that an error-free unit navigates to it exactly.

The paper says nothing of the dynamics (time constant, sway); they are assumptions of the
specification, and parameters here.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from robins import _float64  # noqa: F401
from robins.earth import Geodetic, curvature_radii
from robins.ins.imu_errors import ImuErrorModel, TriadErrors
from robins.ins.increments import Increments, joined
from robins.ins.mechanise import Nav, mechanise
from robins.rotation import Rotation, conjugate, from_euler, rotate, to_euler
from robins.sim.air_data import observe_air, observe_height, wind_estimate_error
from robins.sim.ideal_imu import increments_between
from robins.sim.imu_sensor import corrupt
from robins.sim.random import Component, stream
from robins.sim.sar import SarErrorModel, observe_sar
from robins.sim.star_sensor import observe_euler
from robins.sim.wind import Carried, carried_at, carry, dryden, gusts, von_karman, wind_at
from robins.systems.airship.parameters import AirData, Airship, Barometer, Draw, Sar, Star

PARTS = 2  # increments between two star sights that a filter with states for biases takes
_BLEND_S = 20.0  # over which sway grows when gusts set in

# Streams folded into the keys of a run; part of the file format, as `Component` is.
_GUSTS, _TURBULENCE = 0, 1  # of the wind
_BIASES, _SAMPLES = 0, 1  # of the inertial unit
_AIR, _WIND_ERROR = 0, 1  # of the air data


class Course(NamedTuple):
    """What all runs share."""

    epoch_s: np.ndarray  # (E,)
    sights: int  # S, of the stars in an epoch, the last at its end
    samples: int  # of the inertial unit between two of them
    parts: int  # a divisor of that
    start: Nav
    metres_per_radian: np.ndarray  # (2,) of latitude and longitude, at the start
    sar: np.ndarray  # (E,) bool, whether there is a fix; likewise below
    barometer: np.ndarray
    air_data: np.ndarray
    star: np.ndarray  # (E, S)


class World(NamedTuple):
    """One run; E epochs, NED/FRD. Measurements are NaN where there is none."""

    whole: Increments  # (E,), (E, 3) as reported, one for an epoch
    parts: Increments  # (E, K), (E, K, 3) the same in K parts
    since: Array  # (E, S - 1, 3) rad, turn as reported from each early sight to the epoch's end
    truth: Nav  # (E,) at the end of each epoch
    start: Nav  # true, at time zero
    initial_error: Array  # (9,) true = retract(estimate, error)
    gyro_bias: Array  # (3,) rad/s
    accel_bias: Array  # (3,) m/s^2
    wind: Array  # (E, 2) m/s, north east, true
    wind_error: Array  # (E, 2) m/s, of what is thought to be the wind: thought minus true
    air_b: Array  # (E, 3) m/s, true velocity through the air, body axes
    air_measured_b: Array  # (E, 3) m/s
    sar_position: Geodetic  # (E,) height without meaning
    sar_heading: Array  # (E,) rad
    height: Array  # (E,) m
    euler: Array  # (E, S, 3) rad, pitch, roll, heading by the stars


def lay_out(given: Airship) -> Course:
    """Epochs, the start and who measures when, in NumPy.

    Raises:
        ValueError: the flight is shorter than two epochs.
    """
    count = math.floor(given.duration / given.epoch + 1e-9)
    if count < 2:
        raise ValueError(
            f"duration {given.duration:g} s holds {count} epoch(s) of {given.epoch:g} s: two at "
            "least are wanted"
        )
    epoch_s = given.epoch * np.arange(1, count + 1)
    sights = round(given.star.rate * given.epoch)
    sight_s = np.arange(1, count * sights + 1) / given.star.rate
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
    return Course(
        epoch_s=epoch_s,
        sights=sights,
        samples=samples,
        parts=max(k for k in range(1, PARTS + 1) if samples % k == 0),
        start=start,
        metres_per_radian=np.array([north, east * math.cos(place.latitude)]),
        sar=_present(epoch_s, given.epoch, given.sar),
        barometer=_present(epoch_s, given.epoch, given.barometer),
        air_data=_present(epoch_s, given.epoch, given.air_data),
        star=_present(sight_s, 1.0 / given.star.rate, given.star).reshape(count, sights),
    )


def _towards(direction: float) -> np.ndarray:
    return np.array([math.cos(direction), math.sin(direction)])


def _present(
    time_s: np.ndarray, step_s: float, sensor: Sar | Barometer | AirData | Star
) -> np.ndarray:
    """Whether a sensor is there at times: at its own rate, and not where it is lost."""
    every = round(1.0 / (step_s * sensor.rate))
    there = (np.arange(1, len(time_s) + 1) % every) == 0
    for span in sensor.lost:
        there &= ~span.holds(time_s)
    return there


def _attitude(given: Airship, time_s: Any):
    """Roll, pitch, heading [rad] at times, NumPy or JAX: sines that grow in gusts."""
    hull, wind = given.hull, given.wind
    gusty = wind.gusts is not None or wind.turbulence is not None
    xp = np if isinstance(time_s, np.ndarray) else jnp

    def rise(at: float):
        return 0.5 * (1.0 + xp.tanh((time_s - at) / (0.5 * _BLEND_S)))

    share = rise(wind.span.begin) - rise(wind.span.end) if gusty else 0.0 * time_s
    out = []
    for i, mean in enumerate((0.0, 0.0, hull.course)):
        size = hull.sway_calm[i] + share * (hull.sway_gust[i] - hull.sway_calm[i])
        phase = 2.0 * math.pi * (time_s / hull.sway_period[i] + i / 3.0)
        out.append(mean + size * xp.sin(phase))
    return out


def blow(given: Airship, key: Array) -> tuple[Array, float]:
    """Wind held over steps: (M, 2) m/s north east, and the length of a step [s]."""
    wind = given.wind
    step = given.duration
    if wind.gusts is not None:
        step = wind.gusts.every
    if wind.turbulence is not None:
        step = wind.turbulence.step
    count = math.ceil(given.duration / step - 1e-9)
    total = jnp.broadcast_to(jnp.asarray(wind.constant * _towards(wind.towards)), (count, 2))
    begin, end = wind.span.begin, wind.span.end
    if wind.gusts is not None:
        g = wind.gusts
        coarse = math.ceil(given.duration / g.every - 1e-9)
        drawn = gusts(
            jax.random.fold_in(key, _GUSTS),
            coarse,
            begin,
            end,
            g.every,
            g.speed,
            (wind.towards, g.spread),
        )
        total = total + jnp.repeat(drawn, round(g.every / step), axis=0)[:count]
    if wind.turbulence is not None:
        t = wind.turbulence
        shape = dryden if t.spectrum == "dryden" else von_karman
        own = jax.random.fold_in(key, _TURBULENCE)
        along_across = shape(own, count, step, given.hull.air_speed, t.sigma, t.length)
        towards = _towards(wind.towards)
        turn = jnp.asarray(np.stack([towards, [-towards[1], towards[0]]]))
        time = step * jnp.arange(count, dtype=float)
        inside = (time >= begin) & (time < end)
        total = total + jnp.where(inside[:, None], along_across @ turn, 0.0)
    return total, step


def signed(key: Array, size: Any, draw: Draw) -> Array:
    """Errors of a stated size: as stated, with signs drawn, or drawn with it as sigma."""
    sigma = jnp.asarray(size, float)
    normal = jax.random.normal(key, sigma.shape)
    if draw == "plus-sigma":
        return sigma
    return sigma * (jnp.where(normal < 0.0, -1.0, 1.0) if draw == "random-sign" else normal)


def _desired(given: Airship, course: Course, carried: Carried, time_s: Float[Array, "n"]) -> Nav:
    """The motion at times; position only as exactly as gravity and rates need it."""
    velocity, moved, _ = carried_at(carried, time_s)
    zero = jnp.zeros_like(time_s)
    start = course.start.position
    lat, lon = (
        at + moved[:, i] / course.metres_per_radian[i]
        for i, at in enumerate((start.lat, start.lon))
    )
    return Nav(
        Rotation(from_euler(*_attitude(given, time_s))),
        jnp.stack([velocity[:, 0], velocity[:, 1], zero], 1),
        Geodetic(lat, lon, zero + start.alt),
    )


def simulate(given: Airship, course: Course, seed: int, index: Array) -> World:
    """One run, from its number, which may be traced; pure."""
    key = partial(stream, seed, index)
    wind, step = blow(given, key(Component.WIND))
    commanded = jnp.asarray(given.hull.air_speed * _towards(given.hull.course))
    carried = carry(wind, step, commanded, given.hull.response, course.start.v_n[:2])
    imu, n = given.imu, course.samples
    unit = key(Component.IMU)
    bias = jax.random.split(jax.random.fold_in(unit, _BIASES))
    gyro_bias = signed(bias[0], imu.gyro_bias, imu.draw)
    accel_bias = signed(bias[1], imu.accel_bias, imu.draw)
    errors = ImuErrorModel(
        TriadErrors(bias=gyro_bias, white=np.asarray(imu.gyro_noise)),
        TriadErrors(bias=accel_bias, white=np.asarray(imu.accel_noise)),
    )
    dt = jnp.full(n, 1.0 / imu.rate)
    noise = jax.random.fold_in(unit, _SAMPLES)

    def between_sights(k: Array):
        """Increments: true as one, reported as parts and as one."""
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

    count, sights = len(course.epoch_s), course.sights
    true, parts, single = jax.lax.map(between_sights, jnp.arange(count * sights))
    path = mechanise(course.start, true)

    def by_epoch(x: Array) -> Array:
        return x.reshape(count, sights, *x.shape[1:])

    parts = jax.tree.map(lambda x: by_epoch(x).reshape(count, -1, *x.shape[2:]), parts)
    single = jax.tree.map(by_epoch, single)
    truth = jax.tree.map(lambda x: by_epoch(x)[:, -1], path)
    blown = wind_at(wind, step, jnp.asarray(course.epoch_s) - 1e-6)  # as the epoch ends
    return World(
        whole=jax.vmap(joined)(single),
        parts=parts,
        since=_turned_since(single),
        truth=truth,
        start=jax.tree.map(jnp.asarray, course.start),
        initial_error=signed(key(Component.INITIAL_STATE), start_sigma(given), given.start.draw),
        gyro_bias=gyro_bias,
        accel_bias=accel_bias,
        wind=blown,
        euler=by_epoch(_sighted(given, course, key, path)),
        **_sensed(given, course, key, truth, blown),
    )


def _turned_since(single: Increments) -> Array:
    """Turn from each early sight of an epoch to its end, (E, S - 1, 3), from (E, S) increments."""
    sights = single.dt.shape[1]
    rest = [
        jax.vmap(joined)(jax.tree.map(lambda x, j=j: x[:, j:], single)).theta
        for j in range(1, sights)
    ]
    return jnp.stack(rest, 1) if rest else jnp.zeros((single.dt.shape[0], 0, 3))


def _sighted(given: Airship, course: Course, key: Callable[[Component], Array], path: Nav) -> Array:
    """Angles by the stars along the path."""
    there, sigma = jnp.asarray(course.star).reshape(-1), jnp.full(3, given.star.attitude)
    return observe_euler(key(Component.STAR_SENSOR), path.q_nb.wxyz, sigma, there)


def start_sigma(given: Airship) -> np.ndarray:
    """(9,) of attitude, velocity and position."""
    s = given.start
    return np.array([*s.attitude, *s.velocity, *s.position])


def _sensed(
    given: Airship, course: Course, key: Callable[[Component], Array], truth: Nav, wind: Array
) -> dict[str, Any]:
    """What the sensors other than the inertial unit report, and how the air data err."""
    q, v_n, position = truth.q_nb.wxyz, truth.v_n, truth.position
    through = jnp.concatenate([v_n[:, :2] - wind, v_n[:, 2:]], 1)
    air_b = rotate(conjugate(q), through)
    air, a, s = key(Component.AIR_DATA), given.air_data, given.sar
    sar, barometer, air_data = (
        jnp.asarray(there) for there in (course.sar, course.barometer, course.air_data)
    )
    model = SarErrorModel(s.position, s.heading, s.outlier_share, s.outlier_factor)
    fix = observe_sar(model, key(Component.SAR), position, to_euler(q)[2], sar)
    count, step = len(course.epoch_s), given.epoch
    of_wind = jax.random.fold_in(air, _WIND_ERROR)
    return {
        "wind_error": wind_estimate_error(of_wind, count, step, a.wind_error, a.wind_time),
        "air_b": air_b,
        "air_measured_b": observe_air(jax.random.fold_in(air, _AIR), air_b, a.noise, air_data),
        "sar_position": fix.position,
        "sar_heading": fix.heading_rad,
        "height": observe_height(
            key(Component.BAROMETER), position.alt, given.barometer.height, barometer
        ),
    }
