"""Magnitudes far beyond any vehicle: the doctor reports larger values, `clean` refuses them."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from robins.dataset import (
    AttitudeTable,
    GnssTable,
    ImuTable,
    MagTable,
    OdometryTable,
    Trajectory,
)
from robins.ins.plausible import ACCEL_LIMIT, GYRO_LIMIT
from robins.logs.findings import Finding
from robins.logs.quiet import warning
from robins.logs.tables import Table

LAT_LIMIT, LON_LIMIT = np.pi / 2, 2 * np.pi
ALT_LIMIT_M = 1e9
SPEED_LIMIT = 1e5  # m/s
SIGMA_LIMIT = 1e9  # m or m/s; squares of larger ones break the arithmetic of a filter
QUATERNION_LIMIT = 1.001
FIELD_LIMIT_T = 1.0  # beyond any magnetometer that finds north


def few_beyond(values: np.ndarray, limit: float) -> np.ndarray:
    """Mask (n,) of rows of (n,) or (n, k) with a number beyond a limit; NaN does not count.

    All False if they are half of the rows or more: then the unit is another.
    """
    rows = np.asarray((np.abs(values) > limit).any(axis=tuple(range(1, values.ndim))))
    return rows if 2 * rows.sum() < len(rows) else np.zeros(len(values), bool)


_PLACE = {"lat_rad": LAT_LIMIT, "lon_rad": LON_LIMIT}
_PATH = _PLACE | {"alt_m": ALT_LIMIT_M, "v_n": SPEED_LIMIT}  # fixes are covered by `check_gnss`
_LIMITS: dict[type, dict[str, float]] = {
    ImuTable: {"gyro": GYRO_LIMIT, "accel": ACCEL_LIMIT},
    GnssTable: _PLACE | {"sigma_m": SIGMA_LIMIT, "sigma_v": SIGMA_LIMIT},
    Trajectory: _PATH | {"q_nb": QUATERNION_LIMIT, "omega_ib_b": GYRO_LIMIT},
    MagTable: {"field_t": FIELD_LIMIT_T},
    OdometryTable: {"speed_mps": SPEED_LIMIT},
    AttitudeTable: {},  # its quaternions are checked for unit length
}


def check_limits(table: Table) -> Iterator[Finding]:
    """Findings about single numbers beyond the limits of `clean`.

    If most of a column is beyond, its unit is another, which other checks report. They also report
    infinities, except those of a path.
    """
    for name, limit in _LIMITS[type(table)].items():
        values = getattr(table, name)
        if values is None:
            continue
        if not isinstance(table, Trajectory):
            values = np.where(np.isfinite(values), values, np.nan)
        rows = few_beyond(values, limit)
        if rows.any():
            k = int(np.argmax(rows))
            worst = float(np.ravel(values[k])[np.nanargmax(np.abs(values[k]))])
            yield warning(table, "absurd", int(rows.sum()), k)(
                f"{name} is {worst:g} here, which no vehicle has; {rows.sum()} of {len(table)} "
                "rows are like that. A bit or a digit was lost in the sensor, the recorder or the "
                "copy; a replay refuses those numbers and counts them."
            )
