"""Text files of KF-GINS: IMU increments, GNSS positions, navigation results; read and written.

Columns, separated by blanks; t is the second of the GPS week:

- IMU: t, dtheta x y z [rad], dv x y z [m/s], increments since the line before, forward-right-down;
- GNSS: t, latitude [deg], longitude [deg], height [m], sigmas north, east, down [m];
- navigation: week, t, latitude [deg], longitude [deg], height [m], velocity north, east, down
  [m/s], roll, pitch, yaw [deg].

The first two have no week, so stamps that are read count from the beginning of the week of the
first line, in all three. Where t begins anew at 0 the next week begins, and the count goes on. What
is written from absolute stamps (since 1970 in GPS time) comes back less whole weeks, to the
nanosecond. KF-GINS itself wants t to grow, so in the first two it goes on beyond 604800 s.
"""

from __future__ import annotations

import os

import jax.numpy as jnp
import numpy as np

from robins import rotation
from robins.dataset import GnssTable, ImuTable, Trajectory
from robins.logs.findings import Finding, LogError
from robins.logs.text import Layout, read_columns
from robins.logs.timebase import (
    GPS_EPOCH_NS,
    WEEK_NS,
    ns_to_decimal,
    stamps_to_ns,
    unrolled,
    weeks_of,
)
from robins.logs.writing import rows_of_numbers, write_lines

_T = "time of week [s]"
_IMU = (
    _T,
    "dtheta_x [rad]",
    "dtheta_y [rad]",
    "dtheta_z [rad]",
    "dv_x [m/s]",
    "dv_y [m/s]",
    "dv_z [m/s]",
)
_POSITION = ("latitude [deg]", "longitude [deg]", "height [m]")
_GNSS = (_T, *_POSITION, "sigma_N [m]", "sigma_E [m]", "sigma_D [m]")
_NAV = (
    "week",
    _T,
    *_POSITION,
    "vN [m/s]",
    "vE [m/s]",
    "vD [m/s]",
    "roll [deg]",
    "pitch [deg]",
    "yaw [deg]",
)

Path = str | os.PathLike[str]


def read_kfgins_imu(path: Path, findings: list[Finding] | None = None) -> ImuTable:
    """Read an IMU file of KF-GINS.

    Args:
        path: the file, plain or compressed.
        findings: receives what was left out; without it that is issued as `LogWarning`.

    Raises:
        LogError: the file is not of this kind.
    """
    columns = read_columns(path, Layout(_IMU, None), findings)
    return ImuTable(
        time_ns=unrolled(stamps_to_ns(str(path), _T, columns.texts[:, 0], columns.rows)),
        gyro=columns.values[:, 0:3].copy(),
        accel=columns.values[:, 3:6].copy(),
        kind="increment",
        source=str(path),
        rows=columns.rows,
    )


def read_kfgins_gnss(path: Path, findings: list[Finding] | None = None) -> GnssTable:
    """Read a GNSS file of KF-GINS. Arguments and errors as for `read_kfgins_imu`."""
    columns = read_columns(path, Layout(_GNSS, None), findings)
    return GnssTable(
        time_ns=unrolled(stamps_to_ns(str(path), _T, columns.texts[:, 0], columns.rows)),
        lat_rad=np.deg2rad(columns.values[:, 0]),
        lon_rad=np.deg2rad(columns.values[:, 1]),
        alt_m=columns.values[:, 2].copy(),
        sigma_m=columns.values[:, 3:6].copy(),
        source=str(path),
        rows=columns.rows,
    )


def read_kfgins_nav(path: Path, findings: list[Finding] | None = None) -> Trajectory:
    """Read a navigation file of KF-GINS. Arguments and errors as for `read_kfgins_imu`."""
    columns = read_columns(path, Layout(_NAV, None, texts=2), findings)
    v = columns.values
    week = weeks_of(str(path), "week", columns.texts[:, 0], columns.rows)
    time_ns = stamps_to_ns(str(path), _T, columns.texts[:, 1], columns.rows)
    return Trajectory(
        time_ns=unrolled(time_ns + (week - week[0]) * WEEK_NS),
        lat_rad=np.deg2rad(v[:, 0]),
        lon_rad=np.deg2rad(v[:, 1]),
        alt_m=v[:, 2].copy(),
        v_n=v[:, 3:6].copy(),
        q_nb=np.asarray(rotation.from_euler(*np.deg2rad(v[:, 6:9]).T)),
        source=str(path),
    )


def write_kfgins_imu(path: Path, imu: ImuTable, week: int | None = None) -> None:
    """Write an IMU file of KF-GINS; numbers read back bit by bit.

    Args:
        path: the file.
        imu: increments; stamps since 1970 in GPS time, or seconds of a week.
        week: GPS week whose beginning absolute stamps are counted from; by default that of the
            first. Give the same for the files of one run.

    Raises:
        LogError: the samples are rates, or not forward-right-down; or the file cannot be written.
    """
    if imu.kind != "increment":
        raise LogError(
            str(path), "KF-GINS wants increments, these are rates", "integrate them first"
        )
    _require(path, "body", imu.body, "FRD")
    values = np.hstack([imu.gyro, imu.accel])
    write_lines(path, rows_of_numbers(_of_week(imu.time_ns, week), values, " "))


def write_kfgins_gnss(path: Path, gnss: GnssTable, week: int | None = None) -> None:
    """Write a GNSS file of KF-GINS, which has no velocities and no missing components.

    ``week`` is that of `write_kfgins_imu`.

    Raises:
        LogError: a number is missing, the sigmas are not along NED; the file cannot be written.
    """
    _require(path, "nav", gnss.nav, "NED")
    position = (np.rad2deg(gnss.lat_rad), np.rad2deg(gnss.lon_rad), gnss.alt_m)
    values = np.column_stack([*position, gnss.sigma_m])
    if not np.all(np.isfinite(values)):
        row = int(np.argmin(np.isfinite(values).all(axis=1)))
        raise LogError(
            str(path),
            "KF-GINS cannot read a missing component",
            "leave out the fixes that are not complete",
            where=f"time {ns_to_decimal(int(gnss.time_ns[row]))} s",
        )
    write_lines(path, rows_of_numbers(_of_week(gnss.time_ns, week), values, " "))


def write_kfgins_nav(path: Path, trajectory: Trajectory, week: int = 0) -> None:
    """Write a navigation file of KF-GINS, yaw in [0, 360) deg.

    Args:
        path: the file.
        trajectory: stamps since 1970 in GPS time, or seconds of a week.
        week: GPS week that seconds of a week are of; absolute stamps are each in their own.

    Raises:
        LogError: the frames are not NED and FRD; the file cannot be written.
    """
    _require(path, "nav", trajectory.nav, "NED")
    _require(path, "body", trajectory.body, "FRD")
    roll, pitch, yaw = (np.rad2deg(a) for a in rotation.to_euler(jnp.asarray(trajectory.q_nb)))
    position = (np.rad2deg(trajectory.lat_rad), np.rad2deg(trajectory.lon_rad), trajectory.alt_m)
    values = np.column_stack([*position, trajectory.v_n, roll, pitch, np.mod(yaw, 360.0)])
    origin_ns = GPS_EPOCH_NS if _absolute(trajectory.time_ns) else -week * WEEK_NS
    weeks, of_week_ns = np.divmod(trajectory.time_ns - origin_ns, WEEK_NS)
    lines = rows_of_numbers(of_week_ns, values, " ")
    rows = (line for block in lines for line in block.splitlines(True))
    write_lines(path, (f"{w} {line}" for w, line in zip(weeks.tolist(), rows, strict=True)))


def _absolute(time_ns: np.ndarray) -> bool:
    """Whether stamps count from 1970; if not, they are seconds of a week or since power-up."""
    return len(time_ns) > 0 and bool(time_ns[0] >= GPS_EPOCH_NS)


def _of_week(time_ns: np.ndarray, week: int | None) -> np.ndarray:
    """Stamps from the beginning of a week, by default that of the first of them."""
    if not _absolute(time_ns):
        return time_ns
    since_ns = time_ns - GPS_EPOCH_NS
    return since_ns - (since_ns[0] // WEEK_NS if week is None else week) * WEEK_NS


def _require(path: Path, what: str, has: str, wants: str) -> None:
    if has != wants:
        raise LogError(
            str(path), f"KF-GINS wants {what} frame {wants}, this table is in {has}", "convert it"
        )
