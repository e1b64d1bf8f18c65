"""The filters of the satellite: their states, and their models of gyro and star sensor.

The attitude q_ib maps body to inertial, with its error in body axes: q = q^ exp(dtheta). Over a
sample of length T the gyro reports theta, and attitude and bias b obey

    q+ = q exp(theta - T b),    dtheta+ = exp(-[theta - T b]x) dtheta - T J dbias,

J the right Jacobian of the exponential map, here of angles so small that it is the identity to a
part in a thousand of T dbias. The noise of a sample is that of `robins.systems.satellite.gyro`.
"""

from __future__ import annotations

from functools import cache
from typing import Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial
from jaxtyping import Array

from robins import linalg
from robins.filters import Belief, Filter, Model, Motion, Sensor, adaptive, kalman, taylor
from robins.filters.rules import constant_gain, gate
from robins.rotation import BodyRotation, conjugate, from_rotvec, multiply, normalise, skew, to_dcm
from robins.sim._arguments import Listed
from robins.systems.satellite.gyro import walk_covariance
from robins.systems.satellite.nodes import STAR, StateForm

GATE = 0.9999962  # chi-square of 3 at 27.9
PATIENCE = 20  # consecutive refused frames after which their common value is accepted
Build = Literal["mekf", "quaternion", "gated", "adaptive", "fixed", "fixed-gated", "redesigned"]


class AttitudeState(NamedTuple):
    """State of a multiplicative filter."""

    attitude: BodyRotation
    gyro_bias: Array  # (3,) rad/s


class QuaternionState(NamedTuple):
    """State of an additive filter, with the quaternion's components."""

    q_ib: Array  # (4,)
    gyro_bias: Array  # (3,) rad/s


class GyroNoiseModel(NamedTuple):
    """Assumed noise of the gyro, for a sample of length T."""

    step_s: Array  # ()
    factor: Array  # (6, 6) of Q, attitude and bias


def noise_of(random_walk: float, rate_walk: float, step_s: float) -> GyroNoiseModel:
    """Noise of a sample on three axes, from its densities [rad/sqrt(s), rad/s/sqrt(s)]."""
    one = np.linalg.cholesky(walk_covariance(random_walk, rate_walk, step_s))
    return GyroNoiseModel(jnp.asarray(step_s), jnp.asarray(np.kron(one, np.eye(3))))


def _turn(x: AttitudeState | QuaternionState, theta: Array, noise: GyroNoiseModel) -> Array:
    return theta - noise.step_s * x.gyro_bias


# --------------------------------------------------------------------------------- multiplicative


def _move(noise: GyroNoiseModel, x: AttitudeState, theta: Array) -> AttitudeState:
    turn = from_rotvec(_turn(x, theta, noise))
    return AttitudeState(BodyRotation(normalise(multiply(x.attitude.wxyz, turn))), x.gyro_bias)


def _linear(noise: GyroNoiseModel, x: AttitudeState, theta: Array):
    moved, T = _move(noise, x, theta), noise.step_s
    turn = _turn(x, theta, noise)
    back = to_dcm(conjugate(from_rotvec(turn)))
    # the right Jacobian to first order of the turn: I - [turn]x/2
    J = jnp.eye(3) - 0.5 * skew(turn)
    top = jnp.concatenate([back, -T * J], axis=1)
    low = jnp.concatenate([jnp.zeros((3, 3)), jnp.eye(3)], axis=1)
    return moved, jnp.concatenate([top, low]), noise.factor


def _read(x: AttitudeState, aux: Array | None) -> BodyRotation:
    return x.attitude


def _read_linear(x: AttitudeState, aux: Array | None):
    return x.attitude, jnp.eye(3, 6)


# --------------------------------------------------------------------------------------- additive


def xi(q: Array) -> Array:
    """(4, 3) with q' = Xi(q) w/2 (Lefferts, Markley & Shuster 1982)."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    return jnp.stack([-x, -y, -z, w, -z, y, z, w, -x, -y, x, w]).reshape(4, 3)


def _move_additive(noise: GyroNoiseModel, x: QuaternionState, theta: Array) -> QuaternionState:
    q = normalise(x.q_ib)
    return QuaternionState(multiply(q, from_rotvec(_turn(x, theta, noise))), x.gyro_bias)


def _noise_additive(noise: GyroNoiseModel, x: QuaternionState, theta: Array) -> Array:
    top = 0.5 * xi(normalise(x.q_ib)) @ noise.factor[:3]
    return jnp.concatenate([top, noise.factor[3:]])


def _read_additive(x: QuaternionState, aux: Array | None) -> BodyRotation:
    return BodyRotation(normalise(x.q_ib))


def _rows_additive(q_ib: Array) -> Array:
    """(6, 7) map of component errors to attitude error in body axes and bias error."""
    rows = jnp.zeros((6, 7))
    return rows.at[:3, :4].set(2.0 * xi(q_ib).T).at[3:, 4:].set(jnp.eye(3))


MULTIPLICATIVE = StateForm(
    attitude=lambda x: x.attitude.wxyz,
    bias=lambda x: x.gyro_bias,
    state=lambda q, b: AttitudeState(BodyRotation(q), b),
    rows=lambda q: None,
)
ADDITIVE = StateForm(
    attitude=lambda x: normalise(x.q_ib),
    bias=lambda x: x.gyro_bias,
    state=QuaternionState,
    rows=_rows_additive,
)


def _noise_of_frame(x: AttitudeState | QuaternionState, factor: Array) -> Array:
    return factor


def model(
    noise: GyroNoiseModel, star_rad: Listed, additive: bool = False, of_frame: bool = False
) -> Model:
    """Motion and star sensor, whose noise may be stated by each frame."""
    sigma = _noise_of_frame if of_frame else jnp.asarray(star_rad, float)
    if additive:
        moves = Motion(Partial(_move_additive, noise), Partial(_noise_additive, noise))
        return Model(moves, (Sensor(_read_additive, sigma, 3, STAR),))
    moves = Motion(Partial(_move, noise), noise.factor, Partial(_linear, noise))
    return Model(moves, (Sensor(_read, sigma, 3, STAR, _read_linear),))


def start(q_ib: Array, attitude_rad: Listed, bias_rad_s: Listed, additive: bool = False) -> Belief:
    """Initial belief of filters: no bias, and these sigmas."""
    sizes = jnp.repeat(jnp.stack([jnp.asarray(attitude_rad), jnp.asarray(bias_rad_s)]), 3)
    if not additive:
        return Belief(AttitudeState(BodyRotation(q_ib), jnp.zeros(3)), jnp.diag(sizes))
    # sigma equal about all axes and no uncertainty along q: P = sigma^2 Xi Xi'/4
    attitude = linalg.tria(0.5 * sizes[0] * xi(q_ib))
    factor = jnp.zeros((7, 7)).at[:4, :4].set(attitude).at[4:, 4:].set(jnp.diag(sizes[3:]))
    return Belief(QuaternionState(q_ib, jnp.zeros(3)), factor)


@cache  # made before a run is traced: a rule checks its gain, which a trace cannot
def make_filter(build: Build) -> Filter:
    """The filter of a build; shared by filters that differ in their gains, which are data."""
    if build == "adaptive":
        return adaptive(parts={"gyro": slice(None)})
    if build == "redesigned":  # imported here: other filters need no designs
        from robins.systems.satellite.stepwise import LmiStep

        return kalman(taylor(), [LmiStep()])
    reopened = gate(GATE, PATIENCE, "reinitialise")
    held = constant_gain({STAR: np.zeros((6, 3))})
    rules = {"gated": [reopened], "fixed": [held], "fixed-gated": [reopened, held]}
    return kalman(taylor(), rules.get(build, []))
