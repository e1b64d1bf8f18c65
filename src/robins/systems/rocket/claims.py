"""Metrics of the rocket's filters, and claims about them: the paper's, and those marked "ours"."""

from __future__ import annotations

from typing import Any

import numpy as np

from robins.systems.judgement import Band, Metric, ratio_claims
from robins.systems.rocket.world import BODY, EULER, RocketCourse

PAPER, SCALAR, UKF = "federated-vector-stukf", "federated-scalar-ukf", "ukf"
RMS, QUIET, PEAK = "attitude_rms_deg", "quiet_rms_deg", "burst_peak_deg"
TOTAL, ABOUT = "total_rms_deg", "about_field_rms_deg"


def _pooled_deg(rms: np.ndarray) -> float:
    return float(np.degrees(np.sqrt(np.mean(rms**2))))


def _common_metrics(course: RocketCourse, statistics: Any) -> dict[str, Metric]:
    """Metrics of both studies: components 0 to 2 are the attitude's.

    ``attitude_rms_deg`` is the RMS error of an axis, pooled over the three, ``quiet_rms_deg`` the
    same long after disturbances, ``burst_peak_deg`` the largest error within `PEAK_S` of the
    beginning of a disturbance, averaged over axes, disturbances and runs.
    """
    counted = statistics.counted
    attitude, quiet = statistics.rms[counted, :3], course.quiet[counted]
    out: dict[str, Any] = {RMS: _pooled_deg(statistics.pooled_rms[:3])}
    if np.any(quiet):
        out[QUIET] = _pooled_deg(attitude[quiet])
    if course.bursts:
        out[PEAK] = float(np.degrees(np.mean(statistics.peaks[:, :, :3])))
    out["nees_attitude"] = statistics.mean_nees()["nees_attitude"]
    out["anees_share_inside"] = statistics.anees_share_inside()
    out["diverged_runs"] = statistics.diverged
    return out


def _each(axes: tuple[str, ...], unit: str, rms: np.ndarray) -> dict[str, float]:
    return {f"{axis}_rms_{unit}": float(value) for axis, value in zip(axes, rms, strict=True)}


def angle_metrics(course: RocketCourse, statistics: Any) -> dict[str, Metric]:
    """Metrics of "magnetic-attitude": axes are roll, pitch, yaw, then the rates.

    ``settled_s`` is when the RMS error over runs and angles falls below 0.5 deg for the first time.
    """
    rms = np.degrees(statistics.pooled_rms)
    out = _common_metrics(course, statistics)
    out |= _each(EULER, "deg", rms[:3]) | _each(("p", "q", "r"), "deg_s", rms[3:])
    below = np.degrees(np.sqrt(np.mean(statistics.rms[:, :3] ** 2, axis=1))) < 0.5
    out["settled_s"] = float(course.time_s[np.argmax(below)]) if np.any(below) else float("nan")
    return out


def field_metrics(course: RocketCourse, statistics: Any) -> dict[str, Metric]:
    """Metrics of "field-vector": axes are those of the body, then about the field and across it.

    ``total_rms_deg`` is the RMS of the error angle, ``across_field_rms_deg`` of its component
    across the field.
    """
    rms = np.degrees(statistics.pooled_rms)
    out = _common_metrics(course, statistics) | _each(BODY, "deg", rms[:3])
    out[TOTAL] = float(np.linalg.norm(rms[:3]))
    out[ABOUT] = float(rms[3])
    out["across_field_rms_deg"] = float(np.linalg.norm(rms[4:6]))
    out["about_field_end_deg"] = float(np.degrees(statistics.rms[-1, 3]))
    if course.bursts:
        across = np.mean(statistics.norm_peaks("across_field"))
        out["across_burst_peak_deg"] = float(np.degrees(across))
    return out


_BETTER: tuple[Band, Band] = ((0.0, 0.98), (0.0, 1.0))
_AXES = tuple(f"{angle}_rms_deg" for angle in EULER)
_RATIOS = {
    "better-than-sensors": (PAPER, ("gyro", "magnetic-raw"), _AXES, *_BETTER),
    "better-than-magnetometer": (PAPER, ("magnetometer",), (RMS,), *_BETTER),
    "better-than-scalar": (PAPER, (SCALAR,), (RMS,), *_BETTER),
    "better-than-scalar-quiet": (PAPER, (SCALAR,), (QUIET,), *_BETTER),
    "resists-disturbance": (PAPER, (UKF,), (PEAK,), (0.0, 0.9), (0.0, 1.0)),
    # a step of 0.1 s is a seventh of it
    "converges-faster": (PAPER, (UKF,), ("settled_s",), (0.0, 0.8), (0.0, 0.95)),
    "vector-shares-improve": ("federated-vector-ukf", (SCALAR,), (RMS,), *_BETTER),
    "discriminator-best": ("discriminator", (UKF, PAPER), (RMS,), *_BETTER),
    "gate-consistent": ("gate", ("usque",), ("nees_attitude",), (0.0, 0.5), (0.0, 0.9)),
    "fading-loses-attitude": ("strong-tracking", ("gyro",), (ABOUT,), (2.0, None), (1.0, None)),
    "scale-factor-state": ("gate-scale-factor", ("gate",), (TOTAL,), (0.0, 0.5), (0.0, 0.9)),
}
_TEXTS = {
    "better-than-sensors": "Fusion is better than either sensor about all three axes; value: the "
    "largest ratio of the RMS error of the vector-sharing STUKF to the better raw sensor, over "
    "roll, pitch, yaw",
    "better-than-magnetometer": "Fusion is better than either sensor, each filtered with the same "
    "model (the fair reading; ours); value: RMS error of the vector-sharing STUKF over that of a "
    "UKF that has the magnetometer alone",
    "better-than-scalar": "Vector sharing with strong tracking is better than the federated UKF "
    "with scalar sharing; value: ratio of the RMS errors",
    "better-than-scalar-quiet": "The same long after disturbances; value: ratio of the RMS errors",
    "resists-disturbance": "It is effective against abnormal disturbances of the magnetometer; "
    "value: its peak error in a disturbance over that of the plain UKF",
    "converges-faster": "It converges faster from a wrong start; value: ratio of the times until "
    "the RMS error is below 0.5 deg, to the UKF",
    "vector-shares-improve": "Shares by state improve the federated filter; value: RMS error with "
    "vector sharing as printed over scalar sharing, both without strong tracking",
    "discriminator-best": "Telling outliers from model errors by their length beats the UKF and "
    "strong tracking (ours); value: RMS error of the discriminator over the better of the two",
    "gate-consistent": "A gate keeps disturbances out of the direction that is not measured "
    "(ours); value: NEES of the attitude, gated over plain USQUE",
    "fading-loses-attitude": "Strong tracking loses the direction that one vector does not show "
    "(ours); value: its RMS error about the field over that of dead reckoning",
    "scale-factor-state": "With a scale factor on the spin, it must be a state (ours); value: "
    "total RMS error with the state over without, both gated",
}


CLAIMS = ratio_claims(_RATIOS, _TEXTS)
"""Every claim that a scenario may state."""
