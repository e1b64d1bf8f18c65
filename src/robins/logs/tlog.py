"""Telemetry of MAVLink (``.tlog``), decoded by the package pymavlink of the extra ``logs``.

Messages read, from the first vehicle that sends any:

- ``HIGHRES_IMU`` (SI, gauss), else ``SCALED_IMU``, else ``RAW_IMU`` of ArduPilot, whose units are
  those of the scaled one (mG of gravity, mrad/s, milligauss): samples and magnetic field, FRD;
- ``GPS_RAW_INT``: fixes, with velocity over ground.

Stamps are those of the vehicle, since power-up or UTC. If the fixes have UTC and the samples do
not, the latter are converted by the order of arrival. Source: mavlink.io, common.xml.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from typing import Any

import numpy as np

from robins.dataset import Dataset, GnssTable, ImuTable, MagTable
from robins.gps_time import dated, gps_of
from robins.logs.findings import (
    AnyPath,
    Findings,
    LogError,
    extra_package,
    finding_reporter,
    report_cut_end,
    report_geoid_heights,
    report_left_out,
)
from robins.logs.fix_kinds import MAVLINK, fixes, over_ground
from robins.logs.merging import gps_clock
from robins.logs.opening import Bytes, map_file
from robins.logs.tables import recording
from robins.logs.text import Head
from robins.logs.ulog import UlogTopic, column, stamps, triad
from robins.units import to_si

_STAMP = struct.Struct(">Q")  # microseconds of UTC at which the ground station received it
_EARLIEST, _LATEST = (int(year * 31_556_952e6) for year in (30, 130))
_ONE, _TWO = 0xFE, 0xFD  # first byte of a frame of MAVLink 1 and 2
_FIRST = re.compile(rb"[\xfd\xfe]")
_INERTIAL = {105: "HIGHRES_IMU", 26: "SCALED_IMU", 27: "RAW_IMU"}
_GPS = 24
_SENSORS = [axis + what for what in ("gyro", "acc", "mag") for axis in "xyz"]
_FIX = ("fix_type", "lat", "lon", "alt", "alt_ellipsoid", "h_acc", "v_acc", "vel_acc", "vel", "cog")


def is_tlog(head: Head) -> bool:
    """True if a file begins with a plausible date and a frame."""
    if len(head.start) < 12 or head.start[8] not in (_ONE, _TWO):
        return False
    return _EARLIEST < _STAMP.unpack_from(head.start)[0] < _LATEST


def read_tlog(path: AnyPath, findings: Findings = None) -> Dataset:
    """Read inertial samples, and magnetic field and fixes if sent.

    Args:
        path: the file, plain or compressed.
        findings: receives omissions and assumptions; without it they are issued as `LogWarning`.

    Raises:
        LogError: pymavlink is not installed, or there are no inertial samples.
    """
    file = str(path)
    topics = _topics(file, map_file(path, findings), findings)
    number = next((k for k in _INERTIAL if k in topics), None)
    if number is None:
        cause = f"has no messages {', '.join(_INERTIAL.values())}"
        raise LogError(file, cause, "request them at 50 Hz or more, or use the log on board")
    imu, gps, gnss = topics[number], topics.get(_GPS), None
    units = ("rad/s", "m/s^2", "G") if number == 105 else ("mrad/s", "mg", "mG")
    gyro, accel, field = (
        to_si(triad(file, imu, "{}" + what, "xyz"), unit)
        for what, unit in zip(("gyro", "acc", "mag"), units, strict=True)
    )
    time_ns = _stamps(file, imu)
    if gps is not None and (column(file, gps, "fix_type") >= 2).any():
        gnss = _fixes(file, gps, findings)
        arrived = np.searchsorted(imu.fields["at"], gps.fields["at"]) - 1
        known = (arrived >= 0) & np.isfinite(gnss.lat_rad)
        if _dated(gnss.time_ns) and not _dated(time_ns) and known.any():
            clock = gps_clock(file, time_ns[arrived[known]], gnss.time_ns[known], findings)
            time_ns = clock(time_ns)
    there = field.any(axis=1)  # zeros mean no magnetometer
    mag = MagTable(time_ns[there], field[there], source=file) if there.any() else None
    samples = ImuTable(time_ns, gyro, accel, "rate", source=file)
    return recording(file, samples, gnss, mag=mag)


def _frames(file: str, data: Bytes, findings: Findings) -> Iterator[tuple[int, int, bytes]]:
    """Position, message number and bytes of the frames that are read."""
    at, end, stray = 0, len(data), 0
    while at < end:
        stamp, first, length, flags = struct.unpack(">QBBB", data[at : at + 11].ljust(11, b"\0"))
        size = {_ONE: 16, _TWO: 20 + 13 * (flags & 1)}.get(first, 0) + length
        if size <= length or not _EARLIEST < stamp < _LATEST:
            later = _FIRST.search(data, at + 9)  # after the stamp of the next frame
            stray, at = stray - at, later.start() - 8 if later else end
            stray += at
            continue
        if at + size > end:
            report_cut_end(findings, file, at)
            break
        frame = data[at + 8 : at + size]
        number = frame[5] if first == _ONE else int.from_bytes(frame[7:10], "little")
        if number == _GPS or number in _INERTIAL:
            yield at, number, frame
        at += size
    report_left_out(findings, file, stray, "bytes belong to no message")


def _topics(file: str, data: Bytes, findings: Findings) -> dict[int, UlogTopic]:
    """Messages of the first vehicle with inertial samples, by message number.

    Raises:
        LogError: pymavlink is not installed.
    """
    with extra_package(file, "telemetry of MAVLink"):
        from pymavlink.dialects.v20 import common
    decoder, wrong = common.MAVLink(None), 0
    senders: dict[tuple[int, int, int], dict[int, list[list[float]]]] = {}
    for at, number, frame in _frames(file, data, findings):
        try:
            one: Any = decoder.decode(bytearray(frame))
        except common.MAVError:
            wrong += 1
            continue
        names = _FIX if number == _GPS else _SENSORS
        stamp = 1000 * one.time_boot_ms if number == 26 else one.time_usec
        unit = one.id if number == 105 else 0  # one of several units on a vehicle
        sender = senders.setdefault((one.get_srcSystem(), one.get_srcComponent(), unit), {})
        sender.setdefault(number, []).append([at, stamp, *(getattr(one, x) for x in names)])
    report_left_out(findings, file, wrong, "messages have a wrong checksum")
    if len(senders) > 1:
        finding_reporter(findings, "note", "several_instances", file, value=len(senders))(
            f"{len(senders)} vehicles, components or units sent samples; the first is read."
        )
    first = next((s for s in senders.values() if s.keys() - {_GPS}), {})
    topics: dict[int, UlogTopic] = {}
    for number, rows in first.items():
        names = ("at", "timestamp", *(_FIX if number == _GPS else _SENSORS))
        fields = {name: np.array([row[k] for row in rows]) for k, name in enumerate(names)}
        fields["timestamp"] = fields["timestamp"].astype(np.uint64)
        topics[number] = UlogTopic(_INERTIAL.get(number, "GPS_RAW_INT"), fields)
    return topics


def _dated(time_ns: np.ndarray) -> bool:
    return dated(int(time_ns[-1]))


def _stamps(file: str, topic: UlogTopic) -> np.ndarray:
    """GPS time if the vehicle has UTC, else time since power-up [ns]."""
    time_ns = stamps(file, topic)
    return gps_of(time_ns) if _dated(time_ns) else time_ns


def _fixes(file: str, gps: UlogTopic, findings: Findings) -> GnssTable:
    fix, lat, lon, msl, ellipsoid, h_acc, v_acc, vel_acc, vel, cog = (
        column(file, gps, name) for name in _FIX
    )
    if not ellipsoid.any():  # MAVLink 1 does not have it
        report_geoid_heights(findings, file, "Set the telemetry to MAVLink 2.")
        ellipsoid = msl
    speed, course = (np.where(x < 65535.0, x * 1e-2, np.nan) for x in (vel, cog))
    place = lat * 1e-7, lon * 1e-7, ellipsoid * 1e-3
    sigma_m, sigma_v = (h_acc * 1e-3, h_acc * 1e-3, v_acc * 1e-3), vel_acc * 1e-3
    v_n, kind = over_ground(speed, course), np.array([MAVLINK.get(int(k), 0) for k in fix])
    time_ns = _stamps(file, gps)
    return fixes(file, time_ns, place, sigma_m, v_n, sigma_v, kind, fix == 2, findings)
