"""What a campaign of drives says: errors, their bounds, and whether the filter is consistent."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from robins import units
from robins.systems.judgement import consistency, consistency_claims
from robins.systems.study import StateBlock

CLAIMS = consistency_claims(
    {
        "sigma": "On no state the RMS error is proven, at 99 % confidence, to differ from the "
        "filter's sigma by more than 5 %; value: the largest difference proven",
        "anees": "ANEES is inside its 95 % band at 90 % of the epochs or more",
        "nis": "The grand mean NIS of every sensor is inside its 99.9 % band",
    }
)
"""With several filters, of the worst of them."""


def drive_metrics(
    outage: np.ndarray, blocks: Sequence[StateBlock], statistics: Any
) -> dict[str, Any]:
    """Metrics of one filter from its campaign statistics."""
    start = statistics.count_from
    rms = statistics.rms
    aided = ~outage[start:]
    of = {b.name: b.where for b in blocks}

    def pooled(columns, epochs) -> float:
        return float(np.sqrt(np.mean(np.sum(rms[start:][epochs][:, columns] ** 2, axis=1))))

    position = of["position"].start
    horizontal, vertical = [position, position + 1], [position + 2]
    minute = units.parse("1 arcmin", "angle")
    degree_per_hour = units.parse("1 deg/h", "angle rate")
    milli_g = units.parse("1 mg", "acceleration")
    out: dict[str, Any] = {
        "horizontal_rms_m": pooled(horizontal, aided),
        "vertical_rms_m": pooled(vertical, aided),
        "velocity_rms_mps": pooled(of["velocity"], aided),
        "tilt_rms_arcmin": pooled([0, 1], aided) / minute,
        "heading_rms_arcmin": pooled([2], aided) / minute,
        "gyro_bias_rms_deg_per_h": pooled(of["gyro_bias"], aided) / degree_per_hour,
        "accel_bias_rms_mg": pooled(of["accel_bias"], aided) / milli_g,
    }
    if np.any(outage[start:]):
        out["outage_horizontal_rms_m"] = pooled(horizontal, ~aided)
        worst = np.sum(rms[start:][~aided][:, horizontal] ** 2, axis=1)
        out["outage_horizontal_worst_rms_m"] = float(np.sqrt(np.max(worst)))
    return out | consistency(statistics) | {"diverged_runs": statistics.diverged}
