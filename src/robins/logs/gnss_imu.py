"""IMU logs of the GNSS_IMU project: CSV without header, one sample a line.

Columns: time [s] (counted from 1970 in GPS time), specific force x, y, z [g], angular rate x, y, z
[rad/s], then unused columns. The axes are those of the sensor; turn them with `Mounting`.
"""

from __future__ import annotations

import os

import numpy as np

from robins.dataset import ImuTable
from robins.logs.findings import Finding
from robins.logs.text import Layout, read_columns
from robins.logs.timebase import stamps_to_ns
from robins.units import to_si

_NAMES = (
    "time [s]",
    "acc_x [g]",
    "acc_y [g]",
    "acc_z [g]",
    "gyro_x [rad/s]",
    "gyro_y [rad/s]",
    "gyro_z [rad/s]",
)


def read_gnss_imu(path: str | os.PathLike[str], findings: list[Finding] | None = None) -> ImuTable:
    """Read an IMU log of GNSS_IMU, along the sensor's own axes.

    Args:
        path: the file, plain or compressed.
        findings: receives what was left out; without it that is issued as `LogWarning`.

    Raises:
        LogError: the file is not such a log.
    """
    columns = read_columns(path, Layout(_NAMES, ","), findings)
    return ImuTable(
        time_ns=stamps_to_ns(str(path), _NAMES[0], columns.texts[:, 0], columns.rows),
        gyro=np.ascontiguousarray(columns.values[:, 3:6]),
        accel=to_si(columns.values[:, 0:3], "g"),
        kind="rate",
        source=str(path),
        rows=columns.rows,
    )
