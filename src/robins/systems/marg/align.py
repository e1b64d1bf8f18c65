"""The attitude before the first step: gravity gives the tilt, the field the heading."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation as SciRotation

from robins.systems.marg.parameters import Accelerometer, Start

_STILL_RATE = np.radians(8.0)  # rad/s, mean length of the rate
_STILL_SPREAD = np.radians(1.0)  # rad/s, mean length of its changes
_STILL_FORCE = 0.5  # m/s^2


class FirstLook(NamedTuple):
    """Where the filter begins."""

    q_nb: np.ndarray  # (4,)
    field_t: np.ndarray  # (2,) T along the horizontal and down; zeros where no field was seen
    tilt_rad: float
    heading_rad: float
    still: bool
    sentence: str


def attitude_of(force_b: np.ndarray, field_b: np.ndarray | None) -> np.ndarray:
    """q_nb (4,) for which specific force points up and the field north (TRIAD, gravity first).

    Without a field, or with one along the vertical, some heading.
    """
    down = -force_b / np.linalg.norm(force_b)
    north = np.eye(3)[np.argmin(np.abs(down))] if field_b is None else field_b
    east = np.cross(down, north)
    if np.linalg.norm(east) <= 1e-3 * np.linalg.norm(north):
        east = np.cross(down, np.eye(3)[np.argmin(np.abs(down))])
    east = east / np.linalg.norm(east)
    rows = np.stack([np.cross(east, down), east, down])
    q = np.roll(SciRotation.from_matrix(rows).as_quat(), 1)
    return q if q[0] >= 0.0 else -q


def first_look(
    dt_s: np.ndarray,
    theta: np.ndarray,
    dv: np.ndarray,
    field_b: np.ndarray,
    start: Start,
    accelerometer: Accelerometer,
) -> FirstLook:
    """Align on the first samples: a short while of rest, or a longer one of motion.

    In motion the gyros carry specific force and field back to the first sample, so that a swing
    averages out.

    Args:
        dt_s: (N,) s.
        theta: (N, 3) rad.
        dv: (N, 3) m/s.
        field_b: (N, 3) T, NaN where none.
        start: parameters.
        accelerometer: parameters, for gravity.
    """
    time = np.cumsum(dt_s)
    window = max(int(np.searchsorted(time, start.still, side="right")), 1)
    rate, force = theta[:window] / dt_s[:window, None], dv[:window] / dt_s[:window, None]
    still = bool(
        np.mean(np.linalg.norm(rate, axis=1)) < _STILL_RATE
        and np.mean(np.abs(rate - rate.mean(axis=0))) < _STILL_SPREAD
        and np.max(np.std(force, axis=0)) < _STILL_FORCE
    )
    if not still:
        window = max(int(np.searchsorted(time, start.moving, side="right")), 1)
    turned = _turned(theta[:window])
    pushed = np.sum(turned[:-1].apply(dv[:window]), axis=0) / time[window - 1]
    there = np.all(np.isfinite(field_b[:window]), axis=1)
    seen = None
    if np.any(there):
        seen = np.mean(turned[1:].apply(np.where(there[:, None], field_b[:window], 0.0)), axis=0)
        seen = seen * window / np.sum(there)
    return _from_means(pushed, seen, still, float(time[window - 1]), start, accelerometer)


def _turned(theta: np.ndarray) -> SciRotation:
    """Attitude before each interval and after the last, against the first."""
    steps = SciRotation.from_rotvec(theta)
    out = [SciRotation.identity()]
    for step in steps:
        out.append(out[-1] * step)
    return SciRotation.concatenate(out)


def _from_means(
    force: np.ndarray,
    field: np.ndarray | None,
    still: bool,
    seconds: float,
    start: Start,
    accelerometer: Accelerometer,
) -> FirstLook:
    how = f"{'at rest' if still else 'in motion'}, over {seconds:.2g} s"
    tilt = start.tilt if still else start.tilt_moving
    heading = start.heading if still else start.heading_moving
    size = float(np.linalg.norm(force))
    if not 0.5 < size / accelerometer.gravity < 1.5:
        how += f"; the mean specific force is {size:.2f} m/s^2, so the tilt is hardly known"
        tilt = np.pi / 2.0
        force = force if size > 1e-3 else np.array([0.0, 0.0, -1.0])
    q = attitude_of(force, field)
    if field is None:
        sentence = f"Levelled {how}; there is no field, so the heading is counted from the start."
        return FirstLook(q, np.zeros(2), tilt, np.pi, still, sentence)
    north, _, down = SciRotation.from_quat(np.roll(q, -1)).apply(field)
    strength = float(np.linalg.norm(field))
    dip = np.degrees(np.arctan2(down, north))
    sentence = (
        f"Aligned {how}: the field there, {strength * 1e6:.1f} uT at a dip of {dip:.1f} deg, is "
        f"north."
    )
    return FirstLook(q, np.array([north, down]), tilt, heading, still, sentence)
