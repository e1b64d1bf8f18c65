"""Preparation of a log for the filter: finite samples, and the calibrated field."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from robins.dataset import Dataset, ImuTable
from robins.ins.frames import to_ned_frd, turned
from robins.ins.increments import usual_interval
from robins.systems.marg import model
from robins.systems.marg.parameters import MargMagnetometer, MargReplay
from robins.systems.marg.path import SamplePath, joined
from robins.systems.marg.saturation import levels
from robins.systems.marg.start import FilterStart
from robins.systems.replaying import LogPiece
from robins.systems.study import Case


@dataclass(frozen=True, kw_only=True)
class PreparedMargLog(LogPiece):
    """A log prepared for the filter; K blocks of n samples, N samples. The world is a `Case`."""

    time_ns: np.ndarray  # (N,) int64, of each sample
    samples: model.Samples
    rows: np.ndarray  # (K,) index of the last sample of each block
    look: FilterStart
    still: np.ndarray  # (K,) bool
    counts: dict[str, int]


def earth_field(
    field_t: np.ndarray, magnetometer: MargMagnetometer
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Calibrated readings (M, 3) [T], and masks (M,) of incomplete and of implausible ones."""
    missing = ~np.all(np.isfinite(field_t), axis=1)
    field = turned(np.array(magnetometer.matrix), field_t - np.array(magnetometer.offset))
    size = np.linalg.norm(np.where(missing[:, None], 0.0, field), axis=1)
    able = (size >= magnetometer.least) & (size <= magnetometer.most)
    return field, missing, ~missing & ~able


def at_samples(time_ns: np.ndarray, field_ns: np.ndarray, field: np.ndarray) -> np.ndarray:
    """Last reading (N, 3) within each interval (time[k-1], time[k]]; NaN where there is none.

    `time_ns` is (N + 1,), ascending, starting with the begin of the first interval; `field_ns` (M,)
    are the times of the readings (M, 3), ascending.
    """
    out = np.full((len(time_ns) - 1, 3), np.nan)
    interval = np.searchsorted(time_ns, field_ns, side="left") - 1
    inside = (interval >= 0) & (interval < len(out))
    out[interval[inside]] = field[inside]
    return out


def prepare(dataset: Dataset, parameters: MargReplay) -> PreparedMargLog:
    """Prepare a log by `SamplePath`, as one chunk.

    Raises:
        ValueError: the log cannot be used; the message gives the reason.
    """
    table = to_ned_frd(dataset.imu)
    finite = np.all(np.isfinite(table.gyro), axis=1) & np.all(np.isfinite(table.accel), axis=1)
    columns = ("time_ns", "gyro", "accel", *(() if table.rows is None else ("rows",)))
    imu: ImuTable = replace(table, **{name: getattr(table, name)[finite] for name in columns})
    if len(imu) < 2:
        raise ValueError(f"orientation needs two whole inertial samples; this log has {len(imu)}")
    time_ns, gyro = np.asarray(imu.time_ns), np.asarray(imu.gyro, float)
    field, found = np.full(gyro.shape, np.nan), {"field_missing": 0, "field_implausible": 0}
    if dataset.mag is not None and parameters.use_magnetometer != "never":
        mag = to_ned_frd(dataset.mag)
        readings, *none = earth_field(mag.field_t, parameters.magnetometer)
        found = dict(zip(found, (int(np.sum(one)) for one in none), strict=True))
        able = ~np.any(none, axis=0)
        field[1:] = at_samples(time_ns, mag.time_ns[able], readings[able])
    dt = np.diff(time_ns) * 1e-9
    ends = levels(gyro, float(np.median(dt))) if imu.kind == "rate" else None
    path = SamplePath(parameters, usual_interval(dt), imu.kind, ends)
    steps = joined([*path.push(time_ns, np.hstack([gyro, imu.accel, field])), *path.finish()])
    found_start = path.start(is_complete=True)
    assert found_start is not None
    look, belief = found_start
    rows = np.minimum((np.arange(len(steps.still)) + 1) * path.n, len(dt))
    counts = ("imu_saturated", "imu_bridged", "imu_frozen", "imu_gaps", "blocks_in_free_fall")
    return PreparedMargLog(
        world=Case(belief, steps.u, steps.y, steps.aux, None),
        begin_s=0.0,
        epoch_s=(time_ns[rows] - time_ns[0]) * 1e-9,
        time_ns=time_ns,
        samples=steps.samples,
        rows=rows,
        look=look,
        still=steps.still,
        counts={"imu_missing": int(np.sum(~finite))}
        | {name: path.counts[name] for name in counts}
        | found,
    )
