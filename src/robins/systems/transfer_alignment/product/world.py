"""A master and a slave on one vehicle: outputs of both, and the truth of the slave.

The slave's axes are rotated from the master's by flexure lambda (master axes), the nominal mounting
and the mounting error mu (slave axes):

    q_ns = q_nm exp(lambda) q_nominal exp(mu)

and its gyros and accelerometers sense all of it. `lay_out` inverts the mechanisation once, for a
slave without lambda and mu; `simulate_pair` rotates its increments run by run. With d the rotation
from true to nominal slave axes at either end of a sample,

    exp(theta) = d_begin^-1 exp(theta_nominal) d_end,        dv = d_begin^-1 dv_nominal

which is exact, so an error-free slave navigates to its true attitude and velocity whatever the
flexure. The lever arm is rigid: the displacement of the slave by bending is not modelled.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.spatial.transform import Rotation as _Rotation

from robins import _float64  # noqa: F401
from robins.earth import Geodetic, gravity
from robins.ins.imu_errors import ImuErrorModel, TriadErrors
from robins.ins.increments import Increments, from_imu
from robins.ins.mechanise import Nav, mechanise, nav_at
from robins.ins.state import InsState
from robins.manifold import retract
from robins.rotation import Rotation, conjugate, from_rotvec, multiply, rotate, to_rotvec
from robins.scenario import Span
from robins.sim.disturbance import drift_step, outlier_factor, student_t, window_factor
from robins.sim.flexure import simulate_flexure
from robins.sim.ideal_imu import ideal_increments
from robins.sim.imu_sensor import corrupt
from robins.sim.manoeuvres import MODERATE_SEA, BankedTurn, SeaMotion, Wave, fly, roughen, sail
from robins.sim.random import Component, stream, unit
from robins.sim.trajectory import MotionProfile, at_lever_arm
from robins.systems.parts import as_array, may_be_nonzero, outside, signed
from robins.systems.parts import motion_of as driven
from robins.systems.transfer_alignment.product.model import (
    RECORDS,
    MasterQuantity,
    ProductState,
    RecordDelay,
)
from robins.systems.transfer_alignment.product.parameters import (
    Aircraft,
    GroundVehicle,
    PairDisturbance,
    PairParameters,
    Ship,
)

SLACK_S = 1e-8  # times are rounded to nanoseconds
# Streams folded into the keys of a run; part of the file format, as `Component` is, and so is the
# order of `RECORDS`.
_NAVIGATION, _MOUNTING = 0, 1  # of the initial state
_MASTER = unit(Component.IMU, 1)


class PairCourse(NamedTuple):
    """Data common to all runs: the motion, and increments of an ideal slave.

    This slave has its nominal mounting and its lever arm, no flexure, no mounting error and no
    sensor errors; `simulate_pair` adds these run by run.
    """

    motion: MotionProfile  # of the master
    epoch_s: np.ndarray  # (E,)
    each: int  # K, samples in an epoch
    dt: np.ndarray  # (N,) s, N = E K
    begin_s: np.ndarray  # (N,) start of each sample
    q_nominal: np.ndarray  # (4,) nominal mounting, slave to master axes
    nominal: Increments  # of a slave without flexure and mounting error, (N,), (N, 3), (N, 3)
    turn: np.ndarray  # (N, 4) exp(theta) of these
    q_nb: np.ndarray  # (N + 1, 4) attitude of that slave
    path: Nav  # that slave at each epoch, leading axis E
    start: Nav  # and at time zero
    load_factor: np.ndarray  # (N + 1,) specific force of the master over g
    master: Nav  # true master at the records' times of validity, leading axis E
    master_omega_b: np.ndarray  # (E, 3) rad/s
    there: np.ndarray  # (E,) bool: True unless the record is lost


def motion_of(manoeuvre: Aircraft | Ship | GroundVehicle) -> MotionProfile:
    """The motion of the master.

    Raises:
        ValueError: legs that cannot be flown or driven.
    """
    m = manoeuvre
    start = Geodetic(m.latitude, m.longitude, m.height)
    if isinstance(m, Aircraft):
        banks = [BankedTurn(leg.bank, leg.seconds) for leg in m.legs]
        return fly(start, banks, m.speed, m.heading, m.pitch, m.roll_time)
    if isinstance(m, Ship):
        given = (m.roll, m.pitch, m.yaw, m.heave)
        sea = MODERATE_SEA
        if any(waves is not None for waves in given):
            sea = SeaMotion(*(_waves(waves or ()) for waves in given))
        return sail(start, m.seconds, m.speed, m.heading, sea)
    return roughen(driven(m, m.legs, m.speed), _waves(m.roll), _waves(m.pitch))


def _waves(waves) -> tuple[Wave, ...]:
    return tuple(Wave(w.amplitude, w.period, w.phase) for w in waves)


def lay_out(pair: PairParameters) -> PairCourse:
    """Set up everything that does not depend on the run.

    Raises:
        ValueError: an impossible motion; rates that do not divide; a run shorter than an epoch; a
            window or a step of a disturbance outside the run or without its partner.
    """
    each = _samples_an_epoch(pair.slave.rate, pair.master.rate)
    motion = motion_of(pair.manoeuvre)
    count = int(np.floor(motion.duration_s * pair.master.rate * (1.0 + 1e-12)))
    if count < 1:
        raise ValueError(
            f"the manoeuvre lasts {motion.duration_s:g} s, less than an epoch of the master at "
            f"{pair.master.rate:g} Hz"
        )
    time_ns = np.round(np.arange(count * each + 1) * (1e9 / pair.slave.rate)).astype(np.int64)
    time_s = time_ns * 1e-9
    epoch_s = time_s[each::each]
    _check_disturbance(pair.disturbance, float(epoch_s[-1]))

    carried = at_lever_arm(motion, pair.lever_arm)
    truth = carried.trajectory(time_ns)
    mounted = _Rotation.from_euler("ZYX", pair.mounting.nominal[::-1])
    q_nb = _Rotation.from_quat(truth.q_nb, scalar_first=True) * mounted
    truth = replace(truth, q_nb=q_nb.as_quat(scalar_first=True))
    nominal = from_imu(ideal_increments(truth))[0]._replace(dr=None)
    start = nav_at(truth, 0)
    path = mechanise(start, jax.tree.map(jnp.asarray, nominal))

    force = np.linalg.norm(motion.at(time_s).rates()[1], axis=-1)
    g = np.asarray(_compiled_gravity(truth.lat_rad, truth.alt_m))
    described_s = epoch_s - pair.master.delay
    described_ns = np.round(np.maximum(described_s, 0.0) * 1e9).astype(np.int64)
    there = (described_s >= -SLACK_S) & outside(pair.disturbance.dropouts, epoch_s)
    return PairCourse(
        motion=motion,
        epoch_s=epoch_s,
        each=each,
        dt=np.asarray(nominal.dt),
        begin_s=time_s[:-1],
        q_nominal=mounted.as_quat(scalar_first=True),
        nominal=nominal,
        turn=_Rotation.from_rotvec(nominal.theta).as_quat(scalar_first=True),
        q_nb=np.concatenate([truth.q_nb[:1], np.asarray(path.q_nb.wxyz)]),
        path=jax.tree.map(lambda x: np.asarray(x)[each - 1 :: each], path),
        start=start,
        load_factor=force / g,
        master=nav_at(motion.trajectory(described_ns), slice(None)),
        master_omega_b=motion.at(described_ns * 1e-9).rates()[0],
        there=there,
    )


_compiled_gravity = jax.jit(gravity)


def _samples_an_epoch(slave_hz: float, master_hz: float) -> int:
    each = round(slave_hz / master_hz)
    if each < 1 or abs(slave_hz - each * master_hz) > 1e-9 * slave_hz:
        raise ValueError(
            f"slave.rate is {slave_hz:g} Hz, not a multiple of master.rate, {master_hz:g} Hz: "
            "every epoch must end with a sample of the slave"
        )
    return each


def _check_disturbance(disturbance: PairDisturbance, end_s: float) -> None:
    d = disturbance

    def inside(name: str, window: Span) -> None:
        if window.end > end_s + SLACK_S:
            raise ValueError(
                f"disturbance.{name} from {window.begin:g} s to {window.end:g} s must lie within "
                f"the run, 0 s to {end_s:g} s"
            )

    if d.gyro_noise_window is not None:
        inside("gyro_noise_window", d.gyro_noise_window)
    elif d.gyro_noise_factor != 1.0:
        raise ValueError(
            f"disturbance.gyro_noise_factor is {d.gyro_noise_factor:g} without a "
            "gyro_noise_window to act in"
        )
    for k, window in enumerate(d.dropouts):
        inside(f"dropouts[{k}]", window)
    if (d.drift_step_time is None) != (not any(d.drift_step)):
        raise ValueError(
            "disturbance.drift_step and drift_step_time belong together: give both or neither"
        )
    if d.drift_step_time is not None and d.drift_step_time >= end_s - SLACK_S:
        raise ValueError(
            f"disturbance.drift_step_time is {d.drift_step_time:g} s, the run ends at {end_s:g} s"
        )


class PairRun(NamedTuple):
    """One run, simulated or recorded; E epochs, K samples of the slave in each, NED/FRD."""

    increments: Increments  # dt (E, K), theta (E, K, 3), dv (E, K, 3) as the slave reports
    noise_scale: Any  # (E,) of the process noise factor: 1, more across a gap in the samples
    start: Nav  # true slave at time zero; for a recorded pair its assumed state
    initial_error: Any  # (9,) of attitude, velocity, position: true = retract(estimate, error)
    master: Nav  # leading axis E, as reported; NaN where missing
    master_omega_b: Any  # (E, 3) rad/s, omega_ib_b of the master at the time of its record
    truth: ProductState | None  # of the slave, leading axis E; None where it is not known
    lag: RecordDelay | None = None  # of the records; None: that of the delay a filter assumes


def simulate_pair(pair: PairParameters, course: PairCourse, seed: int, index: Array) -> PairRun:
    """One run of the course of a pair, from its number, which may be traced; pure."""
    initial = stream(seed, index, Component.INITIAL_STATE)
    normal = jax.random.normal(jax.random.fold_in(initial, _MOUNTING), (3,))
    mounting = jnp.asarray(pair.mounting.error) + jnp.asarray(pair.mounting.sigma) * normal
    angle, rate = _flexure(pair, course, stream(seed, index, Component.FLEXURE))
    # From true to nominal slave axes: q_nominal^-1 exp(lambda) q_nominal exp(mu).
    in_slave_axes = rotate(conjugate(jnp.asarray(course.q_nominal)), angle)
    d = multiply(from_rotvec(in_slave_axes), from_rotvec(mounting))
    theta, dv = _ideal_increments(course, d)
    q_nb = multiply(jnp.asarray(course.q_nb), d)
    theta_error, dv_error, *biases = _slave_errors(pair, course, stream(seed, index, Component.IMU))
    begin = [*pair.start.attitude, *pair.start.velocity, *pair.start.position]
    shape = (len(course.epoch_s), course.each)

    def at_epochs(x: Array) -> Array:
        return x[course.each - 1 :: course.each]

    true = jax.tree.map(jnp.asarray, course.path)._replace(q_nb=Rotation(at_epochs(q_nb[1:])))
    return PairRun(
        increments=Increments(
            jnp.asarray(course.dt).reshape(shape),
            (theta + theta_error).reshape(*shape, 3),
            (dv + dv_error).reshape(*shape, 3),
        ),
        noise_scale=jnp.ones(shape[0]),
        start=jax.tree.map(jnp.asarray, course.start)._replace(q_nb=Rotation(q_nb[0])),
        initial_error=signed(jax.random.fold_in(initial, _NAVIGATION), begin, pair.start.draw),
        master=_records(pair, course, seed, index),
        master_omega_b=jnp.asarray(course.master_omega_b),
        truth=ProductState(
            InsState(*true, *map(at_epochs, biases)),
            jnp.broadcast_to(mounting, (shape[0], 3)),
            jnp.concatenate([at_epochs(angle[1:]), at_epochs(rate[1:])], 1),
        ),
    )


def start_estimate(run: PairRun) -> Nav:
    """Initial estimate of the slave at time zero, `initial_error` away from the truth.

    The position is exact but for the curvature of the Earth, 2e-5 m at 10 m.
    """
    return retract(run.start, -run.initial_error)


def _flexure(pair: PairParameters, course: PairCourse, key: Array) -> tuple[Array, Array]:
    f = pair.flexure
    if not may_be_nonzero((*f.sigma, *f.bending)):
        stiff = jnp.zeros((len(course.dt) + 1, 3))
        return stiff, stiff
    load = jnp.asarray(course.load_factor)
    return simulate_flexure(f.flexure, key, 1.0 / pair.slave.rate, len(course.dt), load)


def _ideal_increments(course: PairCourse, d: Float[Array, "n 4"]) -> tuple[Array, Array]:
    """Ideal increments (N, 3) each along the true slave axes."""
    back = conjugate(d[:-1])
    turned = multiply(multiply(back, jnp.asarray(course.turn)), d[1:])
    return to_rotvec(turned), rotate(back, jnp.asarray(course.nominal.dv))


def _slave_errors(pair: PairParameters, course: PairCourse, key: Array) -> tuple[Array, ...]:
    """Errors of theta and dv, biases of gyros and accelerometers after each sample; (N, 3) each.

    All errors are additive, so they are the output of the unit for a body at rest in free fall.
    """
    s, dt, still = pair.slave, jnp.asarray(course.dt), jnp.zeros((len(course.dt), 3))
    slow = (
        {"markov_sigma": as_array(s.gyro_slow), "markov_tau_s": as_array(s.gyro_slow_time)}
        if may_be_nonzero(s.gyro_slow)
        else {}
    )
    unit = ImuErrorModel(
        TriadErrors(bias_sigma=s.gyro_left, white=as_array(s.gyro_noise), **slow),
        TriadErrors(bias_sigma=s.accel_left, white=as_array(s.accel_noise)),
    )
    theta, dv, seen = corrupt(dt, still, still, unit, key)
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
    return theta, dv, bias, seen.accel.bias


def _records(pair: PairParameters, course: PairCourse, seed: int, index: Array) -> Nav:
    """Records of the master at each epoch, NaN where one is lost."""
    d, count, key = pair.disturbance, len(course.epoch_s), stream(seed, index, _MASTER)
    struck = outlier_factor(
        stream(seed, index, Component.FAULT), (count,), d.outlier_share, d.outlier_factor
    )

    def noise(part: int, record: MasterQuantity) -> Array:
        own, shape = jax.random.fold_in(key, part), (count, 3)
        tails = d.tail_dof
        white = jax.random.normal(own, shape) if tails is None else student_t(own, shape, tails)
        factor = struck if record.struck else jnp.ones(count)
        return jnp.asarray(getattr(pair.master, record.sigma))[None] * white * factor[:, None]

    true, lost = jax.tree.map(jnp.asarray, course.master), np.flatnonzero(~course.there)
    errors = [noise(part, record) for part, record in enumerate(RECORDS.values())]
    reported = jax.vmap(retract)(true, jnp.concatenate(errors, 1))
    return jax.tree.map(lambda x: x.at[lost].set(jnp.nan), reported)
