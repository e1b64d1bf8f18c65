"""The doctor on numbers that are too large for any vehicle, in whatever table and column."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from robins.dataset import AttitudeTable, GnssTable, ImuTable, MagTable, Trajectory
from robins.logs.findings import Finding
from robins.logs.limits import (
    ACCEL_LIMIT,
    ALT_LIMIT_M,
    FIELD_LIMIT_T,
    GYRO_LIMIT,
    LAT_LIMIT,
    LON_LIMIT,
    SIGMA_LIMIT,
    SPEED_LIMIT,
    few_beyond,
)
from robins.logs.quiet import warning
from robins.logs.tables import Table

_PLACE = {"lat_rad": LAT_LIMIT, "lon_rad": LON_LIMIT}
_PATH = _PLACE | {"alt_m": ALT_LIMIT_M, "v_n": SPEED_LIMIT}  # of fixes, `check_gnss` tells of these
_LIMITS: dict[type, dict[str, float]] = {
    ImuTable: {"gyro": GYRO_LIMIT, "accel": ACCEL_LIMIT},
    GnssTable: _PLACE | {"sigma_m": SIGMA_LIMIT, "sigma_v": SIGMA_LIMIT},
    Trajectory: _PATH | {"q_nb": 1.001, "omega_ib_b": GYRO_LIMIT},
    MagTable: {"field_t": FIELD_LIMIT_T},
    AttitudeTable: {},  # its quaternions have a check of their length
}


def check_limits(table: Table) -> Iterator[Finding]:
    """Findings about single numbers beyond the limits of `clean`.

    Where most of a column is beyond, its unit is another, which other checks tell. They tell of
    infinities too, but for those of a path.
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
            yield warning(
                table,
                "absurd",
                int(rows.sum()),
                f"{name} is {worst:g} here, which no vehicle has; {rows.sum()} of {len(table)} "
                "rows are like that. A bit or a digit was lost in the sensor, the recorder or the "
                "copy; `clean` refuses those numbers and counts them.",
                k,
            )
