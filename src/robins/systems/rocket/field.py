"""Test-bed B: attitude on SO(3), driven by the gyro and corrected by the measured field.

State x = (q, b, s): attitude q_nb, whose error phi is seen in n (q = exp(phi) q^), bias b of the
gyro and, in some filters, its scale factors s. Input theta: the angle reported by the gyro over a
step T. With C = R(q) J(w), J the left Jacobian of SO(3):

    w = (theta - T b) / (1 + s) ,      q <- q exp(w)                            (B1)

        [I  -T C/(1 + s)  -C w/(1 + s)]
    F = [0       I              0     ]  ,   columns of C divided by axis       (B2)
        [0       0              I     ]

    Q = diag((angle^2 + doubt^2) I, walk^2 I, 0)                                (B3)
    z = R(q)' B_n + v ,      H = [R(q)' [B_n]x   0   0]                         (B4)
    R = (|B_n| sin sigma)^2 I                                                   (B5)

After Crassidis & Markley (2003), with rotation vectors in place of their modified Rodrigues
parameters: the two differ in the third order of a sigma point's length.

The rotation about a single vector is unobservable; it becomes observable because B_n turns along
the flight and the gyro propagates the attitude. The accuracy follows from the information of K
vectors with angle noise sigma on a constant rotation, H'R^-1 H of (B4):

    Y = 1/sigma^2 sum_k (I - b_k b_k') ,    b_k = B_k / |B_k|                   (B6)

The eigenvector of its least eigenvalue is the least observable direction; for one vector that is b,
with an eigenvalue of zero. This is the bound for a perfect gyro: with a real one the information
of old vectors decays.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial
from jaxtyping import Array

from robins.errors import require
from robins.filters import Motion, Sensor
from robins.filters.values import Numbers
from robins.manifold import dim
from robins.rotation import (
    Rotation,
    conjugate,
    from_rotvec,
    left_jacobian,
    multiply,
    normalise,
    rotate,
    skew,
    to_dcm,
)

FIELD, SNAPSHOT = "field", "snapshot"  # the sensor; the same, used without a motion model
REPORTED = 9  # attitude in body axes, attitude about and across the field, bias

# One sigma of the error of a held gyro sample, as a share of it: coning changes the rotation.
HELD_DOUBT = 0.1
_LEAST, _MOST = 0.3, 3.0  # plausible magnitudes, relative to the expected field


class FieldState(NamedTuple):
    """Attitude, and errors of the gyro in body axes."""

    q_nb: Rotation
    bias: Any  # (3,) rad/s
    scale: Any = None  # (3,) relative scale factor errors; None where they are no states


class GyroTurn(NamedTuple):
    """Input of a step: the reported gyro angle, and its uncertainty in addition to its noise."""

    theta_b: Any  # (3,) rad
    doubt: Any = 0.0  # rad, one sigma, each axis


class GyroNoise(NamedTuple):
    """White noise of a step [rad], growth of the bias in a step [rad/s], and the step [s]."""

    angle: Any
    bias: Any
    step_s: Any


def field_motion(gyro: GyroNoise) -> Motion:
    """Attitude and gyro errors, (B1) to (B3)."""
    return Motion(Partial(propagate, gyro), Partial(noise_of, gyro), Partial(propagated, gyro))


def field_sensor(sine: Array, name: str = FIELD) -> Sensor:
    """The magnetometer, (B4) and (B5); sine of the standard deviation of the field's direction."""
    return Sensor(read_field, Partial(field_noise, sine), 3, name, observed)


# (B1)
def propagate(g: GyroNoise, x: FieldState, u: GyroTurn) -> FieldState:
    """Rotate by the reported gyro angle of a step."""
    return x._replace(q_nb=Rotation(normalise(multiply(x.q_nb.wxyz, from_rotvec(_turn(g, x, u))))))


def _turn(g: GyroNoise, x: FieldState, u: GyroTurn) -> Array:
    """Rotation vector w (3,) [rad] of a step: the reported angle corrected for bias and scale."""
    return (u.theta_b - g.step_s * x.bias) / _scale_factor(x)


def _scale_factor(x: FieldState) -> Array:
    """(3,) 1 + s, which is far from zero for any usable gyro."""
    return jnp.ones(3) if x.scale is None else 1.0 + x.scale


# (B2)
def propagated(g: GyroNoise, x: FieldState, u: GyroTurn):
    """`propagate` with its Jacobian and noise."""
    w, gain = _turn(g, x, u), 1.0 / _scale_factor(x)
    # the rotation of a step is small, but not negligible for a coning body
    C = to_dcm(x.q_nb.wxyz) @ left_jacobian(w)
    rows = [jnp.eye(3), -g.step_s * C * gain[None, :], -C * (gain * w)[None, :]]
    n = dim(x)
    F = jnp.eye(n).at[:3].set(jnp.concatenate(rows, axis=1)[:, :n])
    return propagate(g, x, u), F, noise_of(g, x, u)


# (B3)
def noise_of(g: GyroNoise, x: FieldState, u: GyroTurn) -> Array:
    """Standard deviations (n,) of a step: equal on all axes, so the same in body and n axes."""
    angle = jnp.sqrt(g.angle**2 + u.doubt**2)
    return jnp.concatenate([jnp.full(3, angle), jnp.full(3, g.bias), jnp.zeros(dim(x) - 6)])


# (B4)
def read_field(x: FieldState, field_n: Array) -> Array:
    """(3,) field in body axes, in the unit of ``field_n``."""
    return rotate(conjugate(x.q_nb.wxyz), field_n)


def observed(x: FieldState, field_n: Array):
    """`read_field` with its Jacobian: R(q)' exp(-phi) B = R(q)' (B + B x phi)."""
    C_bn = to_dcm(x.q_nb.wxyz).T
    H = jnp.concatenate([C_bn @ skew(field_n), jnp.zeros((3, dim(x) - 3))], axis=1)
    return C_bn @ field_n, H


# (B5)
def field_noise(sine: Array, x: FieldState, field_n: Array) -> Array:
    """(3,) standard deviations, proportional to the field, since the error is an angle."""
    return jnp.full(3, sine * jnp.sqrt(field_n @ field_n))


def bridged(theta_b: Array) -> GyroTurn:
    """Gyro angles (E, 3) with lost samples (NaN) held at the last one, and their uncertainty.

    Before the first sample the angle is zero with a sigma of one radian.
    """

    def hold(last, theta):
        there = jnp.all(jnp.isfinite(theta))
        now = jnp.where(there, theta, last)
        size = jnp.sqrt(jnp.sum(now**2))
        known = jnp.where(size > 0.0, HELD_DOUBT * size, 1.0)
        return now, GyroTurn(now, jnp.where(there, 0.0, known))

    return jax.lax.scan(hold, jnp.zeros(3), theta_b)[1]


def plausible(field_b: Array, expected_n: Array, full_scale_t: float | None = None) -> Array:
    """Fields (..., 3) with implausible ones replaced by NaN.

    A zero field, one of less than 0.3 or more than 3 times the expected magnitude, or one with an
    axis at full scale (where that is known) has no usable direction.
    """
    size, expected = (jnp.sqrt(jnp.sum(x**2, axis=-1)) for x in (field_b, expected_n))
    fits = (size >= _LEAST * expected) & (size <= _MOST * expected)
    if full_scale_t is not None:
        fits = fits & jnp.all(jnp.abs(field_b) < full_scale_t, axis=-1)
    return jnp.where(fits[..., None], field_b, jnp.nan)


def rows_of(q_nb: Array, field_n: Array, n: int) -> Array:
    """(E, 9, n) from a tangent error, whose attitude is in n, to the reported components.

    Attitude error in body axes; the same about the field and across it; the bias.
    """
    b = field_n / jnp.sqrt(jnp.sum(field_n**2, axis=1, keepdims=True))
    level = jnp.cross(jnp.array([[0.0, 0.0, 1.0]]), b)
    level = level / jnp.sqrt(jnp.sum(level**2, axis=1, keepdims=True))
    along = jnp.stack([b, level, jnp.cross(b, level)], axis=1)
    attitude = jnp.concatenate([jnp.swapaxes(to_dcm(q_nb), 1, 2), along], axis=1)
    rows = jnp.zeros((len(field_n), REPORTED, n))
    return rows.at[:, :6, :3].set(attitude).at[:, 6:, 3:6].set(jnp.eye(3)[None])


class Unobserved(NamedTuple):
    """The least observable direction, and bounds on the attitude accuracy."""

    direction_n: np.ndarray  # (3,) unit vector
    sigma_rad: float  # about it; infinite where unobservable
    across_rad: float  # about the best observable direction
    from_field_rad: float  # angle between it and the mean field
    field_turn_rad: float  # largest angle between any vector and the first


# (B6)
def unobserved(field_n: np.ndarray, sigma_rad: float) -> Unobserved:
    """Least observable direction for a series of measured fields, and bounds for a perfect gyro.

    Args:
        field_n: (K, 3) field where it is measured, in any unit; NaN rows are ignored.
        sigma_rad: noise of the direction of each vector, about each axis across it.

    Raises:
        ValueError: no vector is left, one has no direction, or sigma is not positive.
    """
    field = np.asarray(field_n, float)
    require(field.shape[1:] == (3,), "field_n must have shape (K, 3)", field.shape)
    require(sigma_rad > 0.0, "sigma_rad must be positive", sigma_rad)
    field = field[np.all(np.isfinite(field), axis=1)]
    size = np.linalg.norm(field, axis=1)
    if len(field) == 0 or np.any(size == 0.0):
        raise ValueError("a field without a direction says nothing: omit NaN and zero vectors")
    b = field / size[:, None]
    Y = (len(b) * np.eye(3) - b.T @ b) / sigma_rad**2
    values, vectors = np.linalg.eigh(Y)
    # rounding leaves an eigenvalue of about eps K for K vectors of one direction
    floor = 1e-12 * values[-1]
    with np.errstate(divide="ignore"):
        sigma = np.where(values > floor, 1.0 / np.sqrt(np.maximum(values, floor)), np.inf)
    mean = np.mean(b, axis=0)
    mean = mean / np.linalg.norm(mean)
    direction = vectors[:, 0] * (1.0 if vectors[:, 0] @ mean >= 0.0 else -1.0)

    def between(x: np.ndarray, y: np.ndarray) -> Numbers:
        return np.arctan2(np.linalg.norm(np.cross(x, y), axis=-1), np.sum(x * y, axis=-1))

    return Unobserved(
        direction_n=direction,
        sigma_rad=float(sigma[0]),
        across_rad=float(sigma[-1]),
        from_field_rad=float(between(direction, mean)),
        field_turn_rad=float(np.max(between(b, b[:1]))),
    )


def sentence(found: Unobserved) -> str:
    """Sentence that states the least observable direction and the bounds."""
    north, east, down = found.direction_n
    elevation = np.degrees(np.arcsin(-down))
    azimuth = np.degrees(np.arctan2(east, north)) % 360.0
    known = (
        "nothing is known about it"
        if not np.isfinite(found.sigma_rad)
        else f"a perfect gyro would allow {np.degrees(found.sigma_rad):.2g} deg (1 sigma) about it"
    )
    return (
        f"Least observed: turns about azimuth {azimuth:.0f} deg, elevation {elevation:.0f} deg, "
        f"which is {np.degrees(found.from_field_rad):.1f} deg from the mean field; {known} and "
        f"{np.degrees(found.across_rad):.2g} deg across. The field turns by "
        f"{np.degrees(found.field_turn_rad):.1f} deg along the flight."
    )
