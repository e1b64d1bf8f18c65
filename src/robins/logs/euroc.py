"""CSV of EuRoC / ASL recordings: IMU (``imu0/data.csv``) and ground truth.

Time is integer nanoseconds. The IMU's axes S are those of the sensor (in EuRoC x points up): turn
them with `Mounting`. The ground truth lives in a local frame R, z up, metres, with no place on the
Earth and any heading; it is read as east-north-up of an origin. Quaternions are scalar first in the
file.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from robins.dataset import ImuTable, Trajectory
from robins.logs.findings import Finding, LogError, report
from robins.logs.local import LocalPath, Origin, from_local
from robins.logs.text import Layout, read_columns
from robins.logs.timebase import stamps_to_ns
from robins.logs.writing import rows_of_numbers, write_lines

_TIME = "timestamp [ns]"
_IMU = (
    _TIME,
    *(f"w_RS_S_{axis} [rad s^-1]" for axis in "xyz"),
    *(f"a_RS_S_{axis} [m s^-2]" for axis in "xyz"),
)
_TRUTH = (
    _TIME,
    *(f"p_RS_R_{axis} [m]" for axis in "xyz"),
    *(f"q_RS_{part} []" for part in "wxyz"),
    *(f"v_RS_R_{axis} [m s^-1]" for axis in "xyz"),
)
NOWHERE = Origin(0.0, 0.0, 0.0)


def read_euroc_imu(path: str | os.PathLike[str], findings: list[Finding] | None = None) -> ImuTable:
    """Read an IMU recording, along the sensor's axes S.

    Args:
        path: the file, plain or compressed.
        findings: receives what was left out; without it that is issued as `LogWarning`.

    Raises:
        LogError: the file is not of this kind.
    """
    columns = read_columns(path, Layout(_IMU, ","), findings)
    return ImuTable(
        time_ns=stamps_to_ns(str(path), _TIME, columns.texts[:, 0], columns.rows, exponent=0),
        gyro=columns.values[:, 0:3].copy(),
        accel=columns.values[:, 3:6].copy(),
        kind="rate",
        source=str(path),
        rows=columns.rows,
    )


def read_euroc_truth(
    path: str | os.PathLike[str],
    findings: list[Finding] | None = None,
    origin: Origin = NOWHERE,
) -> Trajectory:
    """Read a ground truth with position, quaternion and velocity (state_groundtruth_estimate0).

    Args:
        path: the file, plain or compressed.
        findings: receives what was left out; without it that is issued as `LogWarning`.
        origin: where the local frame is put on the Earth, its x axis east.

    Raises:
        LogError: the file is not of this kind, or a quaternion is not of unit length to 1e-3.
    """
    file = str(path)
    columns = read_columns(path, Layout(_TRUTH, ","), findings)
    v = columns.values
    length = np.linalg.norm(v[:, 3:7], axis=-1)
    wrong = np.flatnonzero(~(np.abs(length - 1.0) < 1e-3))
    if len(wrong):
        raise LogError(
            file,
            "a quaternion is not of unit length",
            "are the columns q_w, q_x, q_y, q_z?",
            where=f"line {columns.rows[wrong[0]]}",
            field="norm of q_RS",
            value=float(length[wrong[0]]),
        )
    if origin == NOWHERE:
        report(
            findings,
            Finding(
                "note",
                "no_place",
                file,
                "",
                "0 0 0",
                f"{Path(file).name}: positions are local metres; they are put at latitude 0, "
                "longitude 0, height 0, x to the east. Gravity and Earth rate there are not those "
                "of the recording; give an origin if that matters.",
            ),
        )
    local = LocalPath(
        stamps_to_ns(file, _TIME, columns.texts[:, 0], columns.rows, exponent=0),
        v[:, 0:3],
        v[:, 7:10],
        v[:, 3:7] / length[:, None],
    )
    return from_local(local, origin, source=file)


def write_euroc_imu(path: str | os.PathLike[str], imu: ImuTable) -> None:
    """Write an IMU recording; numbers read back bit by bit.

    Raises:
        LogError: the samples are increments, or the file cannot be written.
    """
    if imu.kind != "rate":
        raise LogError(
            str(path), "EuRoC wants rates, these are increments", "divide them by their dt first"
        )

    def blocks():
        yield "#" + ",".join(_IMU) + "\n"
        values = np.hstack([imu.gyro, imu.accel])
        yield from rows_of_numbers(imu.time_ns, values, ",", seconds=False)

    write_lines(path, blocks())
