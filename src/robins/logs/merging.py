"""Samples of two sensors on one clock."""

from __future__ import annotations

import numpy as np


def on_clock_of(
    gyro_ns: np.ndarray, gyro: np.ndarray, accel_ns: np.ndarray, accel: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rates and specific forces at the stamps of the rates.

    Args:
        gyro_ns: (n,) stamps of the rates.
        gyro: (n, 3) rates.
        accel_ns: (m,) stamps of the specific forces, in any order.
        accel: (m, 3) specific forces.

    Returns:
        The stamps and rates as they are, and (n, 3) specific forces, interpolated linearly; NaN
        outside of their time.
    """
    order = np.argsort(accel_ns, kind="stable")
    at = (accel_ns[order] - gyro_ns[0]) * 1e-9  # seconds from one stamp keep all digits
    wanted = (gyro_ns - gyro_ns[0]) * 1e-9
    columns = (accel[order, k] for k in range(3))
    force = [np.interp(wanted, at, column, left=np.nan, right=np.nan) for column in columns]
    return gyro_ns, gyro, np.stack(force, axis=-1)
