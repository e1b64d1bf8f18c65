"""Claims with a number: what a paper says, the figure that decides it, and the verdict."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

Metrics = Mapping[str, Mapping[str, Any]]  # by filter
Band = tuple[float | None, float | None]


class Claim(NamedTuple):
    """What is claimed, and what decides it."""

    text: str
    needs: tuple[str, ...]  # filters without which nothing can be said
    value: Callable[[Metrics], float]
    band: Band  # in which it is reproduced
    partly: Band | None = None


def ratio(ours: str, theirs: str, metric: str) -> Callable[[Metrics], float]:
    """A metric of one filter over that of another."""
    return lambda metrics: metrics[ours][metric] / metrics[theirs][metric]


def listed(claims: Mapping[str, Claim]) -> tuple[dict[str, str], ...]:
    """Ids and texts, as a `robins.systems.system.Study` wants them."""
    return tuple({"id": key, "text": claim.text} for key, claim in claims.items())


def verdicts(
    claims: Mapping[str, Claim], stated: Sequence[str], metrics: Metrics
) -> list[dict[str, Any]]:
    """Verdicts of the claims that a scenario states, where their filters were run.

    Args:
        claims: of the study, by id.
        stated: ids of those to judge.
        metrics: by filter.

    Raises:
        ValueError: the study has no claim of this id.
    """
    out = []
    for key in stated:
        if key not in claims:
            raise ValueError(f"no claim '{key}' in this study; it has {', '.join(claims)}")
        claim = claims[key]
        if any(name not in metrics for name in claim.needs):
            continue
        value = claim.value(metrics)
        verdict = "reproduced" if _inside(value, claim.band) else "not"
        if verdict == "not" and claim.partly is not None and _inside(value, claim.partly):
            verdict = "partly"
        out.append(
            {
                "id": key,
                "text": claim.text,
                "verdict": verdict,
                "value": value,
                "band": list(claim.band),
            }
        )
    return out


def consistency(statistics: Any) -> dict[str, Any]:
    """Metrics, of campaign statistics, on whether a filter errs as much as it says."""
    out: dict[str, Any] = {
        "error_over_sigma": statistics.overall_ratio().tolist(),
        "error_over_sigma_bounds": statistics.ratio_bounds().tolist(),
        "anees_share_inside": statistics.anees_share_inside(),
        "anees_mean": float(np.mean(statistics.anees()[statistics.count_from :])),
    }
    for sensor in statistics.sensors:
        verdict = statistics.nis(sensor, 0.999)
        out[f"nis_{sensor}"] = verdict.value
        out[f"nis_{sensor}_band"] = [verdict.low, verdict.high]
    return out


def proven(metrics: Mapping[str, Any]) -> float:
    """Largest difference between the RMS error of a state and its sigma that is proven.

    Their ratio scatters by 10 % in 50 runs, so what counts is what its bounds leave unexplained.
    """
    low, high = np.transpose(metrics["error_over_sigma_bounds"])
    return float(max(np.max(low - 1.0), np.max(1.0 - high), 0.0))


def grand_means(metrics: Mapping[str, Any]) -> tuple[float, bool]:
    """The grand mean NIS that is farthest from one, and whether all are inside their bands."""
    names = [k for k in metrics if k.startswith("nis_") and f"{k}_band" in metrics]
    farthest = max([1.0, *(metrics[k] for k in names)], key=lambda value: abs(value - 1.0))
    bands = {k: metrics[f"{k}_band"] for k in names}
    return farthest, all(low <= metrics[k] <= high for k, (low, high) in bands.items())


def _inside(value: float, band: Band) -> bool:
    low, high = band
    return (low is None or value >= low) and (high is None or value <= high)
