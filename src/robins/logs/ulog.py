"""PX4 flight logs (ULog, ``.ulg``), decoded by the package pyulog of the extra ``logs``.

Topics read, from the first instance of each:

- ``sensor_combined``: rates [rad/s] and specific force [m/s^2], forward-right-down;
- ``vehicle_magnetometer``, else ``sensor_mag``: magnetic field [gauss];
- ``vehicle_gps_position``, else ``sensor_gps``: fixes. Their ``eph`` is used for north and for
  east, as in PX4's own filter; components that the receiver marks as invalid are missing.

Estimates of PX4 (``vehicle_attitude`` and the like) are not truth and are ignored. Stamps are
microseconds since power-up. A ULog has no checksums: its framing is checked from the first byte to
the last, but an altered number is undetected.
"""

from __future__ import annotations

import contextlib
import io
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from robins.dataset import Dataset, GnssTable, ImuTable, MagTable
from robins.foreign import decoding
from robins.logs.findings import (
    AnyPath,
    Finding,
    Findings,
    LogError,
    damaged,
    extra_package,
    finding_reporter,
    refused,
    report,
)
from robins.logs.fix_kinds import PX4
from robins.logs.opening import read_whole
from robins.logs.tables import recording
from robins.logs.timebase import LIMIT_NS
from robins.units import to_si

MAGIC = b"ULog\x01\x12\x35"
_START = 16  # bytes before the first message
_HEADER = struct.Struct("<HB")  # size of the content, type
_MOST, _DEEPEST = 1 << 16, 20  # most numbers in a message, deepest nesting of definitions
_TYPES = frozenset(b"BFIMPQARDLCSO")
_LARGEST = 1 << 30  # bytes, largest file
_IMU, _MAG = ("sensor_combined",), ("vehicle_magnetometer", "sensor_mag")
_GNSS = ("vehicle_gps_position", "sensor_gps")
_TO_CSV = "this version of the autopilot is not known; export the topic to CSV"
_NO_FIX, _FLAT_FIX = 2, 3  # least types of a fix, and of one with height


class UlogTopic(NamedTuple):
    """Logged fields of one topic."""

    name: str
    fields: dict[str, np.ndarray]


def read_ulog(path: AnyPath, findings: Findings = None) -> Dataset:
    """Read inertial samples, and magnetic field and fixes if logged.

    Args:
        path: the file, plain or compressed.
        findings: receives omissions; without it they are issued as `LogWarning`.

    Raises:
        LogError: pyulog is not installed; the log is damaged, or has no inertial samples.
    """
    file = str(path)
    data, cut = read_whole(path, _LARGEST)
    if not data.startswith(MAGIC):
        raise refused(file, "byte 0")("is no ULog", "leave the format to be recognised")
    sound = max((end for *_, end in _messages(data)), default=min(_START, len(data)))
    if sound < len(data) or cut:
        sentence = (
            f"{Path(file).name} breaks off at byte {sound} of {len(data)}: what follows is half a "
            "message, or none. The recording or the copy was interrupted, or a crash report is "
            "appended; all before it was read."
        )
        report(findings, Finding("warning", "ends_early", file, f"byte {sound}", sound, sentence))
    _check_formats(file, data[:sound])
    log = _decode(file, data[:sound])
    imu = _first(file, log, _IMU, findings)
    if imu is None:
        held = ", ".join(sorted({item.name for item in log.data_list})) or "nothing"
        cause = f"has no samples of {_IMU[0]}; it holds {held}"
        raise LogError(file, cause, "log that topic and fly again")
    time_ns = stamps(file, imu)
    mag, gnss = (_first(file, log, topics, findings) for topics in (_MAG, _GNSS))
    gyro = triad(file, imu, "gyro_rad[{}]", "012")
    accel = triad(file, imu, "accelerometer_m_s2[{}]", "012")
    samples = ImuTable(time_ns, gyro, accel, "rate", source=file)
    return recording(file, samples, gnss and _fixes(file, gnss), mag=mag and _field(file, mag))


def _messages(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Type of each message of the unbroken sequence, and begin and end of its content [bytes]."""
    at = _START
    while at + _HEADER.size <= len(data):
        size, kind = _HEADER.unpack_from(data, at)
        begin, at = at + _HEADER.size, at + _HEADER.size + size
        if kind not in _TYPES or size == 0 or at > len(data):
            return
        yield kind, begin, at


def _check_formats(file: str, data: bytes) -> None:
    """Refuse a definition that declares more numbers than a message has bytes: 64 KiB.

    The package makes a name for each number of each definition, multiplied by nesting, before it
    reads a message.

    Raises:
        LogError: there is such a definition, or one that contains itself.
    """
    formats: dict[str, list[tuple[str, int]]] = {}
    for kind, begin, end in _messages(data):
        if kind == ord("F"):
            name, _, fields = data[begin:end].decode("utf-8", "replace").partition(":")
            formats[name] = []
            for field in fields.split(";"):
                of, _, length = field.partition(" ")[0].partition("[")
                with contextlib.suppress(ValueError):  # not a number, which the package refuses
                    formats[name].append((of, int(length.partition("]")[0] or 1)))
    sizes: dict[str, int] = {}

    def size_of(name: str, above: tuple[str, ...]) -> int:
        if name not in formats:
            return 1
        if name in above or len(above) > _DEEPEST:
            raise damaged(file)(f"the definition of {name} contains itself")
        if name not in sizes:
            parts = (count * size_of(of, (*above, name)) for of, count in formats[name])
            sizes[name] = sum(parts)
            if sizes[name] > _MOST:
                raise damaged(file)(f"the definition of {name} has {sizes[name]} numbers")
        return sizes[name]

    for name in formats:
        size_of(name, ())


def _decode(file: str, data: bytes) -> Any:
    with extra_package(file, "a PX4 ULog"):
        from pyulog import ULog
    printed = io.StringIO()
    # the package prints its warnings
    with decoding(damaged(file)), contextlib.redirect_stdout(printed):
        log = ULog(io.BytesIO(data), [*_IMU, *_MAG, *_GNSS], disable_str_exceptions=False)
    if log.file_corruption:
        why = " ".join(printed.getvalue().split())
        raise damaged(file)(why or "messages contradict each other")
    return log


def _first(file: str, log: Any, topics: tuple[str, ...], findings: Findings) -> UlogTopic | None:
    """The first instance of the first of these topics that was logged."""
    for name in topics:
        found = sorted((d for d in log.data_list if d.name == name), key=lambda d: d.multi_id)
        if len(found) > 1:
            finding_reporter(findings, "note", "several_instances", file, value=len(found))(
                f"{name} was logged of {len(found)} sensors; the first, number "
                f"{found[0].multi_id}, is read and the others are left alone."
            )
        if found:
            return UlogTopic(name, dict(found[0].data))
    return None


def column(file: str, topic: UlogTopic, name: str) -> np.ndarray:
    """Numbers of a field.

    Raises:
        LogError: there is no field of this name, or it contains text.
    """
    if name in topic.fields:
        values = np.asarray(topic.fields[name])
        if values.dtype.kind not in "biuf":
            raise refused(file, field=f"{topic.name}.{name}")("holds text, no numbers", _TO_CSV)
        with np.errstate(invalid="ignore"):  # a signalling NaN stays NaN
            return values.astype(np.float64)
    cause = f"has no field {name}; it has {', '.join(sorted(topic.fields))}"
    raise refused(file, field=topic.name)(cause, _TO_CSV)


def triad(file: str, topic: UlogTopic, pattern: str, parts: str) -> np.ndarray:
    """Three fields as (n, 3)."""
    return np.stack([column(file, topic, pattern.format(part)) for part in parts], axis=-1)


def stamps(file: str, topic: UlogTopic) -> np.ndarray:
    """Times of measurement, or else of logging [ns]."""
    sample = topic.fields.get("timestamp_sample")
    stamps = topic.fields.get("timestamp") if sample is None or not np.all(sample) else sample
    if stamps is None or stamps.dtype.kind != "u" or np.any(stamps >= LIMIT_NS // 1000):
        cause = "are no microseconds since power-up"
        raise refused(file, field=f"stamps of {topic.name}")(cause, "fetch it again")
    return stamps.astype(np.int64) * 1000


def _field(file: str, topic: UlogTopic) -> MagTable:
    pattern, parts = ("{}", "xyz") if topic.name == "sensor_mag" else ("magnetometer_ga[{}]", "012")
    field_t = to_si(triad(file, topic, pattern, parts), "G")
    return MagTable(stamps(file, topic), field_t, source=file)


def _fixes(file: str, topic: UlogTopic) -> GnssTable:
    """Fixes of a topic; older versions log integers of 1e-7 deg and mm, newer ones deg and m."""

    def either(new: str, old: str, scale: float) -> np.ndarray:
        return column(file, topic, new) if new in topic.fields else column(file, topic, old) * scale

    fix = column(file, topic, "fix_type")
    lat, lon = (either(f"{x}itude_deg", x[:3], 1e-7) for x in ("lat", "long"))
    alt_m = either("altitude_ellipsoid_m", "alt_ellipsoid", 1e-3)
    eph, epv, speed = (column(file, topic, name) for name in ("eph", "epv", "s_variance_m_s"))
    v_n = triad(file, topic, "vel_{}_m_s", "ned")
    v_n[(fix < _FLAT_FIX) | (column(file, topic, "vel_ned_valid") == 0)] = np.nan

    def known(values: np.ndarray, least: int) -> np.ndarray:
        return np.where(fix >= least, values, np.nan)

    lat, lon = (np.deg2rad(known(x, _NO_FIX)) for x in (lat, lon))
    time_ns, alt = stamps(file, topic), known(alt_m, _FLAT_FIX)
    sigma_m, sigma_v = (np.stack(x, axis=-1) for x in ([eph, eph, epv], [speed] * 3))
    quality = np.array([PX4.get(int(k), 0) for k in fix], np.int64)
    return GnssTable(time_ns, lat, lon, alt, sigma_m, v_n, sigma_v, quality, source=file)
