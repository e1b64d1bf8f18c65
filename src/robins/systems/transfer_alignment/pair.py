"""A master and a slave on one vehicle: what both report, and the truth about the slave.

The slave's axes are turned from the master's by flexure lambda (master axes), the nominal mounting
and the mounting error mu (slave axes):

    q_ns = q_nm exp(lambda) q_nominal exp(mu)

and its gyros and accelerometers feel all of it. `pair_course` inverts the mechanisation once, for a
slave without lambda and mu; `simulate_pair` turns its increments run by run. With d the turn from
true to nominal slave axes at either end of a sample,

    exp(theta) = d_begin^-1 exp(theta_nominal) d_end,        dv = d_begin^-1 dv_nominal

which is exact, so an error-free slave navigates to its true attitude and velocity whatever the
flexure. The lever arm is rigid: that a structure which bends also shifts the slave is left out.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from robins import _float64  # noqa: F401
from robins.earth import Geodetic
from robins.ins.imu_errors import ImuErrorModel, TriadErrors
from robins.ins.increments import Increments
from robins.ins.mechanise import Nav
from robins.manifold import retract
from robins.rotation import Rotation, conjugate, from_rotvec, multiply, rotate, to_rotvec
from robins.sim.disturbance import drift_step, outlier_factor, student_t, window_factor
from robins.sim.flexure import Flexure, simulate_flexure
from robins.sim.imu_sensor import corrupt
from robins.sim.random import Component, stream, unit
from robins.systems.transfer_alignment.pair_course import SLACK_S, Course
from robins.systems.transfer_alignment.pair_parameters import PairParameters, Start

# Streams folded into the keys of a run; part of the file format, as `Component` is.
_NAVIGATION, _MOUNTING = 0, 1  # of the initial state
_ATTITUDE, _VELOCITY, _POSITION = 0, 1, 2  # of the master
_MASTER = unit(Component.IMU, 1)


class SlaveTruth(NamedTuple):
    """What is true of the slave at each epoch."""

    q_nb: Any  # (E, 4) slave axes to NED
    v_n: Any  # (E, 3) m/s
    position: Geodetic  # (E,)
    gyro_bias: Any  # (E, 3) rad/s
    accel_bias: Any  # (E, 3) m/s^2
    mounting_rad: Any  # (E, 3) mu, in slave axes
    flexure_rad: Any  # (E, 3) lambda, in master axes
    flexure_rate_rad_s: Any  # (E, 3)


class PairRun(NamedTuple):
    """One run; E epochs, K samples of the slave in each, NED/FRD."""

    increments: Increments  # dt (E, K), theta (E, K, 3), dv (E, K, 3) as the slave reports
    start: Nav  # true slave at time zero
    initial_error: Any  # (9,) of attitude, velocity, position: true = retract(estimate, error)
    master_position: Geodetic  # (E,) as reported; this and the next two NaN where missing
    master_v_n: Any  # (E, 3) m/s as reported
    master_q_nb: Any  # (E, 4) as reported
    master_omega_b: Any  # (E, 3) rad/s, omega_ib_b of the master at the time of its record
    truth: SlaveTruth


def error_model(pair: PairParameters) -> ImuErrorModel:
    """The errors of the slave's sensors, disturbances left out."""
    s = pair.slave
    return ImuErrorModel(
        TriadErrors(bias_sigma=np.asarray(s.gyro_bias), white=np.asarray(s.gyro_noise)),
        TriadErrors(bias_sigma=np.asarray(s.accel_bias), white=np.asarray(s.accel_noise)),
    )


def simulate_pair(pair: PairParameters, course: Course, seed: int, index: Array) -> PairRun:
    """One run, from its number, which may be traced; pure.

    Args:
        pair: the parameters that `course` was laid out from.
        course: from `lay_out`.
        seed: of the campaign.
        index: () number of the run.
    """
    initial = stream(seed, index, Component.INITIAL_STATE)
    normal = jax.random.normal(jax.random.fold_in(initial, _MOUNTING), (3,))
    mounting = jnp.asarray(pair.mounting.error) + jnp.asarray(pair.mounting.sigma) * normal
    angle, rate = _flexure(pair, course, stream(seed, index, Component.FLEXURE))
    # From true to nominal slave axes: q_nominal^-1 exp(lambda) q_nominal exp(mu).
    in_slave_axes = rotate(conjugate(jnp.asarray(course.q_nominal)), angle)
    d = multiply(from_rotvec(in_slave_axes), from_rotvec(mounting))
    theta, dv = _felt(course, d)
    q_nb = multiply(jnp.asarray(course.q_nb), d)
    errors = _slave_errors(pair, course, stream(seed, index, Component.IMU))
    each = course.each
    shape = (len(course.epoch_s), each)
    position, v_n, q_m = _records(pair, course, seed, index)

    def at_epochs(x: Array) -> Array:
        return x[each - 1 :: each]

    return PairRun(
        increments=Increments(
            jnp.asarray(course.dt).reshape(shape),
            (theta + errors.theta).reshape(*shape, 3),
            (dv + errors.dv).reshape(*shape, 3),
        ),
        start=Nav(Rotation(q_nb[0]), *(jax.tree.map(jnp.asarray, x) for x in course.start[1:])),
        initial_error=_initial_error(pair.start, jax.random.fold_in(initial, _NAVIGATION)),
        master_position=position,
        master_v_n=v_n,
        master_q_nb=q_m,
        master_omega_b=jnp.asarray(course.master_omega_b),
        truth=SlaveTruth(
            at_epochs(q_nb[1:]),
            jnp.asarray(course.path.v_n),
            jax.tree.map(jnp.asarray, course.path.position),
            at_epochs(errors.gyro_bias),
            at_epochs(errors.accel_bias),
            jnp.broadcast_to(mounting, (shape[0], 3)),
            at_epochs(angle[1:]),
            at_epochs(rate[1:]),
        ),
    )


def start_estimate(run: PairRun) -> Nav:
    """The slave's own idea of where it is at time zero, `initial_error` away from the truth.

    The position is so to the curvature of the Earth, 2e-5 m at 10 m.
    """
    return retract(run.start, -run.initial_error)


def _flexure(pair: PairParameters, course: Course, key: Array) -> tuple[Array, Array]:
    f = pair.flexure
    if not any((*f.sigma, *f.bending)):
        stiff = jnp.zeros((len(course.dt) + 1, 3))
        return stiff, stiff
    model = Flexure(
        np.asarray(f.sigma), np.asarray(f.time), f.damping, f.tail_dof, np.asarray(f.bending)
    )
    load = jnp.asarray(course.load_factor)
    return simulate_flexure(model, key, 1.0 / pair.slave.rate, len(course.dt), load)


def _felt(course: Course, d: Float[Array, "n 4"]) -> tuple[Array, Array]:
    """Increments of the true slave axes, (N, 3) each."""
    back = conjugate(d[:-1])
    turned = multiply(multiply(back, jnp.asarray(course.turn)), d[1:])
    return to_rotvec(turned), rotate(back, jnp.asarray(course.nominal.dv))


class _SlaveErrors(NamedTuple):
    theta: Array  # (N, 3) rad
    dv: Array  # (N, 3) m/s
    gyro_bias: Array  # (N, 3) rad/s at the end of each sample
    accel_bias: Array  # (N, 3) m/s^2


def _slave_errors(pair: PairParameters, course: Course, key: Array) -> _SlaveErrors:
    """All errors add, so the unit is asked what it reports of a body at rest in free fall."""
    dt, still = jnp.asarray(course.dt), jnp.zeros((len(course.dt), 3))
    theta, dv, seen = corrupt(dt, still, still, error_model(pair), key)
    bias = seen.gyro.bias
    d = pair.disturbance
    if d.gyro_noise_window is not None:
        w = d.gyro_noise_window
        constant = bias * dt[:, None]
        begin, end = w.begin - SLACK_S, w.end - SLACK_S
        factor = window_factor(jnp.asarray(course.begin_s), begin, end, d.gyro_noise_factor)
        theta = constant + factor[:, None] * (theta - constant)
    if d.drift_step_time is not None:
        at = d.drift_step_time - SLACK_S
        step, turned = drift_step(jnp.asarray(course.begin_s), dt, at, jnp.asarray(d.drift_step))
        theta, bias = theta + turned, bias + step
    return _SlaveErrors(theta, dv, bias, seen.accel.bias)


def _initial_error(start: Start, key: Array) -> Float[Array, "9"]:
    sigma = jnp.asarray([*start.attitude, *start.velocity, *start.position])
    normal = jax.random.normal(key, (9,))
    if start.draw == "plus-sigma":
        return sigma
    return sigma * (jnp.where(normal < 0.0, -1.0, 1.0) if start.draw == "random-sign" else normal)


def _records(pair: PairParameters, course: Course, seed: int, index: Array):
    """Position, velocity and attitude as the master reports them."""
    key = stream(seed, index, _MASTER)
    d, m = pair.disturbance, pair.master
    count = len(course.epoch_s)

    def noise(part: int, sigma, factor) -> Array:
        own = jax.random.fold_in(key, part)
        shape = (count, 3)
        unit_noise = (
            jax.random.normal(own, shape)
            if d.tail_dof is None
            else student_t(own, shape, d.tail_dof)
        )
        return jnp.asarray(sigma)[None] * unit_noise * factor[:, None]

    struck = outlier_factor(
        stream(seed, index, Component.FAULT), (count,), d.outlier_share, d.outlier_factor
    )
    there = jnp.asarray(course.there)

    def known(x: Array) -> Array:
        return jnp.where(there.reshape(-1, *([1] * (x.ndim - 1))), x, jnp.nan)

    true = jax.tree.map(jnp.asarray, course.master)
    tilt = from_rotvec(noise(_ATTITUDE, m.attitude_noise, struck))
    at = true.position.retract(noise(_POSITION, m.position_noise, jnp.ones(count)))
    v_n = true.v_n + noise(_VELOCITY, m.velocity_noise, struck)
    return (
        jax.tree.map(known, at),
        known(v_n),
        known(multiply(tilt, true.q_nb.wxyz)),
    )
