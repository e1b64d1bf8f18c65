"""Tools of the doctor: tables without bad rows, their usual step, their quiet stretches."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from robins.dataset import AttitudeTable, ImuTable, MagTable
from robins.ins.increments import own_intervals
from robins.logs.findings import SEVERITIES, Finding, Severity, Value, make_finding
from robins.logs.ordering import increasing
from robins.logs.tables import Table

_WINDOW_S = 1.0
_NONSENSE = 1e9
_REST = 0.01  # relative scatter of |specific force| in a window at rest
_LEAST_REST_S = 3.0
_STEADY = 0.003  # relative change of the specific force from one window at rest to the next


def name_of(table: Table) -> str:
    """Name of a table in sentences: its file without the folder, or its type.

    A magnetometer is often in the file of its IMU, so the part of the file is named too.
    """
    if not table.source:
        return type(table).__name__
    part = {MagTable: " (magnetic field)", AttitudeTable: " (attitude)"}
    return Path(table.source).name + part.get(type(table), "")


def place(table: Table, row: int) -> str:
    """Place of a row: its line in the file if known, else its time since the first row."""
    rows = getattr(table, "rows", None)
    if rows is not None:
        return f"line {rows[row]}"
    since = (int(table.time_ns[row]) - int(table.time_ns[0])) * 1e-9
    return f"{since:.3f} s after the start"


def finding(
    severity: Severity, table: Table, code: str, value: Value, row: int | None = None
) -> Callable[[str], Finding]:
    """Maker of a finding about a table or a row of it, see `make_finding`."""
    where = "" if row is None else place(table, row)
    return make_finding(severity, code, table.source, where, value, name_of(table))


error, warning, note = (partial(finding, severity) for severity in SEVERITIES)


def usual_step_s(time_ns: np.ndarray) -> float:
    """Median of the positive steps of time [s]; NaN if there is none."""
    step = np.diff(time_ns)
    step = step[step > 0]
    return float(np.median(step)) * 1e-9 if len(step) else np.nan


def median_of(values: np.ndarray) -> float:
    """Median of the finite numbers; NaN if there are none."""
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if len(finite) else np.nan


def longest_run(same: np.ndarray) -> tuple[int, int]:
    """First index and length of the longest stretch of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], same.astype(np.int8), [0]])))
    starts, lengths = edges[::2], np.diff(edges)[::2]
    if not len(starts):
        return 0, 0
    k = int(np.argmax(lengths))
    return int(starts[k]), int(lengths[k])


class ImuSignal(NamedTuple):
    """An IMU table as rates, good rows only, in the order of time."""

    rows: np.ndarray  # (n,) index into the table
    time_s: np.ndarray  # (n,) since the first sample
    gyro: np.ndarray  # (n, 3) rad/s if the units are as labelled
    accel: np.ndarray  # (n, 3) m/s^2, likewise
    step_s: float  # mean step without gaps


def signal_of(imu: ImuTable) -> ImuSignal | None:
    """The usable samples of a table; None if there are fewer than ten."""
    # Wide enough for deg/h and milli-g, so that wrong units are detected; squares do not overflow.
    good = (np.abs(np.hstack([imu.gyro, imu.accel])) < _NONSENSE).all(axis=1)
    rows = np.flatnonzero(good)
    rows = rows[increasing(imu.time_ns[rows])]
    if len(rows) < 10:
        return None
    time_s = (imu.time_ns[rows] - imu.time_ns[rows[0]]) * 1e-9
    steps = np.diff(time_s)
    step_s = float(np.mean(steps[steps < 2.5 * np.median(steps)]))
    per = np.ones((len(rows), 1))
    if imu.kind == "increment":
        per[:, 0] = own_intervals(steps, imu.gyro[rows], imu.accel[rows])
    return ImuSignal(rows, time_s, imu.gyro[rows] / per, imu.accel[rows] / per, step_s)


class Windows(NamedTuple):
    """Stretches of about one second."""

    first: np.ndarray  # (w,) index of the first sample of each in the signal
    gyro: np.ndarray  # (w, 3) mean
    accel: np.ndarray  # (w, 3) mean
    restless: np.ndarray  # (w,) scatter of |gyro - mean|
    at_rest: np.ndarray  # (w,) bool, the specific force hardly changes, in any unit
    calm: np.ndarray  # (w,) bool, those at rest, or, if there are none, the quietest tenth


def usual_force(windows: Windows) -> float:
    """Median magnitude of the specific force in calm windows."""
    return float(np.median(np.linalg.norm(windows.accel[windows.calm], axis=-1)))


def _long_enough(low: np.ndarray, change: np.ndarray, least: int) -> np.ndarray:
    """Mask (w,) of windows of low scatter in runs of at least `least` without a change."""
    if len(low) < least:
        return np.zeros_like(low)
    joined = np.where(change & low[1:] & low[:-1], 1, 0)
    row = sliding_window_view(joined, least - 1).all(axis=1)  # for runs that begin at each window
    return np.convolve(row, np.ones(least)) > 0


def windows_of(signal: ImuSignal) -> Windows:
    """Cut a signal into windows of one second, or of ten samples if that is longer."""
    n = min(max(round(_WINDOW_S / signal.step_s), 10), len(signal.rows))
    count = len(signal.rows) // n

    def cut(values: np.ndarray) -> np.ndarray:
        return values[: count * n].reshape(count, n, *values.shape[1:])

    gyro, accel = cut(signal.gyro), cut(signal.accel)
    force, size = accel.mean(axis=1), np.linalg.norm(accel, axis=-1)
    mean = size.mean(axis=1)
    # A smooth drive scatters as little as rest, but its specific force changes with every turn, if
    # not within a second or two.
    change = np.linalg.norm(np.diff(force, axis=0), axis=-1) < _STEADY * mean[1:]
    scatter = size.std(axis=1)
    low = scatter < _REST * mean
    at_rest = _long_enough(low, change, max(2, round(_LEAST_REST_S / (n * signal.step_s))))
    return Windows(
        np.arange(count) * n,
        gyro.mean(axis=1),
        force,
        np.linalg.norm(gyro.std(axis=1), axis=-1),
        at_rest,
        at_rest if at_rest.any() else scatter <= np.percentile(scatter, 10.0),
    )
