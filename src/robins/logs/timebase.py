"""Time stamps of logs as integer nanoseconds, exact from their decimal text.

A double holds seconds of today's Unix time only to 2.4e-7 s, so the digits are read as integers.
Absolute stamps count from 1970-01-01 *in GPS time*: no leap seconds, as in RTKLIB's GPST and in the
GNSS_IMU logs. Stamps of other epochs (seconds of the GPS week, since power-up) are kept
unchanged; the doctor reports files that do not fit together.
"""

from __future__ import annotations

import datetime
import re
from decimal import Decimal

import numpy as np

from robins.gps_time import GPS_EPOCH_S, leap_seconds
from robins.logs.findings import refused

WEEK_S = 604_800
_NS = 1_000_000_000
GPS_EPOCH_NS, WEEK_NS = GPS_EPOCH_S * _NS, WEEK_S * _NS
LIMIT_NS = 2**62  # 146 years; differences of stamps below it stay within int64
_LAST_WEEK = (LIMIT_NS - GPS_EPOCH_NS) // WEEK_NS  # in 2116
_HOUR_NS = 3600 * _NS
_DATE = re.compile(r"(\d{4})/(\d{1,2})/(\d{1,2})", re.ASCII)
_STAMP = re.compile(
    r'"?(\d{4})-(\d\d)-(\d\d)[ T](\d\d:\d\d:\d\d(?:[.,]\d{1,9})?)(Z|([+-])(\d\d):?(\d\d))?"?',
    re.ASCII,
)
_CLOCK = re.compile(r"(\d{1,2}):(\d{1,2}):(\d{1,2}(?:\.\d*)?)", re.ASCII)
_EPOCH_DAY = datetime.date(1970, 1, 1).toordinal()


def decimals_to_ns(text: np.ndarray, exponent: int = 9) -> tuple[np.ndarray, np.ndarray]:
    """Decimal numbers in text, times 10**exponent, rounded (half up) to integers.

    Args:
        text: (n,) bytes, such as b"1756402240.9610000"; blanks around the number are ignored.
        exponent: 9 for seconds, 0 for nanoseconds.

    Returns:
        Integers (n,) int64, and mask (n,): False where the text is no number or beyond int64.
    """
    value, plain = np.zeros(len(text), np.int64), np.zeros(len(text), bool)
    if len(text):
        whole, _, part = np.strings.partition(text, b".")
        digits = np.strings.add(whole, np.strings.ljust(part, exponent, b"0"))
        length = np.strings.str_len(digits)
        plain = np.strings.isdigit(digits) & (np.strings.str_len(part) <= exponent)
        plain &= np.strings.str_len(whole) + np.strings.str_len(part) > 0
        # int64 holds all numbers of 18 digits, and those of 19 that begin with less than 9.
        plain &= (length < 19) | ((length == 19) & (digits < b"9"))
        value[plain] = digits[plain].astype(np.int64)
    for i in np.flatnonzero(~plain):  # signs, exponents, blanks, digits beyond ns, invalid text
        exact = _exactly(text[i], exponent)
        value[i], plain[i] = exact or 0, exact is not None
    return value, plain


def _exactly(text: bytes, exponent: int, count: int = 1) -> int | None:
    if b"_" in text:  # accepted by Python between digits
        return None
    try:
        number = Decimal(text.decode("ascii").strip()).scaleb(exponent) * count
        if number.adjusted() > 18:  # do not expand 1e999999999
            return None
        whole = int((number + Decimal("0.5")).to_integral_value("ROUND_FLOOR"))
    except (ArithmeticError, ValueError):
        return None
    return whole if -(2**63) <= whole < 2**63 else None


def stamps_to_ns(
    file: str, field: str, text: np.ndarray, rows: np.ndarray, exponent: int = 9, count: int = 1
) -> np.ndarray:
    """`decimals_to_ns` for a column of a file, in units of count * 10**exponent ns.

    Raises:
        LogError: a stamp is no number, or too large for its unit.
    """
    if count == 1:
        time_ns, good = decimals_to_ns(text, exponent)
    else:
        exact = [_exactly(one, exponent, count) for one in text.tolist()]
        good = np.array([ns is not None for ns in exact])
        time_ns = np.array([ns or 0 for ns in exact], np.int64)
    good &= (time_ns > -LIMIT_NS) & (time_ns < LIMIT_NS)
    if not good.all():
        bad = int(np.argmin(good))
        shown = text[bad].decode("utf-8", "replace").strip()
        large = _exactly(text[bad], 0) is not None
        cause = "does not fit: the time may be in ns, us or ms" if large else "is not a time stamp"
        remedy = "convert the time column to seconds" if large else "repair or delete the line"
        raise refused(file, f"line {rows[bad]}", field, shown)(cause, remedy)
    return time_ns


def ns_to_decimal(time_ns: int, exponent: int = 9) -> str:
    """Nanoseconds over 10**exponent as exact decimal text, with at least three decimals."""
    if not exponent:
        return str(time_ns)
    sign = "-" if time_ns < 0 else ""
    whole, part = divmod(abs(time_ns), 10**exponent)
    decimals = f"{part:0{exponent}d}".rstrip("0").ljust(3, "0")
    return f"{sign}{whole}.{decimals}"


def calendar_to_ns(date: str, clock: str, *, utc: bool = False, ahead_s: int = 0) -> int:
    """``2025/08/28`` and ``17:30:39.749`` as nanoseconds since 1970 in GPS time.

    Args:
        date: year/month/day.
        clock: hour:minute:second with any decimals.
        utc: the stamp is UTC; the leap seconds since 1980 are added.
        ahead_s: offset of the local clock from UTC, which is subtracted first [s].

    Raises:
        ValueError: a date or time of another form, or 146 years or more from 1970.
    """
    day, time = _DATE.fullmatch(date), _CLOCK.fullmatch(clock)
    if not (day and time):
        raise ValueError(f"{date} {clock} is not year/month/day hour:minute:second")
    today = datetime.date(*(int(part) for part in day.groups()))
    hour, minute, seconds = int(time[1]), int(time[2]), Decimal(time[3])
    # RTKLIB writes 60.000 where rounding carries; a leap second is 60.x as well.
    if not (hour < 24 and minute < 60 and seconds < 61):
        raise ValueError(f"{clock} is no time of day")
    days = today.toordinal() - _EPOCH_DAY
    whole = (days * 24 + hour) * 3600 + minute * 60 - ahead_s
    if utc:
        whole += leap_seconds(datetime.date.fromordinal(_EPOCH_DAY + whole // 86400))
    if abs(whole) * _NS >= LIMIT_NS - _NS:
        raise ValueError(f"the year {today.year} is not one from which anyone has a log")
    return whole * _NS + int((seconds * _NS).to_integral_value())


def dates_to_ns(
    file: str, field: str, text: np.ndarray, rows: np.ndarray, zone: str = ""
) -> np.ndarray:
    """Dates and times of ISO 8601 as nanoseconds since 1970 in GPS time.

    Args:
        file: for messages.
        field: name of the column, for messages.
        text: (n,) bytes, such as b"2025-06-11T20:34:27.5+02:00".
        rows: (n,) line numbers.
        zone: "UTC" or "GPS" of stamps without an offset from UTC; with "GPS" none may have one.

    Raises:
        LogError: a stamp is no such date.
    """
    out = np.zeros(len(rows), np.int64)
    for k, raw in enumerate(text.tolist()):
        shown = raw.decode("utf-8", "replace").strip()
        match = _STAMP.fullmatch(shown)
        try:
            if match is None or (zone == "GPS" if match[5] else not zone):
                raise ValueError("not of that form")
            year, month, day, clock, _, sign, hours, minutes = match.groups()
            date, clock = f"{year}/{month}/{day}", clock.replace(",", ".")
            ahead_s = 3600 * int(hours) + 60 * int(minutes) if sign else 0
            ahead_s = -ahead_s if sign == "-" else ahead_s
            out[k] = calendar_to_ns(date, clock, utc=zone != "GPS", ahead_s=ahead_s)
        except ValueError as error:
            form = "a date and time" if zone else "a date and time with its offset from UTC"
            cause = f"is not {form} ({error})"
            remedy = f"write it like 2025-06-11 20:34:27{'' if zone else '+00:00'}"
            raise refused(file, f"line {rows[k]}", field, shown)(cause, remedy) from error
    return out


def weeks_of(file: str, field: str, text: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Column of GPS weeks since 1980, without rollover at 1024.

    Raises:
        LogError: a week is no number, or not from 1980 to 2116.
    """
    weeks = stamps_to_ns(file, field, text, rows, exponent=0)
    bad = (weeks < 0) | (weeks > _LAST_WEEK)
    if bad.any():
        raise refused(file, f"line {rows[np.argmax(bad)]}", field, int(weeks[np.argmax(bad)]))(
            "is no GPS week from which anyone has a log", "repair or delete the line"
        )
    return weeks


def week_to_ns(week: np.ndarray, tow_ns: np.ndarray) -> np.ndarray:
    """Nanoseconds since 1970 in GPS time, of GPS week (see `weeks_of`) and time of week [ns]."""
    return GPS_EPOCH_NS + week * WEEK_NS + tow_ns


def unrolled(of_week_ns: np.ndarray) -> np.ndarray:
    """Times of week [ns] continued across the end of a week.

    That is a step from the last hour of a week into the first hour of one; any other step back is a
    fault, and left unchanged.
    """
    before, after = of_week_ns[:-1], of_week_ns[1:]
    late, early = WEEK_NS - before, after
    anew = (late > 0) & (late < _HOUR_NS) & (early >= 0) & (early < _HOUR_NS)
    return of_week_ns + WEEK_NS * np.concatenate([[0], np.cumsum(anew)])[: len(of_week_ns)]
