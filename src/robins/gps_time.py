"""GPS time and UTC: the leap seconds between them.

Absolute stamps of logs count nanoseconds from 1970-01-01 in GPS time, without leap seconds. UTC has
fallen behind by one second at each leap, 18 s since 2017 (IERS Bulletin C). A new leap second is a
new row below.
"""

from __future__ import annotations

import datetime

import numpy as np

_NS = 1_000_000_000
GPS_EPOCH_S = 315_964_800
"""1980-01-06 in seconds from 1970-01-01 without leap seconds; earlier stamps have no date."""

# UTC dates from which GPS time - UTC has grown by one more second.
_LEAPS = [
    datetime.date(*day)
    for day in [
        (1981, 7, 1), (1982, 7, 1), (1983, 7, 1), (1985, 7, 1), (1988, 1, 1), (1990, 1, 1),
        (1991, 1, 1), (1992, 7, 1), (1993, 7, 1), (1994, 7, 1), (1996, 1, 1), (1997, 7, 1),
        (1999, 1, 1), (2006, 1, 1), (2009, 1, 1), (2012, 7, 1), (2015, 7, 1), (2017, 1, 1),
    ]
]  # fmt: skip
_LEAPS_NS = np.array(
    [
        ((day - datetime.date(1970, 1, 1)).days * 86400 + k) * _NS
        for k, day in enumerate(_LEAPS, start=1)
    ]
)


def leap_seconds(utc: datetime.date) -> int:
    """GPS time - UTC [s] on a day of UTC."""
    return sum(utc >= leap for leap in _LEAPS)


def dated(stamp_ns: int) -> bool:
    """True if a stamp is GPS time since 1970, not since power-up or the beginning of a week."""
    return stamp_ns >= GPS_EPOCH_S * _NS


def utc_of(time_ns: np.ndarray) -> np.ndarray:
    """UTC of stamps in GPS time since 1970, int64 ns, as datetime64[ns].

    A leap second itself, 23:59:60, is shown as the first second of the next day.
    """
    time_ns = np.asarray(time_ns, dtype=np.int64)
    behind = np.searchsorted(_LEAPS_NS, time_ns, side="right")
    # NumPy reduces a single stamp to a scalar.
    return np.asarray(time_ns - behind * _NS).astype("datetime64[ns]")


def gps_of(utc_ns: np.ndarray) -> np.ndarray:
    """GPS time since 1970 of UTC since 1970, both int64 ns; inverse of `utc_of`."""
    utc_ns = np.asarray(utc_ns, dtype=np.int64)
    leaps_utc_ns = _LEAPS_NS - np.arange(1, len(_LEAPS_NS) + 1) * _NS
    return np.asarray(utc_ns + np.searchsorted(leaps_utc_ns, utc_ns, side="right") * _NS)
