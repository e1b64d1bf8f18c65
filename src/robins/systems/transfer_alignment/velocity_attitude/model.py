"""Velocity and attitude matching: a free-running slave INS, and its twelve error states.

The model of a patent on transfer alignment (Southeast University), its eqs. (1) to (5), in its
frames: navigation n east-north-up, body b right-forward-up, heading clockwise from north. The slave
navigates with its vertical channel held (VU = 0, height as at the start); nothing is fed back, so
its errors grow by the linear model, as long as they are small. The state is

    x = [dL, dlon, dVE, dVN, phi_E, phi_N, phi_U, nabla_x, nabla_y, eps_x, eps_y, eps_z]

computed minus true, in rad, m/s, m/s^2 and rad/s; C_computed = exp(-phi x) C_true. With Earth's
radii of curvature RM, RN (height included), its rate w, specific force f and omega_in of n,

    dL'   = dVN / RM                                                        (1)
    dlon' = (dVE + VE tan L dL) / (RN cos L)                                (2)
    dV'   = f x phi + C_nb nabla - errors of Coriolis terms                 (3)  horizontal part
    phi'  = -omega_in x phi + d(omega_in) - C_nb (eps + white noise)        (4)
    nabla' = 0,   eps' = 0                                                  (5)

Phi = I + F T + (F T)^2 / 2 over an interval, Q = diag(0, (sa^2 T) I2, (sg^2 T) I3, 0) of white
noise of accelerometers and gyros. The measurement is the slave minus the master,

    Y = [VE, VN, heading, pitch, roll] = [dV, H1 phi] + v                   (6)

as two sensors, which differ in units; sequential updates are equivalent to a joint one. As in the
patent, the model omits the bias of the z accelerometer, which a bank projects into the horizontal,
and mounting angles between the two units. Euler angles are singular with the nose up: see
`refuse_steep`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike, Float

from robins import _float64  # noqa: F401
from robins.earth import OMEGA_E, curvature_radii
from robins.filters import Model
from robins.ins.frames import euler_enu_rfu, swap, swap_q
from robins.ins.increments import Increments
from robins.ins.mechanise import Nav, advance, rows, unpacked, vector
from robins.ins.state import InsState
from robins.manifold import retract, wrap
from robins.rotation import conjugate, multiply, rotate, to_dcm, to_euler
from robins.systems.parts import moved_by, seen_by

STATES = 12
LAT, LON, VE, VN, PHI_E, PHI_N, PHI_U, NABLA_X, NABLA_Y, EPS_X, EPS_Y, EPS_Z = range(STATES)
POSITION, VELOCITY, PHI = slice(0, 2), slice(2, 4), slice(4, 7)
NABLA, EPS = slice(7, 9), slice(9, 12)

VELOCITY_SENSOR, ATTITUDE_SENSOR = "velocity_matching", "attitude_matching"
STEEPEST_RAD = math.radians(85.0)

# --------------------------------------------------------------------------------- the error model


class SlaveFlight(NamedTuple):
    """Flight of the slave."""

    lat_rad: Array  # ()
    alt_m: Array  # ()
    v_enu: Array  # (3,) m/s, of which the model uses east and north
    f_enu: Array  # (3,) m/s^2, specific force
    C_nb: Array  # (3, 3) body RFU to navigation ENU


class Interval(NamedTuple):
    """Inputs of the motion between two epochs."""

    flight: SlaveFlight  # on average
    dt_s: Array  # ()
    sigma: Array  # (12,) process noise of the interval


def error_dynamics(flight: SlaveFlight) -> Float[Array, "12 12"]:
    """F of x' = F x, eqs. (1) to (5), with the radii of curvature taken as constant."""
    RM, RN = curvature_radii(flight.lat_rad)
    RM, RN = RM + flight.alt_m, RN + flight.alt_m
    s, c = jnp.sin(flight.lat_rad), jnp.cos(flight.lat_rad)
    t = s / c
    E, N = flight.v_enu[0], flight.v_enu[1]
    fE, fN, fU = flight.f_enu[0], flight.f_enu[1], flight.f_enu[2]
    T, w, o = flight.C_nb, OMEGA_E, jnp.zeros(())
    up, north = w * s + E * t / RN, w * c + E / RN  # omega_in, but for VN / RM about west
    table = [
        # dL  dlon  dVE  dVN  phi_E  phi_N  phi_U
        [o, o, o, 1.0 / RM, o, o, o],
        [E * t / (RN * c), o, 1.0 / (RN * c), o, o, o, o],
        [2.0 * w * c * N + E * N / (RN * c**2), o, N * t / RN, w * s + up, o, -fU, fN],
        [-(2.0 * w * c * E + E**2 / (RN * c**2)), o, -2.0 * up, o, fU, o, -fE],
        [o, o, o, -1.0 / RM, o, up, -north],
        [-w * s, o, 1.0 / RN, o, -up, o, -N / RM],
        [w * c + E / (RN * c**2), o, t / RN, o, north, N / RM, o],
    ]
    F1 = jnp.stack([jnp.stack([jnp.asarray(x, float) for x in row]) for row in table])
    C = jnp.zeros((7, 5)).at[2:4, :2].set(T[:2, :2]).at[4:, 2:].set(-T)
    return jnp.pad(jnp.concatenate([F1, C], axis=1), ((0, 5), (0, 0)))


def transition(interval: Interval) -> Float[Array, "12 12"]:
    """Phi = I + F T + (F T)^2 / 2."""
    FT = error_dynamics(interval.flight) * interval.dt_s
    return jnp.eye(STATES) + FT + 0.5 * FT @ FT


def process_sigma(gyro_noise: float, accel_noise: float, dt_s: float) -> np.ndarray:
    """(12,) roots of the diagonal of Q over an interval, for noise equal on all axes.

    The noises are an angle random walk [rad/sqrt(s)] and a velocity random walk [m/s/sqrt(s)].
    """
    sigma, root = np.zeros(STATES), math.sqrt(dt_s)
    sigma[VELOCITY], sigma[PHI] = accel_noise * root, gyro_noise * root
    return sigma


def measurement_matrix(C_nb: Float[Array, "3 3"]) -> Float[Array, "5 12"]:
    """H of Y = H x, eq. (6): velocities as they are, and H1 from phi to heading, pitch, roll."""
    T12, T22, T32 = C_nb[0, 1], C_nb[1, 1], C_nb[2, 1]
    level_sq = 1.0 - T32**2  # cos(pitch)^2
    level = jnp.sqrt(level_sq)
    o = jnp.zeros(())
    H1 = [
        # phi_E  phi_N  phi_U
        [-T12 * T32 / level_sq, -T22 * T32 / level_sq, o + 1.0],
        [-T22 / level, T12 / level, o],
        [-T12 / level_sq, -T22 / level_sq, o],
    ]
    H = jnp.zeros((5, STATES)).at[:2, VELOCITY].set(jnp.eye(2))
    return H.at[2:, PHI].set(jnp.stack([jnp.stack(row) for row in H1]))


def _moved(x: Array, interval: Interval) -> tuple[Array, Array, Array]:
    Phi = transition(interval)
    return Phi @ x, Phi, interval.sigma


def _velocity(x: Array, sigma: Array) -> tuple[Array, Array]:
    return x[VELOCITY], jnp.eye(STATES)[VELOCITY]


def _angles(x: Array, aux: tuple[Array, Array]) -> tuple[Array, Array]:
    C_nb, _ = aux
    H = measurement_matrix(C_nb)[2:]
    return H @ x, H


MODEL = Model(
    moved_by(None, _moved),
    (
        seen_by(_velocity, lambda x, sigma: sigma, 2, VELOCITY_SENSOR),
        seen_by(_angles, lambda x, aux: aux[1], 3, ATTITUDE_SENSOR),
    ),
)
"""The model. Its motion takes an `Interval` for each step, the sensor of velocity (VE, VN) its (2,)
standard deviations [m/s], that of attitude (heading, pitch, roll) the (3, 3) C_nb of the slave and
its (3,) standard deviations [rad]."""


def euler_difference(slave_q_enu: ArrayLike, master_q_enu: ArrayLike) -> Float[Array, "*b 3"]:
    """Heading, pitch and roll of the slave minus those of the master [rad], in [-pi, pi).

    Attitudes (..., 4) are body RFU to ENU, of aligned units; NaN where one is missing.
    """
    slave, master = (euler_enu_rfu(jnp.asarray(q, float)) for q in (slave_q_enu, master_q_enu))
    return wrap(jnp.stack([a - b for a, b in zip(slave[::-1], master[::-1], strict=True)], -1))


def refuse_steep(time_s: np.ndarray, q_nb: ArrayLike) -> None:
    """Refuse attitudes (N, 4), NED/FRD, at which roll and heading are hard to separate.

    Outside compiled code.

    Raises:
        ValueError: the nose points more than 85 deg up or down at some time [s] of `time_s` (N,).
    """
    pitch = np.asarray(to_euler(jnp.asarray(q_nb, float))[1])
    steep = np.flatnonzero(np.abs(pitch) > STEEPEST_RAD)
    if len(steep):
        k = steep[0]
        raise ValueError(
            f"pitch is {math.degrees(pitch[k]):.1f} deg at {time_s[k]:g} s: beyond 85 deg heading "
            "and roll are hard to tell apart and their differences no measurement of attitude. "
            "Match rotation matrices instead, as the filter 'product' does"
        )


def dcm_enu(q_nb: ArrayLike) -> Float[Array, "*b 3 3"]:
    """DCM from body RFU to ENU of an attitude NED/FRD (..., 4)."""
    return to_dcm(swap_q(jnp.asarray(q_nb, float)))


# -------------------------------------------------------------------------- the free-running slave

_Q, _V, _V_DOWN, _LAT, _ALT = slice(0, 4), slice(4, 7), 6, 7, 9  # indices in the vector of a step


def start_with_error(start: Nav, error: ArrayLike) -> Nav:
    """Initial estimate of the slave.

    Args:
        start: the truth, NED/FRD.
        error: (9,) tangent of attitude, velocity and position, true = retract(believed, error); its
            vertical velocity and height are ignored.
    """
    horizontal = jnp.asarray(error, float).at[jnp.array([5, 8])].set(0.0)
    estimate = retract(start, -horizontal)
    return estimate._replace(v_n=jnp.asarray(estimate.v_n).at[2].set(0.0))


def navigate(start: Nav, increments: Increments) -> tuple[Nav, SlaveFlight]:
    """Navigate over E blocks of K increments; pure, for any number of runs under `vmap`.

    Args:
        start: initial estimate of the slave, NED/FRD; its height is held.
        increments: reported increments of the slave, dt (E, K), theta and dv (E, K, 3).

    Returns:
        Its computed state at the end of each block, NED/FRD, and its mean flight over each.
    """
    first = vector(start)
    E, K = increments.dt.shape
    samples = rows(increments).reshape(E * K, -1)

    def held(x: Array) -> Array:
        return x.at[_V_DOWN].set(0.0).at[_ALT].set(first[_ALT])

    def sample(x: Array, row: Array):
        x = held(advance(x, row))
        return x, x

    def average(x: Array) -> Array:
        """Mean over blocks of a quantity given at both ends of each sample."""
        middle = 0.5 * (x[1:] + x[:-1])
        return jnp.mean(middle.reshape(E, K, *x.shape[1:]), 1)

    first = held(first)
    _, path = lax.scan(sample, first, samples)
    path = jnp.concatenate([first[None], path])
    dv = increments.dv.reshape(E * K, 3)
    felt = rotate(path[:-1, _Q], dv).reshape(E, K, 3)  # dv is in the axes at a sample's begin
    flight = SlaveFlight(
        lat_rad=average(path[:, _LAT]),
        alt_m=average(path[:, _ALT]),
        v_enu=swap(average(path[:, _V])),
        f_enu=swap(jnp.sum(felt, 1) / jnp.sum(increments.dt, 1)[:, None]),
        C_nb=average(dcm_enu(path[:, _Q])),
    )
    return unpacked(path[K::K]), flight


def corrected_by_master(
    own: Nav, flight: SlaveFlight, master: Nav
) -> tuple[SlaveFlight, Float[Array, "e 3 3"]]:
    """The slave's flight and attitudes, corrected by the reports of the master.

    A model linearised there has smaller errors than one about the slave's own estimate, whose
    attitude is wrong by degrees. Each interval is rotated and shifted by the difference at its end,
    so the motion within it is still that of the slave's samples.

    Args:
        own: computed state of the slave at each epoch.
        flight: its computed flight over the intervals that end there.
        master: as reported at each epoch, for a unit aligned with the slave; where it is NaN, the
            slave's own estimate is used.

    Returns:
        The flight over the intervals, and the DCM from body RFU to ENU at the epochs.
    """
    q = jnp.asarray(master.q_nb.wxyz)
    there = jnp.all(jnp.isfinite(q), -1, keepdims=True)
    turn = dcm_enu(multiply(jnp.where(there, q, own.q_nb.wxyz), conjugate(own.q_nb.wxyz)))

    def off(own: Array, reported: Array) -> Array:
        return jnp.where(jnp.isfinite(reported), own - reported, 0.0)

    about = SlaveFlight(
        lat_rad=flight.lat_rad - off(own.position.lat, master.position.lat),
        alt_m=flight.alt_m,
        v_enu=flight.v_enu - swap(off(own.v_n, master.v_n)),
        f_enu=jnp.einsum("eij,ej->ei", turn, flight.f_enu),
        C_nb=turn @ flight.C_nb,
    )
    return about, turn @ dcm_enu(own.q_nb.wxyz)


def true_errors(computed: Nav, true: InsState) -> Float[Array, "*b 12"]:
    """True error state x, from truth in NED/FRD; any leading axes."""
    p, position = computed.position, true.position
    parts = (
        jnp.stack([p.lat - position.lat, p.lon - position.lon], -1),
        swap(computed.v_n - true.v_n)[..., :2],
        swap(computed.q_nb.local(true.q_nb)),
        swap(jnp.asarray(true.accel_bias, float))[..., :2],
        swap(jnp.asarray(true.gyro_bias, float)),
    )
    return jnp.concatenate(parts, -1)
