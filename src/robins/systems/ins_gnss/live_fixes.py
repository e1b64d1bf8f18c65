"""Fixes of a live log as rows of numbers, in the order of time, and as the table a replay has.

A row: time [s], latitude, longitude [rad], height [m], three sigmas [m], velocity [m/s], its
sigmas, quality; what is missing is NaN.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from robins.dataset import GnssTable
from robins.systems.streaming import LiveError, numbers

WIDTH = 14
TOLD = [1, 2, 3, 7, 8, 9]  # what a fix can say


def row_of(
    time_s: float, place: Any, sigma_m: Any, v_n: Any, sigma_v: Any, quality: Any
) -> np.ndarray:
    """(14,) row of a fix.

    Raises:
        LiveError: a vector of another kind, a velocity without sigmas, angles that are no radians.
    """
    where, sigma = numbers("lat_rad, lon_rad, alt_m", place, 3), numbers("sigma_m", sigma_m, 3)
    missing = np.full(3, np.nan)
    velocity = missing if v_n is None else numbers("v_n", v_n, 3)
    if v_n is not None and sigma_v is None:
        raise LiveError("a velocity needs sigmas", "sigma_v", "give (3,) m/s")
    spread = missing if sigma_v is None else numbers("sigma_v", sigma_v, 3)
    if abs(where[0]) > np.pi / 2 or abs(where[1]) > 2.0 * np.pi:
        what = f"latitude {where[0]:.4g} and longitude {where[1]:.4g} are no radians"
        raise LiveError(what, "push_fix", "of degrees give np.radians")
    # as of a log that was cleaned: a component whose sigma is none is missing
    where = np.where(np.isfinite(where) & (sigma > 0.0), where, np.nan)
    velocity = np.where(np.isfinite(velocity) & (spread > 0.0), velocity, np.nan)
    sigma = np.where(sigma > 0.0, sigma, 1.0)
    spread = np.where(spread > 0.0, spread, 1.0)
    return np.array([time_s, *where, *sigma, *velocity, *spread, float(quality)])


def table_of(rows: np.ndarray, origin_ns: int, velocities: bool) -> GnssTable:
    """Rows (M, 14), whose times count from an origin, as a table with velocities or without."""
    time_ns = np.round(rows[:, 0] * 1e9).astype(np.int64) + origin_ns
    v, spread = (rows[:, 7:10], rows[:, 10:13]) if velocities else (None, None)
    quality = rows[:, 13].astype(int)
    return GnssTable(time_ns, rows[:, 1], rows[:, 2], rows[:, 3], rows[:, 4:7], v, spread, quality)


def some(table: GnssTable, keep: np.ndarray) -> GnssTable:
    """Some rows of a table of fixes."""
    columns: dict[str, Any] = {
        name: None if (a := getattr(table, name)) is None else a[keep]
        for name in (
            *("time_ns", "lat_rad", "lon_rad", "alt_m", "sigma_m", "v_n", "sigma_v"),
            "quality",
        )
    }
    return GnssTable(**columns)
