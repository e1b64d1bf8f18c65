"""Tables as others may rely on them: float64 and int64, contiguous, of matching lengths."""

from __future__ import annotations

import dataclasses
from typing import Any, TypeVar

import numpy as np

from robins.dataset import AttitudeTable, GnssTable, ImuTable, MagTable, Trajectory
from robins.logs.findings import LogError, refused
from robins.logs.tables import Table
from robins.logs.timebase import LIMIT_NS

AnyTable = TypeVar("AnyTable", bound=Table)

# Columns of real numbers and how many components each has; 0: one number a row.
_PLACE = {"lat_rad": 0, "lon_rad": 0, "alt_m": 0}
_FLOATS: dict[type, dict[str, int]] = {
    ImuTable: {"gyro": 3, "accel": 3},
    GnssTable: _PLACE | {"sigma_m": 3, "v_n": 3, "sigma_v": 3},
    Trajectory: _PLACE | {"v_n": 3, "q_nb": 4, "omega_ib_b": 3},
    MagTable: {"field_t": 3},
    AttitudeTable: {"q_nb": 4},
}
_OPTIONAL = {(GnssTable, "v_n"), (GnssTable, "sigma_v"), (Trajectory, "omega_ib_b")}


def checked(table: AnyTable) -> AnyTable:
    """The same table with plain arrays.

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
        mend = f"give {lacking} as well"
        raise LogError(_name(table), "velocities and their sigmas belong together", mend)
    out = {"time_ns": _stamps(table)}
    n = len(out["time_ns"])
    for field, components in _FLOATS[type(table)].items():
        value = getattr(table, field)
        if value is None and (type(table), field) in _OPTIONAL:
            continue
        array = np.asarray(value)
        if array.dtype.kind not in "fiu":
            raise refused(_name(table), field=field)(
                f"holds {array.dtype}, not real numbers",
                "give an array of floats, nan where a number is missing",
            )
        shape = (n, components) if components else (n,)
        out[field] = np.ascontiguousarray(_shaped(table, field, array, shape), np.float64)
    for field in ("quality", "rows"):
        if getattr(table, field, None) is not None:
            out[field] = _shaped(table, field, _integers(table, field, "give integers"), (n,))
    if isinstance(table, AttitudeTable) and table.moving is not None:
        moving = np.asarray(table.moving)
        if moving.dtype.kind != "b":
            raise refused(_name(table), field="moving")(
                f"is {moving.dtype}, not bool", "give True and False"
            )
        out["moving"] = _shaped(table, "moving", moving, (n,))
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


def _integers(table: Table, field: str, mend: str) -> np.ndarray:
    array = np.asarray(getattr(table, field))
    if array.dtype.kind not in "iu" or array.ndim != 1:
        cause = f"is {array.dtype} of shape {array.shape}, not a row of integers"
        raise refused(_name(table), field=field)(cause, mend)
    return np.ascontiguousarray(array, np.int64)


def _shaped(table: Table, field: str, array: np.ndarray, shape: tuple[int, ...]) -> Any:
    if array.shape != shape:
        cause = f"has shape {array.shape} where {shape} is needed"
        raise refused(_name(table), field=field)(cause, "one row for each time stamp")
    return array
