"""The invariant extended Kalman filter for inertial navigation: a state, a motion, sensors.

Attitude, velocity and position are one element of SE_2(3) (`ins.extended_pose`). Over an interval
with increments theta, dv, dr in body axes the true state and its estimate both move as

    X' = Gamma Phi(X) Upsilon,   Gamma = (I, g dt, g dt^2 / 2),   Upsilon = (exp(theta x), dv, dr)

and Phi, position += velocity dt, respects the group product. So with exact increments the error
obeys a law independent of the trajectory and of its own size (Barrau & Bonnabel 2017, theorem 2):

    right:  xi' = Ad(Gamma) Phi xi            left:  xi' = Ad(Upsilon)^-1 Phi xi

On this state `kalman(taylor(), rules)` *is* the invariant filter. With biases in the state the law
holds in the navigation part only (the "imperfect" filter of Barrau 2015, sec. 7.3).

The frame is local-level NED, fixed to the ground, body FRD. Gravity is constant, and Earth rate and
transport rate are neglected: 15 deg/h, and 1.5e-4 m/s^2 per m/s of speed. That suits sensors of
10 deg/h and worse over kilometres and minutes; `robins.ins.state` includes them.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial
from jaxtyping import Array, Float

from robins import _float64  # noqa: F401
from robins.filters.model import Data, Motion, Sensor
from robins.ins.extended_pose import ExtendedPose
from robins.ins.increments import Increments
from robins.ins.state import InsNoise
from robins.rotation import Rotation, left_jacobian, skew

GRAVITY = 9.80665  # m/s^2, down

Vector = Any  # three numbers
Sigma = Any  # a number, or one per axis


class InvariantState(NamedTuple):
    """Pose and biases; tangent order: pose (9), gyro bias (3), accelerometer bias (3)."""

    pose: ExtendedPose
    gyro_bias: Array  # (3,) rad/s
    accel_bias: Array  # (3,) m/s^2

    @classmethod
    def start(cls, pose: ExtendedPose) -> InvariantState:
        """State at a pose, with zero biases."""
        return cls(pose, jnp.zeros(3), jnp.zeros(3))


def propagate(
    x: InvariantState, increment: Increments, gravity: Vector = (0.0, 0.0, GRAVITY)
) -> InvariantState:
    """Propagate over one increment (scalar ``dt``), corrected for the biases.

    Args:
        x: at the start of the interval.
        increment: as measured, in body axes at the start; ``dr`` None: half of ``dv dt``.
        gravity: (3,) m/s^2, navigation axes.
    """
    g = jnp.asarray(gravity, float)
    dt, step = _bias_corrected(x, increment)
    return x._replace(pose=_free_fall(x.pose, dt, g) @ step)


def transition(
    x: InvariantState, increment: Increments, gravity: Vector = (0.0, 0.0, GRAVITY)
) -> tuple[InvariantState, Float[Array, "15 15"], Float[Array, "15 6"]]:
    """`propagate`, with its transition matrices.

    Returns:
        The new state; F of the errors; and G of errors of the rotation [rad] and the velocity
        increment [m/s], such as sensor noise, the latter spread over the interval, so that half of
        it times dt is position.
    """
    g = jnp.asarray(gravity, float)
    dt, step = _bias_corrected(x, increment)
    coasted = _free_fall(x.pose, dt, g)
    moved = coasted @ step
    drift = jnp.eye(9).at[6:9, 3:6].set(dt * jnp.eye(3))
    # An error of the increments is Upsilon_true Upsilon^-1 = exp(slip), in axes before the step.
    turn = left_jacobian(step.rotation.as_rotvec())
    zero, eye, half = jnp.zeros((3, 3)), jnp.eye(3), 0.5 * dt * jnp.eye(3)
    rows = [[turn, zero], [skew(step.velocity) @ turn, eye], [skew(step.position) @ turn, half]]
    slip = jnp.block(rows)
    if x.pose.error == "right":
        gamma = ExtendedPose(Rotation.identity(), g * dt, 0.5 * g * dt**2)
        F_pose, G = gamma.adjoint() @ drift, coasted.adjoint() @ slip
    else:
        back = step.inverse().adjoint()
        F_pose, G = back @ drift, back @ slip
    F = jnp.eye(15).at[:9, :9].set(F_pose).at[:9, 9:].set(-dt * G)
    new = x._replace(pose=moved)
    return new, F, jnp.concatenate([G, jnp.zeros((6, 6))])


def invariant_motion(noise: InsNoise, gravity: Vector = (0.0, 0.0, GRAVITY)) -> Motion:
    """Motion of an `InvariantState`, driven by one `Increments` per step.

    Biases are random walks: time constants and scale factors of the noise are not used.

    Raises:
        ValueError: gravity is not three numbers.
    """
    if np.shape(gravity) != (3,):
        raise ValueError(f"gravity must be three numbers [m/s^2], got shape {np.shape(gravity)}")
    white = jnp.concatenate([_each(noise.gyro_arw), _each(noise.accel_vrw)])
    walk = jnp.concatenate([_each(noise.gyro_bias_rw), _each(noise.accel_bias_rw)])
    g = jnp.asarray(gravity, float)
    given = g, white, walk
    return Motion(Partial(_step, g), Partial(_noise, *given), Partial(_linear, *given))


def _step(g: Array, x: InvariantState, u: Increments) -> InvariantState:
    return propagate(x, u, g)


def _linear(g: Array, white: Array, walk: Array, x: InvariantState, u: Increments):
    new, F, G = transition(x, u, g)
    drive = jnp.concatenate([jnp.zeros((9, 6)), jnp.diag(walk)])
    return new, F, jnp.sqrt(u.dt) * jnp.concatenate([G * white[None], drive], 1)


def _noise(g: Array, white: Array, walk: Array, x: InvariantState, u: Increments) -> Array:
    return _linear(g, white, walk, x, u)[2]


def position_sensor(sigma: Sigma, lever_b: Vector = (0.0, 0.0, 0.0), name="position") -> Sensor:
    """Position [m] in the navigation frame of a point at ``lever_b`` [m] in the body.

    A left-invariant observation: with a pose of left error its Jacobian is (J, 0, C), and with one
    sigma for all axes the gain in body axes does not depend on the estimated attitude.
    """
    return Sensor(Partial(_read_position, _each(lever_b)), _each(sigma), 3, name)


def _read_position(lever_b: Array, x: InvariantState, aux: Data) -> Array:
    return x.pose.position + x.pose.rotation.apply(lever_b)


def velocity_sensor(sigma: Sigma, name: str = "velocity") -> Sensor:
    """Velocity [m/s] in the navigation frame; left-invariant, as `position_sensor`."""
    return Sensor(_read_velocity, _each(sigma), 3, name)


def _read_velocity(x: InvariantState, aux: Data) -> Array:
    return x.pose.velocity


def landmark_sensor(sigma: Sigma, landmark: Vector, name: str = "landmark") -> Sensor:
    """Sensor of the position of a known point, relative to the body [m], body axes.

    A right-invariant observation: it goes with a pose of right error (Hartley et al. 2020).
    """
    return Sensor(Partial(_read_landmark, _each(landmark)), _each(sigma), 3, name)


def _read_landmark(point: Array, x: InvariantState, aux: Data) -> Array:
    return x.pose.rotation.inverse().apply(point - x.pose.position)


def direction_sensor(sigma: Sigma, direction: Vector, name: str = "direction") -> Sensor:
    """Sensor of a known direction of the navigation frame (north, the sun) in body axes; unitless.

    Right-invariant, as `landmark_sensor`.
    """
    return Sensor(Partial(_read_direction, _each(direction)), _each(sigma), 3, name)


def _read_direction(way: Array, x: InvariantState, aux: Data) -> Array:
    return x.pose.rotation.inverse().apply(way)


def _bias_corrected(x: InvariantState, increment: Increments) -> tuple[Array, ExtendedPose]:
    """Duration of an interval, and Upsilon corrected for the biases."""
    dt = jnp.asarray(increment.dt, float)
    theta, dv = jnp.asarray(increment.theta, float), jnp.asarray(increment.dv, float)
    dr = 0.5 * dv * dt if increment.dr is None else jnp.asarray(increment.dr, float)
    turn = Rotation.from_rotvec(theta - x.gyro_bias * dt)
    dv, dr = dv - x.accel_bias * dt, dr - 0.5 * x.accel_bias * dt**2
    return dt, ExtendedPose(turn, dv, dr, x.pose.error)


def _free_fall(pose: ExtendedPose, dt: Array, g: Array) -> ExtendedPose:
    """Gamma Phi(X): free fall."""
    velocity = pose.velocity + g * dt
    position = pose.position + pose.velocity * dt + 0.5 * g * dt**2
    return ExtendedPose(pose.rotation, velocity, position, pose.error)


def _each(value: Any) -> Array:
    return jnp.broadcast_to(jnp.asarray(value, float), 3)
