"""Recordings of ROS 2 in MCAP files: the messages of `robins.ros`, as tables.

Of each type the first topic that has messages counts:

- ``sensor_msgs/msg/Imu``: rates [rad/s] and specific force [m/s^2]. The orientation is the estimate
  of whoever wrote it, no truth, and is left alone.
- ``sensor_msgs/msg/MagneticField``: magnetic field [T].
- ``sensor_msgs/msg/NavSatFix``: fixes; sigmas are missing where the covariance is not known.

Axes of sensors are forward-left-up (REP-103) and become those of a table. The stamp is that of the
header: UTC since 1970, which becomes GPS time, or else a count from a start of its own, which stays
(a second of UTC that is a leap second has no stamp of its own).
"""

from __future__ import annotations

import io
import os
import struct
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from robins import ros
from robins.dataset import Dataset, GnssTable, ImuTable, MagTable
from robins.foreign import decoding, unpacked, within
from robins.gps_time import GPS_EPOCH_S, gps_of
from robins.logs.findings import Finding, LogError, report, telling
from robins.logs.opening import whole
from robins.logs.tables import Table
from robins.logs.text import Head

if TYPE_CHECKING:
    from mcap.records import McapRecord

MAGIC = b"\x89MCAP0\r\n"
_LARGEST = 1 << 30  # bytes of a file
_RECORD, _FOOTER = struct.Struct("<BQ"), 2  # opcode and length of a record; the last one's opcode
_FLU = np.array([1.0, -1.0, -1.0])  # forward-left-up <-> forward-right-down
_NED = [1, 0, 2]  # of east, north, up: variances have no sign
_QUALITY = {0: 5, 1: 3, 2: 4}  # status of a NavSatFix -> RTKLIB's Q
_KINDS: tuple[type[ros.Message], ...] = (ros.Imu, ros.MagneticField, ros.NavSatFix)
_EARLY = (
    "{name} breaks off ({why}): the recording or the copy was interrupted. All before it was read."
)
NO_PACKAGE = "is an MCAP file, and the package for these is not installed"
INSTALL = "install it with: pip install 'robins[logs]'"


class _Found(NamedTuple):
    """The messages of a topic."""

    topic: str
    time_ns: np.ndarray
    messages: list[Any]

    def column(self, name: str) -> np.ndarray:
        """A field of all messages."""
        return np.array([getattr(one, name) for one in self.messages], np.float64)

    def known(self, name: str) -> np.ndarray:
        """A quantity of an Imu, along forward-right-down; NaN where it says that it has none."""
        values, first = self.column(name) * _FLU, self.column(f"{name}_covariance")[:, 0]
        return np.where((first == -1.0)[:, None], np.nan, values)


def is_mcap(head: Head) -> bool:
    """Whether a file begins as MCAP files do."""
    return head.start.startswith(MAGIC)


def read_rosbag(
    path: str | os.PathLike[str], findings: list[Finding] | None = None
) -> Table | Dataset:
    """Read inertial samples, magnetic field and fixes.

    Args:
        path: the file, plain or compressed.
        findings: receives what was left out; without it that is issued as `LogWarning`.

    Returns:
        A dataset; a table where there are no inertial samples but magnetic field or fixes.

    Raises:
        LogError: the package `mcap` is not installed; the file is damaged, or holds no samples.
    """
    file = str(path)
    topics = _messages(file, path, findings)
    imu, mag, gnss = (_first(file, topics, kind, findings) for kind in _KINDS)
    field = mag and MagTable(mag.time_ns, mag.column("magnetic_field") * _FLU, source=file)
    fixes = gnss and _fixes(file, gnss)
    if imu is not None:
        rates, accel = imu.known("angular_velocity"), imu.known("linear_acceleration")
        return Dataset(
            name=Path(file).name.split(".")[0],
            imu=ImuTable(imu.time_ns, rates, accel, "rate", source=file),
            mag=field,
            gnss=fixes,
            time_unit_known=(file,),
        )
    alone = field if fixes is None else fixes
    if alone is None or (field is not None and fixes is not None):
        held = ", ".join(sorted({name for name, _ in topics})) or "no messages that robins reads"
        cause = f"has no messages {ros.name_of(ros.Imu)}; it holds {held}"
        raise LogError(file, cause, "record that topic as well")
    return alone


def _messages(
    file: str, path: str | os.PathLike[str], findings: list[Finding] | None
) -> dict[tuple[str, str], list[ros.Stamped]]:
    """All messages of these types, by type and topic.

    Raises:
        LogError: as `read_rosbag`.
    """
    data, cut = whole(path, _LARGEST)
    sound, closed = _sound(data)

    def damaged(why: str) -> LogError:
        mend = "fetch it again; nothing of it was used, for no number in it can be trusted"
        return LogError(file, f"is damaged ({why})", mend)

    found: dict[tuple[str, str], list[ros.Stamped]] = {}
    names = {ros.name_of(kind): kind for kind in _KINDS}
    schemas: dict[int, str] = {}
    channels: dict[int, tuple[str, str]] = {}  # schema and topic of those whose messages are read
    one: Any
    for one in _records(file, data[:sound], damaged):
        kind = type(one).__name__  # the package is not imported here
        if kind == "Schema":
            schemas[one.id] = one.name
        elif kind == "Channel":
            name = schemas.get(one.schema_id, "")
            if one.schema_id and not name:
                raise damaged(f"topic {one.topic} has schema {one.schema_id}, which is not there")
            if name in names and one.message_encoding == "cdr":
                channels[one.id] = (name, one.topic)
            else:
                channels[one.id] = ("", one.topic)
        elif kind == "Message":
            if one.channel_id not in channels:
                raise damaged(f"a message of channel {one.channel_id}, which is not there")
            name, topic = channels[one.channel_id]
            if name:
                try:
                    stamped = ros.decode(names[name], one.data)
                except ros.RosError as error:
                    raise damaged(f"RosError: {error}") from error
                found.setdefault((name, topic), []).append(stamped)
    if cut or not closed:
        why = "its compressed stream has no end" if cut else f"after {len(data)} bytes"
        sentence = _EARLY.format(name=Path(file).name, why=why)
        place = f"byte {len(data)}"
        report(findings, Finding("warning", "ends_early", file, place, len(data), sentence))
    return found


def _sound(data: bytes) -> tuple[int, bool]:
    """Up to which byte records follow each other without a break, and whether the last closes."""
    at = len(MAGIC)
    while at + _RECORD.size <= len(data):
        opcode, size = _RECORD.unpack_from(data, at)
        if opcode == 0 or at + _RECORD.size + size > len(data):
            break
        at += _RECORD.size + size
        if opcode == _FOOTER:
            return at + len(MAGIC), data[at : at + len(MAGIC)] == MAGIC
    return min(at, len(data)), False


def _records(file: str, data: bytes, damaged: Callable[[str], LogError]) -> Iterator[McapRecord]:
    """All records of a file, those of its chunks among them; the package decodes each.

    Raises:
        LogError: the package is not installed, or a record is damaged.
    """
    try:
        from mcap.exceptions import EndOfFile
        from mcap.records import Chunk
        from mcap.stream_reader import StreamReader, breakup_chunk
    except ImportError as error:
        raise LogError(file, NO_PACKAGE, INSTALL) from error
    plain, stream = 0, io.BytesIO(data)
    records = StreamReader(stream, emit_chunks=True, validate_crcs=True).records
    while True:
        try:
            with decoding(damaged):
                one = next(records, None)
        except LogError as error:
            if isinstance(error.__cause__, EndOfFile) and stream.tell() == len(data):
                return  # behind the last whole record: the file is not closed
            raise
        if one is None:
            return
        if not isinstance(one, Chunk):
            yield one
            continue
        plain += one.uncompressed_size
        within(plain, len(data), "its chunks", damaged)
        content = unpacked(one.data, one.compression, one.uncompressed_size, damaged)
        with decoding(damaged):
            inner = breakup_chunk(replace(one, data=content, compression=""), validate_crc=True)
        yield from inner


def _first(
    file: str,
    topics: dict[tuple[str, str], list[ros.Stamped]],
    kind: type[ros.Message],
    findings: list[Finding] | None,
) -> _Found | None:
    """The first topic of a type."""
    name = ros.name_of(kind)
    found = [topic for of, topic in topics if of == name]
    if not found:
        return None
    if len(found) > 1:
        telling(findings, "note", "several_instances", file, value=len(found))(
            f"{name} was recorded on {len(found)} topics; the first, {found[0]}, is read and the "
            f"others are left alone: {', '.join(found[1:])}."
        )
    stamped = topics[name, found[0]]
    time_ns = np.array([one.time_ns for one in stamped], np.int64)
    dated = time_ns >= GPS_EPOCH_S * 1_000_000_000
    return _Found(
        found[0], np.where(dated, gps_of(time_ns), time_ns), [one.message for one in stamped]
    )


def _fixes(file: str, gnss: _Found) -> GnssTable:
    status = gnss.column("status")
    lost = status < 0
    variance = gnss.column("position_covariance")[:, [0, 4, 8]][:, _NED]
    unknown = gnss.column("position_covariance_type") == 0
    with np.errstate(invalid="ignore"):  # a negative variance is none
        sigma_m = np.where(unknown[:, None], np.nan, np.sqrt(variance))

    def known(name: str) -> np.ndarray:
        return np.where(lost, np.nan, gnss.column(name))

    return GnssTable(
        time_ns=gnss.time_ns,
        lat_rad=np.deg2rad(known("latitude")),
        lon_rad=np.deg2rad(known("longitude")),
        alt_m=known("altitude"),
        sigma_m=sigma_m,
        quality=np.array([_QUALITY.get(int(k), 0) for k in status], np.int64),
        source=file,
    )
