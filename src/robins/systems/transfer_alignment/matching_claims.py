"""What the study "attitude-matching" says of each filter, and of the claims of Gu & Qin (2005)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from robins import units
from robins.systems.judgement import Claim, Metrics, graded, ratio

FIVE_ARCMIN = "5_arcmin"

UNITS = ("hinf-rad", "hinf-deg", "hinf-arcmin")
PUBLISHED = ("hinf-rad", "hinf-rad-identity", "hinf-deg", "hinf-arcmin")
ALL = "attitude_rms_all_arcmin"

NO_RESULT: dict[str, Any] = {
    "attitude_rms_arcmin": [np.nan] * 3,
    "attitude_rms_all_arcmin": np.nan,
    "mounting_rms_arcmin": [np.nan] * 3,
    "gyro_bias_rms_deg_per_h": [np.nan] * 3,
    "share_below_5_arcmin": np.nan,
}
"""The figures of a filter that does not exist."""


def matching_metrics(statistics: Any) -> dict[str, Any]:
    """Metrics of one filter from its campaign statistics, over the epochs that count."""
    start = statistics.count_from
    square = np.mean(statistics.rms[start:] ** 2, axis=0)
    minute = units.parse("1 arcmin", "angle")
    degree_per_hour = units.parse("1 deg/h", "angle rate")
    attitude, drift, mounting = square[:3], square[3:6], square[6:9]
    return {
        "attitude_rms_arcmin": (np.sqrt(attitude) / minute).tolist(),
        "attitude_rms_all_arcmin": float(np.sqrt(np.mean(attitude)) / minute),
        "mounting_rms_arcmin": (np.sqrt(mounting) / minute).tolist(),
        "gyro_bias_rms_deg_per_h": (np.sqrt(drift) / degree_per_hour).tolist(),
        "share_below_5_arcmin": float(np.mean(statistics.settled(FIVE_ARCMIN) <= start)),
        "diverged_runs": statistics.diverged,
    }


def _axes(metrics: Mapping[str, Any]) -> np.ndarray:
    return np.asarray(metrics["attitude_rms_arcmin"])


def _best(metrics: Metrics) -> float | None:
    """The worst axis of the best of the published filters that exist."""
    ran = [metrics[name] for name in PUBLISHED if name in metrics]
    worst = [float(np.max(_axes(m))) for m in ran if m.get("feasible", True)]
    return min(worst, default=float("nan")) if ran else None


def _kf_lost(metrics: Metrics) -> str:
    best = _best(metrics)
    within = best is not None and best < 5.0
    return graded(within and np.all(_axes(metrics["kf"]) >= 10.0), within)


def _gained(metrics: Metrics) -> str:
    gained = 1.0 - metrics["hinf-deg"][ALL] / metrics["hinf-deg-inf"][ALL]
    return graded(gained >= 0.1, gained >= 0.02)


def _existing(metrics: Metrics) -> int | None:
    if any(name not in metrics for name in UNITS):
        return None
    return sum(bool(metrics[name]["feasible"]) for name in UNITS)


def _by_axis(metrics: Metrics) -> np.ndarray:
    return _axes(metrics["hinf-deg"]) / _axes(metrics["kf"])


CLAIMS: dict[str, Claim] = {
    "five-arcmin": Claim(
        "From 15 s on the H-infinity filter with gamma = 50 is within 5' on every axis, the "
        "Kalman filter at tens of arcminutes (Gu & Qin 2005); RMS over the runs, in the unit of "
        "angle that suits it best; value: its worst axis [arcmin]",
        ("kf",),
        _best,
        (0.0, 5.0),
        verdict=_kf_lost,
    ),
    "gamma-50": Claim(
        "gamma = 50 makes it robust (Gu & Qin 2005): in degrees it is at least 10 % more accurate"
        " than the same filter with gamma = inf, a Kalman filter with R = (1 deg)^2; value: the "
        "largest difference of their RMS on an axis [arcmin]",
        ("hinf-deg", "hinf-deg-inf"),
        lambda m: float(np.max(np.abs(_axes(m["hinf-deg"]) - _axes(m["hinf-deg-inf"])))),
        None,
        verdict=_gained,
    ),
    "units": Claim(
        "With R = I, L = I and gamma = 50 the filter exists over the whole run in any unit of "
        "angle; value: in how many of radians, degrees and arcminutes it does",
        (),
        _existing,
        (3, 3),
        (1, 3),
    ),
    "beats-kf": Claim(
        "Told nothing of the flexure, the H-infinity filter in degrees is more accurate than the "
        "Kalman filter with R = (1')^2 (Gu & Qin 2005) on every axis; value: the largest ratio of"
        " their RMS on an axis",
        ("hinf-deg", "kf"),
        lambda metrics: float(np.max(_by_axis(metrics))),
        (0.0, 1.0),
        verdict=lambda m: graded(np.all(_by_axis(m) < 1.0), np.any(_by_axis(m) < 1.0)),
    ),
    "saves-the-model": Claim(
        "It saves modelling the flexure (Gu & Qin 2005): in degrees its RMS over all axes is at "
        "most 1.1 times that of a Kalman filter with flexure states; value: that ratio",
        ("hinf-deg", "kf-flexure"),
        ratio("hinf-deg", "kf-flexure", ALL),
        (0.0, 1.1),
        (0.0, 1.5),
    ),
}
"""Every claim a scenario of the study may state."""
