"""The formats of logs, recognised by content, and `open_log`, which reads any of them."""

from __future__ import annotations

import itertools
import os
import re
from collections.abc import Callable
from typing import NamedTuple

from robins.dataset import Dataset
from robins.logs import (
    broad,
    euroc,
    gnss_imu,
    kfgins,
    named_csv,
    phone,
    pyins_csv,
    rtklib,
    ulog,
    xio,
)
from robins.logs.findings import Finding, LogError
from robins.logs.opening import beginning
from robins.logs.tables import Table
from robins.logs.text import Head, peek


class Format(NamedTuple):
    """One kind of file."""

    name: str
    holds: str  # "imu", "gnss", "trajectory", or "several" tables, which make a `Dataset`
    about: str
    recognise: Callable[[Head], bool]
    read: Callable[..., Table | Dataset]
    binary: bool = False


def _numbers(head: Head, delimiter: str | None, lines: int = 20) -> list[list[float]]:
    """The first data lines as numbers; empty if they are not all numbers, or not of one width."""
    try:
        rows = [[float(x) for x in text.split(delimiter)] for _, text in head.data(lines)]
    except ValueError:
        return []
    rows = rows[1:] if len({len(row) for row in rows[:2]}) == 2 else rows  # began mid-line
    return rows if len({len(row) for row in rows}) == 1 else []


def _is_gnss_imu(head: Head) -> bool:
    rows = _numbers(head, ",")
    # Seconds since 1970 between 1990 and 2100; specific force of one g or so, not ten.
    return (
        bool(rows)
        and len(rows[0]) >= 7
        and all(6e8 < row[0] < 4.2e9 for row in rows)
        and sorted(sum(a * a for a in row[1:4]) for row in rows)[len(rows) // 2] < 25.0
    )


def _is_rtklib(head: Head) -> bool:
    header = any(line.startswith("%") and " ns " in line for line in head.lines)
    stamp = re.compile(r"\d{4}/\d\d/\d\d[ ,]+\d\d:\d\d:\d\d")
    return header or any(stamp.match(text) for _, text in head.data(1))


def _spacing(rows: list[list[float]]) -> float:
    steps = sorted(abs(b[0] - a[0]) for a, b in itertools.pairwise(rows))
    return steps[len(steps) // 2] if steps else 0.0


def _is_kfgins_imu(head: Head) -> bool:
    rows = _numbers(head, None)
    if not rows or len(rows[0]) != 7:
        return False
    small = all(abs(x) < 10.0 for row in rows for x in row[1:])  # increments of one sample
    return small and 0.0 < _spacing(rows) < 0.2


def _is_kfgins_gnss(head: Head) -> bool:
    rows = _numbers(head, None)
    if not rows or len(rows[0]) != 7 or _is_kfgins_imu(head):
        return False
    return all(
        abs(row[1]) <= 90 and abs(row[2]) <= 360 and min(row[4:7]) >= 0 for row in rows
    ) and all(abs(a - b) < 0.1 for a, b in zip(rows[0][1:3], rows[-1][1:3], strict=True))


def _is_kfgins_nav(head: Head) -> bool:
    rows = _numbers(head, None)
    return (
        bool(rows)
        and len(rows[0]) == 11
        and all(row[0] == int(row[0]) and 0 <= row[0] < 5000 for row in rows)
        and all(0 <= row[1] < 700_000 and abs(row[2]) <= 90 for row in rows)
    )


def _is_pyins(*tables: str) -> Callable[[Head], bool]:
    return lambda head: pyins_csv.table_of(pyins_csv.header(head)) in tables


def _is_named(kind: str) -> Callable[[Head], bool]:
    return lambda head: named_csv.holds(head, kind)


def _is_euroc(column: str) -> Callable[[Head], bool]:
    def recognise(head: Head) -> bool:
        first, *others = head.lines[0].split(",")
        return first.startswith("#timestamp") and any(n.strip().startswith(column) for n in others)

    return recognise


FORMATS: tuple[Format, ...] = (
    Format(
        "rtklib-pos",
        "gnss",
        "RTKLIB solution .pos, latitude/longitude/height",
        _is_rtklib,
        rtklib.read_rtklib,
    ),
    Format(
        "gnss-imu",
        "imu",
        "CSV of GNSS_IMU: Unix-like time, acceleration [g], rate [rad/s], no header",
        _is_gnss_imu,
        gnss_imu.read_gnss_imu,
    ),
    Format(
        "kfgins-imu",
        "imu",
        "KF-GINS IMU text: t, dtheta [rad], dv [m/s]",
        _is_kfgins_imu,
        kfgins.read_kfgins_imu,
    ),
    Format(
        "kfgins-gnss",
        "gnss",
        "KF-GINS GNSS text: t, lat, lon [deg], height, sigmas [m]",
        _is_kfgins_gnss,
        kfgins.read_kfgins_gnss,
    ),
    Format(
        "kfgins-nav",
        "trajectory",
        "KF-GINS navigation text: week, t, lat, lon, height, velocity, roll, pitch, yaw",
        _is_kfgins_nav,
        kfgins.read_kfgins_nav,
    ),
    Format(
        "pyins-imu",
        "imu",
        "pyins CSV: time, gyro_x .. accel_z, or dt, theta_x .. dv_z",
        _is_pyins("Imu", "Increments"),
        pyins_csv.read_pyins,
    ),
    Format(
        "pyins-trajectory",
        "trajectory",
        "pyins CSV: time, lat lon alt VN VE VD roll pitch heading",
        _is_pyins("Trajectory"),
        pyins_csv.read_pyins,
    ),
    Format(
        "euroc-imu",
        "imu",
        "EuRoC/ASL CSV: #timestamp [ns], w_RS_S_x .. a_RS_S_z",
        _is_euroc("w_RS_S_x"),
        euroc.read_euroc_imu,
    ),
    Format(
        "euroc-truth",
        "trajectory",
        "EuRoC/ASL CSV: #timestamp, p_RS_R_x .. q_RS_w .. v_RS_R_z",
        _is_euroc("p_RS_R_x"),
        euroc.read_euroc_truth,
    ),
    Format(
        "named-imu",
        "imu",
        "CSV with units in its header: time_s, gyro_x_rad_s .. accel_z_m_s2, or dtheta .. dv",
        _is_named("imu"),
        named_csv.read_named_imu,
    ),
    Format(
        "named-path",
        "trajectory",
        "CSV with units in its header: time_s, lat_deg .. v_down_m_s, roll_deg .. or q_w ..",
        _is_named("trajectory"),
        named_csv.read_named_path,
    ),
    Format(
        "xio-csv",
        "several",
        "CSV of x-io and Fusion: Time (s), Gyroscope X (deg/s) .. Magnetometer Z (uT)",
        xio.is_xio,
        xio.read_xio,
    ),
    Format(
        "phone-csv",
        "several",
        "CSV of a phone, as of strapdown-rs: time, latitude, acc_x, gyro_x, mag_x, ..",
        phone.is_phone,
        phone.read_phone,
    ),
    Format(
        "broad-npz",
        "several",
        "NumPy archive of BROAD: imu_gyr, imu_acc, imu_mag, opt_quat, movement, sampling_rate",
        broad.is_archive,
        broad.read_broad,
        binary=True,
    ),
    Format(
        "px4-ulog",
        "several",
        "PX4 ULog: sensor_combined, vehicle_magnetometer, vehicle_gps_position",
        ulog.is_ulog,
        ulog.read_ulog,
        binary=True,
    ),
)


def fitting(path: str | os.PathLike[str]) -> tuple[Head, list[Format]]:
    """How a file begins, and the formats that its beginning fits.

    Raises:
        LogError: the file is empty, cannot be opened, or is neither text nor of a known kind.
    """
    head = Head(os.fspath(path), [], beginning(path))
    if found := [f for f in FORMATS if f.binary and f.recognise(head)]:
        return head, found
    head = peek(path)
    return head, [f for f in FORMATS if not f.binary and f.recognise(head)]


def recognise(path: str | os.PathLike[str]) -> Format:
    """The format of a file, by its content.

    Raises:
        LogError: no format fits, or several do; the sentence lists the candidates.
    """
    head, found = fitting(path)
    if len(found) == 1:
        return found[0]
    shown = (head.data(1) or [(1, head.lines[0])])[0]
    commas = any(re.search(r"\d,\d+(;|\s)\s*[-+\d]", text) for _, text in head.data(2))
    mend = (
        "write numbers with a decimal point, not a comma"
        if commas
        else "name the format, or convert the file to one of these"
    )
    candidates = found or FORMATS
    width = max(len(f.name) for f in candidates)
    listed = "".join(f"\n  {f.name:{width}}  {f.about}" for f in candidates)
    raise LogError(
        head.file,
        f"{'several formats fit' if found else 'no known format fits'} ({shown[1][:60]!r})",
        f"{mend}:{listed}",
        where=f"line {shown[0]}",
    )


def open_log(
    path: str | os.PathLike[str],
    format: str | None = None,
    findings: list[Finding] | None = None,
) -> Table | Dataset:
    """Read a log.

    Args:
        path: the file, plain or compressed (.xz, .gz).
        format: a name in `FORMATS`; by default it is recognised by content.
        findings: receives what the reader left out or doubts; without it that is issued as
            `LogWarning`.

    Returns:
        An `ImuTable` along the axes of the sensor, a `GnssTable` or a `Trajectory`; a `Dataset` if
        the file holds several tables.

    Raises:
        LogError: unknown format, unreadable file, a line or number that is not what it should be.
    """
    if format is None:
        return recognise(path).read(path, findings)
    named = {f.name: f for f in FORMATS}
    if format not in named:
        raise LogError(
            str(path), f"no format is called {format!r}", f"choose one of {', '.join(named)}"
        )
    return named[format].read(path, findings)
