"""Sentences of NMEA 0183 that a receiver wrote, whatever else stands between them.

- ``GGA``: fixes; the height above the ellipsoid is the altitude plus the separation of the geoid.
- ``RMC``, else ``VTG``: velocity over ground; there is none down. Without GGA also the place.
- ``GST``: sigmas of the place. Others are the usual ones of the kind of a fix, see `fix_kinds`.
- ``RMC`` and ``ZDA``: the date. Stamps are UTC and become GPS time.

Sentences without a right checksum are left out and counted. Of several talkers GN counts, or the
first. Source: NMEA 0183 4.11; u-blox F9 HPG 1.32 interface description, UBX-22008968.
"""

from __future__ import annotations

import datetime
import math
import mmap
import os
import re
from functools import reduce
from operator import xor

import numpy as np

from robins.dataset import GnssTable
from robins.gps_time import gps_of
from robins.logs.findings import Finding, LogError, breaks_off, left_out, telling
from robins.logs.fix_kinds import fixes
from robins.logs.opening import mapped
from robins.logs.text import Head
from robins.units import to_si

_BEGINS = re.compile(
    rb"(?:^|[\r\n])[^$\r\n]{0,60}\$[A-Z]{2}(?:GGA|RMC|VTG|GST|ZDA|GLL|GS[AV]|TXT),"
)
_SENTENCE = re.compile(
    rb"\$([A-Z]{2})(GGA|RMC|VTG|GST|ZDA),([^*$\r\n]{0,200})(?:\*([0-9A-Fa-f]{2}))?", re.DOTALL
)
_DAY_NS, _EPOCH = 86_400_000_000_000, datetime.date(1970, 1, 1).toordinal()
_KIND = {"1": 5, "2": 4, "3": 5, "4": 1, "5": 2}  # of GGA -> RTKLIB's Q; others are no fix
_ESTIMATED = ("6", "7", "8")  # by dead reckoning, by hand, simulated

Epoch = dict[str, list[str]]
"""Sentences of one time of day, by their type."""


def is_nmea(head: Head) -> bool:
    """Has a line with a sentence among the first bytes."""
    return _BEGINS.search(head.start) is not None


def read_nmea(path: str | os.PathLike[str], findings: list[Finding] | None = None) -> GnssTable:
    """Read fixes.

    Args:
        path: the file, plain or compressed.
        findings: receives what was left out or assumed; without it that is issued as `LogWarning`.

    Raises:
        LogError: there is no sentence GGA or RMC with a right checksum.
    """
    file = str(path)
    data, _ = mapped(path)
    times, epochs = _epochs(_sentences(file, data, findings))
    placed = "GGA" if any("GGA" in epoch for epoch in epochs) else "RMC"
    kept = [k for k, epoch in enumerate(epochs) if placed in epoch]
    if not kept:
        cause = "has no sentence GGA or RMC with a right checksum"
        raise LogError(file, cause, "switch on GGA, RMC and GST in the receiver")
    days = _days(file, times, epochs, findings)
    utc_ns = np.array([days[k] * _DAY_NS + times[k] for k in kept], np.int64)
    rows = [_fix(epochs[k], placed) for k in kept]
    estimated = 0
    if placed == "GGA":
        estimated = sum(epochs[k]["GGA"][5] in _ESTIMATED for k in kept)
    if estimated:
        telling(findings, "note", "other_kinds", file, value=estimated)(
            f"{estimated} fixes are estimated, set by hand or simulated; they are taken as none."
        )
    lat, lon, height_m, *sigmas, north, east, kind = np.array(rows).T
    nothing = np.full(len(rows), np.nan)
    return fixes(
        file,
        gps_of(utc_ns) if days[kept[0]] else utc_ns,
        (lat, lon, height_m),
        (sigmas[0], sigmas[1], sigmas[2]),
        np.stack([north, east, nothing], axis=-1),
        nothing,
        kind,
        np.zeros(len(rows), bool),
        findings,
    )


def _sentences(
    file: str, data: bytes | mmap.mmap, findings: list[Finding] | None
) -> list[tuple[str, list[str]]]:
    """Type and fields of the sentences with a right checksum, of one talker for each type."""
    found: list[tuple[str, str, list[str]]] = []
    talkers: dict[str, list[str]] = {}
    wrong, open_at = 0, -1
    for one in _SENTENCE.finditer(data):
        talker, kind, body, given = one.groups()
        sum_of = reduce(xor, talker + kind + b"," + body)
        fields = body.decode("ascii", "replace").split(",")
        if given is None and one.end() == len(data):
            open_at = one.start()
        elif given is None or int(given, 16) != sum_of or not _plausible(kind.decode(), fields):
            wrong += 1
        else:
            name = kind.decode()
            found.append((talker.decode(), name, fields))
            talkers.setdefault(name, [])
            if talker.decode() not in talkers[name]:
                talkers[name].append(talker.decode())
    left_out(findings, file, wrong, "sentences lack a right checksum or a field")
    if open_at >= 0:
        breaks_off(findings, file, open_at)
    chosen = {k: "GN" if "GN" in names else names[0] for k, names in talkers.items()}
    several = sorted({name for k, names in talkers.items() for name in names} - {*chosen.values()})
    if several:
        telling(findings, "note", "several_instances", file, value=len(several) + 1)(
            f"sentences come from several talkers; {', '.join(sorted({*chosen.values()}))} is read "
            f"and the others are left alone: {', '.join(several)}."
        )
    return [(kind, fields) for talker, kind, fields in found if talker == chosen[kind]]


_NUMBER = re.compile(r"(-?(\d+\.?\d*|\.\d+))?")
_CLOCK = re.compile(r"(([01]\d|2[0-3])[0-5]\d([0-5]\d|60)(\.\d*)?)?")
_SHAPE = {  # fields at least, and the places of numbers, which may be empty
    "GGA": (11, (1, 3, 8, 10)),
    "RMC": (9, (2, 4, 6, 7, 8)),
    "VTG": (5, (0, 4)),
    "GST": (8, (5, 6, 7)),
    "ZDA": (4, (1, 2, 3)),
}


def _plausible(kind: str, fields: list[str]) -> bool:
    """Has as many fields as its type, a time and numbers where they belong."""
    least, numbers = _SHAPE[kind]
    if len(fields) < least or (kind != "VTG" and not _CLOCK.fullmatch(fields[0])):
        return False
    return all(_NUMBER.fullmatch(fields[k]) for k in numbers)


def _number(text: str) -> float:
    return float(text) if text else math.nan


def _epochs(sentences: list[tuple[str, list[str]]]) -> tuple[list[int], list[Epoch]]:
    """Times of day [ns] and the sentences of each; those without a time belong to the last."""
    times: list[int] = []
    epochs: list[Epoch] = []
    for kind, fields in sentences:
        if kind == "VTG":
            if epochs:
                epochs[-1].setdefault(kind, fields)
            continue
        if not fields[0]:
            continue  # a receiver that does not know the time yet
        clock = fields[0]
        time_ns = (int(clock[:2]) * 60 + int(clock[2:4])) * 60_000_000_000
        time_ns += round(float(clock[4:]) * 1e9)
        near = [
            k for k in range(len(times) - 1, max(len(times) - 4, -1), -1) if times[k] == time_ns
        ]
        if near:
            epochs[near[0]].setdefault(kind, fields)
        else:
            times.append(time_ns)
            epochs.append({kind: fields})
    return times, epochs


def _date(epoch: Epoch) -> int | None:
    """Days since 1970 of an epoch that states its date."""
    if (zda := epoch.get("ZDA")) and all(zda[1:4]):
        day, month, year = (int(float(x)) for x in zda[1:4])
    elif (rmc := epoch.get("RMC")) and len(rmc[8]) == 6 and rmc[8].isdigit():
        day, month, year = int(rmc[8][:2]), int(rmc[8][2:4]), int(rmc[8][4:])
        year += 2000 if year < 80 else 1900
    else:
        return None
    try:
        return datetime.date(year, month, day).toordinal() - _EPOCH
    except ValueError:
        return None


def _days(
    file: str, times: list[int], epochs: list[Epoch], findings: list[Finding] | None
) -> list[int]:
    """Day of each epoch: that it states, else that of its neighbour, with midnights between."""
    stated = [_date(epoch) for epoch in epochs]
    first = next((k for k, day in enumerate(stated) if day is not None), None)
    if first is None:
        telling(findings, "note", "undated", file, value=len(epochs))(
            "no sentence states the date (RMC, ZDA); stamps count from the midnight before the "
            "first."
        )
    midnight = [0] * len(times)  # counted up to each epoch
    for k in range(1, len(times)):
        midnight[k] = midnight[k - 1] + (times[k] < times[k - 1] - _DAY_NS // 2)
    day = 0 if first is None else (stated[first] or 0) - midnight[first]
    days: list[int] = []
    for k in range(len(times)):
        if (known := stated[k]) is not None:
            day = known - midnight[k]
        days.append(day + midnight[k])
    return days


def _degrees(text: str, side: str) -> float:
    """Degrees of ddmm.mmm, negative to the south and west."""
    if not text:
        return math.nan
    whole = float(text) // 100.0
    return (whole + (float(text) - 100.0 * whole) / 60.0) * (-1.0 if side in ("S", "W") else 1.0)


def _fix(epoch: Epoch, placed: str) -> tuple[float, ...]:
    """Latitude, longitude [deg], height [m], sigmas [m], velocity north, east [m/s], kind."""
    rmc, vtg, gst = (epoch.get(kind) for kind in ("RMC", "VTG", "GST"))
    valid = rmc is not None and rmc[1] == "A"
    if placed == "GGA":
        gga = epoch["GGA"]
        kind, place = _KIND.get(gga[5], 0), gga[1:5]
        height_m = _number(gga[8]) + _number(gga[10])
    else:
        kind, place, height_m = (5 if valid else 0), (rmc or [])[2:6], math.nan
    lat, lon = _degrees(*place[:2]), _degrees(*place[2:4])
    sigmas = map(_number, gst[5:8] if gst else ("", "", ""))
    speed = course = math.nan
    if rmc is not None:
        speed, course = (_number(rmc[6]), _number(rmc[7])) if valid else (math.nan, math.nan)
    elif vtg is not None:
        speed, course = _number(vtg[4]), _number(vtg[0])
    speed = to_si(speed, "kn")
    if speed < 0.05 and math.isnan(course):  # receivers leave out the course at rest
        course = 0.0
    north, east = speed * math.cos(math.radians(course)), speed * math.sin(math.radians(course))
    return lat, lon, height_m, *sigmas, north, east, kind
