"""Writing of inertial samples, magnetic field and fixes as a ROS 2 recording in an MCAP file.

Profile "ros2" of MCAP (mcap.dev/spec/registry). Topics have the usual names of drivers:
``/imu/data_raw``, ``/imu/mag``, ``/gnss/fix``. Axes of sensors are converted to
forward-left-up, covariances to east-north-up, GPS time to UTC; other stamps are unchanged.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from robins import ros
from robins.dataset import Dataset, GnssTable, ImuTable, MagTable
from robins.gps_time import GPS_EPOCH_S, utc_of
from robins.logs.findings import AnyPath, LogError, LogWarning
from robins.logs.opening import write_lines
from robins.logs.quantities import words_of
from robins.logs.ros_files import mcap_package
from robins.logs.tables import Table, kind_in_text, tables_of

_LATEST_NS = (1 << 31) * 1_000_000_000
_BLOCK = 2000  # messages per write to the file
_STATUS = {3: 1, 4: 2, 1: 2, 2: 2}  # RTKLIB's Q -> status of a NavSatFix; else 0, a plain fix


class _Topic(NamedTuple):
    """Topic and message maker of a table."""

    name: str
    frame_id: str
    kind: type[ros.Message]
    make: Callable[[Any, int], ros.Message]  # message of a row of the table


def _imu(table: ImuTable, k: int) -> ros.Message:
    return ros.imu(table.gyro[k], table.accel[k], body=table.body)


def _field(table: MagTable, k: int) -> ros.Message:
    return ros.magnetic_field(table.field_t[k], body=table.body)


def _fix(table: GnssTable, k: int) -> ros.Message:
    place = float(table.lat_rad[k]), float(table.lon_rad[k]), float(table.alt_m[k])
    quality = 0 if table.quality is None else int(table.quality[k])
    status = _STATUS.get(quality, 0) if np.isfinite(place[:2]).all() else None
    spread = np.diag(table.sigma_m[k] ** 2)
    return ros.nav_sat_fix(*place, covariance=spread, nav=table.nav, status=status)


_TOPICS: dict[type[Any], _Topic] = {
    ImuTable: _Topic("/imu/data_raw", "imu", ros.Imu, _imu),
    MagTable: _Topic("/imu/mag", "imu", ros.MagneticField, _field),
    GnssTable: _Topic("/gnss/fix", "gnss", ros.NavSatFix, _fix),
}


def write_rosbag(path: AnyPath, table: Table | Dataset) -> None:
    """Write tables; `robins.logs.rosbag.read_rosbag` reads them back.

    A NavSatFix has no velocity, so those of fixes are omitted, with a `LogWarning`; nor can it have
    a single missing sigma: then all are marked unknown. Qualities 1, 2 and 4 of RTKLIB all become
    "with ground-based augmentation".

    Raises:
        LogError: a table of another kind, increments, or a time outside the range of ROS; the
            package `mcap` is not installed; or the file cannot be written. No part of it is left
            behind.
    """
    tables = tables_of(table)
    for one in tables:
        _check(str(path), one)
    write_lines(path, _blocks(str(path), tables))
    if any(isinstance(one, GnssTable) and one.v_n is not None for one in tables):
        left = "velocities of the fixes are left out, for NavSatFix has no place for them"
        warnings.warn(f"{Path(path).name}: {left}", LogWarning, stacklevel=2)


def _check(file: str, table: Table) -> None:
    """Refuse tables that these messages cannot represent."""
    if type(table) not in _TOPICS:
        held = "inertial samples, magnetic field and fixes"
        cause = f"ros-mcap holds {held}, not {words_of(kind_in_text(table))}"
        raise LogError(file, cause, "choose another format")
    if isinstance(table, ImuTable) and table.kind != "rate":
        cause = "ros-mcap wants rates, these are increments"
        raise LogError(file, cause, "divide them by their dt first")
    if len(table) and not (table.time_ns.min() >= 0 and table.time_ns.max() < _LATEST_NS):
        cause = "ROS has times from 1970 to 2038 only, as seconds from 0 to 2^31"
        raise LogError(file, cause, "let the stamps begin at zero")


class _Sink:
    """File object for the MCAP writer; returns the bytes written, in pieces."""

    def __init__(self) -> None:
        self._waiting = bytearray()
        self._at = 0

    def write(self, data: bytes) -> int:
        self._waiting += data
        return len(data)

    def tell(self) -> int:
        return self._at + len(self._waiting)

    def take(self) -> bytes:
        out = bytes(self._waiting)
        self._at += len(out)
        self._waiting.clear()
        return out


def _blocks(file: str, tables: list[Table]) -> Iterator[bytes]:
    """Pieces of the file, with messages in order of time."""
    with mcap_package(file):
        from mcap.well_known import MessageEncoding, Profile, SchemaEncoding
        from mcap.writer import Writer
    sink: Any = _Sink()
    writer = Writer(sink)
    writer.start(Profile.ROS2, "robins")
    topics, channels = [_TOPICS[type(one)] for one in tables], []
    for topic in topics:
        name, text = ros.name_of(topic.kind), ros.definition(topic.kind).encode()
        schema = writer.register_schema(name, SchemaEncoding.ROS2, text)
        about = {"offered_qos_profiles": ""}  # required by the profile
        channels.append(writer.register_channel(topic.name, MessageEncoding.CDR, schema, about))
    times = [_utc(one.time_ns) for one in tables]
    which = np.repeat(np.arange(len(tables)), [len(one) for one in tables])
    row = np.concatenate([np.arange(len(one)) for one in tables])
    order = np.argsort(np.concatenate(times), kind="stable")
    for count, (t, k) in enumerate(zip(which[order].tolist(), row[order].tolist(), strict=True)):
        topic, time_ns = topics[t], int(times[t][k])
        data = ros.encode(topic.make(tables[t], k), time_ns, topic.frame_id)
        writer.add_message(channels[t], time_ns, data, time_ns, k)
        if count % _BLOCK == _BLOCK - 1:
            yield sink.take()
    writer.finish()
    yield sink.take()


def _utc(time_ns: np.ndarray) -> np.ndarray:
    dated = time_ns >= GPS_EPOCH_S * 1_000_000_000
    return np.where(dated, utc_of(time_ns).astype(np.int64), time_ns)
