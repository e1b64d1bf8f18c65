"""The doctor on whether the files of one run overlap in time, and on one time base."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from robins.dataset import ImuTable
from robins.logs.findings import Finding
from robins.logs.quiet import error, name_of, warning
from robins.logs.tables import Table
from robins.logs.timebase import GPS_EPOCH_S, WEEK_S

_LEAP = 18.0


def check_span(imu: ImuTable, others: Sequence[Table]) -> Iterator[Finding]:
    """Findings about how the times of other tables lie against the IMU's."""
    for other in others:
        yield from _span_of(imu, other)


def _span_of(imu: ImuTable, other: Table) -> Iterator[Finding]:
    if not len(imu) or not len(other):
        return
    (a, b), (c, d) = _span(imu), _span(other)
    overlap = min(b, d) - max(a, c)
    if overlap <= 0:
        cause = _offset(a, b, c, d)
        yield error(
            other,
            "no_overlap",
            c - a,
            f"covers {c:.3f} to {d:.3f} s, {name_of(imu)} covers {a:.3f} to {b:.3f} s: no common "
            f"time. {cause}",
        )
        return
    if abs(abs(c - a) - _LEAP) < 1.0 and abs(abs(d - b) - _LEAP) < 1.0 and (c - a) * (d - b) > 0:
        yield warning(
            other,
            "leap_seconds",
            c - a,
            f"begins {c - a:+.3f} s and ends {d - b:+.3f} s against {name_of(imu)}. Both were "
            "probably recorded together, one stamped in UTC (Unix time) and one in GPS time, which "
            "is 18 s ahead since 2017; shift one of them.",
        )
    if overlap < 0.5 * (d - c):
        yield warning(
            other,
            "little_overlap",
            overlap,
            f"only {overlap:.1f} s of {d - c:.1f} s are covered by {name_of(imu)} "
            f"({a:.3f} to {b:.3f} s). The rest is of no use; are the files of one recording?",
        )


def _span(table: Table) -> tuple[float, float]:
    """Start and end [s], without the few stamps that a damaged clock put far away."""
    ns = np.sort(table.time_ns)
    trim = len(ns) // 100
    return float(ns[trim]) * 1e-9, float(ns[len(ns) - 1 - trim]) * 1e-9


def _offset(a: float, b: float, c: float, d: float) -> str:
    """Which shift of the other table's time [c, d] would put it on the IMU's [a, b]."""

    def fits(shift: float | int) -> bool:
        return min(b, d + shift) - max(a, c + shift) > 0.5 * min(b - a, d - c)

    weeks = round((a - GPS_EPOCH_S - c) / WEEK_S), round((c - GPS_EPOCH_S - a) / WEEK_S)
    if fits(GPS_EPOCH_S + weeks[0] * WEEK_S) and weeks[0] > 0:
        return (
            f"Its times are seconds of the GPS week, the IMU's are absolute: they fit if GPS week "
            f"{weeks[0]} ({GPS_EPOCH_S + weeks[0] * WEEK_S} s) is added."
        )
    if fits(-GPS_EPOCH_S - weeks[1] * WEEK_S) and weeks[1] > 0:
        return (
            f"Its times are absolute, the IMU's are seconds of the GPS week: they fit if GPS week "
            f"{weeks[1]} ({GPS_EPOCH_S + weeks[1] * WEEK_S} s) is added to the IMU's."
        )
    for shift, cause in (
        (float(GPS_EPOCH_S), "counted from 1980, the IMU's from 1970"),
        (-float(GPS_EPOCH_S), "counted from 1970, the IMU's from 1980"),
        (_LEAP, "in UTC, the IMU's in GPS time, 18 s ahead"),
        (-_LEAP, "in GPS time, the IMU's in UTC, 18 s behind"),
    ):
        if fits(shift):
            return f"Its times are probably {cause}: they fit if {shift:+.0f} s is added."
    for scale, unit in ((1e-3, "milliseconds"), (1e-6, "microseconds"), (1e-9, "nanoseconds")):
        for low, high, whose in ((c, d, "its"), (a, b, "the IMU's")):
            first, last = (a, b) if whose == "its" else (c, d)
            if min(last, high * scale) - max(first, low * scale) > 0:
                return f"They fit if {whose} times are {unit}: convert that column to seconds."
    hours = round((a - c) / 3600.0)
    if 0 < abs(hours) <= 14 and fits(hours * 3600.0):
        return f"They fit if {hours:+d} h is added: one clock is in local time."
    return (
        "No usual offset explains it: one counts from power-up, or the files are of different "
        "recordings. Give both one time base."
    )
