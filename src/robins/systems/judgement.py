"""What a study says of its filters: claims with a number, their verdicts, consistency."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from robins import units
from robins.errors import require_known

Metrics = Mapping[str, Mapping[str, Any]]  # by filter
Band = Sequence[float | int | None]  # from, to


class Claim(NamedTuple):
    """What is claimed, and what decides it."""

    text: str
    needs: tuple[str, ...]  # filters that must have been run, and exist, for anything to be said
    value: Callable[[Metrics], Any]  # None: nothing can be said
    band: Band | None  # in which it is reproduced
    partly: Band | None = None
    verdict: Callable[[Metrics], str] | None = None  # decides where no band of the value does


def graded(good: object, fair: object = False) -> str:
    """A verdict from two answers."""
    return "reproduced" if good else "partly" if fair else "not"


def ratio(ours: str, theirs: str, metric: str) -> Callable[[Metrics], float]:
    """A metric of one filter over that of another."""
    return lambda metrics: metrics[ours][metric] / metrics[theirs][metric]


def ratio_claims(
    rows: Mapping[str, tuple[str, Sequence[str], Sequence[str], Band, Band]],
    texts: Mapping[str, str],
) -> dict[str, Claim]:
    """Claims that one filter is better than others, by id.

    Args:
        rows: the filter, the others, of which the best counts, metrics, of which the worst ratio to
            that counts, and the bands in which the claim is reproduced and partly so.
        texts: of the claims.
    """

    def largest(ours: str, theirs: Sequence[str], keys: Sequence[str]) -> Callable[..., float]:
        return lambda metrics: max(
            metrics[ours][key] / min(metrics[name][key] for name in theirs) for key in keys
        )

    return {
        key: Claim(texts[key], (ours, *theirs), largest(ours, theirs, keys), band, partly)
        for key, (ours, theirs, keys, band, partly) in rows.items()
    }


def judging(
    claims: Mapping[str, Claim], stated: Sequence[str] | None = None
) -> Callable[[Metrics], list[dict[str, Any]]]:
    """What gives the verdicts of the claims stated, by id, where their filters were run.

    All claims are judged where none are stated.

    Raises:
        ValueError: the study has no claim of this id.
    """
    chosen = tuple(claims) if stated is None else tuple(stated)
    for key in chosen:
        require_known("claim", key, claims)
    return partial(_verdicts, {key: claims[key] for key in chosen})


def about(
    filters: Sequence[str], claims: Callable[[Metrics], list[dict[str, Any]]]
) -> Callable[[Metrics], list[dict[str, Any]]]:
    """Verdicts on these filters alone, whatever else was run beside them."""
    return lambda metrics: claims({k: m for k, m in metrics.items() if k in filters})


def _verdicts(claims: Mapping[str, Claim], metrics: Metrics) -> list[dict[str, Any]]:
    out = []
    for key, claim in claims.items():
        exists = (n in metrics and metrics[n].get("feasible", True) for n in claim.needs)
        value = claim.value(metrics) if all(exists) else None
        if value is None:
            continue
        verdict = graded(_inside(value, claim.band), _inside(value, claim.partly))
        out.append(
            {
                "id": key,
                "text": claim.text,
                "verdict": verdict if claim.verdict is None else claim.verdict(metrics),
                "value": value,
                "band": None if claim.band is None else list(claim.band),
            }
        )
    return out


def rms_by_component(statistics: Any) -> np.ndarray:
    """(r,) RMS error of each component that is reported [SI], over runs and epochs that count."""
    return np.sqrt(np.mean(statistics.rms[statistics.counted] ** 2, axis=0))


def rms_by_axis(statistics: Any, all_axes: Sequence[str] = ()) -> dict[str, Any]:
    """RMS error of every axis of every block in its display unit, over runs and epochs that count.

    Of the blocks in `all_axes` the RMS over all axes is told too.
    """
    rms, out = rms_by_component(statistics), {}
    for block in statistics.blocks:
        ending = "mps" if block.display_unit == "m/s" else units.as_ending(block.display_unit)
        sizes = units.convert(rms[block.where], block.units, block.display_unit)
        out[f"{block.name}_rms_{ending}"] = sizes.tolist()
        if block.name in all_axes:
            out[f"{block.name}_rms_all_{ending}"] = float(np.sqrt(np.mean(sizes**2)))
    return out


def standard_metrics(statistics: Any) -> dict[str, Any]:
    """RMS error of every block, whether the filter errs as much as it says, runs that diverged."""
    rms, errors = rms_by_component(statistics), {}
    for block in statistics.blocks:
        size = float(np.linalg.norm(rms[block.where]))  # pooled over the axes
        shown = units.convert(size, block.units, block.display_unit)
        errors[f"{block.name}_rms_{units.as_ending(block.display_unit)}"] = float(shown)
    return errors | consistency(statistics) | {"diverged_runs": statistics.diverged}


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


def consistency_claims(texts: Mapping[str, str], judged: str | None = None) -> dict[str, Claim]:
    """Claims "sigma", "anees" and "nis" on `consistency`, with these texts.

    They are about one filter, `judged`, or about the worst of all where none is given.
    """
    needs = () if judged is None else (judged,)

    def of(metrics: Metrics) -> list[Mapping[str, Any]]:
        return [metrics[name] for name in needs or metrics]

    def farthest(metrics: Metrics) -> float:
        return max((_farthest(m) for m in of(metrics)), key=lambda nis: abs(nis - 1.0))

    return {
        "sigma": Claim(
            texts["sigma"],
            needs,
            lambda metrics: float(np.max([_proven(m) for m in of(metrics)])),
            (0.0, 0.05),
        ),
        "anees": Claim(
            texts["anees"],
            needs,
            lambda metrics: float(np.min([m["anees_share_inside"] for m in of(metrics)])),
            (0.9, 1.0),
        ),
        "nis": Claim(
            texts["nis"],
            needs,
            farthest,
            None,
            verdict=lambda metrics: graded(all(_nis_inside(m) for m in of(metrics))),
        ),
    }


def _proven(metrics: Mapping[str, Any]) -> float:
    """Largest difference between the RMS error of a state and its sigma that is proven.

    Their ratio scatters by 10 % in 50 runs, so what counts is what its bounds leave unexplained.
    """
    low, high = np.transpose(metrics["error_over_sigma_bounds"])
    return float(np.max([*(low - 1.0), *(1.0 - high), 0.0]))


def _grand_means(metrics: Mapping[str, Any]) -> list[str]:
    return [k for k in metrics if k.startswith("nis_") and f"{k}_band" in metrics]


def _farthest(metrics: Mapping[str, Any]) -> float:
    """The grand mean NIS that is farthest from one."""
    return max(
        [1.0, *(metrics[k] for k in _grand_means(metrics))], key=lambda value: abs(value - 1.0)
    )


def _nis_inside(metrics: Mapping[str, Any]) -> bool:
    """Whether the grand mean NIS of every sensor is inside its band."""
    return all(_inside(metrics[k], metrics[f"{k}_band"]) for k in _grand_means(metrics))


def _inside(value: Any, band: Band | None) -> bool:
    if band is None:
        return False
    low, high = band
    return (low is None or value >= low) and (high is None or value <= high)
