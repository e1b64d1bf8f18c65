"""Figures of merit of the rocket studies."""

from __future__ import annotations

from typing import Any

import numpy as np

from robins.systems.rocket.world import Course


def _rms_deg(rms: np.ndarray) -> np.ndarray:
    """(r,) pooled over the epochs of (E, r), in degrees."""
    return np.degrees(np.sqrt(np.mean(rms**2, axis=0)))


def _pooled_deg(rms: np.ndarray) -> float:
    """The same, pooled over the components too."""
    return float(np.degrees(np.sqrt(np.mean(rms**2))))


def _quiet(course: Course, counted: slice) -> np.ndarray:
    """(E,) bool: counted, and long after a disturbance."""
    inside = np.zeros(len(course.time_s), dtype=bool)
    inside[counted] = True
    return inside & course.quiet


def common_metrics(course: Course, statistics: Any) -> dict[str, Any]:
    """Of both studies: components 0 to 2 are the attitude's.

    ``attitude_rms_deg`` is the RMS error of an axis, pooled over the three, ``quiet_rms_deg`` the
    same long after disturbances, ``burst_peak_deg`` the mean over axes, disturbances and runs of
    the largest error soon after one.
    """
    out: dict[str, Any] = {"attitude_rms_deg": _pooled_deg(statistics.rms[statistics.counted, :3])}
    quiet = _quiet(course, statistics.counted)
    if np.any(quiet):
        out["quiet_rms_deg"] = _pooled_deg(statistics.rms[quiet, :3])
    if course.bursts:
        out["burst_peak_deg"] = float(np.degrees(np.mean(statistics.peaks[:, :, :3])))
    blocks = statistics.block_anees()
    out["nees_per_dim"] = float(np.mean(blocks["attitude"][statistics.counted]))
    out["anees_share_inside"] = statistics.anees_share_inside()
    out["diverged_runs"] = statistics.diverged
    return out


def angle_metrics(course: Course, statistics: Any) -> dict[str, Any]:
    """Of "magnetic-attitude": axes are roll, pitch, yaw, then the rates.

    ``settled_s`` is when the RMS error over runs and angles falls below 0.5 deg for the first time.
    """
    out = common_metrics(course, statistics)
    rms = _rms_deg(statistics.rms[statistics.counted])
    out |= dict(
        zip(("roll_rms_deg", "pitch_rms_deg", "yaw_rms_deg"), map(float, rms), strict=False)
    )
    names = ("p_rms_deg_s", "q_rms_deg_s", "r_rms_deg_s")
    out |= dict(zip(names, map(float, rms[3:]), strict=True))
    below = np.degrees(np.sqrt(np.mean(statistics.rms[:, :3] ** 2, axis=1))) < 0.5
    out["settled_s"] = float(course.time_s[np.argmax(below)]) if np.any(below) else float("nan")
    return out


def field_metrics(course: Course, statistics: Any) -> dict[str, Any]:
    """Of "field-vector": axes are those of the body, then about the field and across it.

    ``total_rms_deg`` is of the angle of the error, ``across_field_rms_deg`` of its part across.
    """
    out = common_metrics(course, statistics)
    rms = _rms_deg(statistics.rms[statistics.counted])
    out |= dict(zip(("x_rms_deg", "y_rms_deg", "z_rms_deg"), map(float, rms), strict=False))
    out["total_rms_deg"] = float(np.linalg.norm(rms[:3]))
    out["about_field_rms_deg"] = float(rms[3])
    out["across_field_rms_deg"] = float(np.linalg.norm(rms[4:6]))
    out["about_field_end_deg"] = float(np.degrees(statistics.rms[-1, 3]))
    if course.bursts:
        across = np.mean(statistics.norm_peaks("across_field"))
        out["across_burst_peak_deg"] = float(np.degrees(across))
    return out
