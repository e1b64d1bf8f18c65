"""What the airship study says of each filter, and of the claims of the paper."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from robins.systems.judgement import Claim, ratio

AEKF, UKF, RAUKF, CUKF = "aekf", "ukf", "raukf", "cukf-wind-states"

# Table 1 of the paper: position and velocity error, mean and standard deviation [m, m/s]
PUBLISHED: Mapping[str, Mapping[str, tuple[float, float, float, float]]] = {
    "calm": {
        AEKF: (2.37, 1.53, 0.326, 0.178),
        RAUKF: (1.50, 0.50, 0.120, 0.066),
        CUKF: (1.63, 0.51, 0.123, 0.070),
    },
    "wind": {
        AEKF: (4.56, 2.36, 0.496, 0.361),
        RAUKF: (3.01, 1.56, 0.309, 0.276),
        CUKF: (2.02, 1.26, 0.151, 0.121),
    },
}
METRICS = ("horizontal_mean_m", "horizontal_std_m", "velocity_mean_m_s", "velocity_std_m_s")


def published(name: str, windy: bool) -> dict[str, float]:
    """The row of the paper's table that stands for a filter, if there is one."""
    row = PUBLISHED["wind" if windy else "calm"].get(name, ())
    return {f"published_{key}": value for key, value in zip(METRICS, row, strict=False)}


def airship_metrics(epoch_s: np.ndarray, at_s: Sequence[float], statistics: Any) -> dict[str, Any]:
    """Metrics of one filter from its campaign statistics, over the epochs that count.

    Means and standard deviations over time are of the length of the horizontal error, averaged over
    the runs; `nees_per_dim` is one for a filter that knows how wrong it is.
    """
    position, velocity = (np.mean(statistics.norm(n), axis=0) for n in ("horizontal", "velocity"))
    at = statistics.counted
    out: dict[str, Any] = dict(zip(METRICS, map(float, [*position, *velocity]), strict=True))
    out["nees_per_dim"] = float(np.mean(statistics.anees()[at]))
    for block, values in statistics.block_anees().items():
        out[f"nees_per_dim_{block}"] = float(np.mean(values[at]))
    out["anees_share_inside"] = statistics.anees_share_inside()
    horizontal = np.sqrt(np.sum(statistics.rms[:, 6:8] ** 2, axis=1))
    for time in at_s:
        k = int(np.searchsorted(epoch_s, time - 1e-6))
        if k < len(epoch_s):
            out[f"horizontal_rms_at_{time:g}_s_m"] = float(horizontal[k])
    out["diverged_runs"] = statistics.diverged
    return out


def _worst_ratio(ours: str, others: Sequence[str]) -> Callable[..., float]:
    """Of position and velocity, against the best of the others."""

    def value(metrics: Mapping[str, dict[str, Any]]) -> float:
        return max(
            metrics[ours][m] / min(metrics[o][m] for o in others) for m in (METRICS[0], METRICS[2])
        )

    return value


CLAIMS: dict[str, Claim] = {
    "aekf-worse": Claim(
        "The robust adaptive UKF is more accurate than the adaptive EKF; value: ratio of the mean "
        "horizontal errors, RAUKF to AEKF",
        (RAUKF, AEKF),
        ratio(RAUKF, AEKF, METRICS[0]),
        (0.0, 0.98),
        (0.0, 1.0),
    ),
    "ekf-is-why": Claim(
        "The EKF family is worse because it linearises; value: mean horizontal error of the EKF "
        "over that of the UKF",
        ("ekf", UKF),
        ratio("ekf", UKF, METRICS[0]),
        (1.05, None),
        (1.01, None),
    ),
    "equal-in-calm": Claim(
        "Without wind the constrained UKF is as accurate as RAUKF; value: ratio of the mean "
        "velocity errors, CUKF to RAUKF",
        (CUKF, RAUKF),
        ratio(CUKF, RAUKF, METRICS[2]),
        (0.9, 1.1),
        (0.8, 1.25),
    ),
    "best-in-wind": Claim(
        "In wind the constrained UKF is more accurate than AEKF and RAUKF; value: the larger of "
        "its ratios of mean position and velocity error to the better of the two",
        (CUKF, AEKF, RAUKF),
        _worst_ratio(CUKF, (AEKF, RAUKF)),
        (0.0, 0.98),
        (0.0, 1.0),
    ),
    "absolute": Claim(
        "The constrained UKF navigates to 2.02 m and 0.151 m/s in wind (Table 1); value: mean "
        "horizontal error [m] of the one with wind states",
        (CUKF,),
        lambda metrics: metrics[CUKF][METRICS[0]],
        (0.0, 2.02 * 1.15),
        (0.0, 2.02 * 1.5),
    ),
    "at-the-bound": Claim(
        "With states for biases and wind the filter is as good as its sensors allow (ours); value: "
        "the larger of its RMS position and velocity errors over the covariance bound",
        ("product",),
        lambda metrics: max(
            metrics["product"][f"{b}_over_bound"] for b in ("position", "velocity")
        ),
        (0.0, 1.15),
    ),
    "survives-loss": Claim(
        "Without radar and barometer the wind keeps the position (not in the paper: the case in "
        "which the constraint earns its place); value: horizontal RMS at the end of the loss, "
        "CUKF with wind states over UKF",
        (CUKF, UKF),
        ratio(CUKF, UKF, "horizontal_rms_at_699_s_m"),
        (0.0, 0.3),
        (0.0, 0.7),
    ),
}
"""Every claim that a scenario may state."""
