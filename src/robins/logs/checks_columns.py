"""The doctor on single IMU columns: missing, stuck, saturated, coarse."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from robins.dataset import ImuTable
from robins.logs.findings import Finding
from robins.logs.quiet import error, usual_step_s, warning

_STUCK_S = 2.0
_STUCK_SAMPLES = 100
_SATURATED_RUN, _SATURATED_LONG = 3, 10
_COARSE = 64  # distinct values of a column
_FULL_SCALES = {
    "gyro": [np.deg2rad(v) for v in (125, 245, 250, 450, 500, 1000, 2000, 4000)],
    "accel": [9.80665 * v for v in (2, 4, 6, 8, 16, 24, 30, 32, 40)],
}


def check_columns(imu: ImuTable) -> Iterator[Finding]:
    """All findings about the six columns of an IMU table, each by itself."""
    if len(imu) < 2:
        return
    step_s = usual_step_s(imu.time_ns)
    for sensor in ("gyro", "accel"):
        for k, axis in enumerate("xyz"):
            name, column = f"{sensor}_{axis}", getattr(imu, sensor)[:, k]
            good = np.isfinite(column)
            if not good.all():
                yield _missing(imu, name, column, good)
            if np.count_nonzero(good) < 10:
                continue
            if np.ptp(column[good]) == 0.0:
                yield error(
                    imu,
                    "axis_stuck",
                    float(column[good][0]),
                    f"{name} is {column[good][0]:g} in every sample. A real sensor always has "
                    "noise: the axis is dead, not connected, or this is another column.",
                )
                continue
            yield from _stuck(imu, name, column, step_s)
            yield from _saturated(imu, sensor, name, column, good)
            yield from _coarse(imu, name, column, good)


def _missing(imu: ImuTable, name: str, column: np.ndarray, good: np.ndarray) -> Finding:
    first = int(np.argmin(good))
    bad = int(np.count_nonzero(~good))
    if bad == len(imu):
        return error(
            imu,
            "column_missing",
            bad,
            f"{name} is {column[0]} in every sample. The sensor was not recorded, or the columns "
            "are in another order; without it there is no inertial navigation.",
        )
    return warning(
        imu,
        "not_finite",
        bad,
        f"{name} is {column[first]} here, and not a number in {bad} samples in all. The sensor or "
        "the logger skipped them; `clean` refuses those samples and declares the gaps.",
        first,
    )


def longest_run(same: np.ndarray) -> tuple[int, int]:
    """First index and length of the longest stretch of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], same.astype(np.int8), [0]])))
    starts, lengths = edges[::2], np.diff(edges)[::2]
    if not len(starts):
        return 0, 0
    k = int(np.argmax(lengths))
    return int(starts[k]), int(lengths[k])


def _stuck(imu: ImuTable, name: str, column: np.ndarray, step_s: float) -> Iterator[Finding]:
    start, length = longest_run(np.diff(column) == 0.0)
    if length >= _STUCK_SAMPLES and length * step_s >= _STUCK_S:
        yield warning(
            imu,
            "axis_stuck_for_a_while",
            length,
            f"{name} stays at {column[start]:g} for {length + 1} samples ({length * step_s:.1f} s) "
            "from here. The sensor or its bus hung; a filter would take this for a perfect "
            "measurement, so cut the log here or refuse these samples.",
            start,
        )


def _saturated(
    imu: ImuTable, sensor: str, name: str, column: np.ndarray, good: np.ndarray
) -> Iterator[Finding]:
    values = column[good]
    middle = np.median(values)
    # A stop is an extreme met several times in a row that is far from the bulk, or held for long;
    # a coarse column holds its extremes for long without being stopped.
    fine = len(np.unique(values)) > _COARSE
    spread = np.subtract(*np.percentile(values, [95, 5])) / 3.3 + 1e-300
    for extreme in (float(values.max()), float(values.min())):
        start, length = longest_run(column == extreme)
        far = abs(extreme - middle) > 4.0 * spread
        if length < (_SATURATED_RUN if far else _SATURATED_LONG) or not (far or fine):
            continue
        total = int(np.count_nonzero(column == extreme))
        near = min(_FULL_SCALES[sensor], key=lambda scale: abs(abs(extreme) - scale))
        unit = "rad/s" if sensor == "gyro" else "m/s^2"
        usual = abs(abs(extreme) / near - 1.0) < 0.03
        range_ = f", a usual full scale ({near:.4g} {unit})" if usual else ""
        yield warning(
            imu,
            "saturated",
            extreme,
            f"{name} stops at {extreme:.6g}{range_} in {total} samples, {length} in a row here. "
            "The sensor is saturated and the motion beyond is lost; choose a larger range or damp "
            "the mounting, and expect a jump of attitude or velocity here.",
            start,
        )


def _coarse(imu: ImuTable, name: str, column: np.ndarray, good: np.ndarray) -> Iterator[Finding]:
    values = column[good]
    if len(values) < 1000:
        return
    distinct = np.unique(values)
    if len(distinct) <= _COARSE:
        step = float(np.median(np.diff(distinct)))
        yield warning(
            imu,
            "coarse",
            step,
            f"{name} takes only {len(distinct)} different values, {step:.3g} apart. The recording "
            "has too few bits or decimals; slow motion below one step is lost. Log with more "
            "digits or a smaller range.",
        )
