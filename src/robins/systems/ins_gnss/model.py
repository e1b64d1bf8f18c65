"""Loosely coupled INS/GNSS: the motion and the sensors (Groves 2013, ch. 14).

The navigation state itself is the filter's mean, so the estimate is fed back to the mechanisation
by construction (closed loop). A step of the motion is a block of IMU increments; every sensor
answers "what would it read here", and the Jacobian follows by differentiation on the manifold.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
from jax.tree_util import Partial
from jaxtyping import Array, ArrayLike

from robins.earth import Geodetic, earth_rate_n, gravity_n
from robins.filters import Model, Motion, Sensor
from robins.ins.increments import Increments
from robins.ins.state import InsNoise, InsState, propagate, propagate_linear

POSITION, VELOCITY, STANDSTILL, STILL_RATE, ROAD = (
    "gnss_position",
    "gnss_velocity",
    "zero_velocity",
    "zero_rate",
    "non_holonomic",
)


class Block(NamedTuple):
    """Input of one step of the motion."""

    increments: Increments  # (K,), (K, 3), (K, 3)
    noise_scale: ArrayLike  # () multiplies the process noise factor: 1, more across an IMU gap


class Fix(NamedTuple):
    """What a GNSS position needs besides the state."""

    sigma: ArrayLike  # (3,) m, north east down
    omega_b: ArrayLike  # (3,) rad/s mean raw gyro rate about the fix


class Velocity(NamedTuple):
    """What a GNSS velocity needs besides the state.

    A receiver that differences positions states the mean velocity over a window up to the fix. It
    is older than the fix by what the vehicle gained since, on average over the window.
    """

    sigma: ArrayLike  # (3,) m/s, north east down
    omega_b: ArrayLike  # (3,) rad/s mean raw gyro rate about the fix
    gained_b: ArrayLike = 0.0  # (3,) m/s, raw, in body axes at the fix
    age_s: ArrayLike = 0.0  # s, mean age over the window: half its length


class Mount(NamedTuple):
    """Where things are on the vehicle."""

    lever_b: Array  # (3,) m, IMU to antenna, body axes
    latency_s: Array  # () s, a fix stamped t is of t - latency
    axle_b: Array  # (3,) m, IMU to the point that cannot slip sideways


def _step(noise: InsNoise, x: InsState, block: Block) -> InsState:
    return propagate(x, block.increments, noise)


def _step_linear(noise: InsNoise, x: InsState, block: Block):
    new, Phi, factor = propagate_linear(x, block.increments, noise)
    return new, Phi, factor * block.noise_scale


def _process_noise(noise: InsNoise, x: InsState, block: Block):
    return _step_linear(noise, x, block)[2]


def turn_rate_b(x: InsState, omega_b: Array) -> Array:
    """Turn rate of the body against the Earth [rad/s, body] from a raw gyro rate."""
    return omega_b - x.gyro_bias - x.q_nb.inverse().apply(earth_rate_n(x.position.lat))


def antenna_velocity(x: InsState, mount: Mount, omega_b: Array) -> Array:
    """Velocity of the antenna [m/s, NED]: the IMU's plus that of turning about it."""
    return x.v_n + x.q_nb.apply(jnp.cross(turn_rate_b(x, omega_b), mount.lever_b))


def read_position(mount: Mount, x: InsState, omega_b: Array) -> Geodetic:
    """Where the antenna was when the fix that comes now was true."""
    arm = x.q_nb.apply(mount.lever_b)
    return x.position.retract(arm - antenna_velocity(x, mount, omega_b) * mount.latency_s)


def _read_position(mount: Mount, x: InsState, fix: Fix):
    return read_position(mount, x, jnp.asarray(fix.omega_b))


def _read_velocity(mount: Mount, x: InsState, fix: Velocity):
    gained_b = jnp.asarray(fix.gained_b) - x.accel_bias * fix.age_s
    gained = x.q_nb.apply(gained_b) + gravity_n(x.position.lat, x.position.alt) * fix.age_s
    return antenna_velocity(x, mount, jnp.asarray(fix.omega_b)) - gained


def _fix_sigma(x: InsState, fix: Fix | Velocity):
    return fix.sigma


def _read_standstill(x: InsState, aux: Any):
    return x.v_n


def _read_still_rate(x: InsState, aux: Any):
    return -turn_rate_b(x, jnp.zeros(3))


def _read_road(mount: Mount, x: InsState, omega_b: Array):
    v_b = x.q_nb.inverse().apply(x.v_n) + jnp.cross(turn_rate_b(x, omega_b), mount.axle_b)
    return v_b[1:]


def ins_gnss_model(
    noise: InsNoise,
    mount: Mount,
    standstill_sigma: Array,
    still_rate_sigma: Array,
    road_sigma: Array,
) -> Model:
    """Loosely coupled INS/GNSS with zero-velocity, zero-rate and non-holonomic updates.

    Args:
        noise: of the inertial sensors, as `InsNoise`.
        mount: lever arms [m] and latency [s].
        standstill_sigma: (3,) m/s, how still a vehicle at rest is.
        still_rate_sigma: (3,) rad/s, the same for its turn rate.
        road_sigma: (2,) m/s, sideways and vertical velocity of a vehicle on a road.

    Returns:
        A model with sensors, in order: "gnss_position" (a `Geodetic`, aux `Fix`),
        "gnss_velocity" ((3,) NED, aux `Velocity`), "zero_velocity" ((3,), zeros), "zero_rate" ((3,)
        mean gyro rate at rest) and "non_holonomic" ((2,) zeros; aux mean gyro rate). A sensor is
        silent at an epoch where its measurement is NaN, and left out of a run that does not name
        it.
    """
    motion = Motion(
        step=Partial(_step, noise),
        noise=Partial(_process_noise, noise),
        linear=Partial(_step_linear, noise),
    )
    return Model(
        motion,
        (
            Sensor(Partial(_read_position, mount), _fix_sigma, 3, POSITION),
            Sensor(Partial(_read_velocity, mount), _fix_sigma, 3, VELOCITY),
            Sensor(_read_standstill, standstill_sigma, 3, STANDSTILL),
            Sensor(_read_still_rate, still_rate_sigma, 3, STILL_RATE),
            Sensor(Partial(_read_road, mount), road_sigma, 2, ROAD),
        ),
    )
