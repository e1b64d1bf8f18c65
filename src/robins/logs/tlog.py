"""Telemetry of MAVLink (``.tlog``), decoded by the package pymavlink of the extra ``logs``.

Read are, from the first vehicle that sends any:

- ``HIGHRES_IMU`` (SI, gauss), else ``SCALED_IMU``, else ``RAW_IMU`` of ArduPilot, whose units are
  those of the scaled one (mG of gravity, mrad/s, milligauss): samples and magnetic field, FRD;
- ``GPS_RAW_INT``: fixes, with velocity over ground.

Stamps are those of the vehicle, since power-up or UTC. Where the fixes have UTC and the samples do
not, these are put on it by the order of arrival. Source: mavlink.io, common.xml.
"""

from __future__ import annotations

import mmap
import os
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from robins.dataset import Dataset, GnssTable, ImuTable, MagTable
from robins.gps_time import GPS_EPOCH_S, gps_of
from robins.logs.findings import Finding, LogError, above_geoid, breaks_off, left_out, telling
from robins.logs.fix_kinds import MAVLINK, fixes
from robins.logs.merging import gps_clock
from robins.logs.opening import mapped
from robins.logs.text import Head
from robins.units import to_si

_STAMP = struct.Struct(">Q")  # microseconds of UTC at which the ground station received it
_EARLIEST, _LATEST = (int(year * 31_556_952e6) for year in (30, 130))
_ONE, _TWO = 0xFE, 0xFD  # first byte of a frame of MAVLink 1 and 2
_HIGHRES, _SCALED, _RAW, _GPS = 105, 26, 27, 24
_NAMES = {_HIGHRES: "HIGHRES_IMU", _SCALED: "SCALED_IMU", _RAW: "RAW_IMU", _GPS: "GPS_RAW_INT"}
_GYRO, _ACCEL, _MAG = ([axis + what for axis in "xyz"] for what in ("gyro", "acc", "mag"))
_UNITS = {_HIGHRES: ("rad/s", "m/s^2", "G")}
_SCALED_UNITS = ("mrad/s", "mg", "mG")
_FIX = ("fix_type", "lat", "lon", "alt", "alt_ellipsoid", "h_acc", "v_acc", "vel_acc", "vel", "cog")


class _Rows(NamedTuple):
    """Messages of one kind of one vehicle."""

    at: np.ndarray  # place in the file
    time_ns: np.ndarray
    values: np.ndarray


def is_tlog(head: Head) -> bool:
    """Begins with a plausible date and a frame."""
    if len(head.start) < 12 or head.start[8] not in (_ONE, _TWO):
        return False
    return _EARLIEST < _STAMP.unpack_from(head.start)[0] < _LATEST


def read_tlog(path: str | os.PathLike[str], findings: list[Finding] | None = None) -> Dataset:
    """Read inertial samples, and field and fixes where they were sent.

    Args:
        path: the file, plain or compressed.
        findings: receives what was left out or assumed; without it that is issued as `LogWarning`.

    Raises:
        LogError: pymavlink is not installed, or there are no inertial samples.
    """
    file = str(path)
    data, _ = mapped(path)
    found, vehicles = _messages(file, data, findings)
    kind = next((k for k in (_HIGHRES, _SCALED, _RAW) if k in found), None)
    if kind is None:
        held = ", ".join(_NAMES[k] for k in found) or "nothing that robins reads"
        cause = f"has no messages HIGHRES_IMU, SCALED_IMU or RAW_IMU; it holds {held}"
        raise LogError(file, cause, "request them at 50 Hz or more, or use the log on board")
    if vehicles > 1:
        telling(findings, "note", "several_instances", file, value=vehicles)(
            f"{vehicles} vehicles or components sent samples or fixes; the first is read."
        )
    imu = found[kind]
    gyro_unit, accel_unit, mag_unit = _UNITS.get(kind, _SCALED_UNITS)
    gyro, accel = to_si(imu.values[:, :3], gyro_unit), to_si(imu.values[:, 3:6], accel_unit)
    field = imu.values[:, 6:9]
    time_ns = imu.time_ns
    gnss = None
    if _GPS in found and (found[_GPS].values[:, 0] >= 2).any():
        gnss = _fixes(file, found[_GPS], findings)
        if _dated(gnss.time_ns[0]) and not _dated(time_ns[0]):
            row = np.searchsorted(imu.at, found[_GPS].at) - 1
            known = row >= 0
            clock = gps_clock(file, time_ns[row[known]], gnss.time_ns[known], findings)
            time_ns = clock(time_ns)
    has_field = np.any(field != 0.0, axis=1)  # zeros: there is no magnetometer
    return Dataset(
        name=Path(file).name.split(".")[0],
        imu=ImuTable(time_ns, gyro, accel, "rate", source=file),
        mag=MagTable(time_ns[has_field], to_si(field[has_field], mag_unit), source=file)
        if has_field.any()
        else None,
        gnss=gnss,
        time_unit_known=(file,),
    )


def _frames(
    file: str, data: bytes | mmap.mmap, findings: list[Finding] | None
) -> Iterator[tuple[int, int, bytes]]:
    """Place, number and bytes of the frames that are read."""
    at, end, stray = 0, len(data), 0

    def size_at(place: int) -> int:
        """Size of stamp and frame there, 0 where there is none."""
        if place + 14 > end or not _EARLIEST < _STAMP.unpack_from(data, place)[0] < _LATEST:
            return 0
        first, length = data[place + 8], data[place + 9]
        if first == _ONE:
            return 8 + 8 + length
        return 8 + 12 + length + 13 * (data[place + 10] & 1) if first == _TWO else 0

    while at < end:
        size = size_at(at)
        if not size:
            stray, at = stray + 1, at + 1
            continue
        if at + size > end:
            breaks_off(findings, file, at)
            break
        frame = data[at + 8 : at + size]
        number = frame[5] if frame[0] == _ONE else int.from_bytes(frame[7:10], "little")
        if number in _NAMES:
            yield at, number, frame
        at += size
    left_out(findings, file, stray, "bytes belong to no message")


def _messages(
    file: str, data: bytes | mmap.mmap, findings: list[Finding] | None
) -> tuple[dict[int, _Rows], int]:
    """Messages of the first vehicle by their number, and the count of vehicles.

    Raises:
        LogError: pymavlink is not installed.
    """
    try:
        from pymavlink.dialects.v20 import common
    except ImportError as error:
        cause = "is telemetry of MAVLink, and the package that reads it is not installed"
        raise LogError(file, cause, "install it with: pip install 'robins[logs]'") from error
    decoder, wrong = common.MAVLink(None), 0
    senders: dict[tuple[int, int], dict[int, list[tuple[int, int, list[float]]]]] = {}
    for at, number, frame in _frames(file, data, findings):
        try:
            one: Any = decoder.decode(bytearray(frame))
        except common.MAVError:
            wrong += 1
            continue
        names = _FIX if number == _GPS else (*_GYRO, *_ACCEL, *_MAG)
        stamp = 1_000_000 * one.time_boot_ms if number == _SCALED else 1000 * one.time_usec
        row = [float(getattr(one, name)) for name in names]
        sender = senders.setdefault((one.get_srcSystem(), one.get_srcComponent()), {})
        sender.setdefault(number, []).append((at, stamp, row))
    left_out(findings, file, wrong, "messages have a wrong checksum")
    inertial = (s for s in senders.values() if s.keys() - {_GPS})
    first = next(inertial, next(iter(senders.values()), {}))
    found: dict[int, _Rows] = {}
    for number, rows in first.items():
        at, stamps, values = zip(*rows, strict=True)
        time_ns = np.array([s if 0 <= s < 1 << 62 else 0 for s in stamps], np.int64)
        if _dated(time_ns[0]):
            time_ns = gps_of(time_ns)
        found[number] = _Rows(np.array(at, np.int64), time_ns, np.array(values))
    return found, len(senders)


def _dated(time_ns: int) -> bool:
    return time_ns >= GPS_EPOCH_S * 1_000_000_000


def _fixes(file: str, gps: _Rows, findings: list[Finding] | None) -> GnssTable:
    fix, lat, lon, msl, ellipsoid, h_acc, v_acc, vel_acc, vel, cog = gps.values.T
    if not ellipsoid.any():  # MAVLink 1 does not have it
        above_geoid(findings, file, "Set the telemetry to MAVLink 2.")
        ellipsoid = msl
    speed, course = (np.where(x < 65535.0, x * 1e-2, np.nan) for x in (vel, cog))
    north, east = speed * np.cos(np.deg2rad(course)), speed * np.sin(np.deg2rad(course))
    return fixes(
        file,
        gps.time_ns,
        (lat * 1e-7, lon * 1e-7, ellipsoid * 1e-3),
        (h_acc * 1e-3, h_acc * 1e-3, v_acc * 1e-3),
        np.stack([north, east, np.full_like(north, np.nan)], axis=-1),
        vel_acc * 1e-3,
        np.array([MAVLINK.get(int(k), 0) for k in fix]),
        fix == 2,
        findings,
    )
