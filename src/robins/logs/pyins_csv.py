"""CSV as pyins users write it: a DataFrame indexed by time [s], `frame.to_csv(path)`.

The columns are named, in any order, and tell what the table is:

- Imu: gyro_x gyro_y gyro_z [rad/s], accel_x accel_y accel_z [m/s^2];
- Increments: dt [s], theta_x theta_y theta_z [rad], dv_x dv_y dv_z [m/s], over the dt before;
- Trajectory: lat lon [deg], alt [m], VN VE VD [m/s], roll pitch heading [deg].

Frames are those of pyins: north-east-down and forward-right-down.
"""

from __future__ import annotations

import os
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from robins import rotation
from robins.dataset import ImuTable, Trajectory
from robins.logs.findings import Finding, LogError, report
from robins.logs.text import Columns, Head, Layout, peek, read_columns
from robins.logs.timebase import stamps_to_ns
from robins.logs.writing import rows_of_numbers, write_lines

GYRO = ("gyro_x", "gyro_y", "gyro_z")
ACCEL = ("accel_x", "accel_y", "accel_z")
THETA = ("theta_x", "theta_y", "theta_z")
DV = ("dv_x", "dv_y", "dv_z")
TRAJECTORY = ("lat", "lon", "alt", "VN", "VE", "VD", "roll", "pitch", "heading")
TABLES = {"Imu": (*GYRO, *ACCEL), "Increments": ("dt", *THETA, *DV), "Trajectory": TRAJECTORY}


def header(head: Head) -> list[str]:
    """Column names without the index, which may have any name or none."""
    first = head.lines[0] if head.lines else ""
    return [name.strip() for name in first.split(",")][1:]


def table_of(names: list[str]) -> str:
    """Which table it is by its columns: a key of `TABLES`; empty if it is none of them."""
    return next((t for t, needed in TABLES.items() if set(needed) <= set(names)), "")


def read_pyins(
    path: str | os.PathLike[str], findings: list[Finding] | None = None
) -> ImuTable | Trajectory:
    """Read an Imu, Increments or Trajectory table.

    Args:
        path: the file, plain or compressed.
        findings: receives what was left out; without it that is issued as `LogWarning`.

    Raises:
        LogError: the columns are not those of one of the three.
    """
    file, names = str(path), header(peek(path))
    kind = table_of(names)
    if not kind:
        lacking = (
            f"{table} lacks {' '.join(n for n in needed if n not in names)}"
            for table, needed in TABLES.items()
        )
        raise LogError(
            file,
            f"the header has no full set of columns ({'; '.join(lacking)})",
            "name the columns as pyins does",
            where="line 1",
        )
    columns = read_columns(path, Layout(("time", *names), ",", skip=1, all_named=True), findings)
    time_ns = stamps_to_ns(file, "time", columns.texts[:, 0], columns.rows)

    def take(wanted: tuple[str, ...]) -> np.ndarray:
        return columns.values[:, [names.index(n) for n in wanted]]

    if kind == "Trajectory":
        lat, lon, alt, *_ = take(TRAJECTORY).T
        return Trajectory(
            time_ns=time_ns,
            lat_rad=np.deg2rad(lat),
            lon_rad=np.deg2rad(lon),
            alt_m=alt.copy(),
            v_n=take(("VN", "VE", "VD")),
            q_nb=np.asarray(rotation.from_euler(*np.deg2rad(take(("roll", "pitch", "heading"))).T)),
            source=file,
        )
    if kind == "Increments":
        _compare_dt(file, columns, time_ns, columns.values[:, names.index("dt")], findings)
    gyro, accel = (GYRO, ACCEL) if kind == "Imu" else (THETA, DV)
    return ImuTable(
        time_ns=time_ns,
        gyro=take(gyro),
        accel=take(accel),
        kind="rate" if kind == "Imu" else "increment",
        source=file,
        rows=columns.rows,
    )


def _compare_dt(
    file: str,
    columns: Columns,
    time_ns: np.ndarray,
    dt: np.ndarray,
    findings: list[Finding] | None,
) -> None:
    """An increment is taken to be over the time since the row before: say where dt disagrees."""
    elapsed = np.diff(time_ns) * 1e-9
    off = np.flatnonzero(np.abs(dt[1:] - elapsed) > 0.01 * np.abs(dt[1:]))
    if len(off):
        first = int(off[0]) + 1
        report(
            findings,
            Finding(
                "warning",
                "dt_disagrees",
                file,
                f"line {columns.rows[first]}",
                float(dt[first]),
                f"{Path(file).name} line {columns.rows[first]}: dt is {dt[first]:g} s but the time "
                f"has grown by {elapsed[first - 1]:g} s ({len(off)} such rows). Increments are "
                "taken over the time since the row before; rows are missing, or dt belongs to the "
                "next row.",
            ),
        )


def write_pyins(path: str | os.PathLike[str], table: ImuTable | Trajectory) -> None:
    """Write a table for pyins: ``pandas.read_csv(path, index_col="time")``.

    Raises:
        LogError: the frames are not NED and FRD, or the file cannot be written.
    """
    if table.body != "FRD" or (isinstance(table, Trajectory) and table.nav != "NED"):
        raise LogError(str(path), "pyins wants frames NED and FRD", "convert the table first")
    if isinstance(table, Trajectory):
        angles = np.rad2deg(np.stack(rotation.to_euler(jnp.asarray(table.q_nb)), axis=-1))
        position = (np.rad2deg(table.lat_rad), np.rad2deg(table.lon_rad), table.alt_m)
        names, values = TRAJECTORY, np.column_stack([*position, table.v_n, angles])
    elif table.kind == "rate":
        names, values = (*GYRO, *ACCEL), np.hstack([table.gyro, table.accel])
    else:
        elapsed = np.diff(table.time_ns) * 1e-9
        # The first row has no row before it; the usual interval stands in.
        dt = np.concatenate([[np.median(elapsed) if len(elapsed) else np.nan], elapsed])
        names, values = ("dt", *THETA, *DV), np.column_stack([dt, table.gyro, table.accel])

    def blocks():
        yield ",".join(("time", *names)) + "\n"
        yield from rows_of_numbers(table.time_ns, values, ",")

    write_lines(path, blocks())
