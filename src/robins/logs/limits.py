"""Magnitudes far beyond any vehicle: only nonsense is larger, and `clean` refuses that."""

from __future__ import annotations

import numpy as np

GYRO_LIMIT = 1e4  # rad/s, 95 000 turns a minute, or rad for increments
ACCEL_LIMIT = 1e6  # m/s^2, or m/s for increments
LAT_LIMIT, LON_LIMIT = np.pi / 2, 2 * np.pi
ALT_LIMIT_M = 1e9
SPEED_LIMIT = 1e5  # m/s
SIGMA_LIMIT = 1e9  # m or m/s; squares of larger ones make the arithmetic of a filter fail
FIELD_LIMIT_T = 1.0  # beyond any magnetometer that finds north


def few_beyond(values: np.ndarray, limit: float) -> np.ndarray:
    """(n,) bool: rows of (n,) or (n, k) with a number beyond a limit, NaN not among them.

    None where they are half of the rows or more: then the unit is another.
    """
    rows = np.asarray((np.abs(values) > limit).any(axis=tuple(range(1, values.ndim))))
    return rows if 2 * rows.sum() < len(rows) else np.zeros(len(values), bool)
