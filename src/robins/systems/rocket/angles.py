"""Test-bed A: roll, pitch, yaw and rates of a spinning body, as the paper states the problem.

State x = (roll, pitch, yaw, p, q, r): Euler angles and body rates. The paper does not print its
state equation; this is the free axisymmetric body, a model of a sounding rocket above the
atmosphere (k = 1, unless the filters assume wrong kinematic rows):

    roll'  = k (p + (q sin roll + r cos roll) tan pitch)                        (A1)
    pitch' = k (q cos roll - r sin roll)                                        (A2)
    yaw'   = k (q sin roll + r cos roll) / cos pitch                            (A3)
    p' = -e2 p ,   q' = e1 p r - e3 q ,   r' = -e1 p q - e3 r                   (A4)

    F  by differentiating a Runge-Kutta step of (A1) to (A4)
    Q = diag(angle^2 I, rate^2 I) T                                             (A5)
    z = (p, q, r) + v ,            H = [0  I]    a gyro                         (A6)
    z = (roll, pitch, yaw) + v ,   H = [I  0]    an integrated gyro, "magnetic attitude"   (A7)

It is singular at a pitch of 90 deg. "Magnetic attitude", three angles from one vector, cannot be
measured: it is kept because the paper's filters use it.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

from robins.filters.belief import Number
from robins.manifold import Angle
from robins.rotation import from_euler, from_rotvec, multiply, to_euler

GYRO, MAGNETIC = "gyro", "magnetic"  # sensors


class AngleState(NamedTuple):
    """Attitude as Euler angles, and rates [rad/s] of the body relative to inertial space."""

    roll: Angle
    pitch: Angle
    yaw: Angle
    omega_b: Any  # (3,)


class AngleCoefficients(NamedTuple):
    """Coefficients of the motion: e1 (no unit), e2, e3 [1/s], kinematic k, the step T [s]."""

    e1: Any
    e2: Any
    e3: Any
    kinematic: Any
    step_s: Any


def angle_state(q_nb: Array, omega_b: Array) -> AngleState:
    """State, or a time series of states, from attitude and rates."""
    roll, pitch, yaw = map(Angle, to_euler(q_nb))
    return AngleState(roll, pitch, yaw, omega_b)


# (A1) to (A4)
def slope(c: AngleCoefficients, x: Array) -> Array:
    """(6,) time derivative of (roll, pitch, yaw, p, q, r)."""
    roll, pitch, _, p, q, r = x
    sin, cos = jnp.sin(roll), jnp.cos(roll)
    across = q * sin + r * cos
    angles = jnp.stack([p + across * jnp.tan(pitch), q * cos - r * sin, across / jnp.cos(pitch)])
    rates = jnp.stack([-c.e2 * p, c.e1 * p * r - c.e3 * q, -c.e1 * p * q - c.e3 * r])
    return jnp.concatenate([c.kinematic * angles, rates])


def step(c: AngleCoefficients, state: AngleState, u: Array | None) -> AngleState:
    """One step of the motion by the classical Runge-Kutta method."""
    x = jnp.concatenate([jnp.stack([a.rad for a in state[:3]]), state.omega_b])
    h = c.step_s
    k1 = slope(c, x)
    k2 = slope(c, x + 0.5 * h * k1)
    k3 = slope(c, x + 0.5 * h * k2)
    k4 = slope(c, x + h * k3)
    moved = h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
    roll, pitch, yaw = (a.retract(moved[i : i + 1]) for i, a in enumerate(state[:3]))
    return AngleState(roll, pitch, yaw, state.omega_b + moved[3:])


def no_motion(state: AngleState, u: Array | None) -> AngleState:
    """No motion; with large process noise, the estimate is the latest measurement alone."""
    return state


def dead_reckoned(step_s: Number, state: AngleState, theta_b: Array) -> AngleState:
    """Rotate by the gyro's reported angles of a step [rad]; the rate is their mean over it."""
    q = multiply(from_euler(*(a.rad for a in state[:3])), from_rotvec(theta_b))
    return angle_state(q, theta_b / step_s)


# (A6)
def read_rate(state: AngleState, aux: Array | None) -> Array:
    """Rate read by the gyro (3,) [rad/s]."""
    return state.omega_b


# (A7)
def read_angles(state: AngleState, aux: Array | None) -> tuple[Angle, Angle, Angle]:
    """Roll, pitch, yaw (3,) [rad], as read by "magnetic attitude" or an integrated gyro."""
    return state[:3]
