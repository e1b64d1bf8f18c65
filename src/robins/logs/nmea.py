"""Sentences of NMEA 0183 from a receiver, with any other data between them.

- ``GGA``, else ``GNS``: fixes; the height above the ellipsoid is the altitude plus the separation
  of the geoid. If a fix lacks that, all heights are altitudes above the geoid, with a warning.
- ``RMC``, else ``VTG``: velocity over ground, without the down component. An epoch without GGA and
  GNS has the position of its RMC, without height; if all lack one, it is assumed, with a warning.
- ``GST``: sigmas of position. Others are the usual ones of the kind of a fix, see `fix_kinds`.
- ``RMC`` and ``ZDA``: the date. Stamps are UTC and become GPS time.

Sentences without a valid checksum are skipped and counted. Of several talkers GN is used, or the
first. Source: NMEA 0183 4.11; u-blox F9 HPG 1.32 interface description, UBX-22008968.
"""

from __future__ import annotations

import datetime
import math
import re
from collections.abc import Iterator
from dataclasses import replace
from functools import partial, reduce
from operator import xor

import numpy as np

from robins.dataset import GnssTable
from robins.gps_time import gps_of
from robins.logs.findings import (
    AnyPath,
    Findings,
    LogError,
    finding_reporter,
    report_cut_end,
    report_geoid_heights,
    report_left_out,
)
from robins.logs.fix_kinds import fixes, over_ground
from robins.logs.opening import Bytes, map_file
from robins.logs.rtcm import end_of_frame
from robins.logs.text import Head
from robins.units import to_si

_BEGINS = re.compile(rb"(^|[\r\n])[^$\r\n]{0,60}\$[A-Z]{4,6}\d*,[^*$\r\n]*\*[0-9A-Fa-f]{2}")
_SENTENCE = re.compile(
    rb"\$([A-Z]{2})(GGA|GNS|RMC|VTG|GST|ZDA),([^*$\r\n]{0,200})(?:\*([0-9A-Fa-f]{2}))?"
)
_CLOCK = re.compile(r"([01]\d|2[0-3])([0-5]\d)([0-5]\d(?:\.\d*)?|60(?:\.\d*)?)", re.ASCII)
_DAY_NS, _EPOCH = 86_400_000_000_000, datetime.date(1970, 1, 1).toordinal()
_KIND = {1: 5, 2: 4, 3: 5, 4: 1, 5: 2, 8: 5}  # quality of GGA -> that of RTKLIB
_MODES = {"R": 4, "F": 5, "D": 2, "P": 3, "A": 1, "S": 8, "E": 6, "M": 7}  # best first -> of GGA
_NO_FIX = {6: "estimated by dead reckoning", 7: "entered by hand"}
_ANY_HEIGHT_M = 1000.0  # sigma of an assumed height, so large that an INS ignores it
_SLOW = 0.05  # m/s, below which receivers omit the course


def is_nmea(head: Head) -> bool:
    """True if the first bytes have a line with any sentence; see `ubx.is_ubx` for mixed files."""
    return _BEGINS.search(head.start) is not None


def read_nmea(path: AnyPath, findings: Findings = None) -> GnssTable:
    """Read fixes.

    Args:
        path: the file, plain or compressed.
        findings: receives omissions and assumptions; without it they are issued as `LogWarning`.

    Raises:
        LogError: there is no sentence GGA or RMC with a valid checksum.
    """
    return fixes_of(str(path), map_file(path, findings), findings)[0]


def fixes_of(file: str, data: Bytes, findings: Findings) -> tuple[GnssTable, np.ndarray]:
    """Fixes, and the byte position of the first sentence of each; errors as `read_nmea`."""
    epochs = _epochs(file, data, findings)
    days = _days(file, epochs, findings)
    kept = [k for k, epoch in enumerate(epochs) if "lat1" in epoch or "lat2" in epoch]
    if not kept:
        cause = "has no sentence GGA or RMC with a right checksum"
        raise LogError(file, cause, "switch on GGA, RMC and GST in the receiver")

    def column(name: str) -> np.ndarray:
        return np.array([epochs[k].get(name, math.nan) for k in kept])

    def of_place(name: str) -> np.ndarray:
        """A number of GGA or GNS, or of RMC in an epoch without these."""
        return np.where(np.isin(kept, without), column(f"{name}2"), column(f"{name}1"))

    without = [k for k in kept if "lat1" not in epochs[k]]
    quality = of_place("quality")
    _report_kinds(file, quality, len(without), findings)
    utc_ns = np.array([days[k] * _DAY_NS + int(epochs[k]["time"]) for k in kept], np.int64)
    stated = np.isfinite(column("speed"))
    speed, course = (np.where(stated, column(x), column(f"{x}1")) for x in ("speed", "course"))
    speed = to_si(speed, "kn")
    course = np.where(np.isnan(course) & (speed < _SLOW), 0.0, course)
    nothing, height = np.full(len(kept), np.nan), column("height")
    if (np.isnan(height) & np.isfinite(column("altitude"))).any():
        report_geoid_heights(
            findings, file, "Set the receiver to state the separation of the geoid in GGA."
        )
        height = column("altitude")
    up = column("up")
    if unknown := bool(np.isnan(height).all()):
        height, up = np.zeros(len(kept)), np.full(len(kept), _ANY_HEIGHT_M)
        finding_reporter(findings, "warning", "height_assumed", file, value=len(kept))(
            f"no fix states a height; 0 m is assumed, with a sigma of {_ANY_HEIGHT_M:g} m. Switch "
            "on GGA for heights."
        )
    time_ns = gps_of(utc_ns) if days[0] >= 0 else utc_ns + _DAY_NS
    place = of_place("lat"), of_place("lon"), height
    sigma_m = column("north"), column("east"), up
    v_n, kind = over_ground(speed, course), np.array([_KIND.get(int(one), 0) for one in quality])
    flat = np.zeros(len(kept), bool)
    table = fixes(file, time_ns, place, sigma_m, v_n, nothing, kind, flat, findings)
    if unknown:
        marks = np.zeros((len(kept), 3), bool) if table.assumed_m is None else table.assumed_m
        table = replace(table, assumed_m=marks | [False, False, True])
    return table, column("at")


def _report_kinds(file: str, quality: np.ndarray, without: int, findings: Findings) -> None:
    """Report positions from RMC alone among others, and qualities that count as no fix."""
    reporter = partial(finding_reporter, findings, "note", "other_kinds", file)
    if 0 < without < len(quality):
        reporter(value=without)(
            f"{without} of {len(quality)} epochs have RMC and no GGA; their place is that of RMC, "
            "which states no height. Switch on GGA at the rate of RMC for heights."
        )
    for number, what in _NO_FIX.items():
        if count := int((quality == number).sum()):
            reporter(value=count)(
                f"{count} sentences GGA have the quality {number} ({what}); they count as no fix."
            )


def _epochs(file: str, data: Bytes, findings: Findings) -> list[dict[str, float]]:
    """Numbers of the sentences by time of day; `_in_order` gives one to those without."""
    epochs: list[dict[str, float]] = []
    talkers = {one[1] for one in _SENTENCE.finditer(data) if one[4]}
    wrong, left = 0, set[bytes]()
    for one in _in_order(data):
        talker, kind, body, given = one.groups()
        if given is None and one.end() == len(data):
            report_cut_end(findings, file, one.start())
            continue
        try:
            if given is None or int(given, 16) != reduce(xor, talker + kind + b"," + body):
                raise ValueError
            found = _numbers(kind.decode(), body.decode("ascii").split(","))
        except (ValueError, IndexError):
            wrong += not end_of_frame(data, one.start())
            continue
        near = (epoch for epoch in epochs[:-4:-1] if epoch["time"] == found.get("time"))
        epoch = epochs[-1] if kind == b"VTG" and epochs else next(near, None)
        if epoch is None and "time" in found:
            epochs.append(epoch := {"at": float(one.start())})
        if epoch is not None:
            if epoch.keys() >= found.keys():
                left.add(talker)
            better = talker == b"GN" and len(talkers) > 1
            epoch |= found if better else {k: x for k, x in found.items() if k not in epoch}
    report_left_out(findings, file, wrong, "sentences lack a right checksum or a field")
    if len(left) and len(talkers) > 1:
        finding_reporter(findings, "note", "several_instances", file, value=len(talkers))(
            f"several talkers ({', '.join(sorted(t.decode() for t in talkers))}) state the same; "
            "GN is read where it is among them, else the first."
        )
    return epochs


def _in_order(data: Bytes) -> Iterator[re.Match[bytes]]:
    """Sentences, ordered so that a VTG follows one with the time of its epoch.

    If the first sentence is a VTG and the last is not, a VTG begins each burst and belongs to the
    time that follows; else to the time before it.
    """
    first = last = None
    for last in _SENTENCE.finditer(data):
        first = first or last
    leads = first is not None and last is not None and first[2] == b"VTG" != last[2]
    held: list[re.Match[bytes]] = []
    for one in _SENTENCE.finditer(data):
        if leads and one[2] == b"VTG":
            held.append(one)
            continue
        yield one
        yield from held
        held.clear()


def _quality(modes: str) -> float:
    """GGA quality from the letters of GNS or RMC, one per constellation; the best counts."""
    return float(next((quality for letter, quality in _MODES.items() if letter in modes), 0))


def _numbers(kind: str, fields: list[str]) -> dict[str, float]:
    """Numbers of a sentence by name.

    Raises:
        ValueError: a field is no number, time or date.
        IndexError: there are too few fields.
    """

    def number(k: int) -> float:
        return float(fields[k]) if fields[k] else math.nan

    def degrees(k: int) -> float:
        whole = number(k) // 100.0  # ddmm.mmm
        value = whole + (number(k) - 100.0 * whole) / 60.0
        return -value if fields[k + 1] in ("S", "W") else value

    if kind == "VTG":
        return {"speed1": number(4), "course1": number(0)}
    if not fields[0]:
        return {}  # the receiver has no time yet
    if (clock := _CLOCK.fullmatch(fields[0])) is None:
        raise ValueError
    minutes = 60 * int(clock[1]) + int(clock[2])
    found: dict[str, float] = {"time": 6e10 * minutes + round(float(clock[3]) * 1e9)}
    if kind in ("GGA", "GNS"):
        found["quality1"] = float(fields[5] or 0) if kind == "GGA" else _quality(fields[5])
        found |= {"altitude": number(8), "height": number(8) + number(10 if kind == "GGA" else 9)}
        return found | {"lat1": degrees(1), "lon1": degrees(3)}
    if kind == "GST":
        return found | {"north": number(5), "east": number(6), "up": number(7)}
    if kind == "RMC":
        valid, date = fields[1] == "A", fields[8]
        mode = "".join(fields[11:12]) or "A"  # stated since NMEA 2.3
        found["quality2"] = _quality(mode) if valid else 0.0
        found |= {"lat2": degrees(2), "lon2": degrees(4)}
        found |= {"speed": number(6), "course": number(7)} if valid else {}
        century = "19" if date[4:5] > "7" else "20"
        day = [date[:2], date[2:4], century + date[4:]] if date else [""]
    else:
        day = fields[1:4]
    if all(day):
        there = datetime.date(*(int(x) for x in day[::-1]))
        found["day"] = float(there.toordinal() - _EPOCH)
    return found


def _days(file: str, epochs: list[dict[str, float]], findings: Findings) -> list[int]:
    """Day of each epoch: as stated, else that of its neighbour, corrected for midnight.

    Days count from 1970, or from -1 if no sentence states the date.
    """
    midnights = [0] * len(epochs)
    for k in range(1, len(epochs)):
        back = epochs[k]["time"] < epochs[k - 1]["time"] - _DAY_NS // 2
        midnights[k] = midnights[k - 1] + back
    stated = [int(e["day"]) - n for e, n in zip(epochs, midnights, strict=True) if "day" in e]
    if epochs and not stated:
        finding_reporter(findings, "note", "undated", file, value=len(epochs))(
            "no sentence states the date (RMC, ZDA); stamps count from the midnight before the "
            "first."
        )
    day, days = stated[0] if stated else -1, []
    for epoch, count in zip(epochs, midnights, strict=True):
        day = int(epoch["day"]) - count if "day" in epoch else day
        days.append(day + count)
    return days
