"""A log made ready for the filter: calibrated field, blocks, alignment, measurements."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation as SciRotation

from robins.dataset import Dataset, ImuTable, MagTable
from robins.filters import Belief
from robins.ins.alignment import triad
from robins.ins.frames import to_ned_frd
from robins.ins.increments import Increments, after_gap, from_imu, usual_interval
from robins.manifold import Angle
from robins.program.evaluated import evaluated
from robins.rotation import Rotation
from robins.systems.marg import model
from robins.systems.marg.parameters import Accelerometer, Gyro, Magnetometer, Replay
from robins.systems.marg.rest import RestFound, at_rest
from robins.systems.marg.saturation import bridged
from robins.systems.replaying import Piece
from robins.systems.study import Case

_PACK = 512  # blocks are filled up to a multiple of this, so that logs alike compile once
_FALLING = 0.3  # of gravity: below it nothing holds the unit up, and tilt cannot be seen
# a unit at rest, by its first samples
_STILL_RATE = np.radians(8.0)  # rad/s, mean length of the rate
_STILL_SPREAD = np.radians(1.0)  # rad/s, mean length of its changes
_STILL_FORCE = 0.5  # m/s^2


class FirstLook(NamedTuple):
    """Where the filter begins."""

    q_nb: np.ndarray  # (4,)
    field_t: np.ndarray  # (2,) T along the horizontal and down; zeros where no field was seen
    tilt_rad: float
    heading_rad: float
    still: bool
    sentence: str


@dataclass(frozen=True, kw_only=True)
class Prepared(Piece):
    """A log as the filter takes it; K blocks of n samples, B of them not padding, N samples.

    The world is a `Case`; epochs of padding repeat the last.
    """

    time_ns: np.ndarray  # (N,) int64, of each sample, from the first one on
    samples: model.Samples
    rows: np.ndarray  # (B,) the sample that each block ends with
    look: FirstLook
    still: np.ndarray  # (B,) bool
    counts: dict[str, int]


class Whole(NamedTuple):
    """The samples that are numbers."""

    imu: ImuTable  # N samples, peaks beyond the range of a gyro put back
    full: np.ndarray  # (N, 3) bool, a gyro at the end of its range
    doubt: np.ndarray  # (N, 3) rad/s, spread of what was put back; NaN where nothing
    accel_full: np.ndarray  # (N,) bool
    counts: dict[str, int]


def whole_samples(imu: ImuTable, gyro: Gyro, accelerometer: Accelerometer) -> Whole:
    """The samples that are numbers, and which of them touch the end of their range.

    Raises:
        ValueError: fewer than two samples are left.
    """
    finite = np.all(np.isfinite(imu.gyro), axis=1) & np.all(np.isfinite(imu.accel), axis=1)
    columns = ("time_ns", "gyro", "accel", *(() if imu.rows is None else ("rows",)))
    kept = replace(imu, **{name: getattr(imu, name)[finite] for name in columns})
    if len(kept) < 2:
        raise ValueError(f"orientation needs two whole inertial samples; this log has {len(kept)}")
    full = np.zeros(kept.gyro.shape, dtype=bool)
    doubt, accel_full = np.full(full.shape, np.nan), np.zeros(len(kept), dtype=bool)
    if kept.kind == "rate":  # increments have no range
        seconds = (kept.time_ns - kept.time_ns[0]) * 1e-9
        rate, full, doubt = bridged(seconds, np.asarray(kept.gyro, float), gyro.range)
        kept = replace(kept, gyro=rate)
        accel_full = np.any(np.abs(kept.accel) >= 0.99 * accelerometer.range, axis=1)
    touched = np.any(full, axis=1) | accel_full
    back = np.any(full & np.isfinite(doubt), axis=1)
    counts = {
        "imu_missing": int(np.sum(~finite)),
        "imu_saturated": int(np.sum(touched)),
        "imu_bridged": int(np.sum(back)),
    }
    return Whole(kept, full, doubt, accel_full, counts)


def as_means(imu: ImuTable, usual_s: float | None = None) -> ImuTable:
    """Rates as increments of the sampling intervals that end with them.

    What a MEMS chip puts out is the mean over its last sampling interval, or later still for its
    filters; to read it as the rate of that instant would run ahead of the motion by half of one.
    The usual interval is that of the table unless it is given.
    """
    if imu.kind == "increment":
        return imu
    dt = np.diff(imu.time_ns) * 1e-9
    usual_s = usual_interval(dt) if usual_s is None else usual_s
    own = np.where(after_gap(dt, usual_s), usual_s, dt)
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
    """(N, 3) the last of readings (M, 3) within each interval (time[k-1], time[k]]; NaN where none.

    Times are (N + 1,), the first one the beginning, and (M,) of the readings, ascending.
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
    imu, full, doubt, accel_full, counts = whole_samples(
        to_ned_frd(dataset.imu), p.gyro, p.accelerometer
    )
    made, _ = from_imu(as_means(imu) if p.update.samples == "means" else imu)
    increments = Increments(*(np.asarray(a, dtype=float) for a in made[:3]))
    dt, theta, dv = increments[:3]
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
    samples = model.Samples(
        _filled(dt, blocks, n, 0.0),
        _filled(theta, blocks, n, 0.0),
        _filled(dv, blocks, n, 0.0),
        _filled(field, blocks, n, np.nan),
    )
    integrals, block_field = model.integrate(samples)
    dt_s = np.asarray(integrals.dt_s)
    rest = at_rest(dt_s, mean_rate(integrals), mean_force(integrals), block_field, p.rest)
    still = rest.still

    turn, lost, gaps = not_sampled(dt, full, doubt, accel_full, usual, p)
    counts["imu_gaps"] = gaps
    lost_turn, lost = (_filled(a, blocks, n, 0.0).sum(axis=1) for a in (turn, lost))
    u, falling = inputs(integrals, still, lost_turn, lost, p)
    counts["blocks_in_free_fall"] = int(np.sum(falling))
    look = first_look(increments, field, parameters)
    ends = np.minimum((np.arange(blocks) + 1) * n, len(dt))
    return Prepared(
        world=Case(
            first_belief(look, parameters, rest),
            u,
            *measurements(integrals, block_field, rest, parameters, Pace()),
            None,
        ),
        begin_s=0.0,
        epoch_s=(imu.time_ns[ends] - imu.time_ns[0]) * 1e-9,
        time_ns=np.asarray(imu.time_ns),
        samples=samples,
        rows=ends[:whole],
        look=look,
        still=still[:whole],
        counts=counts,
    )


def not_sampled(
    dt: np.ndarray,
    full: np.ndarray,
    doubt: np.ndarray,
    accel_full: np.ndarray,
    usual: float,
    parameters: Replay,
) -> tuple[np.ndarray, np.ndarray, int]:
    """Spread of the turn that intervals did not show (N, 3) [rad], seconds of specific force that
    they did not show (N,), and how many are gaps.

    Args:
        dt: (N,) s, intervals between N + 1 samples.
        full: (N + 1, 3) bool, a gyro at the end of its range, and
        doubt: (N + 1, 3) rad/s, spread of what was put back; NaN where nothing.
        accel_full: (N + 1,) bool.
        usual: s, sampling interval.
        parameters: of gaps.
    """
    p = parameters.update
    gap = np.where(dt > p.gap * usual, dt, 0.0)
    known = np.isfinite(doubt)
    unknown = full & ~known
    lost = gap + dt * (accel_full[1:] | accel_full[:-1])
    # what a gyro at its end did not say, about its own axis; what all samples of a gap did not
    turn = p.gap_rate * (gap[:, None] + dt[:, None] * (unknown[1:] | unknown[:-1]))
    turn = turn + dt[:, None] * np.where(known, doubt, 0.0)[1:]
    return turn, lost, int(np.sum(gap > 0.0))


def inputs(
    integrals: model.Integrals,
    still: np.ndarray,
    lost_turn: np.ndarray,
    lost_s: np.ndarray,
    parameters: Replay,
) -> tuple[model.Block, np.ndarray]:
    """What the motion takes of K blocks, and which of them fall freely (K,) bool.

    Args:
        integrals: of the blocks.
        still: (K,) bool.
        lost_turn: (K, 3) rad, spread of the turn that was not sampled.
        lost_s: (K,) s, for how long the specific force was not sampled.
        parameters: of gaps, and gravity.
    """
    weight = parameters.accelerometer.gravity * np.asarray(integrals.dt_s)
    falling = np.linalg.norm(np.asarray(integrals.dv), axis=1) < _FALLING * weight
    fall = np.where(falling, weight, 0.0)
    u = model.Block(
        integrals,
        still=still.astype(float),
        lost_turn=np.minimum(lost_turn, np.pi),
        lost_dv=np.hypot(parameters.update.gap_accel * lost_s, fall),
    )
    return u, falling


def attitude_of(force_b: np.ndarray, field_b: np.ndarray | None) -> np.ndarray:
    """q_nb (4,) for which specific force points up and the field north.

    Without a field, or with one along the vertical, some heading.
    """
    level = np.eye(3)[np.argmin(np.abs(force_b))]
    north = level if field_b is None else field_b
    across = np.linalg.norm(np.cross(force_b / np.linalg.norm(force_b), north))
    C_nb = triad(force_b, north if across > 1e-3 * np.linalg.norm(north) else level)
    return np.asarray(evaluated(Rotation.from_dcm, C_nb).wxyz)


def first_look(increments: Increments, field_b: np.ndarray, parameters: Replay) -> FirstLook:
    """Align on the first samples: a short while of rest, or a longer one of motion.

    In motion the gyros carry specific force and field back to the first sample, so that a swing
    averages out.

    Args:
        increments: dt (N,) s, theta (N, 3) rad, dv (N, 3) m/s.
        field_b: (N, 3) T, NaN where none.
        parameters: of the start, and gravity.
    """
    dt, theta, dv = increments[:3]
    start, time = parameters.start, np.cumsum(dt)
    window = max(int(np.searchsorted(time, start.still, side="right")), 1)
    rate, force = theta[:window] / dt[:window, None], dv[:window] / dt[:window, None]
    still = bool(
        np.mean(np.linalg.norm(rate, axis=1)) < _STILL_RATE
        and np.mean(np.abs(rate - rate.mean(axis=0))) < _STILL_SPREAD
        and np.max(np.std(force, axis=0)) < _STILL_FORCE
    )
    if not still:
        window = max(int(np.searchsorted(time, start.moving, side="right")), 1)
    turned = _turned(theta[:window])
    force = np.sum(turned[:-1].apply(dv[:window]), axis=0) / time[window - 1]
    there = np.all(np.isfinite(field_b[:window]), axis=1)
    tilt = start.tilt if still else start.tilt_moving
    size, how = float(np.linalg.norm(force)), f"over {float(time[window - 1]):.2g} s"
    if not 0.5 < size / parameters.accelerometer.gravity < 1.5:
        how += f"; the mean specific force is {size:.2f} m/s^2, so the tilt is hardly known"
        tilt = np.pi / 2.0
        force = force if size > 1e-3 else np.array([0.0, 0.0, -1.0])
    how = f"{'at rest' if still else 'in motion'}, {how}"
    if not np.any(there):
        sentence = f"Levelled {how}; there is no field, so the heading is counted from the start."
        return FirstLook(attitude_of(force, None), np.zeros(2), tilt, np.pi, still, sentence)
    field = np.mean(turned[1:].apply(np.where(there[:, None], field_b[:window], 0.0)), axis=0)
    field = field * window / np.sum(there)
    q_nb = attitude_of(force, field)
    north, _, down = SciRotation.from_quat(np.roll(q_nb, -1)).apply(field)
    dip = np.degrees(np.arctan2(down, north))
    sentence = (
        f"Aligned {how}: the field there, {np.linalg.norm(field) * 1e6:.1f} uT at a dip of "
        f"{dip:.1f} deg, is north."
    )
    heading = start.heading if still else start.heading_moving
    return FirstLook(q_nb, np.array([north, down]), tilt, heading, still, sentence)


def _turned(theta: np.ndarray) -> SciRotation:
    """Attitude before each interval and after the last, against the first."""
    out = [SciRotation.identity()]
    for step in SciRotation.from_rotvec(theta):
        out.append(out[-1] * step)
    return SciRotation.concatenate(out)


def first_belief(look: FirstLook, parameters: Replay, rest: RestFound | None = None) -> Belief:
    """The belief at the first sample.

    Only heading and declination are correlated: what the field of the start is turned by against
    the mean of the places to come, the heading is wrong by.

    Args:
        look: at the first samples.
        parameters: of the start and of what was not looked at.
        rest: where the log begins with rest, the mean rate read is the bias.
    """
    p = parameters
    bias, bias_sigma = jnp.zeros(3), p.gyro.bias
    if rest is not None and rest.first is not None:
        bias, bias_sigma = jnp.asarray(rest.first), rest.first_sigma
    mean = model.MargState(
        q_nb=Rotation(jnp.asarray(look.q_nb)),
        v_n=jnp.zeros(3),
        p_n=jnp.zeros(3),
        gyro_bias=bias,
        gyro_gain=jnp.zeros((3, 3)),
        accel_bias=jnp.zeros(3),
        declination=jnp.zeros(()),
        field=jnp.asarray(look.field_t),
    )
    known = bool(np.any(look.field_t != 0.0))
    # where north is the field of the start, its declination is none but for a first noise
    bend = p.magnetometer.declination
    if not known or p.start.north == "start":
        bend = bend / (20.0 if look.still else 2.0)
    sigma = [
        [look.tilt_rad, look.tilt_rad, look.heading_rad],
        [p.rest.velocity * 10.0 if look.still else 2.0 * p.travel.velocity] * 3,
        [p.travel.place] * 3,
        [bias_sigma] * 3,
        [p.gyro.gain] * 9,
        [p.accelerometer.bias] * 3,
        [bend],
        [p.magnetometer.noise if known else p.magnetometer.most] * 2,
    ]
    factor = np.diag(np.concatenate([np.asarray(s, dtype=float) for s in sigma]))
    if known and p.start.north == "mean":
        heading = float(np.hypot(look.heading_rad, bend))
        factor[model.HEADING, model.HEADING] = heading
        factor[model.DECLINATION, model.HEADING] = bend**2 / heading
        factor[model.DECLINATION, model.DECLINATION] = bend * look.heading_rad / heading
    return Belief(mean, jnp.asarray(factor))


class Pace:
    """When travel and field were seen last, so that they are seen once in an interval."""

    def __init__(self) -> None:
        """Nothing was seen."""
        self.clock_s = 0.0  # end of the last block
        self.due_s = {model.TRAVEL: -np.inf, model.MAGNETOMETER: -np.inf}

    def take(self, name: str, clock_s: np.ndarray, able: np.ndarray, every_s: float) -> np.ndarray:
        """(K,) bool: which blocks to take so that about `every_s` lies between two."""
        out = np.zeros(len(clock_s), dtype=bool)
        for k in np.flatnonzero(able):
            if clock_s[k] >= self.due_s[name]:
                out[k] = True
                self.due_s[name] = clock_s[k] + every_s * (1.0 - 1e-9)
        return out


def measurements(
    integrals: model.Integrals,
    field_b: np.ndarray,
    rest: RestFound,
    parameters: Replay,
    pace: Pace,
) -> tuple[dict[str, Any], dict[str, Any]]:
    """What is known at the end of each block; NaN where nothing is.

    The pace goes on with these blocks.
    """
    p, time = parameters, np.asarray(integrals.dt_s)
    blocks, clock = len(time), np.cumsum(np.concatenate([[pace.clock_s], time]))[1:]
    pace.clock_s = float(clock[-1])
    still = rest.still & (time > 0.0)
    travel = np.full((blocks, 6), np.nan)
    travel[still, :3] = 0.0
    # Noise that lasts is thinned out: it must be new at each reading to be what the filter thinks.
    travel[pace.take(model.TRAVEL, clock, time > 0.0, p.travel.every)] = 0.0
    y: dict[str, Any] = {
        model.TRAVEL: travel,
        model.REST_RATE: np.where(still[:, None], np.zeros((blocks, 3)), np.nan),
    }
    aux: dict[str, Any] = {
        model.TRAVEL: still.astype(float),
        model.REST_RATE: np.concatenate([mean_rate(integrals), rest.sigma[:, None]], axis=1),
    }
    if p.use_magnetometer != "never":
        there = np.all(np.isfinite(field_b), axis=1)
        look = pace.take(model.MAGNETOMETER, clock, there & ~still, p.travel.every)
        y[model.MAGNETOMETER] = (
            Angle(np.where(look, 0.0, np.nan)),
            np.where(look[:, None], np.zeros((blocks, 2)), np.nan),
        )
        aux[model.MAGNETOMETER] = np.where(there[:, None], field_b, np.array([1e-5, 0.0, 0.0]))
    return y, aux


def mean_rate(integrals: model.Integrals) -> np.ndarray:
    """(K, 3) rad/s, mean over each block, from its rotation; meant for rest."""
    q, dt = np.asarray(integrals.turn), np.asarray(integrals.dt_s)[:, None]
    vector = 2.0 * q[:, 1:] * np.sign(q[:, :1])
    return np.where(dt > 0.0, vector / np.where(dt > 0.0, dt, 1.0), 0.0)


def mean_force(integrals: model.Integrals) -> np.ndarray:
    """(K, 3) m/s^2, mean specific force of each block."""
    dt = np.asarray(integrals.dt_s)[:, None]
    return np.asarray(integrals.dv) / np.where(dt > 0.0, dt, 1.0)
