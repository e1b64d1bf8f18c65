"""Batches: samples read together from a buffer, or stamps that have lost their digits.

Rows of a batch have one stamp, or stamps that follow each other much faster than the sensor
measures. Nothing is wrong with their values, so they are spread evenly: `spread` gives each row the
time that a sensor at a constant rate takes it. The stamp of a batch read from a buffer is the time
of its last row; where stamps are whole multiples of a power of ten that is as long as a batch,
decimals were lost, and the stamp is the middle of its rows.
"""

from __future__ import annotations

import dataclasses
from typing import TypeVar

import numpy as np

from robins.dataset import AttitudeTable, ImuTable, MagTable
from robins.logs.tables import Table

_FEWEST = 20  # rows
_SHARED = 0.05  # share of rows with the stamp of the row before
_BURST = 0.3  # share of rows that follow the row before much faster than the mean
_FAST = 8.0  # how much faster that is
_BLOCK = 64  # rows over which the mean is taken, so that gaps do not count
_GAP = 1.5  # usual intervals of a row: where more have passed, batches are missing
_VALUES = {ImuTable: ("gyro", "accel"), MagTable: ("field_t",), AttitudeTable: ("q_nb",)}
AnyTable = TypeVar("AnyTable", bound=Table)


def batches_of(table: Table) -> np.ndarray | None:
    """First row (b,) of each batch; None where rows do not come in batches.

    Receivers and paths stamp each row, so only tables of sensors are looked at. A row that repeats
    the values before it is no sample of its own.
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
    """Largest step of which all differences between stamps are multiples."""
    return int(np.gcd.reduce(time_ns - time_ns[0]))


def spread(table: AnyTable) -> AnyTable:
    """The table with the rows of each batch spread evenly; itself where there are no batches."""
    first = batches_of(table)
    if first is None:
        return table
    sizes = np.diff(np.append(first, len(table)))
    stamps = table.time_ns[first + sizes - 1]
    apart = np.diff(stamps)
    each = apart / sizes[1:]
    usual = float(np.median(each))
    each = np.append(usual, np.where((each > 0.0) & (each < _GAP * usual), each, usual))
    rounded = resolution_ns(stamps)
    decimals = 2 * rounded > np.median(apart) and str(rounded).strip("0") == "1"
    late = (rounded - each) / 2.0 if decimals else np.zeros(len(each))
    if decimals:  # the recording ended within the last one
        late[-1] -= max(rounded - sizes[-1] * each[-1], 0.0)
    behind = np.repeat(first + sizes - 1, sizes) - np.arange(len(table))
    since = np.repeat(stamps - stamps[0], sizes) + np.repeat(late, sizes)
    time_ns = np.rint(since - behind * np.repeat(each, sizes)).astype(np.int64) + stamps[0]
    return dataclasses.replace(table, time_ns=time_ns)


def spread_counts(kind: str, table: AnyTable, even: AnyTable) -> dict[str, int]:
    """Number of rows that `spread` gave another time, as `robins.logs.clean` counts."""
    moved = int(np.count_nonzero(table.time_ns != even.time_ns))
    return {f"{kind}_spread": moved} if moved else {}


def spread_like(table: AnyTable, one: Table, even: Table) -> AnyTable:
    """`spread` of a table, with the times of another one that has the same stamps."""
    if np.array_equal(table.time_ns, one.time_ns):
        return table if even is one else dataclasses.replace(table, time_ns=even.time_ns)
    return spread(table)
