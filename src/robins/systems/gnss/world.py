"""A simulated drive through a city: walls in blocks, signals blocked, reflected or lost.

Walls stand on both sides of the street, in blocks whose heights and distances are drawn in every
run. With the azimuth b of a satellite relative to the heading, its elevation e and a wall of height
H at the distance a on its side, the signal is blocked if a tan(e) / |sin b| < H. It then arrives by
reflection at the opposite wall, at a', delayed by 2 a' |sin b| cos(e) (the image of the receiver in
that wall), or not at all if there is none. The filters do not model walls, and their law of delays
(`robins.systems.gnss.parameters.Delays`) differs, so that this world does not favour them.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from robins import rotation
from robins.earth import Geodetic
from robins.sim.random import Component, gauss_markov, stream
from robins.systems.gnss.filters import GnssWorld
from robins.systems.gnss.model import (
    LENGTH,
    RANGES,
    GnssState,
    LocalFrame,
    MotionStep,
    Sky,
    clock_density,
    delay_law,
    first_fix,
    pseudoranges,
)
from robins.systems.gnss.parameters import City, GnssAssumptions
from robins.systems.parts import motion_of

_ORBIT_M = 26.56e6  # radius of a GPS orbit
_GOLDEN = np.pi * (3.0 - np.sqrt(5.0))
_MULTIPATH_S = 10.0  # correlation time of the multipath of a signal in direct sight


class GnssCourse(NamedTuple):
    """Data that all runs share; E epochs, N satellites."""

    epoch_s: np.ndarray  # (E,)
    place: LocalFrame
    member: np.ndarray  # (N, 1)
    satellites: tuple[str, ...]
    satellite_e: np.ndarray  # (N, 3) m, ECEF; fixed: their 0.5 deg per minute is negligible
    elevation_rad: np.ndarray  # (N,)
    azimuth_rad: np.ndarray  # (N,)
    position: np.ndarray  # (E, 3) m, NED
    heading_rad: np.ndarray  # (E,)
    dt: np.ndarray  # (E,) s
    speed: np.ndarray  # (E,) m/s, mean over the step
    yaw_rate: np.ndarray  # (E,) rad/s
    way_m: np.ndarray  # (E,) distance along the road


def lay_out(city: City) -> GnssCourse:
    """Compute all that does not depend on the run.

    Raises:
        ValueError: a leg is not complete.
    """
    motion = motion_of(city.place, city.legs)
    time_s = motion.times_ns(city.rate) * 1e-9
    k = motion.at(time_s)
    place = LocalFrame.at(motion.start.as_ecef())
    position = np.asarray(place.local(Geodetic(k.lat, k.lon, k.alt).as_ecef()))
    heading = np.unwrap(np.asarray(rotation.to_euler(jnp.asarray(k.q_nb))[2]))
    dt = np.diff(time_s)
    way = np.hypot(*np.diff(position[:, :2], axis=0).T)
    azimuth, elevation, r_e = _constellation(city, place)
    return GnssCourse(
        epoch_s=time_s[1:],
        place=place,
        member=(np.arange(len(azimuth)) % 2)[:, None].astype(float),
        satellites=tuple(f"{'GR'[k % 2]}{k // 2 + 1:02d}" for k in range(len(azimuth))),
        satellite_e=r_e,
        elevation_rad=elevation,
        azimuth_rad=azimuth,
        position=position[1:],
        heading_rad=heading[1:],
        dt=dt,
        speed=way / dt,
        yaw_rate=np.diff(np.asarray(heading, float)) / dt,
        way_m=np.cumsum(way),
    )


def _constellation(city: City, place: LocalFrame) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Azimuth, elevation (N,) [rad] and position (N, 3) [m, ECEF], uniform over the sky."""
    n, least = city.satellites.count, np.sin(city.satellites.lowest)
    up = least + (1.0 - least) * (np.arange(n) + 0.5) / n
    azimuth, elevation = (np.arange(n) * _GOLDEN) % (2.0 * np.pi), np.arcsin(up)
    flat = np.cos(elevation)
    line = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), -up], axis=1)
    line_e = line @ np.asarray(place.C_en).T
    o = np.asarray(place.origin_e)
    along = line_e @ o
    far = -along + np.sqrt(along**2 + _ORBIT_M**2 - o @ o)
    return azimuth, elevation, o + far[:, None] * line_e


def signals(city: City, course: GnssCourse, key: Array) -> tuple[Array, Array]:
    """Draw walls; return delays (E, N) [m], NaN where a signal is lost, and C/N0 (E, N) [dBHz]."""
    s = city.streets
    count = int(course.way_m[-1] / s.block) + 1
    block = jnp.asarray((course.way_m / s.block).astype(int))
    keys = jax.random.split(key, 7)
    shape = (count, 2)  # left, right
    tall = s.least_height + s.mean_height * jax.random.exponential(keys[0], shape)
    tall = jnp.where(jax.random.uniform(keys[1], shape) < s.gap, 0.0, tall)
    spread = jnp.log(s.farthest / s.nearest)
    wide = s.nearest * jnp.exp(spread * jax.random.uniform(keys[2], shape))

    aside = jnp.sin(course.azimuth_rad[None, :] - course.heading_rad[:, None])  # (E, N)
    right = aside > 0.0

    def of(side: Array, what: Array) -> Array:
        here = what[block]
        return jnp.where(side, here[:, 1:], here[:, :1])

    across = jnp.maximum(jnp.abs(aside), 1e-3)
    slope = np.tan(course.elevation_rad)[None, :]
    blocked = of(right, wide) * slope / across < of(right, tall)
    late = 2.0 * of(~right, wide) * across * np.cos(course.elevation_rad)[None, :]
    late = jnp.where(of(~right, tall) > 0.0, late, jnp.nan)
    e, n = right.shape
    rough = city.delays.multipath * gauss_markov(
        keys[3], e, n, float(np.mean(course.dt)), _MULTIPATH_S
    )
    loss = s.loss_db + 3.0 * jax.random.normal(keys[4], (count, n))[block]
    cn0 = 38.0 + 10.0 * np.sin(course.elevation_rad)[None, :]
    cn0 = cn0 + 1.5 * jax.random.normal(keys[5], (e, n)) - jnp.where(blocked, loss, 0.0)
    return jnp.where(blocked, late, 0.0) + rough, jnp.asarray(cn0)


def simulate(city: City, course: GnssCourse, seed: int, index: Array) -> GnssWorld:
    """Simulate the run of this number; pure."""
    key = partial(stream, seed, index)
    late, cn0 = signals(city, course, key(Component.GNSS))
    e, n = late.shape
    white, first, oscillator, scale_key, odometer, gyro = jax.random.split(
        key(Component.ODOMETER), 6
    )
    draw = jax.random.normal
    b, dt = city, jnp.asarray(course.dt)

    # clock: bias and drift, each a random walk
    phase, pace = clock_density(b.clock)
    begin = draw(first, (3,))
    steps = draw(oscillator, (2, e)) * jnp.sqrt(dt)[None, :]
    drift = b.clock.drift * begin[0] + jnp.cumsum(pace * steps[1])
    clock = 1e4 * begin[1] + jnp.cumsum(drift * dt + phase * steps[0])
    systems = b.clock.system_bias * begin[2:]

    # wheels and yaw gyro
    scale, bias = draw(scale_key, (2,)) * jnp.array([b.wheels.scale, b.wheels.yaw_bias])
    speed = jnp.asarray(course.speed) / (1.0 + scale) + city.speed_noise * draw(odometer, (e,))
    rate = jnp.asarray(course.yaw_rate) + bias + city.yaw_noise * draw(gyro, (e,))
    moving = jnp.asarray(course.speed > 0.01)
    speed = jnp.where(moving, jnp.maximum(speed, 0.0), 0.0)

    present = jnp.isfinite(late)
    delay = jnp.where(present, late, 0.0)
    sigma = city.satellites.noise * 10.0 ** ((45.0 - cn0) / 40.0)
    mean, spread = delay_law(b.delays, course.elevation_rad[None, :], cn0)
    c = (1.0 + scale) * jnp.stack(
        [jnp.cos(course.heading_rad), jnp.sin(course.heading_rad)], axis=1
    )
    truth = GnssState(
        position=jnp.asarray(course.position),
        direction=c,
        yaw_bias=jnp.full(e, bias),
        clock=jnp.stack([clock, drift], axis=1),
        systems=jnp.broadcast_to(systems[None, :], (e, 1)),
        delay=delay,
    )
    sky = Sky(jnp.broadcast_to(course.satellite_e[None], (e, n, 3)), sigma)
    exact = jax.vmap(partial(pseudoranges, course.place, jnp.asarray(course.member)))(truth, sky)
    y = jnp.where(present, exact + sigma * draw(white, (e, n)), jnp.nan)
    wanted: dict[str, Any] = {RANGES: y, LENGTH: length_once(city, course.way_m)}
    u = MotionStep(
        *(dt, speed, rate, jnp.full(e, city.speed_noise), jnp.full(e, city.yaw_noise)),
        *(mean, spread, jnp.zeros((e, n))),
    )
    here = Sky(sky.satellite_e[0], sky.sigma[0])
    fix = first_fix(y[0], here, course.member, b.clock.system_bias)
    return GnssWorld(fix, u, wanted, sky, truth)


def length_once(believed: GnssAssumptions, way_m: np.ndarray) -> np.ndarray:
    """Measurement |c| = 1 (E, 1) at the first epoch after `aligned_after` metres; NaN elsewhere."""
    out = np.full((len(way_m), 1), np.nan)
    far = np.flatnonzero(way_m >= believed.wheels.aligned_after)
    out[far[:1]] = 1.0
    return out
