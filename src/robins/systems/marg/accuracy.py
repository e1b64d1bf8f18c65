"""Errors of an orientation, as BROAD defines them (Laidig, Caruso, Cereatti & Seel 2021)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from robins.dataset import AttitudeTable
from robins.ins.frames import to_ned_frd


class OrientationErrors(NamedTuple):
    """Angles [rad] of q_e = q_estimated conj(q_true), both from body to an earth frame.

    Neither depends on which of the earth's axes is called first, so ENU and NED give the same, but
    for the sign of the heading error, which here is clockwise as headings are.
    """

    total: np.ndarray  # (N,) 0 to pi
    heading: np.ndarray  # (N,) -pi to pi, estimated minus true
    inclination: np.ndarray  # (N,) 0 to pi


def multiply(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Hamilton product of quaternions (..., 4)."""
    pw, pv, qw, qv = p[..., :1], p[..., 1:], q[..., :1], q[..., 1:]
    w = pw * qw - np.sum(pv * qv, axis=-1, keepdims=True)
    return np.concatenate([w, pw * qv + qw * pv + np.cross(pv, qv)], axis=-1)


def orientation_errors(q_estimated: np.ndarray, q_true: np.ndarray) -> OrientationErrors:
    """Total, heading and inclination error; NaN where an attitude is missing.

    With q_e = (w, x, y, z): total 2 acos |w|, heading 2 atan(z / w), inclination
    2 acos sqrt(w^2 + z^2); written with the arc tangent, which is exact for small angles too.

    Args:
        q_estimated: (N, 4) q_nb, scalar first, NED.
        q_true: (N, 4) the same.
    """
    e = multiply(q_estimated, q_true * np.array([1.0, -1.0, -1.0, -1.0]))
    w, z = e[:, 0], e[:, 3]
    across = np.hypot(e[:, 1], e[:, 2])
    sign = np.where(w < 0.0, -1.0, 1.0)
    return OrientationErrors(
        total=2.0 * np.arctan2(np.linalg.norm(e[:, 1:], axis=1), np.abs(w)),
        heading=2.0 * np.arctan2(sign * z, sign * w),
        inclination=2.0 * np.arctan2(across, np.hypot(w, z)),
    )


def truth_at(attitude: AttitudeTable, time_ns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """True q_nb (N, 4) NED at given times and whether they count; NaN where none is near.

    The nearest true attitude within half its own interval is taken, none is interpolated. A phase
    counts where the author of the log said so, everywhere if nothing was said.
    """
    table = to_ned_frd(attitude)
    times = table.time_ns
    later = np.clip(np.searchsorted(times, time_ns), 0, len(times) - 1)
    sooner = np.maximum(later - 1, 0)
    after, before = np.abs(times[later] - time_ns), np.abs(times[sooner] - time_ns)
    nearest = np.where(after <= before, later, sooner)
    reach = 0.51 * float(np.median(np.diff(times))) if len(times) > 1 else 0.0
    near = np.abs(times[nearest] - time_ns) <= reach
    q = np.where(near[:, None], table.q_nb[nearest], np.nan)
    moving = np.ones(len(times), dtype=bool) if table.moving is None else table.moving
    return q, moving[nearest] & np.all(np.isfinite(q), axis=1)


def rms_deg(angle_rad: np.ndarray) -> float:
    """Root of the mean square [deg]; NaN of nothing."""
    return float(np.degrees(np.sqrt(np.mean(angle_rad**2)))) if angle_rad.size else float("nan")
