"""A simulated drive: one true motion, any number of runs with their own sensor errors.

The truth of a run is drawn from the assumptions of the filter: initial errors from its initial
covariance, biases and noise from its IMU parameters, fixes from its GNSS sigmas. A correct filter
is therefore consistent, and `InsGnssAssumptions` makes it wrong on purpose.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from robins.dataset import Dataset
from robins.earth import Geodetic
from robins.filters.values import Numbers
from robins.ins.blocks import cut, epochs_between
from robins.ins.imu_errors import ImuErrorModel, TriadErrors
from robins.ins.increments import Increments, from_imu
from robins.ins.mechanise import Nav, mechanise_chunked, nav_at
from robins.ins.state import InsState
from robins.manifold import retract
from robins.sim.gnss_sensor import GnssErrorModel, as_table, fix_times, observe
from robins.sim.ideal_imu import ideal_increments
from robins.sim.imu_sensor import corrupt
from robins.sim.random import Component, stream
from robins.sim.trajectory import MotionProfile
from robins.systems.ins_gnss.model import POSITION, VELOCITY, Fix, Velocity, start_belief
from robins.systems.ins_gnss.parameters import Drive, InsGnssImu
from robins.systems.parts import ImuBlock, as_array, may_be_nonzero, motion_of
from robins.systems.study import Case


class InsGnssCourse(NamedTuple):
    """Data that all runs share."""

    motion: MotionProfile
    ideal: Increments  # (N,), (N, 3), (N, 3) samples of an ideal unit
    epoch_s: np.ndarray  # (E,)
    blocks: Increments  # (E, K) of the same, with coning and sculling compensated
    parent: np.ndarray  # (E, K) the increment of each piece, -1 where padded
    start: Nav
    truth: Nav  # at each epoch, leading axis E
    sample: np.ndarray  # (E,) index of the sample that ends at each epoch
    rate_b: np.ndarray  # (E, 3) rad/s true gyro rate at each epoch
    at_fix: tuple[np.ndarray, ...]  # the truth at each fix: arguments of `observe`
    fix: np.ndarray  # (E,) index of the fix at each epoch, -1 if none
    outage: np.ndarray  # (E,) bool


def error_model(imu: InsGnssImu) -> ImuErrorModel:
    """Error model of the sensors that the filter's parameters describe."""

    def triad(bias, noise, walk, time, scale) -> TriadErrors:
        given: dict[str, Any] = {"white": as_array(noise)}
        if time is None:
            given |= {"bias_sigma": as_array(bias), "walk": as_array(walk)}
        else:
            given |= {"markov_sigma": as_array(bias), "markov_tau_s": as_array([time] * 3)}
        if imu.scale_states:
            given["scale_sigma"] = as_array(scale)
        return TriadErrors(**given)

    i = imu
    return ImuErrorModel(
        triad(i.gyro_bias, i.gyro_noise, i.gyro_bias_walk, i.gyro_bias_time, i.gyro_scale),
        triad(i.accel_bias, i.accel_noise, i.accel_bias_walk, i.accel_bias_time, i.accel_scale),
    )


def receiver_model(drive: Drive) -> GnssErrorModel:
    """Error model of the receiver, without outages, which are applied to the epochs."""
    g = drive.gnss
    return GnssErrorModel(
        sigma_m=as_array(g.sigma),
        sigma_v=as_array(g.velocity_sigma),
        lever_b_m=as_array(g.lever_arm) if may_be_nonzero(g.lever_arm) else None,
        rate_hz=g.rate,
        time_offset_s=g.latency,
    )


def lay_out(drive: Drive) -> InsGnssCourse:
    """Compute, in NumPy, all that does not depend on the run.

    Raises:
        ValueError: the legs are too short for two fixes.
    """
    motion = motion_of(drive.place, drive.legs)
    time_ns = motion.times_ns(drive.imu_rate)
    trajectory = motion.trajectory(time_ns)
    table = ideal_increments(trajectory)
    compensated, end_ns = from_imu(table)
    time_s = end_ns * 1e-9
    dt = np.diff(time_ns) * 1e-9
    # A bias of the sensors passes through coning and sculling terms of 1e-3 of its size at most, so
    # the errors of a run are added to the compensated increments.
    times = fix_times(receiver_model(drive), 1.0 / drive.gnss.rate, float(time_s[-1]))
    stamps = times.stamp_s
    if len(stamps) < 2:
        raise ValueError(f"the legs last {time_s[-1]:.1f} s, too short for two fixes")
    # blocks after the last fix would not end on a sample, so the run ends with the fix
    epochs = epochs_between(0.0, float(stamps[-1]), stamps, drive.update.longest_block)
    blocks, parent = cut(compensated, time_s, 0.0, epochs)
    start = nav_at(trajectory, 0, np)
    path = mechanise_chunked(start, compensated)
    index = np.searchsorted(time_s, epochs - 1e-9)
    if np.max(np.abs(time_s[index] - epochs)) > 1e-6:
        raise ValueError(
            "imu_rate must be a multiple of gnss.rate and of the block rate, so that every epoch "
            "falls on a sample"
        )
    fix = np.full(len(epochs), -1)
    fix[np.searchsorted(epochs, stamps - 1e-9)] = np.arange(len(stamps))
    outage = np.zeros(len(epochs), dtype=bool)
    if drive.outages is not None:
        outage = drive.outages.mask(epochs, 0.0, float(epochs[-1]))
    return InsGnssCourse(
        motion=motion,
        ideal=Increments(dt, table.gyro[1:], table.accel[1:]),
        epoch_s=epochs,
        blocks=blocks,
        parent=parent,
        start=start,
        truth=jax.tree_util.tree_map(lambda x: x[index], path),
        sample=index,
        rate_b=motion.at(epochs).rates()[0],
        at_fix=_at_fixes(motion, times.valid_s),
        fix=fix,
        outage=outage,
    )


def _at_fixes(motion: MotionProfile, valid_s: np.ndarray) -> tuple[np.ndarray, ...]:
    """Truth at times of validity: arguments of `observe`."""
    k = motion.at(valid_s)
    return valid_s, k.lat, k.lon, k.alt, k.v_n, k.q_nb, k.rates()[0]


def simulate(drive: Drive, course: InsGnssCourse, seed: int, index: Array) -> Case:
    """Simulate the run of this number; pure."""
    dt, theta, dv = (jnp.asarray(a) for a in course.ideal[:3])
    key = partial(stream, seed, index)
    turned, pushed, errors = corrupt(dt, theta, dv, error_model(drive.imu), key(Component.IMU))
    # the share of each piece in its parent sample is the same for all runs
    parent, padded = course.parent, course.parent < 0
    share = course.blocks.dt / np.asarray(course.ideal.dt)[parent]
    share = jnp.asarray(np.where(padded, 0.0, share))[..., None]
    pieces = course.blocks
    u = ImuBlock(
        Increments(
            jnp.asarray(pieces.dt),
            jnp.asarray(pieces.theta) + share * (turned - theta)[parent],
            jnp.asarray(pieces.dv) + share * (pushed - dv)[parent],
        ),
        jnp.ones(len(parent)),
    )
    at = course.sample
    scales: tuple[Any, ...] = ()
    if drive.imu.scale_states:
        each = (jnp.diagonal(e.matrix) for e in (errors.gyro, errors.accel))
        scales = tuple(jnp.broadcast_to(scale, (len(at), 3)) for scale in each)
    truth = InsState(*course.truth, errors.gyro.bias[at], errors.accel.bias[at], *scales)

    # true = retract(mean, e), and biases are drawn about zero by the sensors themselves
    known = start_belief(
        course.start, drive.imu, drive.start, drive.start.tilt, drive.start.heading
    )
    sigma = jnp.diagonal(known.factor)
    e = sigma * jax.random.normal(key(Component.INITIAL_STATE), sigma.shape)
    e = jnp.where(jnp.arange(len(sigma)) < 9, e, 0.0)
    start = known._replace(mean=retract(known.mean, -e))

    receiver = receiver_model(drive)
    fixes = observe(receiver, key(Component.GNSS), *course.at_fix)
    here = jnp.asarray((course.fix >= 0) & ~course.outage)

    def at_epochs(x):
        mask = here.reshape(-1, *([1] * (x.ndim - 1)))
        return jnp.where(mask, x[course.fix], jnp.nan)

    shape = (len(course.fix), 3)
    rate = jnp.asarray(course.rate_b) + errors.gyro.bias[at]
    y: dict[str, Any] = {POSITION: Geodetic(*(at_epochs(x) for x in fixes[:3]))}
    aux: dict[str, Any] = {
        POSITION: Fix(jnp.broadcast_to(jnp.asarray(drive.gnss.sigma), shape), rate)
    }
    if drive.gnss.use_velocity:
        y[VELOCITY] = at_epochs(fixes.v_n)
        aux[VELOCITY] = Velocity(
            jnp.broadcast_to(jnp.asarray(drive.gnss.velocity_sigma), shape),
            rate,
            jnp.zeros(shape),
            jnp.zeros(shape[0]),
        )
    return Case(start, u, y, aux, truth)


# what filters assume: factor of the initial covariance, and sigmas by sensor
_Belief = tuple[Numbers, dict[str, Any]]


def belief_of(drive: Drive, course: InsGnssCourse) -> _Belief:
    """Assumptions of the filters from the parameters."""
    begin = drive.start
    known = start_belief(course.start, drive.imu, begin, begin.tilt, begin.heading)
    r, g = np.sqrt(drive.believed.r_factor), drive.gnss
    sigma = {POSITION: g.sigma} | ({VELOCITY: g.velocity_sigma} if g.use_velocity else {})
    return known.factor, {name: r * as_array(each) for name, each in sigma.items()}


def as_believed(belief: _Belief, world: Case) -> Case:
    """Case of a drive, with the assumptions of the filters in place of the true sigmas."""
    factor, sigma = belief
    aux = {
        name: fix._replace(sigma=jnp.broadcast_to(sigma[name], fix.sigma.shape))
        for name, fix in world.aux.items()
    }
    return world._replace(start=world.start._replace(factor=factor), aux=aux)


def drive_dataset(drive: Drive, seed: int, run: int = 0) -> Dataset:
    """One run of a drive as a log: samples, all fixes, and the truth.

    Its noise is that of the same run in a campaign.
    """
    motion = motion_of(drive.place, drive.legs)
    truth = motion.trajectory(motion.times_ns(drive.imu_rate), source="simulated drive")
    key = partial(stream, seed, run)
    table = ideal_increments(truth)
    dt = np.diff(table.time_ns) * 1e-9
    theta, dv, _ = corrupt(
        dt, table.gyro[1:], table.accel[1:], error_model(drive.imu), key(Component.IMU)
    )
    imu = replace(
        table,
        gyro=np.concatenate([table.gyro[:1], theta]),
        accel=np.concatenate([table.accel[:1], dv]),
        source="simulated drive",
    )
    receiver = receiver_model(drive)
    times = fix_times(receiver, 1.0 / drive.gnss.rate, motion.duration_s)
    fixes = observe(receiver, key(Component.GNSS), *_at_fixes(motion, times.valid_s))
    gnss = as_table(fixes, times.stamp_s)
    return Dataset("simulated drive", imu, gnss, truth)
