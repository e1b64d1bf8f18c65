"""A MEMS gyro triad as papers on cheap attitude systems state it: constant, slow and white errors.

What leaves it in a sampling interval is the turn that carries the attitude over that interval
exactly, its rotation vector, with the errors on top:

    theta_k = (1 + s) log(q_k^-1 q_{k+1}) + dt (b + m_k) + dt sigma xi_k

So a perfect gyro leaves no coning error, and whatever a filter's attitude is off by comes from b,
m, xi and s. White noise is stated per sample; sigma sqrt(dt) is the angle random walk in
rad/sqrt(s). For datasheet units, quantisation and full scale see `robins.sim.imu_sensor`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from robins import _float64  # noqa: F401
from robins.rotation import conjugate, from_rotvec, multiply, normalise, to_rotvec
from robins.sim import _given
from robins.sim.random import gauss_markov

# Streams folded into the key of the gyro; part of the file format, as `Component` is.
_SIGN, _MARKOV, _WHITE = 0, 1, 2


class MemsGyro(NamedTuple):
    """Errors of a triad; each a number for all axes or three."""

    bias_rad_s: Any = 0.0  # constant
    markov_sigma_rad_s: Any = 0.0  # slow drift, steady one sigma
    markov_time_s: Any = 300.0  # its correlation time
    white_rad_s: Any = 0.0  # white noise of the rate, one sigma of a sample
    scale_factor: Any = 0.0  # relative error
    sign_drawn: Any = True  # whether the sign of the bias is drawn for each axis, or is that given


class MemsErrors(NamedTuple):
    """What a triad was off by."""

    bias_rad_s: Any  # (3,) constant
    markov_rad_s: Any  # (E, 3) slow drift in each interval
    white_rad_s: Any  # (E, 3) white noise in each interval
    scale_factor: Any  # (3,) relative


def delta_angles(
    key: Array, q_nb: Any, dt_s: Any, gyro: MemsGyro
) -> tuple[Float[Array, "samples 3"], MemsErrors]:
    """Angles [rad] that a triad reports over the E intervals between E + 1 attitudes, body axes.

    The normal numbers do not depend on the sizes of the errors. Pure JAX, so it maps over keys.

    Args:
        key: of the run, `Component.IMU` of `robins.sim.random.stream`.
        q_nb: (E + 1, 4) attitude at 0, dt, 2 dt ..., body to an inertial frame, scalar first. An
            interval in which the body turns by more than half a turn counts as the shorter way.
        dt_s: interval [s].
        gyro: its errors.

    Returns:
        Delta angles (E, 3) and the errors that are in them.

    Raises:
        ValueError: fewer than two attitudes, or a number out of its range.
    """
    q = jnp.asarray(q_nb, float)
    if q.ndim != 2 or q.shape[1] != 4 or len(q) < 2:
        raise ValueError(f"q_nb must have shape (E + 1, 4), E at least one, got {q.shape}")
    length = jnp.sqrt(jnp.sum(q * q, 1))
    _given.number("q_nb must be unit quaternions: their length", length, 0.99, 1.01)
    _given.number("dt_s", dt_s, 0.0, above=True)
    bias = _given.vector("bias_rad_s", gyro.bias_rad_s, 3)
    slow = _given.vector("markov_sigma_rad_s", gyro.markov_sigma_rad_s, 3, low=0.0)
    white = _given.vector("white_rad_s", gyro.white_rad_s, 3, low=0.0)
    scale = _given.vector("scale_factor", gyro.scale_factor, 3, low=-1.0, above=True)

    count, dt = len(q) - 1, jnp.asarray(dt_s, float)
    sign = jax.random.rademacher(jax.random.fold_in(key, _SIGN), (3,), float)
    bias = jnp.where(gyro.sign_drawn, sign * bias, bias)
    key_slow = jax.random.fold_in(key, _MARKOV)
    drift = slow[None] * gauss_markov(key_slow, count, 3, dt_s, gyro.markov_time_s)
    noise = white[None] * jax.random.normal(jax.random.fold_in(key, _WHITE), (count, 3))

    turned = to_rotvec(multiply(conjugate(q[:-1]), q[1:]))
    reported = (1.0 + scale)[None] * turned + dt * (bias[None] + drift + noise)
    return reported, MemsErrors(bias, drift, noise, scale)


def integrate_angles(q0_nb: Any, theta_b: Any) -> Float[Array, "epochs 4"]:
    """Attitude (E + 1, 4) that delta angles (E, 3) lead to from q0_nb: dead reckoning.

    The `delta_angles` of a perfect gyro lead back to the attitudes they were made of.

    Raises:
        ValueError: shapes that do not fit.
    """

    def step(q, theta):
        q = normalise(multiply(q, from_rotvec(theta)))
        return q, q

    start = normalise(_given.rows("q0_nb", q0_nb, 4))
    theta = jnp.asarray(theta_b, float)
    if theta.ndim != 2 or theta.shape[1] != 3:
        raise ValueError(f"theta_b must have shape (E, 3), got {theta.shape}")
    _, rest = jax.lax.scan(step, start, theta)
    return jnp.concatenate([start[None], rest])
