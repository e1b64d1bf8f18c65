"""Batches: samples read together from a buffer, or stamps that have lost their digits.

Rows of a batch share one stamp, or have stamps that follow each other much faster than the sensor
samples. Their values are sound, so `spread` gives them evenly spaced times, as of a sensor at a
constant rate. The stamp of a batch read from a buffer is the time of its last row; if stamps are
multiples of a power of ten as long as a batch, decimals were lost, and the stamp is the middle of
its rows.
"""

from __future__ import annotations

import dataclasses
import itertools
from typing import TypeVar

import numpy as np

from robins.dataset import AttitudeTable, ImuTable, MagTable
from robins.logs.tables import Table

_FEWEST = 20  # rows in a table
_SHARED = 0.05  # share of rows with the stamp of the previous row
_BURST = 0.3  # share of rows that follow the previous one much faster than the mean
_FAST = 8.0  # ratio for "much faster"
_BLOCK = 64  # rows of a local mean, insensitive to gaps
_LOST = 0.75  # excess interval, in intervals of batches, of a lost batch
_AROUND = 15  # batches on each side over which stamps are averaged
_ENOUGH = 8  # batches that suffice to find the rate
_VALUES = {ImuTable: ("gyro", "accel"), MagTable: ("field_t",), AttitudeTable: ("q_nb",)}
AnyTable = TypeVar("AnyTable", bound=Table)


def batches_of(table: Table) -> np.ndarray | None:
    """First row (b,) of each batch; None if rows do not come in batches.

    Receivers and paths stamp each row, so only tables of sensors are examined. A row that repeats
    the previous values is not counted as a sample.
    """
    if type(table) not in _VALUES or len(table) < _FEWEST:
        return None
    step = np.diff(table.time_ns)
    together = step == 0
    if together.mean() < _SHARED:
        width = min(_BLOCK, len(step) // 4)
        means = np.diff(table.time_ns[::width]) / width
        together = (step >= 0) & (step < np.median(means) / _FAST)
        if together.mean() < _BURST:
            return None
    row = np.flatnonzero(together)
    values = np.nan_to_num(np.hstack([getattr(table, name) for name in _VALUES[type(table)]]))
    changed = (values[row + 1] != values[row]).any(axis=1)
    first = np.concatenate([[0], np.flatnonzero(~together) + 1])
    return first if changed.mean() > 0.5 and len(first) > 1 else None


def resolution_ns(time_ns: np.ndarray) -> int:
    """Largest step [ns] of which all differences between stamps are multiples."""
    return int(np.gcd.reduce(time_ns - time_ns[0]))


def spread(table: AnyTable) -> AnyTable:
    """Table with the rows of each batch spread evenly in time; unchanged without batches.

    Between lost batches the rate is that of rows over time, and times follow the mean of stamps
    over several batches: a single stamp is late, or rounded, by up to a batch.
    """
    first = batches_of(table)
    if first is None:
        return table
    sizes = np.diff(first, append=len(table))
    last = first + sizes - 1
    begin = int(table.time_ns[last[0]])
    since = table.time_ns[last] - begin
    apart = np.diff(since)
    batch = np.median(apart)
    behind = apart - sizes[1:] * np.median(apart / sizes[1:])
    behind[-1] -= batch  # the recording may end within a batch
    broken = (behind > _LOST * batch) | (apart < 0)
    whole = ~broken
    usual = float(apart[whole].sum() / sizes[1:][whole].sum()) if whole.any() else float(batch)
    rounded = resolution_ns(since)
    decimals = 2 * rounded > batch and str(rounded).strip("0") == "1"
    late = 0.5 * (rounded - usual) if decimals else 0.0
    times = np.empty(len(table))
    bounds = [0, *(np.flatnonzero(broken) + 1).tolist(), len(first)]
    for a, b in itertools.pairwise(bounds):
        # the stamp of an incomplete batch with lost decimals is not used
        known = slice(a, b - 1 if decimals and b - a > 1 else b)
        row = np.arange(first[a], last[b - 1] + 1)
        times[row] = _even(row, last[known], since[known].astype(float), usual)
    return dataclasses.replace(table, time_ns=np.rint(times + late).astype(np.int64) + begin)


def _even(row: np.ndarray, at: np.ndarray, since: np.ndarray, usual: float) -> np.ndarray:
    """Times of rows from the stamps of some of them, at a nearly constant rate."""
    x, begin = at - at.mean(), since[0]
    each = float(x @ (since - begin) / (x @ x)) if len(at) >= _ENOUGH else usual
    rest = np.concatenate([[0.0], np.cumsum(since - begin - each * (at - at[0]))])
    k = np.arange(len(at))
    low, high = np.maximum(k - _AROUND, 0), np.minimum(k + _AROUND + 1, len(at))
    mean = (rest[high] - rest[low]) / (high - low)
    return begin + each * (row - at[0]) + np.interp(row, at, mean)


def spread_counts(kind: str, table: AnyTable, even: AnyTable) -> dict[str, int]:
    """Number of rows whose time `spread` changed, in the form of counts of `clean`."""
    moved = int(np.count_nonzero(table.time_ns != even.time_ns))
    return {f"{kind}_spread": moved} if moved else {}


def spread_like(table: AnyTable, one: Table, even: Table) -> AnyTable:
    """Apply `spread` to a table, or take the times of one with the same stamps."""
    if np.array_equal(table.time_ns, one.time_ns):
        return table if even is one else dataclasses.replace(table, time_ns=even.time_ns)
    return spread(table)
