"""Tables as others may rely on them: float64 and int64, contiguous, of matching lengths."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from robins.dataset import AttitudeTable, GnssTable, ImuTable, MagTable, Trajectory
from robins.logs.findings import LogError
from robins.logs.timebase import LIMIT_NS

# Columns and the number of components of each; None: one number a row.
_IMU: dict[str, int | None] = {"gyro": 3, "accel": 3}
_GNSS: dict[str, int | None] = {
    "lat_rad": None,
    "lon_rad": None,
    "alt_m": None,
    "sigma_m": 3,
    "v_n": 3,
    "sigma_v": 3,
}
_TRUTH: dict[str, int | None] = {
    "lat_rad": None,
    "lon_rad": None,
    "alt_m": None,
    "v_n": 3,
    "q_nb": 4,
    "omega_ib_b": 3,
}
_OPTIONAL = {"v_n", "sigma_v", "quality", "rows", "omega_ib_b"}


def checked_imu(imu: ImuTable) -> ImuTable:
    """The same table with plain arrays.

    Integers, float32, big-endian and strided arrays become contiguous float64 of the same values.

    Raises:
        LogError: an array is missing, not numeric, complex, or of another length; or a stamp is
            not an integer.
    """
    if imu.kind not in ("rate", "increment"):
        raise LogError(
            _name(imu),
            "is neither 'rate' nor 'increment'",
            "say which of them the rows are",
            field="kind",
            value=imu.kind,
        )
    return dataclasses.replace(imu, **_checked(imu, _IMU, integers=("rows",)))


def checked_gnss(gnss: GnssTable) -> GnssTable:
    """As `checked_imu`; velocities come with their sigmas or not at all."""
    if (gnss.v_n is None) != (gnss.sigma_v is None):
        lacking = "sigma_v" if gnss.sigma_v is None else "v_n"
        raise LogError(
            _name(gnss), "velocities and their sigmas belong together", f"give {lacking} as well"
        )
    return dataclasses.replace(gnss, **_checked(gnss, _GNSS, integers=("quality", "rows")))


def checked_truth(truth: Trajectory) -> Trajectory:
    """As `checked_imu`."""
    return dataclasses.replace(truth, **_checked(truth, _TRUTH, integers=("rows",)))


def checked_mag(mag: MagTable) -> MagTable:
    """As `checked_imu`."""
    return dataclasses.replace(mag, **_checked(mag, {"field_t": 3}, integers=("rows",)))


def checked_attitude(attitude: AttitudeTable) -> AttitudeTable:
    """As `checked_imu`; ``moving`` is of bool."""
    arrays = _checked(attitude, {"q_nb": 4}, integers=("rows",))
    if attitude.moving is not None:
        moving = np.asarray(attitude.moving)
        if moving.dtype.kind != "b":
            raise LogError(
                _name(attitude),
                f"is {moving.dtype}, not bool",
                "give True and False",
                field="moving",
            )
        arrays["moving"] = _shaped(attitude, "moving", moving, (len(arrays["time_ns"]),))
    return dataclasses.replace(attitude, **arrays)


def _name(table: Any) -> str:
    return table.source or type(table).__name__


def _checked(
    table: Any, floats: dict[str, int | None], integers: tuple[str, ...]
) -> dict[str, np.ndarray]:
    out = {"time_ns": _integers(table, "time_ns")}
    n = len(out["time_ns"])
    # not by np.abs, which leaves the least integer negative
    if n and not -LIMIT_NS < out["time_ns"].min() <= out["time_ns"].max() < LIMIT_NS:
        k = int(np.argmax((out["time_ns"] <= -LIMIT_NS) | (out["time_ns"] >= LIMIT_NS)))
        raise LogError(
            _name(table),
            "is 146 years or more from zero",
            "give int64 nanoseconds; repair or leave out this row",
            where=f"row {k}" if table.rows is None else f"line {table.rows[k]}",
            field="time_ns",
            value=int(out["time_ns"][k]),
        )
    for field in integers:
        if getattr(table, field) is not None:
            out[field] = _integers(table, field)
    for field, components in floats.items():
        value = getattr(table, field)
        if value is None and field in _OPTIONAL:
            continue
        array = np.asarray(value)
        if array.dtype.kind not in "fiu":
            raise LogError(
                _name(table),
                f"holds {array.dtype}, not real numbers",
                "give an array of floats, nan where a number is missing",
                field=field,
            )
        out[field] = _shaped(table, field, array, (n,) if components is None else (n, components))
    for field in integers:
        if field in out:
            _shaped(table, field, out[field], (n,))
    return {k: v if k in ("time_ns", *integers) else _plain(v) for k, v in out.items()}


def _plain(array: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(array, np.float64)


def _integers(table: Any, field: str) -> np.ndarray:
    array = np.asarray(getattr(table, field))
    if array.dtype.kind not in "iu" or array.ndim != 1:
        raise LogError(
            _name(table),
            f"is {array.dtype} of shape {array.shape}, not a row of integers",
            "give time as int64 nanoseconds" if field == "time_ns" else "give integers",
            field=field,
        )
    return np.ascontiguousarray(array, np.int64)


def _shaped(table: Any, field: str, array: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    if array.shape != shape:
        raise LogError(
            _name(table),
            f"has shape {array.shape} where {shape} is needed",
            "one row for each time stamp",
            field=field,
        )
    return array
