"""Tables returned by readers: their kinds, and guaranteed properties of their arrays.

Arrays are float64 and int64, contiguous, of matching lengths. Quaternions are of unit length or
NaN.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TypeVar

import numpy as np

from robins.dataset import (
    AttitudeTable,
    Dataset,
    GnssTable,
    ImuTable,
    MagTable,
    OdometryTable,
    Trajectory,
)
from robins.logs.findings import Findings, LogError, finding_reporter, refused
from robins.logs.timebase import LIMIT_NS

Table = ImuTable | GnssTable | Trajectory | MagTable | AttitudeTable | OdometryTable

KINDS: dict[type, str] = {
    ImuTable: "imu",
    GnssTable: "gnss",
    Trajectory: "truth",
    MagTable: "mag",
    AttitudeTable: "attitude",
    OdometryTable: "odometry",
}
"""Field of a `Dataset` for each type of table; a path that is no truth is its ``master``."""


def place_of(table: GnssTable | Trajectory) -> np.ndarray:
    """Latitude, longitude [rad], height [m], (n, 3)."""
    return np.stack([table.lat_rad, table.lon_rad, table.alt_m], axis=-1)


def kind_of(table: Table) -> str:
    """Field of a `Dataset` for a table of this type."""
    return KINDS[type(table)]


def kind_in_text(table: Table) -> str:
    """Kind of a table as in `robins.logs.quantities`, where a path is a trajectory."""
    kind = kind_of(table)
    return "trajectory" if kind == "truth" else kind


def tables_of(opened: Table | Dataset) -> list[Table]:
    """Tables returned by a reader; for a dataset, all but the master's."""
    if not isinstance(opened, Dataset):
        return [opened]
    tables = [getattr(opened, kind) for kind in KINDS.values()]
    return [table for table in tables if table is not None]


def recording(
    file: str, imu: ImuTable, gnss: GnssTable | None = None, mag: MagTable | None = None
) -> Dataset:
    """Dataset of a file that states the unit of its stamps, named after the file."""
    return Dataset(stem_of(file), imu, gnss, mag=mag, time_unit_known=(file,))


def stem_of(file: str) -> str:
    """Name of a file without its folder and without extensions, from the first dot on."""
    return Path(file).name.split(".")[0]


AnyTable = TypeVar("AnyTable", bound=Table)

# Columns of real numbers and their numbers of components; 0: one number per row.
_PLACE = {"lat_rad": 0, "lon_rad": 0, "alt_m": 0}
_FLOATS: dict[type, dict[str, int]] = {
    ImuTable: {"gyro": 3, "accel": 3},
    GnssTable: _PLACE | {"sigma_m": 3, "v_n": 3, "sigma_v": 3},
    Trajectory: _PLACE | {"v_n": 3, "q_nb": 4, "omega_ib_b": 3},
    MagTable: {"field_t": 3},
    AttitudeTable: {"q_nb": 4},
    OdometryTable: dict.fromkeys(("speed_mps", "yaw_rate", "sigma_speed", "sigma_yaw"), 0),
}
_OPTIONAL = {(GnssTable, "v_n"), (GnssTable, "sigma_v"), (Trajectory, "omega_ib_b")}


def checked(table: AnyTable) -> AnyTable:
    """Table with plain arrays.

    Integers, float32, big-endian and strided arrays become contiguous float64 of the same values.

    Raises:
        LogError: an array is missing, not numeric, complex, or of another length; a stamp is not an
            integer, ``moving`` not bool; or velocities come without their sigmas.
    """
    if isinstance(table, ImuTable) and table.kind not in ("rate", "increment"):
        raise refused(_name(table), field="kind", value=table.kind)(
            "is neither 'rate' nor 'increment'", "say which of them the rows are"
        )
    if isinstance(table, GnssTable) and (table.v_n is None) != (table.sigma_v is None):
        lacking = "sigma_v" if table.sigma_v is None else "v_n"
        remedy = f"give {lacking} as well"
        raise LogError(_name(table), "velocities and their sigmas belong together", remedy)
    out = {"time_ns": _stamps(table)}
    n = len(out["time_ns"])
    for field, components in _FLOATS[type(table)].items():
        value = getattr(table, field)
        if value is None and (type(table), field) in _OPTIONAL:
            continue
        array = np.asarray(value)
        if array.dtype.kind not in "fiu":
            remedy = "give an array of floats, nan where a number is missing"
            cause = f"holds {array.dtype}, not real numbers"
            raise refused(_name(table), field=field)(cause, remedy)
        shape = (n, components) if components else (n,)
        out[field] = np.ascontiguousarray(_shaped(table, field, array, shape), np.float64)
    for field in ("quality", "rows"):
        if getattr(table, field, None) is not None:
            out[field] = _shaped(table, field, _integers(table, field, "give integers"), (n,))
    for field, shape in (("moving", (n,)), ("assumed_m", (n, 3)), ("assumed_v", (n, 3))):
        if (value := getattr(table, field, None)) is not None:
            marks = np.asarray(value)
            if marks.dtype.kind != "b":
                cause = f"is {marks.dtype}, not bool"
                raise refused(_name(table), field=field)(cause, "give True and False")
            out[field] = _shaped(table, field, marks, shape)
    return dataclasses.replace(table, **out)


def _name(table: Table) -> str:
    return table.source or type(table).__name__


def _stamps(table: Table) -> np.ndarray:
    time_ns = _integers(table, "time_ns", "give time as int64 nanoseconds")
    beyond = (time_ns <= -LIMIT_NS) | (time_ns >= LIMIT_NS)
    if beyond.any():
        k = int(np.argmax(beyond))
        where = f"row {k}" if table.rows is None else f"line {table.rows[k]}"
        raise refused(_name(table), where, "time_ns", int(time_ns[k]))(
            "is 146 years or more from zero", "give int64 nanoseconds; repair or leave out this row"
        )
    return time_ns


def _integers(table: Table, field: str, remedy: str) -> np.ndarray:
    array = np.asarray(getattr(table, field))
    if array.dtype.kind not in "iu" or array.ndim != 1:
        cause = f"is {array.dtype} of shape {array.shape}, not a row of integers"
        raise refused(_name(table), field=field)(cause, remedy)
    return np.ascontiguousarray(array, np.int64)


def _shaped(table: Table, field: str, array: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    if array.shape != shape:
        cause = f"has shape {array.shape} where {shape} is needed"
        raise refused(_name(table), field=field)(cause, "one row for each time stamp")
    return array


TOLERANCE = 1e-3  # largest deviation of a length from one, by rounding of decimals


def unit_quaternions(
    file: str, name: str, q: np.ndarray, rows: np.ndarray | None, findings: Findings
) -> np.ndarray:
    """Unit quaternions; other rows become NaN and are reported.

    Args:
        file: for messages.
        name: of the columns, for messages.
        q: (n, 4) as recorded; a row with a NaN is missing.
        rows: (n,) line numbers, or None if there are no lines.
        findings: receives rejected rows; without it they are issued as `LogWarning`.

    Raises:
        LogError: more than half of the rows are not of unit length.
    """
    length = np.linalg.norm(q, axis=-1)
    known = ~np.isnan(length)
    wrong = known & ~(np.abs(length - 1.0) < TOLERANCE)
    good = (known & ~wrong)[:, None]
    out = np.where(good, q / np.where(good, length[:, None], 1.0), np.nan)
    if not wrong.any():
        return out
    k = int(np.argmax(wrong))
    where = f"row {k + 1}" if rows is None else f"line {rows[k]}"
    count = f"{wrong.sum()} of {known.sum()} rows"
    if 2 * wrong.sum() > known.sum():
        raise refused(file, where, f"length of {name}", float(length[k]))(
            f"is not of unit length, as in {count}", "are the columns scalar first: w, x, y, z?"
        )
    finding_reporter(findings, "warning", "quaternion_length", file, where, float(length[k]))(
        f"the quaternion {name} has length {length[k]:g}, not 1 ({count}). Such attitudes are "
        "taken as missing."
    )
    return out
