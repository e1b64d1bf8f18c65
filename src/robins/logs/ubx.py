"""Recordings of u-blox receivers (UBX), also mixed with NMEA sentences and corrections.

- ``NAV-PVT``: fixes with velocity and sigmas; ``NAV-HPPOSLLH`` adds digits beyond 1e-7 deg.
- NMEA sentences if there is no ``NAV-PVT``, see `robins.logs.nmea`;
- ``ESF-MEAS``: rates and specific forces of a receiver with inertial sensors, in its own axes.

GPS time is the time of week of a fix, in the week of its date. Inertial stamps count milliseconds
of the receiver and are converted to GPS time by the order of arrival. ``hAcc`` is used for north
and for east, as for PX4. Source: u-blox F9 HPG 1.32 interface description, UBX-22008968.
"""

from __future__ import annotations

import re
import struct
from dataclasses import replace
from typing import TypeAlias

import numpy as np

from robins.dataset import Dataset, GnssTable, ImuTable
from robins.gps_time import gps_of
from robins.logs.findings import (
    AnyPath,
    Findings,
    LogError,
    finding_reporter,
    report_cut_end,
    report_left_out,
    report_undated,
)
from robins.logs.fix_kinds import fixes
from robins.logs.merging import gps_clock, merged
from robins.logs.nmea import fixes_of
from robins.logs.opening import Bytes, foreign, map_file, read_beginning
from robins.logs.rtcm import end_of_frame
from robins.logs.tables import Table, recording
from robins.logs.text import Head
from robins.logs.timebase import GPS_EPOCH_NS, WEEK_NS
from robins.units import to_si

_SYNC, _RTCM = b"\xb5\x62", b"\xd3\x00"
_FAR = 1 << 16  # bytes searched for a message
_HEAD = struct.Struct("<2sBBH")
_TAG = struct.Struct("<IHH")  # of ESF-MEAS: time [ms], flags, provider
_PVT, _HIGH, _MEAS, _RAW = 0x0107, 0x0114, 0x1002, 0x1003  # class and number
_NAV_PVT = np.dtype(  # oldest version; place: longitude, latitude [1e-7 deg]
    "<u4, <u2, u1, u1, 3u1, u1, V8, u1, u1, V2, 2<i4, <i4, V4, 2<u4, 3<i4, V8, <u4, V12"
)
_NAMES = "tow year month day clock valid _1 fix flags _2 place h_m _3 acc v _4 s_acc _5"
_NAV_PVT.names = tuple(_NAMES.split())
_NAV_HIGH = np.dtype("V3, u1, <u4, 2<i4, <i4, V4, 4i1, 2<u4")
_NAV_HIGH.names = ("_1", "invalid", "tow", "place", "h_m", "_2", "more", "acc")
_DATED = 3  # bits of valid: date, time
_GYRO, _ACCEL = (14, 13, 5), (16, 17, 18)  # types of x, y, z in ESF-MEAS
_GYRO_DEG_S, _ACCEL_M_S2 = 2.0**-12, 2.0**-10


Frames: TypeAlias = dict[int, list[tuple[int, int]]]
"""Position and length of the content of messages, by kind."""


def is_ubx(head: Head) -> bool:
    """True if a file begins with a UBX message, or has a valid one in its first 64 KiB.

    A capture may begin with NMEA sentences, corrections or a partial message.
    """
    if head.start.startswith(_SYNC):
        return True
    if foreign(head.start) and not head.start.startswith(_RTCM):
        return False
    start = read_beginning(head.file, _FAR)
    places = (at.start() for at in re.finditer(re.escape(_SYNC), start))
    return any(start[at + 2 : at + 3] != b"\0" and _end(start, at) for at in places)


def read_ubx(path: AnyPath, findings: Findings = None) -> Table | Dataset:
    """Read fixes, and inertial samples if recorded.

    Args:
        path: the file, plain or compressed.
        findings: receives omissions; without it they are issued as `LogWarning`.

    Returns:
        A dataset, or a table if there are only fixes or only samples.

    Raises:
        LogError: the file has neither.
    """
    file = str(path)
    data = map_file(path, findings)
    frames = _frames(file, data, findings)
    if frames[_RAW]:
        finding_reporter(findings, "note", "other_kinds", file, value=len(frames[_RAW]))(
            f"{len(frames[_RAW])} messages ESF-RAW are left out; switch on ESF-MEAS for samples."
        )
    measured = [place for place in frames[_MEAS] if place[1] >= _TAG.size]
    imu = _inertial(file, data, measured, findings)
    if frames[_PVT]:
        gnss, arrived = _fixes(file, data, frames, findings)
    elif re.search(rb"\$..(GGA|RMC),", data):
        gnss, arrived = fixes_of(file, data, findings)
    elif imu is not None:
        return imu
    else:
        raise LogError(file, "has no messages NAV-PVT or ESF-MEAS", "switch on UBX-NAV-PVT")
    if imu is None:
        return gnss
    tags = np.array([_TAG.unpack_from(data, at)[0] for at, _ in measured], np.int64) * 1_000_000
    before = np.searchsorted([at for at, _ in measured], arrived) - 1  # last one before each fix
    if (known := before >= 0).any():
        clock = gps_clock(file, tags[before[known]], gnss.time_ns[known], findings)
        imu = replace(imu, time_ns=clock(imu.time_ns))
    return recording(file, imu, gnss)


def _frames(file: str, data: Bytes, findings: Findings) -> Frames:
    """Position and length of the content of each message with a valid checksum, by kind."""
    found: Frames = {k: [] for k in (_PVT, _HIGH, _MEAS, _RAW)}
    at, wrong, open_at = data.find(_SYNC), 0, -1
    while at >= 0:
        head = data[at : at + _HEAD.size].ljust(_HEAD.size, b"\xff")
        _, group, number, size = _HEAD.unpack(head)
        end = at + _HEAD.size + size
        if _end(data, at):
            found.get(group << 8 | number, []).append((at + 6, size))
            wrong, open_at = wrong + (open_at >= 0), -1
            at = data.find(_SYNC, end + 2)
            continue
        if after := end_of_frame(data, at):
            at = data.find(_SYNC, after)
            continue
        if end + 2 > len(data):
            open_at = at if open_at < 0 else open_at
        else:
            wrong += 1
        at = data.find(_SYNC, at + 2)
    report_left_out(findings, file, wrong, "messages have a wrong length or checksum")
    if open_at >= 0:
        report_cut_end(findings, file, open_at)
    return found


def _end(data: Bytes, at: int) -> int:
    """End of the message at `at`; 0 if it is incomplete or its checksum is wrong."""
    end = at + _HEAD.size + int.from_bytes(data[at + 4 : at + 6], "little")
    whole = end + 2 <= len(data) and _checksum(data[at + 2 : end]) == data[end : end + 2]
    return end + 2 if whole else 0


def _checksum(content: bytes) -> bytes:
    """8-bit Fletcher checksum."""
    values = np.frombuffer(content, np.uint8).astype(np.int64)
    return bytes([values.sum() & 255, (values @ np.arange(len(values), 0, -1)) & 255])


def _rows(
    data: Bytes, frames: list[tuple[int, int]], kind: np.dtype
) -> tuple[np.ndarray, np.ndarray]:
    """Messages of a fixed layout, and their positions."""
    whole = [at for at, size in frames if size >= kind.itemsize]
    content = b"".join(data[at : at + kind.itemsize] for at in whole)
    return np.frombuffer(content, kind), np.array(whole, np.int64)


def _fixes(
    file: str, data: Bytes, frames: Frames, findings: Findings
) -> tuple[GnssTable, np.ndarray]:
    """Fixes with a date, and the position of each in the file."""
    pvt, at = _rows(data, frames[_PVT], _NAV_PVT)
    dated = ((pvt["valid"] & _DATED) == _DATED) & (pvt["tow"] < WEEK_NS // 1_000_000)
    dated &= (pvt["year"] >= 1980) & (pvt["year"] < 2100) & (pvt["month"] - 1 < 12)
    report_undated(findings, file, int((~dated).sum()), "messages NAV-PVT")
    pvt, at = pvt[dated], at[dated]
    day = [f"{y:04d}-{m:02d}" for y, m in zip(pvt["year"], pvt["month"], strict=True)]
    days = np.array(day, "datetime64[M]").astype("datetime64[D]").astype(np.int64) + pvt["day"] - 1
    utc_ns = (days * 86400 + pvt["clock"] @ np.array([3600, 60, 1])) * 1_000_000_000
    tow_ns = pvt["tow"].astype(np.int64) * 1_000_000
    week = np.rint((gps_of(utc_ns) - GPS_EPOCH_NS - tow_ns) / WEEK_NS).astype(np.int64)
    carrier = pvt["flags"] >> 6
    kind = np.select([carrier == 2, carrier == 1, pvt["flags"] & 2 > 0], [1, 2, 4], 5)
    there = (pvt["flags"] & 1 > 0) & (pvt["fix"] >= 2) & (pvt["fix"] <= 4)
    lon, lat, height_m = *(pvt["place"] * 1e-7).T, pvt["h_m"] * 1e-3
    horizontal, vertical = pvt["acc"].T * 1e-3
    high, _ = _rows(data, frames[_HIGH], _NAV_HIGH)
    _, mine, more = np.intersect1d(pvt["tow"], high["tow"], return_indices=True)
    tows, counts = np.unique(pvt["tow"], return_counts=True)
    if len(more):
        once = np.isin(pvt["tow"][mine], tows[counts == 1])  # others may be from another week
        once &= (high["invalid"][more] & 1) == 0
        mine, more = mine[once], more[once]
        place, digits = high["place"][more], high["more"][more]
        lon[mine], lat[mine] = (place * 1e-7 + digits[:, :2] * 1e-9).T
        height_m[mine] = high["h_m"][more] * 1e-3 + digits[:, 2] * 1e-4
        horizontal[mine], vertical[mine] = high["acc"][more].T * 1e-4
    time_ns, place = GPS_EPOCH_NS + week * WEEK_NS + tow_ns, (lat, lon, height_m)
    sigma_m, sigma_v = (horizontal, horizontal, vertical), pvt["s_acc"] * 1e-3
    kind, flat, v_n = np.where(there, kind, 0), pvt["fix"] == 2, pvt["v"] * 1e-3
    return fixes(file, time_ns, place, sigma_m, v_n, sigma_v, kind, flat, findings), at


def _inertial(
    file: str, data: Bytes, frames: list[tuple[int, int]], findings: Findings
) -> ImuTable | None:
    """Samples on the clock of the receiver."""
    halves: dict[tuple[int, ...], dict[int, list[int]]] = {_GYRO: {}, _ACCEL: {}}
    for at, size in frames:
        tag, flags, _ = _TAG.unpack_from(data, at)
        room = max((size - _TAG.size) // 4 - (flags >> 3 & 1), 0)  # a calibrated time may follow
        count = min(flags >> 11 or room, room)  # older messages state no number
        words = struct.unpack_from(f"<{count}I", data, at + _TAG.size)
        read = {word >> 24 & 63: (word & 0xFFFFFF ^ 0x800000) - 0x800000 for word in words}
        for axes, rows in halves.items():
            if all(axis in read for axis in axes):
                rows[tag] = [read[axis] for axis in axes]
    gyro, accel = (
        (np.array(list(rows), np.int64) * 1_000_000, np.array(list(rows.values()), np.float64))
        for rows in halves.values()
    )
    if not (len(gyro[0]) and len(accel[0])):
        return None
    rates, forces = to_si(gyro[1] * _GYRO_DEG_S, "deg/s"), accel[1] * _ACCEL_M_S2
    if np.array_equal(gyro[0], accel[0]):
        return ImuTable(gyro[0], rates, forces, "rate", source=file)
    turns = ImuTable(gyro[0], rates, np.full_like(rates, np.nan), "rate", source=file)
    other = ImuTable(accel[0], np.full_like(forces, np.nan), forces, "rate", source=file)
    return merged(turns, other, findings)
