"""Velocity and attitude matching with twelve error states, open loop.

The model of a patent on transfer alignment (Southeast University), its eqs. (1) to (5), in its
frames: navigation east-north-up, body right-forward-up, heading clockwise from north. The slave
navigates by itself, with its vertical channel held (VU = 0); what is estimated is how far that is
off,

    x = [dL, dlon, dVE, dVN, phi_E, phi_N, phi_U, nabla_x, nabla_y, eps_x, eps_y, eps_z]

computed minus true, in rad, m/s, m/s^2 and rad/s; C_computed = exp(-phi x) C_true. Measured is

    Y = [VE, VN, heading, pitch, roll] of the slave minus those of the master,

here as two sensors, for they have units of their own; updating with one after the other is
updating with both.

Left out, as by the patent: the accelerometer along z, which a bank turns into the horizontal, and
mounting angles between the two units. Euler angles fail where the nose points up: see
`refuse_steep`.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from robins import _float64  # noqa: F401
from robins.earth import OMEGA_E, curvature_radii
from robins.filters import Model, Motion, Sensor
from robins.ins.frames import euler_enu_rfu, swap_q
from robins.manifold import wrap
from robins.rotation import to_dcm

STATES = 12
LAT, LON, VE, VN, PHI_E, PHI_N, PHI_U, NABLA_X, NABLA_Y, EPS_X, EPS_Y, EPS_Z = range(STATES)
POSITION, VELOCITY, PHI = slice(0, 2), slice(2, 4), slice(4, 7)
NABLA, EPS = slice(7, 9), slice(9, 12)

VELOCITY_SENSOR, ATTITUDE_SENSOR = "velocity_matching", "attitude_matching"
STEEPEST_RAD = math.radians(85.0)


class Flight(NamedTuple):
    """How the slave flies, as it computes it itself."""

    lat_rad: Array  # ()
    alt_m: Array  # ()
    v_enu: Array  # (3,) m/s, of which the model uses east and north
    f_enu: Array  # (3,) m/s^2, specific force
    C_nb: Array  # (3, 3) body RFU to navigation ENU


class Interval(NamedTuple):
    """What the motion is told of the time between two epochs."""

    flight: Flight  # on average
    dt_s: Array  # ()
    sigma: Array  # (12,) process noise of the interval


class Sight(NamedTuple):
    """What the measurement of attitude is told of an epoch."""

    C_nb: Array  # (3, 3)
    sigma: Array  # (3,) rad, of heading, pitch, roll


def error_dynamics(flight: Flight) -> Float[Array, "12 12"]:
    """F of x' = F x (eq. 3), with the radii of curvature taken as constant."""
    RM, RN = curvature_radii(flight.lat_rad)
    RM, RN = RM + flight.alt_m, RN + flight.alt_m
    s, c = jnp.sin(flight.lat_rad), jnp.cos(flight.lat_rad)
    t = s / c
    E, N = flight.v_enu[0], flight.v_enu[1]
    fE, fN, fU = flight.f_enu[0], flight.f_enu[1], flight.f_enu[2]
    T, w, o = flight.C_nb, OMEGA_E, jnp.zeros(())
    up, north = w * s + E * t / RN, w * c + E / RN  # omega_in, but for VN / RM about west
    rows = [
        # dL  dlon  dVE  dVN  phi_E  phi_N  phi_U
        [o, o, o, 1.0 / RM, o, o, o],
        [E * t / (RN * c), o, 1.0 / (RN * c), o, o, o, o],
        [2.0 * w * c * N + E * N / (RN * c**2), o, N * t / RN, w * s + up, o, -fU, fN],
        [-(2.0 * w * c * E + E**2 / (RN * c**2)), o, -2.0 * up, o, fU, o, -fE],
        [o, o, o, -1.0 / RM, o, up, -north],
        [-w * s, o, 1.0 / RN, o, -up, o, -N / RM],
        [w * c + E / (RN * c**2), o, t / RN, o, north, N / RM, o],
    ]
    F1 = jnp.stack([jnp.stack([jnp.asarray(x, float) for x in row]) for row in rows])
    C = jnp.zeros((7, 5)).at[2:4, :2].set(T[:2, :2]).at[4:, 2:].set(-T)
    return jnp.pad(jnp.concatenate([F1, C], axis=1), ((0, 5), (0, 0)))


def transition(interval: Interval) -> Float[Array, "12 12"]:
    """Phi = I + F T + (F T)^2 / 2."""
    FT = error_dynamics(interval.flight) * interval.dt_s
    return jnp.eye(STATES) + FT + 0.5 * FT @ FT


def measurement_matrix(C_nb: Float[Array, "3 3"]) -> Float[Array, "5 12"]:
    """H of Y = H x (eq. 5): velocities as they are, and H1 from phi to heading, pitch, roll."""
    T12, T22, T32 = C_nb[0, 1], C_nb[1, 1], C_nb[2, 1]
    level_sq = 1.0 - T32**2  # cos(pitch)^2
    level = jnp.sqrt(level_sq)
    o = jnp.zeros(())
    rows = [
        [-T12 * T32 / level_sq, -T22 * T32 / level_sq, o + 1.0],
        [-T22 / level, T12 / level, o],
        [-T12 / level_sq, -T22 / level_sq, o],
    ]
    H1 = jnp.stack([jnp.stack(row) for row in rows])
    return jnp.zeros((5, STATES)).at[:2, VELOCITY].set(jnp.eye(2)).at[2:, PHI].set(H1)


def euler_difference(slave_q_enu: ArrayLike, master_q_enu: ArrayLike) -> Float[Array, "*b 3"]:
    """Heading, pitch and roll of the slave minus those of the master [rad], in [-pi, pi).

    Args:
        slave_q_enu: (..., 4) attitude, body RFU to ENU.
        master_q_enu: (..., 4), of boxes that are aligned; NaN where missing.
    """
    slave, master = (euler_enu_rfu(jnp.asarray(q, float)) for q in (slave_q_enu, master_q_enu))
    return wrap(jnp.stack([a - b for a, b in zip(slave[::-1], master[::-1], strict=True)], -1))


def refuse_steep(time_s: ArrayLike, q_nb: ArrayLike) -> None:
    """Refuse attitudes at which roll and heading cannot be told apart; outside compiled code.

    Args:
        time_s: (N,) s.
        q_nb: (N, 4) attitude, NED/FRD.

    Raises:
        ValueError: the nose points more than 85 deg up or down at some time.
    """
    times, q = np.atleast_1d(np.asarray(time_s, float)), np.atleast_2d(np.asarray(q_nb, float))
    w, x, y, z = q.T
    pitch = np.arcsin(np.clip(2.0 * (w * y - x * z), -1.0, 1.0))
    steep = np.flatnonzero(np.abs(pitch) > STEEPEST_RAD)
    if len(steep):
        k = steep[0]
        raise ValueError(
            f"pitch is {math.degrees(pitch[k]):.1f} deg at {times[k]:g} s: beyond 85 deg heading "
            "and roll are hard to tell apart and their differences no measurement of attitude. "
            "Match rotation matrices instead, as the filter 'product' does"
        )


def dcm_enu(q_nb: ArrayLike) -> Float[Array, "*b 3 3"]:
    """C from body RFU to ENU of an attitude NED/FRD (..., 4)."""
    return to_dcm(swap_q(jnp.asarray(q_nb, float)))


def _move(x: Array, interval: Interval) -> Array:
    return transition(interval) @ x


def _noise(x: Array, interval: Interval) -> Array:
    return interval.sigma


def _move_linear(x: Array, interval: Interval) -> tuple[Array, Array, Array]:
    Phi = transition(interval)
    return Phi @ x, Phi, interval.sigma


def _read_velocity(x: Array, sigma: Array) -> Array:
    return x[VELOCITY]


def _read_velocity_linear(x: Array, sigma: Array) -> tuple[Array, Array]:
    return x[VELOCITY], jnp.eye(STATES)[VELOCITY]


def _velocity_sigma(x: Array, sigma: Array) -> Array:
    return sigma


def _read_attitude(x: Array, sight: Sight) -> Array:
    return measurement_matrix(sight.C_nb)[2:] @ x


def _read_attitude_linear(x: Array, sight: Sight) -> tuple[Array, Array]:
    H = measurement_matrix(sight.C_nb)[2:]
    return H @ x, H


def _attitude_sigma(x: Array, sight: Sight) -> Array:
    return sight.sigma


def velocity_attitude_model() -> Model:
    """The model.

    The motion takes an `Interval` for each step; the sensor "velocity" (VE, VN) its (2,) standard
    deviations [m/s], "attitude" (heading, pitch, roll) a `Sight`. Every call gives the same
    functions, so that what was compiled for one serves all.
    """
    return Model(
        Motion(_move, _noise, _move_linear),
        (
            Sensor(_read_velocity, _velocity_sigma, 2, VELOCITY_SENSOR, _read_velocity_linear),
            Sensor(_read_attitude, _attitude_sigma, 3, ATTITUDE_SENSOR, _read_attitude_linear),
        ),
    )


def process_sigma(gyro_noise: Any, accel_noise: Any, dt_s: Any) -> Float[Array, "12"]:
    """(12,) process noise of an interval from white noise of the sensors.

    Noise alike on all axes, so it does not matter how the body is turned.

    Args:
        gyro_noise: angle random walk [rad/sqrt(s)].
        accel_noise: velocity random walk [m/s/sqrt(s)].
        dt_s: [s].
    """
    root = jnp.sqrt(jnp.asarray(dt_s, float))
    sigma = jnp.zeros(STATES).at[VELOCITY].set(accel_noise * root)
    return sigma.at[PHI].set(gyro_noise * root)
