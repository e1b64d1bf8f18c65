"""Test-bed B: attitude on SO(3), driven by the gyro and corrected by the measured field.

    q <- q exp(theta / (1 + s) - b dt) ,      z = R(q)' B_n + v

with theta the angle that the gyro reports of a step, b its bias and s its scale factors, where they
have states. After Crassidis & Markley (2003), with rotation vectors in place of their modified
Rodrigues parameters: the two differ in the third order of a sigma point's length.

One vector leaves the turn about itself open; only because B_n turns along the flight, and because
the gyro carries the attitude, does it become known in the end.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.tree_util import Partial
from jaxtyping import Array

from robins import linalg
from robins.filters import Model, Motion, Sensor
from robins.rotation import Rotation, conjugate, from_rotvec, multiply, normalise, rotate, to_dcm

FIELD, SNAPSHOT = "field", "snapshot"  # the sensor; the same taken at its word

# Of a turn that is held over a lost sample of the gyro: what a coning body may have changed.
HELD_DOUBT = 0.1


class FieldState(NamedTuple):
    """Attitude, and the bias [rad/s] of the gyro in body axes."""

    q_nb: Rotation
    bias: Any  # (3,)


class ScaledState(NamedTuple):
    """The same with the scale factors of the gyro's axes."""

    q_nb: Rotation
    bias: Any  # (3,)
    scale: Any  # (3,) relative


class Turn(NamedTuple):
    """Input of a step: what the gyro reports, and how much more it is doubted than its noise."""

    theta_b: Any  # (3,) rad
    doubt: Any = 0.0  # rad, one sigma, each axis


class GyroNoise(NamedTuple):
    """White noise of a step [rad], growth of the bias in a step [rad/s], and the step [s]."""

    angle: Any
    bias: Any
    step_s: Any


def turned(x: Any, theta_b: Array, step_s: Any) -> Array:
    """(3,) the true turn of a step, as the state sees it through what the gyro reports."""
    theta = theta_b - step_s * x.bias
    # (1 + s) is far from zero wherever a gyro is worth the name
    return theta / (1.0 + x.scale) if isinstance(x, ScaledState) else theta


def bridged(theta_b: Array) -> Turn:
    """Angles (E, 3) of a gyro with lost samples, NaN: the last turn is held there, and doubted.

    Before the first sample nothing is known: no turn, doubted by a radian.
    """

    def hold(last, theta):
        there = jnp.all(jnp.isfinite(theta))
        now = jnp.where(there, theta, last)
        size = jnp.sqrt(jnp.sum(now**2))
        known = jnp.where(size > 0.0, HELD_DOUBT * size, 1.0)
        return now, Turn(now, jnp.where(there, 0.0, known))

    return jax.lax.scan(hold, jnp.zeros(3), theta_b)[1]


def propagate(g: GyroNoise, x: Any, u: Turn) -> Any:
    """Turn by what the gyro reports of a step."""
    q = normalise(multiply(x.q_nb.wxyz, from_rotvec(turned(x, u.theta_b, g.step_s))))
    return x._replace(q_nb=Rotation(q))


def propagated(g: GyroNoise, x: Any, u: Turn):
    """`propagate` with its Jacobian and noise; tangent of the attitude in n."""
    theta = turned(x, u.theta_b, g.step_s)
    after = propagate(g, x, u)
    # exp(R J_r(theta) d theta) on the left: a step turns little, but coning bodies turn fast
    C = to_dcm(x.q_nb.wxyz) @ _left_jacobian(theta)
    gain = jnp.ones(3) / (1.0 + x.scale) if isinstance(x, ScaledState) else jnp.ones(3)
    parts = [jnp.eye(3), -g.step_s * C * gain[None, :]]
    if isinstance(x, ScaledState):
        parts.append(-C * (gain * theta)[None, :])
    n = 3 * len(parts)
    F = jnp.eye(n).at[:3].set(jnp.concatenate(parts, axis=1))
    return after, F, noise_of(g, x, u)


def _left_jacobian(theta: Array) -> Array:
    """J_l of a rotation vector: exp(theta + d) = exp(J_l d) exp(theta) to first order."""
    angle_sq = theta @ theta
    small = angle_sq < 1e-6
    safe = jnp.where(small, 1.0, angle_sq)
    angle = jnp.sqrt(safe)
    one = jnp.where(small, 0.5 - angle_sq / 24.0, (1.0 - jnp.cos(angle)) / safe)
    two = jnp.where(small, 1.0 / 6.0 - angle_sq / 120.0, (angle - jnp.sin(angle)) / (safe * angle))
    K = jnp.array(
        [[0.0, -theta[2], theta[1]], [theta[2], 0.0, -theta[0]], [-theta[1], theta[0], 0.0]]
    )
    return jnp.eye(3) + one * K + two * K @ K


def noise_of(g: GyroNoise, x: Any, u: Turn) -> Array:
    """(n,) of a step: alike on all axes, so the same in body and navigation axes."""
    rest = [jnp.zeros(3)] if isinstance(x, ScaledState) else []
    angle = jnp.sqrt(g.angle**2 + u.doubt**2)
    return jnp.concatenate([jnp.full(3, angle), jnp.full(3, g.bias), *rest])


def read_field(x: Any, field_n: Array) -> Array:
    """(3,) field in body axes, in the unit of ``field_n``."""
    return rotate(conjugate(x.q_nb.wxyz), field_n)


def observed(x: Any, field_n: Array):
    """`read_field` with its Jacobian: R(q)' exp(-phi) B = R(q)' (B + B x phi)."""
    C_bn = to_dcm(x.q_nb.wxyz).T
    b0, b1, b2 = field_n
    cross = jnp.array([[0.0, -b2, b1], [b2, 0.0, -b0], [-b1, b0, 0.0]])
    n = 9 if isinstance(x, ScaledState) else 6
    return C_bn @ field_n, jnp.concatenate([C_bn @ cross, linalg.zeros(3, n - 3)], axis=1)


def field_noise(sine: Array, x: Any, field_n: Array) -> Array:
    """(3,) standard deviations: an angle, so in proportion to the field."""
    return jnp.full(3, sine * jnp.sqrt(field_n @ field_n))


def field_model(gyro: GyroNoise, sine: Array, sensor: str = FIELD) -> Model:
    """Attitude and gyro errors.

    Args:
        gyro: its noise.
        sine: of the standard deviation of the field's direction.
        sensor: name of the magnetometer; "" leaves dead reckoning.
    """
    motion = Motion(Partial(propagate, gyro), Partial(noise_of, gyro), Partial(propagated, gyro))
    field = Sensor(read_field, Partial(field_noise, sine), 3, sensor, observed)
    return Model(motion, (field,) if sensor else ())
