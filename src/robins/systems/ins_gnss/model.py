"""Loosely coupled INS/GNSS: the motion and the sensors (Groves 2013, ch. 14).

The navigation state itself is the filter's mean, so the estimate is fed back to the mechanisation
by construction (closed loop)::

    x = (q_nb, v, p, b_g, b_a [, s_g, s_a])          15 or 21 tangent components

A step of the motion is a block of IMU increments; its transition F and noise Q are those of
`robins.ins.transition`. With C = C(q_nb), the raw gyro rate w, the Earth rate w_ie, the turn rate
against the Earth w_eb = w - b_g - C' w_ie, and lever arms l, the sensors read ::

    gnss_position   p + C l - v_a latency            v_a = v + C (w_eb x l), of the antenna
    gnss_velocity   v_a - C (gained - b_a age) - g age
    zero_velocity   v
    zero_rate       b_g + C' w_ie
    non_holonomic   C' v + w_eb x l_axle, right and down
    odometer        the same, forward

and their Jacobians H follow by differentiation on the manifold.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial
from jaxtyping import Array, ArrayLike

from robins.earth import Geodetic, earth_rate_n, gravity_n
from robins.filters import Belief, Model, Sensor
from robins.filters.belief import Number
from robins.ins.mechanise import Nav
from robins.ins.state import InsNoise, InsState, propagate, propagate_linear
from robins.systems.ins_gnss.parameters import Aids, Gnss, InsGnssImu, InsGnssStart
from robins.systems.parts import FRD, NED, ImuBlock, as_array, moved_by
from robins.systems.study import SensorAxes, StateBlock

POSITION, VELOCITY, STANDSTILL, STILL_RATE, ROAD = (
    "gnss_position",
    "gnss_velocity",
    "zero_velocity",
    "zero_rate",
    "non_holonomic",
)
ODOMETER = "odometer"
IMU = "imu"  # drives the motion; a bank may find it at fault
SENSORS = {
    POSITION: SensorAxes("m", "NED", NED),
    VELOCITY: SensorAxes("m/s", "NED", NED),
    STANDSTILL: SensorAxes("m/s", "NED", NED),
    STILL_RATE: SensorAxes("rad/s", "FRD", FRD),
    ROAD: SensorAxes("m/s", "FRD", FRD[1:]),
    ODOMETER: SensorAxes("m/s", "FRD", FRD[:1]),
}


def state_blocks(scale_states: bool) -> tuple[StateBlock, ...]:
    """Named blocks of the tangent components of `InsState`."""
    blocks = (
        StateBlock("attitude", slice(0, 3), "rad", "deg", "NED", NED),
        StateBlock("velocity", slice(3, 6), "m/s", "m/s", "NED", NED),
        StateBlock("position", slice(6, 9), "m", "m", "NED", NED),
        StateBlock("gyro_bias", slice(9, 12), "rad/s", "deg/h", "FRD", FRD),
        StateBlock("accel_bias", slice(12, 15), "m/s^2", "mg", "FRD", FRD),
        StateBlock("gyro_scale", slice(15, 18), "1", "ppm", "FRD", FRD),
        StateBlock("accel_scale", slice(18, 21), "1", "ppm", "FRD", FRD),
    )
    return blocks if scale_states else blocks[:5]


class Fix(NamedTuple):
    """Inputs of a GNSS position, or of a wheel speed, besides the state."""

    sigma: ArrayLike  # (3,) m, north east down; of a wheel (1,) m/s
    omega_b: ArrayLike  # (3,) rad/s mean raw gyro rate about the time of the measurement


class Velocity(NamedTuple):
    """Inputs of a GNSS velocity besides the state.

    A receiver that differences positions states the mean velocity over a window up to the fix,
    which differs from that at the fix by the mean velocity gained since.
    """

    sigma: ArrayLike  # (3,) m/s, north east down
    omega_b: ArrayLike  # (3,) rad/s mean raw gyro rate about the fix
    gained_b: ArrayLike = 0.0  # (3,) m/s, mean raw gain, in body axes at the fix
    age_s: ArrayLike = 0.0  # s, mean age over the window: half its length


class Mount(NamedTuple):
    """Lever arms of antenna and axle, and the latency of fixes."""

    lever_b: Array  # (3,) m, IMU to antenna, body axes
    latency_s: Array  # () s, a fix stamped t is valid at t - latency
    axle_b: Array  # (3,) m, IMU to the point that cannot slip sideways


def _step(noise: InsNoise, x: InsState, block: ImuBlock) -> InsState:
    return propagate(x, block.increments, noise)


def _step_linear(noise: InsNoise, x: InsState, block: ImuBlock):
    new, Phi, factor = propagate_linear(x, block.increments, noise)
    return new, Phi, factor * block.noise_scale


def turn_rate_b(x: InsState, omega_b: Array) -> Array:
    """Turn rate of the body relative to the Earth [rad/s, body] from a raw gyro rate."""
    return omega_b - x.gyro_bias - x.q_nb.inverse().apply(earth_rate_n(x.position.lat))


def antenna_velocity(x: InsState, mount: Mount, omega_b: Array) -> Array:
    """Velocity of the antenna [m/s, NED]: that of the IMU plus the lever-arm velocity."""
    return x.v_n + x.q_nb.apply(jnp.cross(turn_rate_b(x, omega_b), mount.lever_b))


def read_position(mount: Mount, x: InsState, omega_b: Array) -> Geodetic:
    """Position of the antenna at the time for which the present fix is valid."""
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


def _read_standstill(x: InsState, aux: Array | None):
    return x.v_n


def _read_still_rate(x: InsState, aux: Array | None):
    return -turn_rate_b(x, jnp.zeros(3))


def _axle_velocity_b(mount: Mount, x: InsState, omega_b: Array):
    return x.q_nb.inverse().apply(x.v_n) + jnp.cross(turn_rate_b(x, omega_b), mount.axle_b)


def _read_road(mount: Mount, x: InsState, omega_b: Array):
    return _axle_velocity_b(mount, x, omega_b)[1:]


def _read_wheel(mount: Mount, x: InsState, wheel: Fix):
    return _axle_velocity_b(mount, x, jnp.asarray(wheel.omega_b))[:1]


def noise_of(imu: InsGnssImu) -> InsNoise:
    """Noise of the inertial sensors, SI.

    A Gauss-Markov bias of sigma s and time constant tau is driven by noise of density
    s sqrt(2 / tau).
    """

    def drive(walk, spread, time):
        if time is None:
            return jnp.asarray(walk), jnp.full(3, jnp.inf)
        return jnp.asarray(spread) * math.sqrt(2.0 / time), jnp.full(3, time)

    gyro_walk, gyro_time = drive(imu.gyro_bias_walk, imu.gyro_bias, imu.gyro_bias_time)
    accel_walk, accel_time = drive(imu.accel_bias_walk, imu.accel_bias, imu.accel_bias_time)
    return InsNoise(
        gyro_arw=jnp.asarray(imu.gyro_noise),
        accel_vrw=jnp.asarray(imu.accel_noise),
        gyro_bias_rw=gyro_walk,
        accel_bias_rw=accel_walk,
        gyro_bias_tau=gyro_time,
        accel_bias_tau=accel_time,
    )


def mount_of(gnss: Gnss, aids: Aids) -> Mount:
    """Lever arms and latency of the parameters."""
    return Mount(jnp.asarray(gnss.lever_arm), jnp.asarray(gnss.latency), jnp.asarray(aids.axle))


def ins_gnss_model(imu: InsGnssImu, gnss: Gnss, aids: Aids) -> Model:
    """Loosely coupled INS/GNSS with zero-velocity, zero-rate and non-holonomic updates.

    Args:
        imu: the inertial sensors as a filter models them.
        gnss: lever arm and latency.
        aids: sigmas of standstill and slip, and the lever arm of the axle.

    Returns:
        A model with sensors, in order: "gnss_position" (a `Geodetic`, aux `Fix`),
        "gnss_velocity" ((3,) NED, aux `Velocity`), "zero_velocity" ((3,), zeros), "zero_rate" ((3,)
        mean gyro rate at rest), "non_holonomic" ((2,) zeros; aux mean gyro rate) and "odometer"
        ((1,), aux `Fix`). A NaN
        measurement is missing; a run without a sensor's name omits that sensor.
    """
    noise, mount = noise_of(imu), mount_of(gnss, aids)
    still, still_rate = aids.standstill_velocity, aids.standstill_rate
    return Model(
        moved_by(_step, _step_linear, noise),
        (
            Sensor(Partial(_read_position, mount), _fix_sigma, 3, POSITION),
            Sensor(Partial(_read_velocity, mount), _fix_sigma, 3, VELOCITY),
            Sensor(_read_standstill, jnp.full(3, still), 3, STANDSTILL),
            Sensor(_read_still_rate, jnp.full(3, still_rate), 3, STILL_RATE),
            Sensor(Partial(_read_road, mount), jnp.asarray(aids.road_velocity), 2, ROAD),
            Sensor(Partial(_read_wheel, mount), _fix_sigma, 1, ODOMETER),
        ),
    )


def start_belief(
    nav: Nav,
    imu: InsGnssImu,
    start: InsGnssStart,
    tilt_rad: Number,
    heading_rad: Number,
    gyro_bias: ArrayLike | None = None,
    fix_sigma_m: Iterable[Number] = (0.0, 0.0, 0.0),
) -> Belief:
    """Initial belief about `InsState`, without correlations.

    Sigmas are `tilt_rad` for roll and pitch, `heading_rad` for heading, else those of `imu` and
    `start`; `fix_sigma_m` (3,), of the fix that gives the position, is added in quadrature.
    `gyro_bias` (3,) [rad/s] is the mean if known from rest; else zero.
    """
    place = [(start.position**2 + s**2) ** 0.5 for s in fix_sigma_m]
    sigma = [[tilt_rad, tilt_rad, heading_rad], [start.velocity] * 3, place]
    sigma += [imu.gyro_bias, imu.accel_bias]
    sigma += [imu.gyro_scale, imu.accel_scale] if imu.scale_states else []
    mean = InsState.start(nav, imu.scale_states)
    if gyro_bias is not None:
        mean = mean._replace(gyro_bias=jnp.asarray(gyro_bias))
    each = as_array([x for part in sigma for x in part])
    # NumPy, which compiles nothing, unless the numbers are traced
    factor: Any = (np if isinstance(each, np.ndarray) else jnp).diag(each)
    return Belief(mean, factor)
