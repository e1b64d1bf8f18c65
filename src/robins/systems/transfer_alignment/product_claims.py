"""What a campaign of the product study says: errors, their bounds, and whether they fit."""

from __future__ import annotations

from typing import Any

import numpy as np

from robins import units
from robins.systems.judgement import Claim, consistency, consistency_claims

FIVE_ARCMIN = "5_arcmin"
JUDGED = "product"  # the filter whose consistency is claimed

CLAIMS = consistency_claims(
    {
        "sigma": "On no state the RMS error of the filter 'product' is proven, at 99 % confidence, "
        "to differ from its sigma by more than 5 %; value: the largest difference proven",
        "anees": "ANEES of the filter 'product' is inside its 95 % band at 90 % of the epochs or "
        "more; value: the share",
        "nis": "The grand mean NIS of every sensor is inside its 99.9 % band for the filter "
        "'product'; value: the one farthest from 1",
    },
    JUDGED,
) | {
    "aligned": Claim(
        "Once it counts, the attitude RMS of the filter 'product' is at most 1.15 times what its "
        "covariance allows, pooled over the axes; value: the ratio",
        (JUDGED,),
        lambda metrics: metrics[JUDGED]["attitude_over_sigma"],
        (0.0, 1.15),
    )
}

_FIGURES = {  # block -> metric, unit
    "velocity": ("velocity_rms_mps", "m/s"),
    "position": ("position_rms_m", "m"),
    "gyro_bias": ("gyro_bias_rms_deg_per_h", "deg/h"),
    "accel_bias": ("accel_bias_rms_mg", "mg"),
    "mounting": ("mounting_rms_arcmin", "arcmin"),
}
_KINDS = {"rad": "angle", "rad/s": "angle rate", "m/s^2": "acceleration"}
_ENU = [1, 0, 2]  # of sizes, which have no sign


def product_metrics(statistics: Any) -> dict[str, Any]:
    """Metrics of one filter from its campaign statistics, over the epochs that count.

    Attitudes are listed east, north, up, as in the other studies; the rest as in its block. The
    last sigmas are those that the filter states at the end.
    """
    start = statistics.count_from
    rms = np.sqrt(np.mean(statistics.rms[start:] ** 2, axis=0))
    sigma = np.sqrt(np.mean(statistics.sigma[start:] ** 2, axis=0))
    last = statistics.sigma[-1]
    minute = units.parse("1 arcmin", "angle")
    out: dict[str, Any] = {}
    for block in statistics.blocks:
        here = block.where
        if block.name == "attitude":
            out["attitude_rms_arcmin"] = (rms[here][_ENU] / minute).tolist()
            out["attitude_rms_all_arcmin"] = float(np.sqrt(np.mean(rms[here] ** 2)) / minute)
            out["attitude_last_sigma_arcmin"] = (last[here][_ENU] / minute).tolist()
            ratio = np.sqrt(np.sum(rms[here] ** 2) / np.sum(sigma[here] ** 2))
            out["attitude_over_sigma"] = float(ratio)
            continue
        name, unit = _FIGURES[block.name]
        one = units.parse(f"1 {unit}", _KINDS[block.units]) if block.units in _KINDS else 1.0
        out[name] = (rms[here] / one).tolist()
        if block.name == "mounting":
            out["mounting_last_sigma_arcmin"] = (last[here] / one).tolist()
    settled = statistics.settled(FIVE_ARCMIN)
    out["share_below_5_arcmin"] = float(np.mean(settled <= start))
    return out | consistency(statistics) | {"diverged_runs": statistics.diverged}
