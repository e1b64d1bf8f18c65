"""Gyros: those of a spacecraft in a closed loop, and MEMS gyros as specified in papers.

In a closed loop the rotation is known only step by step, and gyro errors depend on it only through
scale factors and misalignments. So `gyro_errors` draws the errors of a whole run at once, and
inside the loop `read_gyro` computes only

    reported = quantised( (I + S + M) theta + angle )

The errors are those of `robins.ins.imu_errors.TriadErrors`, drawn by `robins.sim.imu_sensor`:
bias, Gauss-Markov drift, random walk of the rate, ramp, white noise (angle random walk), scale,
misalignment. G-sensitivity is not modelled, because there is no specific force in free fall. The
angle is quantised, and the remainder of a sample is carried to the next, so the sum of all is never
off by more than half a count.

`delta_angles` is a MEMS triad as specified in papers on low-cost attitude systems: constant, slow
and white errors. Its output in a sampling interval is the exact rotation vector of the attitude
change over that interval, plus the errors:

    theta_k = (1 + s) log(q_k^-1 q_{k+1}) + dt (b + m_k) + dt sigma xi_k

So a perfect gyro leaves no coning error, and a filter's attitude error comes from b, m, xi and s
alone. White noise is stated per sample; sigma sqrt(dt) is the angle random walk in rad/sqrt(s).
For datasheet units, quantisation and full scale see `robins.sim.imu_sensor`.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from robins import _float64  # noqa: F401
from robins.filters.belief import Number
from robins.ins.imu_errors import ImuErrorModel, TriadErrors
from robins.rotation import conjugate, from_rotvec, multiply, normalise, to_rotvec
from robins.sim import _arguments
from robins.sim.imu_sensor import corrupt, quantise
from robins.sim.random import gauss_markov

# Folded into the key, next to the streams 0 and 1 of `imu_sensor`; part of the file format.
_WHITE = 2


class GyroErrors(NamedTuple):
    """Errors of a triad over a run of E samples."""

    angle: Any  # (E, 3) rad, added to the angle of each sample: bias times dt and white noise
    bias: Any  # (E, 3) rad/s, mean of the additive rate error over each sample without white noise
    matrix: Any  # (3, 3) S + M, scale factor errors and misalignments


def gyro_errors(key: Array, model: TriadErrors, count: int, dt_s: Number) -> GyroErrors:
    """Draw the errors of a triad for a run of ``count`` samples.

    The normal numbers depend on neither the sizes of the errors nor the count: a longer run begins
    with the shorter one. Pure JAX, so it maps over keys and over stacked models.

    Args:
        key: of the run, `Component.IMU` of `robins.sim.random.stream`.
        model: the error model, in rad/s. Its quantum is used in `read_gyro`, not here.
        count: E, number of samples.
        dt_s: sampling interval [s].

    Raises:
        ValueError: no sample, an interval that is not positive, or a model with a full scale, which
            is not simulated here.
    """
    _arguments.count_of("count", count)
    _arguments.number("dt_s", dt_s, 0.0, above=True)
    if model.full_scale is not None:
        raise ValueError("gyro_errors simulates no full scale: give the model full_scale=None")
    dt = jnp.asarray(dt_s, float)
    # At rest and without white noise the increments are the integrals of all parts of the bias.
    slow = dataclasses.replace(model, white=None, quantum=None, g_sensitivity=None)
    slow = ImuErrorModel(gyro=dataclasses.replace(slow, g_sensitivity_sigma=None))
    rest = jnp.zeros((count, 3))
    angle, _, truth = corrupt(jnp.full(count, dt), rest, rest, slow, key)
    bias = angle / dt
    if model.white is not None:
        # Drawn by sample number, as in `imu_sensor`, so independently of their count.
        root = jax.random.fold_in(key, _WHITE)
        keys = jax.vmap(lambda number: jax.random.fold_in(root, number))(jnp.arange(count))
        normal = jax.vmap(lambda one: jax.random.normal(one, (3,)))(keys)
        angle = angle + (jnp.asarray(model.white, float) * jnp.sqrt(dt))[None] * normal
    return GyroErrors(angle, bias, truth.gyro.matrix)


def read_gyro(
    theta_b: Float[Array, "3"],
    angle: Float[Array, "3"],
    matrix: Float[Array, "3 3"],
    residue: Float[Array, "3"],
    quantum_rad: Number = 0.0,
) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
    """Reported angle of a triad over one sample, and the residue of quantisation.

    Args:
        theta_b: true angle [rad] over the sample, the integral of omega_ib_b.
        angle: `GyroErrors.angle` of the sample [rad].
        matrix: `GyroErrors.matrix`.
        residue: [rad] from the sample before, zero at the start.
        quantum_rad: one count [rad], a number or one for each axis; zero: not quantised.

    Returns:
        The reported angle [rad] and the residue [rad] for the next sample.
    """
    return quantise(theta_b + matrix @ theta_b + angle, residue, quantum_rad)


# Streams folded into the key of the gyro; part of the file format, as `Component` is.
_SIGN, _DRIFT, _NOISE = 0, 1, 2


class MemsGyro(NamedTuple):
    """Errors of a triad; each a number for all axes or three."""

    bias_rad_s: Any = 0.0  # constant
    markov_sigma_rad_s: Any = 0.0  # slow drift, steady one sigma
    markov_time_s: Any = 300.0  # its correlation time
    white_rad_s: Any = 0.0  # white noise of the rate, one sigma of a sample
    scale_factor: Any = 0.0  # relative error
    sign_drawn: Any = True  # draw the sign of the bias for each axis; False: as given


class MemsErrors(NamedTuple):
    """True errors of a triad."""

    bias_rad_s: Any  # (3,) constant
    markov_rad_s: Any  # (E, 3) slow drift in each interval
    white_rad_s: Any  # (E, 3) white noise in each interval
    scale_factor: Any  # (3,) relative


def delta_angles(
    key: Array, q_nb: _arguments.Listed, dt_s: Number, gyro: MemsGyro
) -> tuple[Float[Array, "samples 3"], MemsErrors]:
    """Angles [rad] that a triad reports over the E intervals between E + 1 attitudes, body axes.

    The normal numbers do not depend on the sizes of the errors. Pure JAX, so it maps over keys.

    Args:
        key: of the run, `Component.IMU` of `robins.sim.random.stream`.
        q_nb: (E + 1, 4) attitude at 0, dt, 2 dt ..., body to an inertial frame, scalar first. A
            rotation of more than half a turn in an interval is taken the shorter way.
        dt_s: interval [s].
        gyro: its errors.

    Returns:
        Delta angles (E, 3) [rad] and the errors they contain.

    Raises:
        ValueError: fewer than two attitudes, or a number out of its range.
    """
    q = jnp.asarray(q_nb, float)
    if q.ndim != 2 or q.shape[1] != 4 or len(q) < 2:
        raise ValueError(f"q_nb must have shape (E + 1, 4), E at least one, got {q.shape}")
    length = jnp.sqrt(jnp.sum(q * q, 1))
    _arguments.number("q_nb must be unit quaternions: their length", length, 0.99, 1.01)
    _arguments.number("dt_s", dt_s, 0.0, above=True)
    bias = _arguments.vector("bias_rad_s", gyro.bias_rad_s, 3)
    slow = _arguments.vector("markov_sigma_rad_s", gyro.markov_sigma_rad_s, 3, low=0.0)
    white = _arguments.vector("white_rad_s", gyro.white_rad_s, 3, low=0.0)
    scale = _arguments.vector("scale_factor", gyro.scale_factor, 3, low=-1.0, above=True)

    count, dt = len(q) - 1, jnp.asarray(dt_s, float)
    sign = jax.random.rademacher(jax.random.fold_in(key, _SIGN), (3,), float)
    bias = jnp.where(gyro.sign_drawn, sign * bias, bias)
    key_slow = jax.random.fold_in(key, _DRIFT)
    drift = slow[None] * gauss_markov(key_slow, count, 3, dt_s, gyro.markov_time_s)
    noise = white[None] * jax.random.normal(jax.random.fold_in(key, _NOISE), (count, 3))

    turned = to_rotvec(multiply(conjugate(q[:-1]), q[1:]))
    reported = (1.0 + scale)[None] * turned + dt * (bias[None] + drift + noise)
    return reported, MemsErrors(bias, drift, noise, scale)


def integrate_angles(q0_nb: Number, theta_b: _arguments.Listed) -> Float[Array, "epochs 4"]:
    """Attitude (E + 1, 4) integrated from q0_nb by delta angles (E, 3) [rad].

    The `delta_angles` of a perfect gyro reproduce the attitudes they were computed from.

    Raises:
        ValueError: shapes that do not fit.
    """

    def step(q, theta):
        q = normalise(multiply(q, from_rotvec(theta)))
        return q, q

    start = normalise(_arguments.rows("q0_nb", q0_nb, 4))
    theta = jnp.asarray(theta_b, float)
    if theta.ndim != 2 or theta.shape[1] != 3:
        raise ValueError(f"theta_b must have shape (E, 3), got {theta.shape}")
    _, rest = jax.lax.scan(step, start, theta)
    return jnp.concatenate([start[None], rest])
