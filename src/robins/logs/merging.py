"""Merging of the samples of two sensors on one clock, and conversion between two clocks."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from robins.dataset import ImuTable
from robins.logs.findings import Findings, LogError, finding_reporter

_LONG = 5.0  # typical intervals; no interpolation across a longer one
_DRIFT, _STRAY_S = 2e-4, 1.0  # largest drift of a clock; largest deviation of a stamp that is used
_TREND_S = 60.0  # shortest span of stamps to find a drift


def are_halves(one: ImuTable, other: ImuTable) -> bool:
    """True if one has only rates and the other only specific forces; the rest is zero or NaN."""
    has = [[np.nan_to_num(v).any() for v in (t.gyro, t.accel)] for t in (one, other)]
    return sorted(has) == [[False, True], [True, False]]


def merged(gyro: ImuTable, accel: ImuTable, findings: Findings) -> ImuTable:
    """Rates of one table with the specific forces of another, on the clock of the rates.

    They may be given in either order. Specific forces are interpolated linearly. Samples outside
    their time span are omitted; across a gap of more than five of their intervals the specific
    force is missing (NaN).

    Args:
        gyro: rates; its specific forces are not used.
        accel: specific forces; its rates are not used.
        findings: receives a note.

    Raises:
        LogError: the two do not overlap in time.
    """
    if not np.nan_to_num(gyro.gyro).any():
        gyro, accel = accel, gyro
    force = interpolated(gyro.time_ns, accel.time_ns, accel.accel)
    ends = accel.time_ns.min(), accel.time_ns.max()
    inside = (gyro.time_ns >= ends[0]) & (gyro.time_ns <= ends[1])
    if not inside.any():
        cause = "rates and specific forces were recorded apart and share no time"
        raise LogError(gyro.source, cause, "are they of one recording?")
    finding_reporter(findings, "note", "sensors_merged", gyro.source, value=int((~inside).sum()))(
        "rates and specific forces were recorded apart; the forces are interpolated to the times "
        f"of the rates, and {(~inside).sum()} samples without both are left out."
    )
    rows = None if gyro.rows is None else gyro.rows[inside]
    now, turns = gyro.time_ns[inside], gyro.gyro[inside]
    return dataclasses.replace(gyro, time_ns=now, gyro=turns, accel=force[inside], rows=rows)


def interpolated(now_ns: np.ndarray, at_ns: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Values (m, 3) interpolated linearly at other times (n,); (n, 3).

    NaN outside their time span, and across a gap of more than five of their intervals.

    Args:
        now_ns: (n,) wanted times.
        at_ns: (m,) times of the values, in any order.
        values: (m, 3).
    """
    order = np.argsort(at_ns, kind="stable")
    at_ns, values = at_ns[order], values[order]
    now, at = (t - at_ns[0] for t in (now_ns, at_ns))
    columns = [np.interp(now, at, column, left=np.nan, right=np.nan) for column in values.T]
    found, apart = np.stack(columns, axis=-1), np.diff(at, append=at[-1])
    before = np.clip(np.searchsorted(at, now, side="right") - 1, 0, max(len(at) - 2, 0))
    found[(apart[before] > _LONG * np.median(apart)) & (now != at[before])] = np.nan
    return found


def gps_clock(
    file: str, local_ns: np.ndarray, gps_ns: np.ndarray, findings: Findings
) -> Callable[[np.ndarray], np.ndarray]:
    """Conversion to GPS time of a local clock that stamps fixes on arrival.

    The clock may drift linearly. The fastest fix is assumed to arrive without delay: the true delay
    of a receiver cannot be found from stamps, and remains as a latency of the fixes.

    Args:
        file: for messages.
        local_ns: (n,) arrival of each fix, local time.
        gps_ns: (n,) GPS time of each fix.
        findings: receives a note with the spread of the delays.

    Returns:
        A function from local to GPS time [ns].

    Raises:
        LogError: the two clocks do not run at the same rate.
    """
    begin, apart = int(local_ns[0]), int(local_ns[0]) - int(gps_ns[0])
    x, late = (local_ns - begin) * 1e-9, (local_ns - gps_ns - apart) * 1e-9
    span = float(x.max() - x.min())
    near = np.abs(late - np.median(late)) < _STRAY_S + _DRIFT * span
    if 2 * near.sum() <= len(near):
        cause = "the stamps of its fixes and their GPS times do not run at one rate"
        raise LogError(file, cause, "was the clock set during the recording? cut it there")
    slope = float(np.polyfit(x[near], late[near], 1)[0]) if span > _TREND_S else 0.0
    slope = float(np.clip(slope, -_DRIFT, _DRIFT))
    rest = late[near] - slope * x[near]
    finding_reporter(findings, "note", "clock_aligned", file, value=float(np.ptp(rest)))(
        "stamps of the samples are put on GPS time by the arrival of the fixes, whose delays vary "
        f"by {np.ptp(rest):.3f} s; a constant delay of the receiver remains as a latency."
    )

    def to_gps(time_ns: np.ndarray) -> np.ndarray:
        late_ns = (slope * (time_ns - begin) * 1e-9 + float(rest.min())) * 1e9
        return time_ns - apart - np.rint(late_ns).astype(np.int64)

    return to_gps
