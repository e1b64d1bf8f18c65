"""Fixes that came lately, one row each, and with increments a piece of a log made of them."""

from __future__ import annotations

from typing import Any

import numpy as np

from robins.dataset import GnssTable
from robins.ins.increments import Increments
from robins.systems.ins_gnss.parameters import Gnss
from robins.systems.ins_gnss.recording import Log, believed_sigmas
from robins.systems.streaming import LiveError, numbers

# time [s], latitude, longitude, height, their sigmas, velocity, its sigmas, quality
COLUMNS = 14


def row_of_fix(
    seconds: float, place: Any, sigma_m: Any, v_n: Any, sigma_v: Any, quality: int
) -> np.ndarray:
    """(14,) a fix; as of a log that was cleaned, a component whose sigma is none is missing.

    Raises:
        LiveError: a number of another kind, a velocity without sigmas, angles that are no radians.
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
    where = np.where(np.isfinite(where) & (sigma > 0.0), where, np.nan)
    velocity = np.where(np.isfinite(velocity) & (spread > 0.0), velocity, np.nan)
    sigma, spread = (np.where(s > 0.0, s, 1.0) for s in (sigma, spread))
    return np.array([seconds, *where, *sigma, *velocity, *spread, float(quality)])


def log_of(
    rows: np.ndarray,
    fixes: np.ndarray,
    field: np.ndarray,
    gnss: Gnss,
    origin_ns: int,
    velocities: bool,
) -> Log:
    """A piece of a log.

    Args:
        rows: (N, 8) end [s], dt [s], turn [rad] and velocity [m/s] of increments.
        fixes: (M, 14).
        field: (K, 4) time [s] and field [T] of a magnetometer.
        gnss: what is believed of the receiver.
        origin_ns: the stamp at zero.
        velocities: whether the receiver has given one.
    """
    f = fixes
    time_ns = np.round(f[:, 0] * 1e9).astype(np.int64) + origin_ns
    place, quality = (f[:, 1], f[:, 2], f[:, 3], f[:, 4:7]), f[:, 13].astype(int)
    told = GnssTable(time_ns, *place, f[:, 7:10], f[:, 10:13], quality)
    sigma_m, sigma_v = believed_sigmas(told, gnss)
    return Log(
        Increments(rows[:, 1], rows[:, 2:5], rows[:, 5:8]),
        rows[:, 0],
        told if velocities else GnssTable(time_ns, *place, quality=quality),
        f[:, 0],
        sigma_m,
        # there or not, so that nothing is compiled when the first one comes
        None if sigma_v is None else f[:, 7:10],
        sigma_v,
        np.zeros(len(f), dtype=bool),
        field[:, 0] if len(field) else None,
        field[:, 1:] if len(field) else None,
    )
