"""A log made ready for the filter: one clock, calibrated field, blocks, measurements."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from robins.dataset import Dataset, ImuTable, MagTable
from robins.filters import Belief
from robins.ins.frames import to_ned_frd
from robins.ins.increments import after_gap, from_imu, usual_interval
from robins.manifold import Angle
from robins.rotation import Rotation
from robins.systems.marg.align import FirstLook, first_look
from robins.systems.marg.blocks import Integrals, Samples, integrate
from robins.systems.marg.model import MAGNETOMETER, REST_RATE, TRAVEL, Block, MargState
from robins.systems.marg.parameters import Accelerometer, Gyro, Magnetometer, Replay
from robins.systems.marg.rest import still_samples

_PACK = 512  # blocks are filled up to a multiple of this, so that logs alike compile once
_FALLING = 0.3  # of gravity: below it nothing holds the unit up, and tilt cannot be seen


class Prepared(NamedTuple):
    """A log as the filter takes it; K blocks of n samples, N samples with the first."""

    time_s: np.ndarray  # (N,) of each sample, from the first one on
    time_ns: np.ndarray  # (N,) int64
    samples: Samples
    used: int  # N - 1, samples that are not padding
    epoch_s: np.ndarray  # (B,) ends of the blocks that are not padding, B <= K
    start: Belief
    look: FirstLook
    u: Block
    y: dict[str, Any]
    aux: dict[str, Any]
    still: np.ndarray  # (B,) bool
    counts: dict[str, int]


def whole_samples(
    imu: ImuTable, gyro: Gyro, accelerometer: Accelerometer
) -> tuple[ImuTable, np.ndarray, dict[str, int]]:
    """The samples that are numbers, which of them touch the end of their range, and counts.

    Raises:
        ValueError: fewer than two samples are left.
    """
    finite = np.all(np.isfinite(imu.gyro), axis=1) & np.all(np.isfinite(imu.accel), axis=1)
    kept = (
        imu
        if np.all(finite)
        else replace(
            imu,
            time_ns=imu.time_ns[finite],
            gyro=imu.gyro[finite],
            accel=imu.accel[finite],
            rows=None if imu.rows is None else imu.rows[finite],
        )
    )
    if len(kept) < 2:
        raise ValueError(f"orientation needs two whole inertial samples; this log has {len(kept)}")
    if kept.kind == "rate":
        full = np.any(np.abs(kept.gyro) >= 0.99 * gyro.range, axis=1)
        full |= np.any(np.abs(kept.accel) >= 0.99 * accelerometer.range, axis=1)
    else:
        full = np.zeros(len(kept), dtype=bool)
    counts = {"imu_missing": int(np.sum(~finite)), "imu_saturated": int(np.sum(full))}
    return kept, full, counts


def as_means(imu: ImuTable) -> ImuTable:
    """Rates as increments of the sampling intervals that end with them.

    What a MEMS chip puts out is the mean over its last sampling interval, or later still for its
    filters; to read it as the rate of that instant would run ahead of the motion by half of one.
    """
    if imu.kind == "increment":
        return imu
    dt = np.diff(imu.time_ns) * 1e-9
    own = np.where(after_gap(dt), usual_interval(dt), dt)
    own = np.concatenate([own[:1], own])[:, None]
    return replace(imu, gyro=imu.gyro * own, accel=imu.accel * own, kind="increment")


def calibrated(
    mag: MagTable, magnetometer: Magnetometer
) -> tuple[np.ndarray, np.ndarray, dict[str, int]]:
    """Time [ns] and field [T, FRD] of the readings that can be the field of the Earth; counts."""
    table = to_ned_frd(mag)
    finite = np.all(np.isfinite(table.field_t), axis=1)
    field = (table.field_t - np.array(magnetometer.offset)) @ np.array(magnetometer.matrix).T
    size = np.linalg.norm(np.where(finite[:, None], field, 0.0), axis=1)
    able = finite & (size >= magnetometer.least) & (size <= magnetometer.most)
    counts = {
        "field_missing": int(np.sum(~finite)),
        "field_implausible": int(np.sum(finite & ~able)),
    }
    return table.time_ns[able], field[able], counts


def at_samples(time_ns: np.ndarray, field_ns: np.ndarray, field: np.ndarray) -> np.ndarray:
    """(N, 3) the last reading within each interval (time[k-1], time[k]]; NaN where none.

    Args:
        time_ns: (N + 1,) ends of intervals, the first one the beginning.
        field_ns: (M,) ascending.
        field: (M, 3).
    """
    out = np.full((len(time_ns) - 1, 3), np.nan)
    interval = np.searchsorted(time_ns, field_ns, side="left") - 1
    inside = (interval >= 0) & (interval < len(out))
    out[interval[inside]] = field[inside]
    return out


def _filled(values: np.ndarray, blocks: int, n: int, blank: Any) -> np.ndarray:
    rest = blocks * n - len(values)
    pad = np.full((rest, *values.shape[1:]), blank)
    return np.concatenate([values, pad]).reshape(blocks, n, *values.shape[1:])


def prepare(dataset: Dataset, parameters: Replay) -> Prepared:
    """Integrate the samples in blocks, align, and say at which blocks what is known.

    Raises:
        ValueError: the log cannot be used; the sentence says why.
    """
    p = parameters
    imu, full, counts = whole_samples(to_ned_frd(dataset.imu), p.gyro, p.accelerometer)
    increments, _ = from_imu(as_means(imu) if p.update.samples == "means" else imu)
    dt, theta, dv = (np.asarray(a, dtype=float) for a in increments[:3])
    field = np.full_like(theta, np.nan)
    counts |= {"field_missing": 0, "field_implausible": 0}
    if dataset.mag is not None and p.use_magnetometer != "never":
        field_ns, readings, found = calibrated(dataset.mag, p.magnetometer)
        field = at_samples(imu.time_ns, field_ns, readings)
        counts |= found

    usual = float(np.median(dt))
    n = max(1, round(p.update.block / usual))
    whole = -(-len(dt) // n)
    blocks = -(-whole // _PACK) * _PACK
    samples = Samples(
        _filled(dt, blocks, n, 0.0),
        _filled(theta, blocks, n, 0.0),
        _filled(dv, blocks, n, 0.0),
        _filled(field, blocks, n, np.nan),
    )
    integrals = integrate(samples)
    rate, force = theta / dt[:, None], dv / dt[:, None]
    quiet = still_samples(dt, rate, force, p.rest)
    still = np.all(_filled(quiet, blocks, n, True), axis=1)

    gap = np.where(dt > p.update.gap * usual, dt, 0.0)
    lost = _filled(gap + dt * (full[1:] | full[:-1]), blocks, n, 0.0).sum(axis=1)
    counts["imu_gaps"] = int(np.sum(gap > 0.0))
    time = np.asarray(integrals.dt_s)
    falling = np.linalg.norm(np.asarray(integrals.dv), axis=1) < (
        _FALLING * p.accelerometer.gravity * time
    )
    counts["blocks_in_free_fall"] = int(np.sum(falling))
    fall = np.where(falling, p.accelerometer.gravity * time, 0.0)
    u = Block(
        *(np.asarray(a) for a in integrals[:6]),
        still=still.astype(float),
        lost_turn=np.minimum(p.update.gap_rate * lost, np.pi),
        lost_dv=np.hypot(p.update.gap_accel * lost, fall),
    )
    look = first_look(dt, theta, dv, field, p.start, p.accelerometer)
    y, aux = _measurements(integrals, u, still, parameters)
    time_s = (imu.time_ns - imu.time_ns[0]) * 1e-9
    ends = np.minimum((np.arange(whole) + 1) * n, len(dt))
    return Prepared(
        time_s=time_s,
        time_ns=np.asarray(imu.time_ns),
        samples=samples,
        used=len(dt),
        epoch_s=time_s[ends],
        start=first_belief(look, parameters),
        look=look,
        u=u,
        y=y,
        aux=aux,
        still=still[:whole],
        counts=counts,
    )


def first_belief(look: FirstLook, parameters: Replay) -> Belief:
    """The belief at the first sample, uncorrelated."""
    p = parameters
    mean = MargState(
        q_nb=Rotation(jnp.asarray(look.q_nb)),
        v_n=jnp.zeros(3),
        p_n=jnp.zeros(3),
        gyro_bias=jnp.zeros(3),
        gyro_gain=jnp.zeros((3, 3)),
        accel_bias=jnp.zeros(3),
        declination=jnp.zeros(()),
        field=jnp.asarray(look.field_t),
    )
    known = bool(np.any(look.field_t != 0.0))
    sigma = [
        [look.tilt_rad, look.tilt_rad, look.heading_rad],
        [p.rest.velocity * 10.0 if look.still else 2.0 * p.travel.velocity] * 3,
        [p.travel.place] * 3,
        [p.gyro.bias] * 3,
        [p.gyro.gain] * 9,
        [p.accelerometer.bias] * 3,
        # North is the field of the start, so its declination is none but for a first noise.
        [p.magnetometer.declination / (20.0 if look.still else 2.0)],
        [p.magnetometer.noise if known else p.magnetometer.most] * 2,
    ]
    return Belief(mean, jnp.diag(jnp.concatenate([jnp.asarray(s) for s in sigma])))


def _measurements(
    integrals: Integrals, u: Block, still: np.ndarray, parameters: Replay
) -> tuple[dict[str, Any], dict[str, Any]]:
    """What is known at the end of each block; NaN where nothing is."""
    p, time = parameters, np.asarray(integrals.dt_s)
    blocks, clock = len(time), np.cumsum(time)
    known = every(clock, time > 0.0, p.travel.every)
    travel = np.full((blocks, 6), np.nan)
    still = still & (time > 0.0)
    travel[still, :3] = 0.0
    travel[known] = 0.0
    # Noise that lasts is thinned out: it must be new at each reading to be what the filter thinks.
    rate = _mean_rate(u)
    y: dict[str, Any] = {
        TRAVEL: travel,
        REST_RATE: np.where(still[:, None], np.zeros((blocks, 3)), np.nan),
    }
    aux: dict[str, Any] = {TRAVEL: still.astype(float), REST_RATE: rate}
    if p.use_magnetometer != "never":
        field = np.asarray(integrals.field_b)
        there = np.all(np.isfinite(field), axis=1)
        look = every(clock, there & ~still, p.travel.every)
        y[MAGNETOMETER] = (
            Angle(np.where(look, 0.0, np.nan)),
            np.where(look[:, None], np.zeros((blocks, 2)), np.nan),
        )
        aux[MAGNETOMETER] = np.where(there[:, None], field, np.array([1e-5, 0.0, 0.0]))
    return y, aux


def _mean_rate(u: Block) -> np.ndarray:
    """(K, 3) rad/s, mean over each block, from its rotation; meant for rest."""
    q = np.asarray(u.turn)
    vector = 2.0 * q[:, 1:] * np.sign(q[:, :1])
    dt = np.asarray(u.dt_s)[:, None]
    return np.where(dt > 0.0, vector / np.where(dt > 0.0, dt, 1.0), 0.0)


def every(clock_s: np.ndarray, able: np.ndarray, interval_s: float) -> np.ndarray:
    """Which blocks to take so that about `interval_s` lies between two; the first able one on."""
    out = np.zeros(len(clock_s), dtype=bool)
    due = -np.inf
    for k in np.flatnonzero(able):
        if clock_s[k] >= due:
            out[k] = True
            due = clock_s[k] + interval_s * (1.0 - 1e-9)
    return out
