"""What the velocity-attitude study says of each filter, and of the claims of the patent."""

from __future__ import annotations

from typing import Any

import numpy as np

from robins import units
from robins.systems.judgement import Claim, ratio

ADAPTIVE, FIXED, KALMAN = "adaptive-hinf", "hinf-fixed", "kf"
COMPENSATED, INFORMED = "adaptive-hinf-compensated", "kf-told-both"

RMS = "attitude_rms_all_arcmin"
_BETTER = 0.95  # ratio up to which one filter is better than the other
_FAIRLY = 0.98  # and up to which it is so in part; beyond, the two are as good


def _better(text: str, ours: str, theirs: str) -> Claim:
    value = ratio(ours, theirs, RMS)
    return Claim(text, (ours, theirs), value, (0.0, _BETTER), (0.0, _FAIRLY))


CLAIMS: dict[str, Claim] = {
    "beats-kf": _better(
        "Under noise that is unknown and not Gaussian the adaptive H-infinity filter aligns more "
        "accurately than a Kalman filter that is told of the stated noise alone (the patent); "
        "value: ratio of their attitude RMS over all axes",
        ADAPTIVE,
        KALMAN,
    ),
    "kf-suffers": Claim(
        "Not told of the noise that is there, a Kalman filter loses accuracy (the patent); value: "
        "its attitude RMS over that of one told of it",
        (KALMAN, INFORMED),
        ratio(KALMAN, INFORMED, RMS),
        (1.0 / _BETTER, None),
        (1.0 / _FAIRLY, None),
    ),
    "beats-fixed": _better(
        "A bound that adapts to the environment serves better than a fixed one (the patent), here "
        "1.05 times the least there is; value: ratio of attitude RMS",
        ADAPTIVE,
        FIXED,
    ),
    "compensation": _better(
        "Compensating P where the bound does not hold raises the accuracy (the patent); value: "
        "attitude RMS with compensation over that without",
        COMPENSATED,
        ADAPTIVE,
    ),
}
"""Every claim a scenario of the study may state."""


def patent_metrics(epoch_s: np.ndarray, statistics: Any) -> dict[str, Any]:
    """Metrics of one filter from its campaign statistics, over the epochs that count.

    Lists run east, north, up and right, forward, up. A run has settled below a limit when its worst
    attitude axis stays there to the end; how long that takes is the median of all runs, infinite
    where most never do.
    """
    start = statistics.count_from
    rms = np.sqrt(np.mean(statistics.rms[start:] ** 2, axis=0))
    of = {block.name: rms[block.where] for block in statistics.blocks}
    minute = units.parse("1 arcmin", "angle")
    out: dict[str, Any] = {
        "attitude_rms_arcmin": (of["attitude"] / minute).tolist(),
        "attitude_rms_all_arcmin": float(np.sqrt(np.mean(of["attitude"] ** 2)) / minute),
        "velocity_rms_mps": of["velocity"].tolist(),
        "gyro_bias_rms_deg_per_h": (
            of["gyro_bias"] / units.parse("1 deg/h", "angle rate")
        ).tolist(),
        "accel_bias_rms_mg": (of["accel_bias"] / units.parse("1 mg", "acceleration")).tolist(),
    }
    for limit in statistics.limits:
        settled = statistics.settled(limit.name)
        # E stands for never, and a run that is out at the last epoch but one has shown nothing
        times = np.append(np.insert(epoch_s[:-1], 0, 0.0), np.inf)[settled]
        out[f"share_below_{limit.name}"] = float(np.mean(settled <= start))
        out[f"settled_share_{limit.name}"] = float(np.mean(times < epoch_s[-1] - 1.0))
        out[f"settled_median_{limit.name}_s"] = float(np.median(times))
    out["error_over_sigma"] = statistics.overall_ratio().tolist()
    for sensor in statistics.sensors:
        out[f"nis_{sensor}"] = statistics.nis(sensor).value
    out["diverged_runs"] = statistics.diverged
    return out
