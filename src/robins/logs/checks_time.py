"""Checks of time stamps: unit, batches, order, duplicates, jumps, gaps, jitter.

Also of the overlap and common time base of the files of one run.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from robins.dataset import AttitudeTable, GnssTable, ImuTable, MagTable, OdometryTable, Trajectory
from robins.gps_time import GPS_EPOCH_S
from robins.logs.batches import batches_of, resolution_ns, spread
from robins.logs.findings import Finding
from robins.logs.ordering import increasing
from robins.logs.quiet import error, finding, name_of, note, place, usual_step_s, warning
from robins.logs.tables import Table
from robins.logs.timebase import WEEK_S

# Steps of a clock [s] -> their cause.
_WRAPS = {
    2.0**32 * 1e-6: "a 32-bit counter of microseconds that ran over",
    2.0**32 * 1e-3: "a 32-bit counter of milliseconds that ran over",
    2.0**16 * 1e-3: "a 16-bit counter of milliseconds that ran over",
    604_800.0: "the second of the GPS week, which begins again on Sunday",
    1024 * 604_800.0: "the GPS week, which begins again after 1024 weeks",
    86_400.0: "the second of the day, which begins again at midnight",
}
_STEPS = {
    1.0: "a leap second",
    18.0: "the 18 leap seconds between UTC and GPS time",
    3600.0: "a change of time zone or of daylight saving",
}
_GAP = 2.5  # usual steps; longer is a gap
_SLOWEST_IMU_S = 0.25
# Longest and shortest step [s]; a path may be as fast as motion capture.
_STEPS_S = {ImuTable: (_SLOWEST_IMU_S, 2e-5), GnssTable: (45.0, 5e-3), Trajectory: (45.0, 2e-4)}
_LONGEST_BATCH_S = 1.5
_SMALLER = (
    (1e-3, "milliseconds", "ms"),
    (1e-6, "microseconds", "us"),
    (1e-9, "nanoseconds", "ns"),
)
_PART = 500  # rows
_WHY_GAPS = {
    GnssTable: "The receiver had no solution there; the run goes on by inertia alone",
    MagTable: "The logger lost data; heading is held by the gyros meanwhile",
    AttitudeTable: "Nothing is compared there",
    OdometryTable: "The wheels tell nothing there",
}
_LOST = (
    "The logger lost data (buffer, card or cable too slow); a run must bridge it blindly, and "
    "after about a second its heading and position are no longer worth much"
)
_LEAP = 18.0  # s between UTC and GPS time since 2017
_BLIP = 3  # most refused samples of a slip; more mean that the clock was set


def check_time(table: Table, unit_known: bool = False) -> Iterator[Finding]:
    """All findings about the stamps of one table.

    Args:
        table: any table.
        unit_known: the format states the unit of its stamps, so a low rate is no sign of another.
    """
    if len(table) < 2:
        yield error(table, "too_short", len(table))(
            f"only {len(table)} sample(s). Nothing can be run on that; is it the right file?"
        )
        return
    usual = usual_step_s(table.time_ns)
    if not np.isfinite(usual):
        yield error(table, "time_stands", 0.0)(
            "time never goes forward. The time column is constant or another one; name the format."
        )
        return
    if (first := batches_of(table)) is not None:
        even = spread(table)
        usual = usual_step_s(even.time_ns)
        yield _shared(table, float(np.median(np.diff(first, append=len(table)))), usual)
        table = even
    yield from _slow(table, usual) if unit_known else _unit(table, usual)
    keep = increasing(table.time_ns)
    yield from _duplicates(table)
    yield from _order(table, keep, usual)
    yield from _gaps(table, keep, usual)
    yield from _jitter(table, keep, usual)


def _slow(table: Table, usual: float) -> Iterator[Finding]:
    """Inertial samples too far apart for navigation, with stamps of a known unit."""
    if isinstance(table, ImuTable) and usual > _SLOWEST_IMU_S:
        yield warning(table, "time_slow", usual)(
            f"inertial samples are {usual:.4g} s apart. The log was thinned out or its logger is "
            "slow; how the sensor moved between them is lost, so expect little of a run: log at "
            "50 Hz or more."
        )


def _unit(table: Table, usual: float) -> Iterator[Finding]:
    """Rate that no such sensor has, which reveals the unit of time."""
    slowest, fastest = _STEPS_S.get(type(table), (2.0, 2e-5))
    for factor, unit, symbol in _SMALLER:
        if usual > slowest and fastest < usual * factor < slowest:
            yield error(table, "time_unit", usual)(
                f"samples are {usual:g} s apart, one every {usual * factor:g} s if the time column "
                f"is in {unit}. It probably is; convert it to seconds, or state unit = "
                f'"{symbol}" in the file of --columns.'
            )
            return
    if usual > slowest or usual < fastest:
        yield error(table, "time_unit", usual)(
            f"samples are {usual:g} s apart, which no such sensor does. The time column is in "
            "another unit than seconds, or is another column; check it."
        )


def _shared(table: Table, size: float, step_s: float) -> Finding:
    """Finding about batches of samples with one stamp, or stamped in a burst."""
    many_s = size * step_s
    again = np.diff(table.time_ns) == 0
    how = (
        f"{size:g} samples share each stamp (median; {again.mean():.0%} repeat the one before)"
        if again.mean() > 0.01
        else f"samples are stamped in bursts of {size:g}, one burst every {many_s:.4g} s"
    )
    remedy = (
        "A batch lasts so long that nothing can be timed in it; log the time with all its digits"
        if many_s > _LONGEST_BATCH_S
        else f"A replay spreads each batch evenly, {step_s * 1e3:.4g} ms apart; all may be early "
        f"or late by up to {many_s * 1e3:.4g} ms, so log the sensor's own counter, or all digits"
    )
    severity = "error" if many_s > _LONGEST_BATCH_S else "warning"
    row = int(np.argmax(again)) + 1 if again.any() else None
    return finding(severity, table, "stamps_shared", size, row)(
        f"{how}. A buffer was read at once and stamped on arrival, or stamps were rounded. "
        f"{remedy}."
    )


def _duplicates(table: Table) -> Iterator[Finding]:
    again = np.flatnonzero(np.diff(table.time_ns) == 0) + 1
    if len(again):
        share = len(again) / len(table)
        cause = (
            "The logger writes faster than the sensor measures, or time is rounded too coarsely"
            if share > 0.05
            else "A line was written twice, or time is rounded too coarsely"
        )
        yield warning(table, "time_duplicate", len(again), int(again[0]))(
            f"{len(again)} samples ({share:.1%}) repeat the time of the sample before, this one "
            f"first. {cause}; a replay refuses the second of each."
        )


def _order(table: Table, keep: np.ndarray, usual: float) -> Iterator[Finding]:
    """Stamps that go back: slips of single samples in one finding, clocks set back in one each."""
    step = np.diff(table.time_ns) * 1e-9
    slips = []
    for k in np.flatnonzero(step < 0):
        lost = _refused_around(keep, int(k))
        if lost <= _BLIP:
            slips.append(int(k))
            continue
        size = float(-step[k]) + usual
        cause = _named(size, usual, _WRAPS | _STEPS) or "The clock was set, or the logger restarted"
        yield error(table, "clock_set_back", float(step[k]), int(k) + 1)(
            f"time goes back by {-step[k]:.6g} s and goes on from there. {cause}. A replay refuses "
            f"{lost} samples so that time increases, and what follows them is joined wrongly: "
            "split the file here, or add the step to all later stamps."
        )
    if slips:
        sizes = -step[slips]
        yield warning(table, "time_backward", len(slips), slips[0] + 1)(
            f"time goes back by {sizes.max():.6g} s for a sample or so ({len(slips)} such places, "
            "this one first). Lines were swapped or a stamp is damaged; a replay refuses those "
            "samples and goes on."
        )


def _refused_around(keep: np.ndarray, k: int) -> int:
    """Number of refused rows in the stretch that touches the step from row k to k + 1."""
    low = high = k + 1 if not keep[k + 1] else k
    while low > 0 and not keep[low - 1]:
        low -= 1
    while high < len(keep) - 1 and not keep[high + 1]:
        high += 1
    return int(np.sum(~keep[low : high + 1]))


def _named(size: float, usual: float, names: dict[float, str]) -> str:
    """Cause of a step of this size, as the beginning of a sentence; "" if unknown."""
    for known, cause in names.items():
        multiple = max(round(size / known), 1)
        if (known in (1.0, 18.0) and multiple != 1) or multiple > 24:
            continue
        if abs(size - multiple * known) < min(1.6 * usual, 0.5) + 1e-6 * known:
            return f"It fits {cause}"
    return ""


def _gaps(table: Table, keep: np.ndarray, usual: float) -> Iterator[Finding]:
    """Missing samples. Clock steps look alike, so those of known sizes are named as such.

    Receivers lose fixes for any time, and other sensors matter little, so there every gap is one.
    """
    rows = np.flatnonzero(keep).tolist()
    step = (np.diff(table.time_ns[rows]) * 1e-9).tolist()
    gaps = [k for k, s in enumerate(step) if s > _GAP * usual]
    harmless = not isinstance(table, ImuTable | Trajectory)
    jumps = [] if harmless else [k for k in gaps if _jump(step[k] - usual, usual)]
    for k in jumps:
        size = step[k] - usual
        yield warning(table, "time_jump", size, rows[k + 1])(
            f"no sample for {step[k]:.6g} s before this one: a gap, or a clock set ahead by "
            f"{size:.6g} s. {_jump(size, usual)}; if the motion goes on without a break, take the "
            "step off all later stamps."
        )
    gaps = [k for k in gaps if k not in jumps]
    if not gaps:
        return
    worst = max(gaps, key=lambda k: step[k])
    total = sum(step[k] for k in gaps)
    cause = _WHY_GAPS.get(type(table), _LOST)
    severity = "note" if harmless or total < 0.05 else "warning"
    code = "gap_long" if step[worst] >= 1.0 else "gap_short"
    yield finding(severity, table, code, float(step[worst]), rows[worst + 1])(
        f"no sample for {step[worst]:.6g} s before this one, where {usual:.6g} s is usual "
        f"({len(gaps)} gaps, {total:.6g} s in all, the first at {place(table, rows[gaps[0]])}). "
        f"{cause}."
    )


def _jump(size: float, usual: float) -> str:
    return _named(size, usual, _WRAPS | _STEPS) if size > 0.9 else ""


def _jitter(table: Table, keep: np.ndarray, usual: float) -> Iterator[Finding]:
    stamps = table.time_ns[keep]
    step = np.diff(stamps) * 1e-9
    step = step[step < _GAP * usual]
    if len(step) < 10 or isinstance(table, GnssTable):
        return
    scatter = float(step.std()) / usual
    rounded = resolution_ns(stamps) * 1e-9
    if scatter > 0.1 and rounded > 0.5 * usual and _stamp_scatter(stamps) < 1.5 * rounded:
        yield note(table, "stamps_rounded", rounded)(
            f"stamps are whole multiples of {rounded:.4g} s, for samples {step.mean():.4g} s apart "
            f"({1 / step.mean():.4g} Hz). Their digits were lost in writing; log them all, or a "
            f"time is wrong by up to {rounded / 2:.2g} s."
        )
    elif scatter > 0.1:
        low, high = np.percentile(step, [0.5, 99.5])
        yield finding("warning" if scatter > 0.5 else "note", table, "time_jitter", scatter)(
            f"steps of time scatter from {low * 1e3:.3g} to {high * 1e3:.3g} ms (mean "
            f"{step.mean() * 1e3:.4g} ms, {1 / step.mean():.4g} Hz). The stamps were taken on "
            "arrival or rounded, not by the sensor's clock; harmless for slow motion, but use the "
            "sensor's own counter if it was logged."
        )


def _stamp_scatter(stamps: np.ndarray) -> float:
    """Range of the stamps about a constant rate [s], as the median over parts of the table.

    Rounding gives one unit of the last digit; scattered missing rows give more.
    """
    n = min(_PART, len(stamps))
    parts = (stamps[: len(stamps) // n * n] - stamps[0]).reshape(-1, n) * 1e-9
    x = np.arange(n) - 0.5 * (n - 1)
    rest = parts - (parts @ x / (x @ x))[:, None] * x
    return float(np.median(np.ptp(rest, axis=1)))


def check_span(imu: ImuTable, others: Sequence[Table]) -> Iterator[Finding]:
    """Findings about the overlap of other tables with the IMU in time."""
    for other in others:
        if len(imu) and len(other):
            yield from _span_of(imu, other)


def _span_of(imu: ImuTable, other: Table) -> Iterator[Finding]:
    (a, b), (c, d) = _span(imu), _span(other)
    overlap = min(b, d) - max(a, c)
    if overlap <= 0:
        cause = _offset(a, b, c, d)
        yield error(other, "no_overlap", c - a)(
            f"covers {_covered(other)}, {name_of(imu)} covers {_covered(imu)}: no common time. "
            f"{cause}"
        )
        return
    if abs(abs(c - a) - _LEAP) < 1.0 and abs(abs(d - b) - _LEAP) < 1.0 and (c - a) * (d - b) > 0:
        yield note(other, "leap_seconds", c - a)(
            f"begins {c - a:+.3f} s and ends {d - b:+.3f} s against {name_of(imu)}. If both were "
            "recorded together, one is stamped in UTC (Unix time) and one in GPS time, which is "
            "18 s ahead since 2017; then shift one of them."
        )
    if overlap < 0.5 * (d - c):
        yield warning(other, "little_overlap", overlap)(
            f"only {overlap:.1f} s of {d - c:.1f} s are covered by {name_of(imu)} "
            f"({a:.3f} to {b:.3f} s). The rest is of no use; are the files of one recording?"
        )


def _span(table: Table) -> tuple[float, float]:
    """Start and end [s], without a few stamps far off from a faulty clock."""
    ns = np.sort(table.time_ns)
    trim = len(ns) // 100
    return float(ns[trim]) * 1e-9, float(ns[len(ns) - 1 - trim]) * 1e-9


def _covered(table: Table) -> str:
    """Start and end in words; "mostly" where a stamp is far from the others."""
    (a, b), ns = _span(table), table.time_ns
    low, high = float(np.min(ns)) * 1e-9, float(np.max(ns)) * 1e-9
    if high - low > 1.1 * (b - a):
        return f"mostly {a:.3f} to {b:.3f} s"
    return f"{low:.3f} to {high:.3f} s"


def _offset(a: float, b: float, c: float, d: float) -> str:
    """Likely cause, in words, of a shift between the times [a, b] of the IMU and [c, d]."""

    def fits(shift: float | int) -> bool:
        return min(b, d + shift) - max(a, c + shift) > 0.5 * min(b - a, d - c)

    for sign, later_s, how, to in (
        (1, a - c, "seconds of the GPS week, the IMU's are absolute", ""),
        (-1, c - a, "absolute, the IMU's are seconds of the GPS week", " to the IMU's"),
    ):
        week = round((later_s - GPS_EPOCH_S) / WEEK_S)
        shift = GPS_EPOCH_S + week * WEEK_S
        if week > 0 and fits(sign * shift):
            return f"Its times are {how}: they fit if GPS week {week} ({shift} s) is added{to}."
    for shift, cause in (
        (float(GPS_EPOCH_S), "counted from 1980, the IMU's from 1970"),
        (-float(GPS_EPOCH_S), "counted from 1970, the IMU's from 1980"),
        (_LEAP, "in UTC, the IMU's in GPS time, 18 s ahead"),
        (-_LEAP, "in GPS time, the IMU's in UTC, 18 s behind"),
    ):
        if fits(shift):
            return f"Its times are probably {cause}: they fit if {shift:+.0f} s is added."
    for scale, unit, symbol in _SMALLER:
        for low, high, whose in ((c, d, "its"), (a, b, "the IMU's")):
            first, last = (a, b) if whose == "its" else (c, d)
            if min(last, high * scale) - max(first, low * scale) > 0:
                return (
                    f"They fit if {whose} times are {unit}: convert that column to seconds, or "
                    f'state unit = "{symbol}" in the file of --columns.'
                )
    hours = round((a - c) / 3600.0)
    if 0 < abs(hours) <= 14 and fits(hours * 3600.0):
        return f"They fit if {hours:+d} h is added: one clock is in local time."
    return (
        "No usual offset explains it: one counts from power-up, or the files are of different "
        "recordings. Give both one time base."
    )
