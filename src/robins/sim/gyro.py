"""The gyros of a spacecraft: all their errors drawn beforehand, one sample read at a time.

A closed loop knows how its body turns only as it goes, and the errors of its gyros do not depend on
that except by scale factors and misalignments. So a whole run of them is drawn at once by
`gyro_errors`, and `read_gyro` is what is left for inside the loop:

    reported = quantised( (I + S + M) theta + angle )

The errors are those of `robins.ins.imu_errors.TriadErrors`, drawn by `robins.sim.imu_sensor`:
bias, Gauss-Markov drift, random walk of the rate, ramp, white noise (angle random walk), scale,
misalignment. A gyro's sensitivity to specific force is none of them, for in free fall there is no
specific force. It is the angle that is quantised, and what a sample could not report is carried to
the next, so the sum of all is never off by more than half a count.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from robins import _float64  # noqa: F401
from robins.ins.imu_errors import ImuErrorModel, TriadErrors
from robins.sim import _given
from robins.sim.imu_sensor import corrupt, quantise

# Folded into the key, beside the streams 0 and 1 of `imu_sensor`; part of the file format.
_WHITE = 2


class GyroErrors(NamedTuple):
    """Errors of a triad over a run of E samples."""

    angle: Any  # (E, 3) rad, added to the angle of each sample: bias times dt and white noise
    bias: Any  # (E, 3) rad/s, mean of the additive rate error over each sample without white noise
    matrix: Any  # (3, 3) S + M, scale factor errors and misalignments


def gyro_errors(key: Array, model: TriadErrors, count: int, dt_s: Any) -> GyroErrors:
    """Draw the errors of a triad for a run of ``count`` samples.

    The normal numbers depend on neither the sizes of the errors nor the count: a longer run begins
    with the shorter one. Pure JAX, so it maps over keys and over stacked models.

    Args:
        key: of the run, `Component.IMU` of `robins.sim.random.stream`.
        model: of the errors, in rad/s. Its quantum is not used here but in `read_gyro`.
        count: E, samples.
        dt_s: sampling interval [s].

    Raises:
        ValueError: no sample, an interval that is not positive, or a model with a full scale, which
            is not simulated here.
    """
    _given.count_of("count", count)
    _given.number("dt_s", dt_s, 0.0, above=True)
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
        # By sample number, as in `imu_sensor`: no number depends on how many there are.
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
    quantum_rad: Any = 0.0,
) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
    """What a triad reports of one sample, and what it has not yet reported.

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
