"""What the velocity-attitude study says of each filter, and of the claims of the patent."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from robins import units

ADAPTIVE, FIXED, KALMAN = "adaptive-hinf", "hinf-fixed", "kf"
COMPENSATED, INFORMED = "adaptive-hinf-compensated", "kf-told-both"

CLAIMS = (
    {
        "id": "beats-kf",
        "text": "Under noise that is unknown and not Gaussian the adaptive H-infinity filter "
        "aligns more accurately than a Kalman filter that is told of the stated noise alone (the "
        "patent); value: ratio of their attitude RMS over all axes",
    },
    {
        "id": "kf-suffers",
        "text": "Not told of the noise that is there, a Kalman filter loses accuracy (the patent); "
        "value: its attitude RMS over that of one told of it",
    },
    {
        "id": "beats-fixed",
        "text": "A bound that adapts to the environment serves better than a fixed one (the "
        "patent), here 1.05 times the least there is; value: ratio of attitude RMS",
    },
    {
        "id": "compensation",
        "text": "Compensating P where the bound does not hold raises the accuracy (the patent); "
        "value: attitude RMS with compensation over that without",
    },
)
"""Every claim a scenario of the study may state."""

_BETTER = 0.95  # ratio up to which one filter is better than the other
_FAIRLY = 0.98  # and up to which it is so in part; beyond, the two are as good
_COMPARED = {
    "beats-kf": (ADAPTIVE, KALMAN),
    "beats-fixed": (ADAPTIVE, FIXED),
    "compensation": (COMPENSATED, ADAPTIVE),
}


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


def patent_claims(
    stated: Sequence[str], metrics: Mapping[str, dict[str, Any]]
) -> list[dict[str, Any]]:
    """Verdicts of the claims that a scenario states, where their filters were run.

    Args:
        stated: ids of claims.
        metrics: by filter.
    """
    out = []
    for claim in CLAIMS:
        judged = _judged(claim["id"], metrics) if claim["id"] in stated else None
        if judged is not None:
            verdict, value, band = judged
            out.append({**claim, "verdict": verdict, "value": value, "band": band})
    return out


def _judged(claim: str, metrics: Mapping[str, dict[str, Any]]) -> tuple[str, float, Any] | None:
    """Verdict, value and band of a claim; None where a filter it compares was not run."""
    suffers = claim == "kf-suffers"
    ours, theirs = (KALMAN, INFORMED) if suffers else _COMPARED[claim]
    if ours not in metrics or theirs not in metrics:
        return None
    rms = [metrics[name]["attitude_rms_all_arcmin"] for name in (ours, theirs)]
    ratio = rms[0] / rms[1]
    if suffers:
        band = [1.0 / _BETTER, None]
        good, fair = ratio >= 1.0 / _BETTER, ratio >= 1.0 / _FAIRLY
    else:
        band = [0.0, _BETTER]
        good, fair = ratio <= _BETTER, ratio <= _FAIRLY
    return "reproduced" if good else "partly" if fair else "not", ratio, band
