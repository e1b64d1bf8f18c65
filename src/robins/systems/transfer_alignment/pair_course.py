"""What all runs of a master and a slave share: the motion, and increments of an ideal slave.

The slave of `lay_out` has its nominal mounting and its lever arm, no flexure, no mounting error and
no sensor errors; `robins.systems.transfer_alignment.pair` adds these run by run.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation as _Rotation

from robins import _float64  # noqa: F401
from robins.earth import Geodetic, gravity
from robins.ins.increments import Increments, from_imu
from robins.ins.mechanise import Nav, mechanise, nav_at
from robins.sim.commands import from_commands
from robins.sim.ideal_imu import ideal_increments
from robins.sim.manoeuvres import MODERATE_SEA, Bank, Sea, Wave, fly, roughen, sail
from robins.sim.trajectory import Motion
from robins.systems.transfer_alignment.pair_parameters import (
    Aircraft,
    Disturbance,
    PairParameters,
    Ship,
    Vehicle,
    Window,
)

SLACK_S = 1e-8  # times are rounded to nanoseconds


class Course(NamedTuple):
    """What all runs share."""

    motion: Motion  # of the master
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
    master: Nav  # what the master's records describe, leading axis E
    master_omega_b: np.ndarray  # (E, 3) rad/s
    there: np.ndarray  # (E,) bool: the record is not lost


def motion_of(manoeuvre: Aircraft | Ship | Vehicle) -> Motion:
    """The motion of the master.

    Raises:
        ValueError: legs that cannot be flown or driven.
    """
    m = manoeuvre
    start = Geodetic(m.latitude, m.longitude, m.height)
    if isinstance(m, Aircraft):
        banks = [Bank(leg.bank, leg.seconds) for leg in m.legs]
        return fly(start, banks, m.speed, m.heading, m.pitch, m.roll_time)
    if isinstance(m, Ship):
        given = (m.roll, m.pitch, m.yaw, m.heave)
        sea = MODERATE_SEA
        if any(waves is not None for waves in given):
            sea = Sea(*(_waves(waves or ()) for waves in given))
        return sail(start, m.seconds, m.speed, m.heading, sea)
    legs = [leg.command() for leg in m.legs]
    return roughen(from_commands(start, legs, m.heading, m.speed), _waves(m.roll), _waves(m.pitch))


def _waves(waves) -> tuple[Wave, ...]:
    return tuple(Wave(w.amplitude, w.period, w.phase) for w in waves)


def lay_out(pair: PairParameters) -> Course:
    """Everything that does not depend on a run.

    Raises:
        ValueError: a motion that cannot be; rates that do not divide; a run shorter than an epoch;
            a window or a step of a disturbance outside the run or without its partner.
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
    there = described_s >= -SLACK_S
    for window in pair.disturbance.dropouts:
        there &= ~_within(epoch_s, window)
    return Course(
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


def _within(time_s: np.ndarray, window: Window) -> np.ndarray:
    return (time_s >= window.begin - SLACK_S) & (time_s < window.end - SLACK_S)


def _samples_an_epoch(slave_hz: float, master_hz: float) -> int:
    each = round(slave_hz / master_hz)
    if each < 1 or abs(slave_hz - each * master_hz) > 1e-9 * slave_hz:
        raise ValueError(
            f"slave.rate is {slave_hz:g} Hz, not a multiple of master.rate, {master_hz:g} Hz: "
            "every epoch must end with a sample of the slave"
        )
    return each


def _check_disturbance(disturbance: Disturbance, end_s: float) -> None:
    d = disturbance

    def inside(name: str, window: Window) -> None:
        if not window.begin < window.end <= end_s + SLACK_S:
            raise ValueError(
                f"disturbance.{name} from {window.begin:g} s to {window.end:g} s must lie within "
                f"the run, 0 s to {end_s:g} s, and begin before it ends"
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
