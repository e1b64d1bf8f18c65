"""Flight logs of ArduPilot (dataflash, ``.BIN``), which describe their own messages.

Read are, of the lowest instance of each:

- ``IMU``: rates [rad/s] and specific force [m/s^2], forward-right-down;
- ``MAG``: magnetic field [mG], less the offsets that the autopilot believes;
- ``GPS``, with the accuracies and the geoid of ``GPA``: fixes at their GPS week and time of week.

All else counts microseconds since power-up and is put on GPS time by the fixes. There are no
checksums: messages must follow each other without a break, but an altered number is not noticed.
Source: ArduPilot, libraries/AP_Logger/README.md.
"""

from __future__ import annotations

import mmap
import os
import struct
from array import array
from pathlib import Path
from typing import NamedTuple

import numpy as np

from robins.dataset import Dataset, GnssTable, ImuTable, MagTable
from robins.logs.findings import (
    Finding,
    LogError,
    above_geoid,
    breaks_off,
    damaged,
    left_out,
    refused,
    telling,
    undated,
)
from robins.logs.fix_kinds import MAVLINK, fixes
from robins.logs.merging import gps_clock
from robins.logs.opening import mapped
from robins.logs.text import Head
from robins.logs.timebase import GPS_EPOCH_NS, LIMIT_NS, WEEK_NS
from robins.units import to_si

_MARK, _FMT = b"\xa3\x95", 0x80
_FORMAT = struct.Struct("<BB4s16s64s")
_WANTED = ("IMU", "MAG", "GPS", "GPA")
_TYPES = {  # code -> type of NumPy, factor
    "b": ("i1", 1.0), "B": ("u1", 1.0), "h": ("i2", 1.0), "H": ("u2", 1.0), "i": ("i4", 1.0),
    "I": ("u4", 1.0), "f": ("f4", 1.0), "d": ("f8", 1.0), "q": ("i8", 1.0), "Q": ("u8", 1.0),
    "g": ("f2", 1.0), "M": ("u1", 1.0), "a": ("V64", 1.0), "n": ("V4", 1.0), "N": ("V16", 1.0),
    "Z": ("V64", 1.0), "c": ("i2", 0.01), "C": ("u2", 0.01), "e": ("i4", 0.01), "E": ("u4", 0.01),
    "L": ("i4", 1e-7),
}  # fmt: skip


class _Message(NamedTuple):
    """What was logged of a name."""

    name: str
    rows: np.ndarray  # of a structured type
    factors: dict[str, float]


def is_dataflash(head: Head) -> bool:
    """Begins with the definition of a message."""
    return head.start.startswith(_MARK + bytes([_FMT]))


def read_dataflash(path: str | os.PathLike[str], findings: list[Finding] | None = None) -> Dataset:
    """Read inertial samples, and field and fixes where they were logged.

    Args:
        path: the file, plain or compressed.
        findings: receives what was left out or assumed; without it that is issued as `LogWarning`.

    Raises:
        LogError: a definition is damaged, or there are no inertial samples.
    """
    file = str(path)
    data, _ = mapped(path)
    logged = _messages(file, data, findings)
    if "IMU" not in logged:
        held = ", ".join(sorted(logged)) or "nothing that robins reads"
        raise LogError(file, f"has no samples IMU; it holds {held}", "set LOG_BITMASK to log them")
    imu, mag, gps, gpa = (
        logged[name] and _instance(file, logged[name], findings) if name in logged else None
        for name in _WANTED
    )
    assert imu is not None
    gnss = None
    stamps = {name: _stamps(file, one) for name, one in (("imu", imu), ("mag", mag)) if one}
    if gps is not None:
        gnss, arrived = _fixes(file, gps, gpa, findings)
        known = np.isfinite(gnss.lat_rad)
        if known.any():
            clock = gps_clock(file, arrived[known], gnss.time_ns[known], findings)
            stamps = {name: clock(time_ns) for name, time_ns in stamps.items()}
        else:
            gnss = None
    return Dataset(
        name=Path(file).name.split(".")[0],
        imu=ImuTable(
            stamps["imu"], _triad(file, imu, "Gyr"), _triad(file, imu, "Acc"), "rate", source=file
        ),
        mag=mag and MagTable(stamps["mag"], to_si(_triad(file, mag, "Mag"), "mG"), source=file),
        gnss=gnss,
        time_unit_known=(file,),
    )


def _messages(
    file: str, data: bytes | mmap.mmap, findings: list[Finding] | None
) -> dict[str, _Message]:
    """The wanted messages; bytes that belong to none are counted.

    Raises:
        LogError: a definition contradicts itself or an earlier one.
    """
    sizes = [0] * 256
    sizes[_FMT] = 3 + _FORMAT.size
    kinds: dict[int, tuple[str, np.dtype, dict[str, float]]] = {}
    places: dict[int, array[int]] = {}
    at, stray, end = 0, 0, len(data)

    def fits(place: int) -> int:
        """Size of the message there, 0 where there is none."""
        if place + 3 > end or data[place] != _MARK[0] or data[place + 1] != _MARK[1]:
            return 0
        size = sizes[data[place + 2]]
        return size if place + size <= end else 0

    while at < end:
        if not (size := fits(at)):
            begin = at
            at = data.find(_MARK, at + 1)
            while at >= 0 and not ((size := fits(at)) and (at + size == end or fits(at + size))):
                at = data.find(_MARK, at + 1)
            at = end if at < 0 else at
            if set(data[begin : begin + 64]) - {
                0,
                255,
            }:  # blocks of a chip are filled up with these
                stray += at - begin
                if at == end and end - begin < 256 and data[begin : begin + 2] == _MARK:
                    stray -= at - begin
                    breaks_off(findings, file, begin)
            continue
        kind = data[at + 2]
        if kind == _FMT:
            name, number, layout = _definition(file, data, at)
            if sizes[number] not in (0, layout[0].itemsize + 3):
                raise damaged(file)(f"{name} at byte {at} was defined with another size before")
            sizes[number] = layout[0].itemsize + 3
            if name in _WANTED:
                kinds[number] = (name, *layout)
                places.setdefault(number, array("q"))
        elif kind in places:
            places[kind].append(at + 3)
        at += size
    left_out(findings, file, stray, "bytes belong to no message")
    found: dict[str, _Message] = {}
    for number, (name, kind, factors) in kinds.items():
        if places[number]:
            content = b"".join(data[k : k + kind.itemsize] for k in places[number])
            found[name] = _Message(name, np.frombuffer(content, kind), factors)
    return found


def _definition(
    file: str, data: bytes | mmap.mmap, at: int
) -> tuple[str, int, tuple[np.dtype, dict[str, float]]]:
    """Name, number and layout of a message.

    Raises:
        LogError: it contradicts itself.
    """
    number, size, *texts = _FORMAT.unpack_from(data, at + 3)
    name, codes, columns = (text.rstrip(b"\0").decode("ascii", "replace") for text in texts)
    names = columns.split(",") if columns else []
    if number == _FMT:
        size, codes = 3 + _FORMAT.size, "BBnNZ"
    if len(names) != len(codes) or len(set(names)) != len(names) or set(codes) - _TYPES.keys():
        raise damaged(file)(f"the definition of {name!r} at byte {at} has no layout")
    kind = np.dtype([(n, f"<{_TYPES[c][0]}") for n, c in zip(names, codes, strict=True)])
    if kind.itemsize + 3 != size:
        raise damaged(file)(f"the definition of {name!r} at byte {at} states {size} bytes")
    return name, number, (kind, {n: _TYPES[c][1] for n, c in zip(names, codes, strict=True)})


def _instance(file: str, one: _Message, findings: list[Finding] | None) -> _Message:
    """The rows of the lowest instance."""
    if "I" not in one.factors:
        return one
    numbers = np.unique(one.rows["I"])
    if len(numbers) > 1 and one.name != "GPA":
        telling(findings, "note", "several_instances", file, value=len(numbers))(
            f"{one.name} was logged of {len(numbers)} sensors; number {numbers[0]} is read and the "
            "others are left alone."
        )
    return one._replace(rows=one.rows[one.rows["I"] == numbers[0]])


def _column(file: str, one: _Message, name: str) -> np.ndarray:
    if name not in one.factors or one.rows[name].dtype.kind not in "iuf":
        raise refused(file, field=one.name)(
            f"has no field {name}; it has {', '.join(one.factors)}",
            "this version of ArduPilot is not known; convert the log to CSV",
        )
    with np.errstate(invalid="ignore"):  # a NaN that signals stays a NaN
        return one.rows[name].astype(np.float64) * one.factors[name]


def _triad(file: str, one: _Message, stem: str) -> np.ndarray:
    return np.stack([_column(file, one, stem + axis) for axis in "XYZ"], axis=-1)


def _stamps(file: str, one: _Message) -> np.ndarray:
    """Time since power-up [ns]."""
    _column(file, one, "TimeUS")
    stamps = one.rows["TimeUS"]
    if stamps.dtype.kind not in "iu" or np.any(stamps >= LIMIT_NS // 1000) or np.any(stamps < 0):
        raise refused(file, field=f"stamps of {one.name}")(
            "are no microseconds since power-up", "fetch it again"
        )
    return stamps.astype(np.int64) * 1000


def _fixes(
    file: str, gps: _Message, gpa: _Message | None, findings: list[Finding] | None
) -> tuple[GnssTable, np.ndarray]:
    """Fixes that have a GPS time, and when each was logged."""
    week, ms = (np.rint(_column(file, gps, name)) for name in ("GWk", "GMS"))
    dated = (
        (week > 0) & (week < LIMIT_NS // WEEK_NS - 600) & (ms >= 0) & (ms < WEEK_NS // 1_000_000)
    )
    undated(findings, file, int((~dated).sum()), "messages GPS")
    gps = gps._replace(rows=gps.rows[dated])
    arrived, status = _stamps(file, gps), _column(file, gps, "Status")
    time_ns = GPS_EPOCH_NS + week[dated].astype(np.int64) * WEEK_NS
    time_ns += ms[dated].astype(np.int64) * 1_000_000

    def beside(name: str) -> np.ndarray:
        """A column of GPA at the stamps of the fixes; NaN where there is none."""
        if gpa is None or name not in gpa.factors or not len(gpa.rows):
            return np.full(len(arrived), np.nan)
        at = _stamps(file, gpa)
        order = np.argsort(at, kind="stable")
        row = order[np.minimum(np.searchsorted(at, arrived, sorter=order), len(at) - 1)]
        return np.where(at[row] == arrived, _column(file, gpa, name)[row], np.nan)

    # the autopilot counts the geoid's height with the other sign
    separation, height_m = beside("Und"), _column(file, gps, "Alt")
    if np.isnan(separation).any() and len(separation):
        above_geoid(findings, file, "A newer version of ArduPilot logs the geoid.")
        separation = np.zeros_like(separation)
    over_ground, course = _column(file, gps, "Spd"), np.deg2rad(_column(file, gps, "GCrs"))
    down = np.where(beside("VV") == 0.0, np.nan, _column(file, gps, "VZ"))
    table = fixes(
        file,
        time_ns,
        (_column(file, gps, "Lat"), _column(file, gps, "Lng"), height_m - separation),
        (beside("HAcc"), beside("HAcc"), beside("VAcc")),
        np.stack([over_ground * np.cos(course), over_ground * np.sin(course), down], axis=-1),
        beside("SAcc"),
        np.array([MAVLINK.get(int(k), 0) for k in status]),
        status == 2,
        findings,
    )
    return table, arrived
