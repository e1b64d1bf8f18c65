"""From parameters to what the filter takes: noise, mount, filters, initial belief."""

from __future__ import annotations

import math
from functools import cache

import jax.numpy as jnp
import numpy as np

from robins.earth import Geodetic
from robins.errors import require_known
from robins.filters import Belief, Filter, Model, cubature, kalman, taylor, unscented
from robins.filters.rules import gate
from robins.ins.state import InsNoise, InsState
from robins.rotation import Rotation
from robins.systems.ins_gnss.model import (
    POSITION,
    ROAD,
    STANDSTILL,
    STILL_RATE,
    VELOCITY,
    Mount,
    ins_gnss_model,
)
from robins.systems.ins_gnss.parameters import Aids, Gnss, Imu, Start
from robins.systems.study import SensorAxes, StateBlock

FILTERS = {
    "ekf": lambda rules: kalman(taylor(), rules),
    "ekf-joseph": lambda rules: kalman(taylor(), rules, form="joseph"),
    "ukf": lambda rules: kalman(unscented(), rules),
    "ckf": lambda rules: kalman(cubature(), rules),
}
SMOOTHED = "+rts"  # a filter's name with this ending is its smoother


@cache
def make_filter(name: str, gate_probability: float = 0.0) -> Filter:
    """The filter of a name, gated where the probability is not zero.

    Equal arguments give the same object, so that what was compiled for it serves again.

    Raises:
        ValueError: there is no filter of this name.
    """
    base = name.removesuffix(SMOOTHED)
    require_known("filter", base, FILTERS, f"this system, where each may end in {SMOOTHED}")
    return FILTERS[base]((gate(gate_probability),) if gate_probability > 0.0 else ())


def noise_of(imu: Imu) -> InsNoise:
    """Noise of the inertial sensors, SI.

    A Gauss-Markov bias of spread s and time tau is driven by noise of density s sqrt(2 / tau).
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
    """Lever arms and latency."""
    return Mount(jnp.asarray(gnss.lever_arm), jnp.asarray(gnss.latency), jnp.asarray(aids.axle))


def model_of(imu: Imu, gnss: Gnss, aids: Aids) -> Model:
    """The model a filter believes in."""
    return ins_gnss_model(
        noise_of(imu),
        mount_of(gnss, aids),
        standstill_sigma=jnp.full(3, aids.standstill_velocity),
        still_rate_sigma=jnp.full(3, aids.standstill_rate),
        road_sigma=jnp.asarray(aids.road_velocity),
    )


def sigma_of(imu: Imu, start: Start, tilt: float, heading: float) -> np.ndarray:
    """(n,) standard deviations of the initial state's tangent components."""
    parts = [
        [tilt, tilt, heading],
        [start.velocity] * 3,
        [start.position] * 3,
        imu.gyro_bias,
        imu.accel_bias,
    ]
    if imu.scale_states:
        parts += [imu.gyro_scale, imu.accel_scale]
    return np.concatenate([np.asarray(p, dtype=float) for p in parts])


def belief_at(q_nb, v_n, position: Geodetic, sigma: np.ndarray, imu: Imu, gyro_bias=None) -> Belief:
    """Initial belief, uncorrelated."""
    scale = jnp.zeros(3) if imu.scale_states else None
    mean = InsState(
        Rotation(jnp.asarray(q_nb)),
        jnp.asarray(v_n),
        position,
        jnp.zeros(3) if gyro_bias is None else jnp.asarray(gyro_bias),
        jnp.zeros(3),
        scale,
        scale,
    )
    return Belief(mean, jnp.diag(jnp.asarray(sigma)))


NED = ("north", "east", "down")
XYZ = ("forward", "right", "down")
SENSORS = {
    POSITION: SensorAxes("m", "NED", NED),
    VELOCITY: SensorAxes("m/s", "NED", NED),
    STANDSTILL: SensorAxes("m/s", "NED", NED),
    STILL_RATE: SensorAxes("rad/s", "FRD", XYZ),
    ROAD: SensorAxes("m/s", "FRD", XYZ[1:]),
}


def state_blocks(scale_states: bool) -> tuple[StateBlock, ...]:
    """The tangent components of `InsState` under their names."""
    blocks = [
        StateBlock("attitude", slice(0, 3), "rad", "deg", "NED", NED),
        StateBlock("velocity", slice(3, 6), "m/s", "m/s", "NED", NED),
        StateBlock("position", slice(6, 9), "m", "m", "NED", NED),
        StateBlock("gyro_bias", slice(9, 12), "rad/s", "deg/h", "FRD", XYZ),
        StateBlock("accel_bias", slice(12, 15), "m/s^2", "mg", "FRD", XYZ),
    ]
    if scale_states:
        blocks += [
            StateBlock("gyro_scale", slice(15, 18), "1", "ppm", "FRD", XYZ),
            StateBlock("accel_scale", slice(18, 21), "1", "ppm", "FRD", XYZ),
        ]
    return tuple(blocks)
