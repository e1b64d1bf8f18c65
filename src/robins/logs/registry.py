"""Formats of logs, recognised by content: `open_log` reads them, `write_log` writes some.

Tables of numbers in text are described by the rows of `robins.logs.text_formats`; other formats
have a reader of their own and a row here, and perhaps a writer.
"""

from __future__ import annotations

import os
import re
import shlex
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

from robins.dataset import Dataset
from robins.errors import require_kind
from robins.logs import (
    broad,
    dataflash,
    nmea,
    paths,
    phone,
    ros_files,
    rosbag,
    rtklib,
    tlog,
    ubx,
    ulog,
)
from robins.logs.archives import head_of, kind_of_archive
from robins.logs.findings import AnyPath, Findings, LogError, refused
from robins.logs.folders import read_folder
from robins.logs.mounting import Origin
from robins.logs.opening import read_beginning
from robins.logs.quantities import words_of
from robins.logs.read_text import read_text
from robins.logs.tables import KINDS, Table, kind_in_text, tables_of
from robins.logs.text import Head, peek
from robins.logs.text_format import TextFormat
from robins.logs.text_formats import TEXT_FORMATS
from robins.logs.write_rosbag import write_rosbag
from robins.logs.write_text import write_text


class Format(NamedTuple):
    """A format of files."""

    name: str
    holds: tuple[str, ...]  # kinds of tables; several make a `Dataset`
    about: str
    recognise: Callable[[Head], bool]
    read: Callable[..., Table | Dataset]
    binary: bool = False
    text: TextFormat | None = None  # its description, by which it is also written
    write: Callable[[AnyPath, Table | Dataset], None] | None = None  # not for text


def _of_text(row: TextFormat) -> Format:
    return Format(row.name, row.kinds, row.about, row.recognise, partial(read_text, row), text=row)


def _own(name: str, holds: str, *functions: Callable, binary: bool = True):
    """Row of a format with a reader of its own, completed by a line for people.

    Its functions recognise it, read it and, if there are three, write it.
    """
    recognise, read, *write = functions
    kinds, write = tuple(holds.split()), write[0] if write else None
    return lambda about: Format(name, kinds, about, recognise, read, binary, write=write)


def _begins(magic: bytes) -> Callable[[Head], bool]:
    return lambda head: head.start.startswith(magic)


FORMATS: tuple[Format, ...] = (
    *map(_of_text, TEXT_FORMATS),
    _own("rtklib-pos", "gnss", rtklib.is_rtklib, rtklib.read_rtklib, binary=False)(
        "RTKLIB: .pos with latitude, longitude, height in degrees; GPST or UTC"
    ),
    _own("kitti-odometry", "trajectory", paths.is_kitti, paths.read_kitti, binary=False)(
        "KITTI odometry: 12 numbers a line, times.txt beside it"
    ),
    _own("novatel-inspva", "trajectory", paths.is_inspva, paths.read_inspva, binary=False)(
        "NovAtel: INSPVAA and INSPVASA in ASCII, each line against its checksum"
    ),
    _own("phone-csv", "imu mag gnss", phone.is_phone, phone.read_phone, binary=False)(
        "phones, as strapdown-rs keeps their drives: CSV, UTC dates, Android's axes"
    ),
    _own("broad-npz", "imu mag attitude", broad.is_broad, broad.read_broad)(
        "BROAD, the orientation benchmark of Laidig et al. (2021): .mat, .hdf5, .npz"
    ),
    _own("sbet", "trajectory", paths.is_sbet, paths.read_sbet)(
        "Applanix POSPac: SBET, 17 doubles a record"
    ),
    _own(
        "arrays",
        "imu",
        lambda head: bool(kind_of_archive(head.start)) and not broad.is_broad(head),
        lambda path, findings=None: _of_names(path)(path, findings),
    )("npy, npz, MATLAB, HDF5, Parquet ('robins[parquet]'): arrays named as columns of text"),
    _own("px4-ulog", "imu mag gnss", _begins(ulog.MAGIC), ulog.read_ulog)(
        "PX4: .ulg; needs the extra, pip install 'robins[logs]'"
    ),
    _own("ros-mcap", "imu mag gnss", _begins(ros_files.MCAP), rosbag.read_rosbag, write_rosbag)(
        "ROS 2: .mcap with Imu, MagneticField, NavSatFix; needs the extra 'robins[logs]'"
    ),
    _own("ros-db3", "imu mag gnss", _begins(ros_files.SQLITE), rosbag.read_rosbag)(
        "ROS 2: .db3 with Imu, MagneticField, NavSatFix, or the folder of a recording"
    ),
    _own("ros-bag", "imu mag gnss", _begins(ros_files.BAG), rosbag.read_rosbag)(
        "ROS 1: .bag with Imu, MagneticField, NavSatFix; needs the extra 'robins[logs]'"
    ),
    _own("ubx", "imu gnss", ubx.is_ubx, ubx.read_ubx)(
        "u-blox: .ubx with NAV-PVT, and ESF-MEAS of receivers with inertial sensors"
    ),
    _own("nmea", "gnss", lambda head: nmea.is_nmea(head) and not ubx.is_ubx(head), nmea.read_nmea)(
        "NMEA 0183: sentences GGA, GNS, RMC, VTG, GST, ZDA of any receiver"
    ),
    _own("ardupilot-bin", "imu mag gnss", _begins(dataflash.MAGIC), dataflash.read_dataflash)(
        "ArduPilot: dataflash .BIN with IMU, MAG, GPS, GPA"
    ),
    _own("mavlink-tlog", "imu mag gnss", tlog.is_tlog, tlog.read_tlog)(
        "MAVLink: .tlog of a ground station; needs the extra 'robins[logs]'"
    ),
)
"""All formats."""


def _of_names(path: AnyPath) -> Callable[..., Table | Dataset]:
    """Reader of the text format whose column names match the arrays of an archive.

    Raises:
        LogError: none matches, or several do; the message lists the names of the arrays.
    """
    head = head_of(path)
    rows = [row for row in TEXT_FORMATS if row.named and row.recognise(head)]
    if len(rows) != 1:
        held = ", ".join(head.names[:40])
        cause = "no known format has" if not rows else "several formats have"
        raise LogError(
            head.file, f"{cause} arrays of these names: {held}", "declare your columns (--columns)"
        )
    return partial(read_text, rows[0])


def matching_formats(path: AnyPath) -> tuple[Head, list[Format]]:
    """Beginning of a file, and the formats that it fits.

    Raises:
        LogError: the file is empty, cannot be opened, or is neither text nor of a known kind.
    """
    head = Head(os.fspath(path), [], read_beginning(path))
    if found := [f for f in FORMATS if f.binary and f.recognise(head)]:
        return head, found
    head = peek(path)
    return head, [f for f in FORMATS if not f.binary and f.recognise(head)]


def recognise(path: AnyPath) -> Format:
    """The format of a file, by its content.

    Raises:
        LogError: no format fits, or several do; the sentence lists the candidates.
    """
    head, found = matching_formats(path)
    if len(found) == 1:
        return found[0]
    shown = (head.data(1) or [(1, head.lines[0])])[0]
    commas = any(re.search(r"\d,\d+(;|\s)\s*[-+\d]", text) for _, text in head.data(2))
    remedy = (
        "write numbers with a decimal point, not a comma"
        if commas
        else "give --format, or --columns (`robins guess` writes them); these are known"
    )
    candidates = found or FORMATS
    width = max(len(f.name) for f in candidates)
    listed = "".join(f"\n  {f.name:{width}}  {f.about}" for f in candidates)
    stem = os.path.basename(head.file).split(".")[0] or "columns"
    words = f"{shlex.join(['robins', 'guess', head.file])} > {shlex.quote(f'{stem}.toml')}"
    then = "" if found else f"\nNext:   {words}"
    raise refused(head.file, f"line {shown[0]}")(
        f"{'several formats fit' if found else 'no known format fits'} ({shown[1][:60]!r})",
        f"{remedy}:{listed}{then}",
    )


def open_log(
    path: AnyPath,
    format: str | TextFormat | None = None,
    findings: Findings = None,
    *,
    origin: Origin | None = None,
) -> Table | Dataset:
    """Read a log.

    Args:
        path: the file, plain or compressed (.xz, .gz); or a folder that is a recording.
        format: a name in `FORMATS`, or a format of your own; by default recognised by content. For
            a folder only a ROS format can be given.
        findings: receives omissions and doubts of the reader; without it they are issued as
            `LogWarning`.
        origin: position on the Earth of a path in local metres.

    Returns:
        An `ImuTable` in the axes of the sensor, a `GnssTable` or a `Trajectory`; a `Dataset` if
        the file holds several tables.

    Raises:
        LogError: unknown format, unreadable file, an invalid line or number.
    """
    if isinstance(format, TextFormat):
        known = _of_text(format)
    elif os.path.isdir(path) and format is None:
        return read_folder(path, findings, origin)
    else:
        known = recognise(path) if format is None else format_named(format, path)
    if os.path.isdir(path) and known.read is not rosbag.read_rosbag:
        cause = f"is a folder, and {known.name} is a format of files"
        raise LogError(str(path), cause, "omit the format, or give a file")
    if origin is None:
        return known.read(path, findings)
    if known.text is None or not known.text.local:
        cause = f"{known.name} has no local metres to put at an origin"
        raise LogError(str(path), cause, "give no origin")
    return known.read(path, findings, origin)


def write_log(
    path: AnyPath,
    table: Table | Dataset,
    format: str | TextFormat | None = None,
    *,
    week: int | None = None,
    origin: Origin | None = None,
) -> None:
    """Write a table so that it is read back unchanged, except for unit conversions.

    Args:
        path: the file; compressed if its name ends in .xz or .gz.
        table: of a kind that the format holds; several as a dataset.
        format: a name in `FORMATS`, or a format of your own; by default ``named-imu`` for inertial
            samples and ``named-path`` for a path, both text, and ``ros-mcap`` if the name ends in
            .mcap.
        week: for formats with time of a GPS week: the week that absolute stamps are relative to, by
            default that of the first (use the same for all files of a run), and the week of other
            stamps.
        origin: for formats in local metres: their origin, by default the first point.

    Raises:
        TypeError: the argument is no dataset or table.
        LogError: the format holds other data, or the file cannot be written; no part of it is left
            behind.
    """
    require_kind(table, (Dataset, *KINDS), "write_log")
    if isinstance(format, TextFormat):
        row = format
    else:
        written = [f for f in FORMATS if f.text or f.write]
        named = format_named(format or _usual(path, table), path, written)
        if named.write is not None:
            if week is not None or origin is not None:
                cause = f"{named.name} has neither a GPS week nor local metres"
                raise LogError(str(path), cause, "give no week and no origin")
            named.write(path, table)
            return
        row = named.text
    assert row is not None
    write_text(row, path, table, week=week, origin=origin)


def _usual(path: AnyPath, table: Table | Dataset) -> str:
    if str(path).endswith(".mcap"):
        return "ros-mcap"
    kinds = tuple(map(kind_in_text, tables_of(table)))
    for name in ("named-imu", "named-path"):
        if kinds == format_named(name, path).holds:
            return name
    remedy = f"choose a format: {', '.join(f.name for f in FORMATS if f.text or f.write)}"
    raise LogError(str(path), f"no named format holds {' and '.join(map(words_of, kinds))}", remedy)


def format_named(name: str, path: AnyPath, among: Sequence[Format] = FORMATS) -> Format:
    """Format by name; the path is for the message.

    Raises:
        LogError: there is no such format.
    """
    named = {f.name: f for f in among}
    if name not in named:
        cause = f"no format is called {name!r}"
        raise LogError(str(path), cause, f"choose one of {', '.join(named)}")
    return named[name]
