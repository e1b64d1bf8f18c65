"""Evaluation of the filters of a study: quantified claims, their verdicts, consistency."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from scipy.special import ndtri, stdtrit

from robins import units
from robins.errors import require, require_known
from robins.filters.consistency_limits import TEST_LEVEL
from robins.results import Probability

Metric = float | int | str | list | Probability | None
Metrics = Mapping[str, Mapping[str, Any]]  # by filter
Band = Sequence[float | int | None]  # from, to
Verdicts = list[dict[str, Any]]  # of claims, as `summary.json` has them
Judge = Callable[..., Verdicts]  # (metrics, metrics of bootstrap draws of runs) -> verdicts
MOST_MORE = 1e4  # times as many runs: more are not proposed for a verdict
RUNS = "runs"  # key, in the metrics of draws, of the number of runs


class Claim(NamedTuple):
    """A claim and the figure that decides it."""

    text: str
    needs: tuple[str, ...]  # filters that must exist and have been run for a verdict
    value: Callable[[Metrics], Any]  # gives None: no verdict
    band: Band | None  # of the value, in which the claim is reproduced
    partly: Band | None = None
    verdict: Callable[[Metrics], str] | None = None  # decides if given, instead of the bands
    tested: bool = False  # the value or its band states a confidence, so it has no interval


def graded(good: bool | np.bool_, fair: bool | np.bool_ = False) -> str:
    """The verdict "reproduced" if good, else "partly" if fair, else "not"."""
    return "reproduced" if good else "partly" if fair else "not"


def ratio(ours: str, theirs: str, metric: str) -> Callable[[Metrics], float]:
    """Ratio of a metric of one filter to that of another, as a function of the metrics."""
    return lambda metrics: _ratio(metrics[ours][metric], metrics[theirs][metric])


def ratio_claims(
    rows: Mapping[str, tuple[str, Sequence[str], Sequence[str], Band, Band]],
    texts: Mapping[str, str],
) -> dict[str, Claim]:
    """Claims that one filter is better than others, by id.

    Args:
        rows: by id: filter, others, metrics, and the bands in which the claim is reproduced and
            partly so. The value is the largest, over the metrics, of the filter's metric over the
            least of the others'.
        texts: of the claims, by id.
    """
    for key, (_, _, keys, *_) in rows.items():
        for metric in keys:
            check_words(texts[key], metric)

    def largest(ours: str, theirs: Sequence[str], keys: Sequence[str]) -> Callable[..., float]:
        def value(metrics: Metrics) -> float:
            best = (min(metrics[name][key] for name in theirs) for key in keys)
            found = [_ratio(metrics[ours][key], of) for key, of in zip(keys, best, strict=True)]
            return float(np.max(found))

        return value

    return {
        key: Claim(texts[key], (ours, *theirs), largest(ours, theirs, keys), band, partly)
        for key, (ours, theirs, keys, band, partly) in rows.items()
    }


def _ratio(ours: float, best: float) -> float:
    """`ours` over `best`; `best` may be zero, as in a draw of few runs in which none diverged."""
    if best:
        return ours / best
    return math.inf if ours else math.nan


def check_words(text: str, metric: str) -> None:
    """Refuse a claim on a NEES whose text does not name the states of that NEES.

    Raises:
        ValueError: they are not named.
    """
    of = metric.removeprefix("nees_").replace("_", " ")
    require(
        not metric.startswith("nees_") or of in text,
        f"the claim {text!r} is decided by {metric}; say in its words that it is of: {of}",
    )


def nees_claim(text: str, filter_: str, of: str, band: Band) -> Claim:
    """Claim on the mean NEES per degree of freedom of a block, or of "all_states".

    Raises:
        ValueError: the text does not name the block.
    """
    check_words(text, metric := f"nees_{of}")
    return Claim(text, (filter_,), lambda metrics: metrics[filter_][metric], band)


def claim_judge(claims: Mapping[str, Claim], stated: Sequence[str] | None = None) -> Judge:
    """The judge of the stated claims whose filters were run; of all claims if none are stated.

    Its optional second argument is a sequence of metrics of bootstrap draws of the runs, see
    `interval_of`; a verdict is then "undecided" if the interval of the value crosses the edge of a
    band.

    Raises:
        ValueError: the study has no claim of this id.
    """
    chosen = tuple(claims) if stated is None else tuple(stated)
    for key in chosen:
        require_known("claim", key, claims)
    return partial(_verdicts, {key: claims[key] for key in chosen})


def judge_filters(filters: Sequence[str], judge: Judge) -> Judge:
    """A judge that sees only the metrics of these filters, whichever others were run."""

    def judged(metrics: Metrics, drawn: Sequence[Metrics] = ()) -> Verdicts:
        chosen = [{k: m for k, m in one.items() if k in filters} for one in (metrics, *drawn)]
        return judge(chosen[0], chosen[1:])

    return judged


def _verdicts(
    claims: Mapping[str, Claim], metrics: Metrics, drawn: Sequence[Metrics] = ()
) -> Verdicts:
    out = []
    for key, claim in claims.items():
        exists = (n in metrics and metrics[n].get("feasible", True) for n in claim.needs)
        value = claim.value(metrics) if all(exists) else None
        if value is None:
            continue
        interval = None if claim.tested else interval_of(claim.value, value, drawn)
        verdict = _verdict(claim, metrics, value, interval, drawn)
        out.append(
            {
                "id": key,
                "text": claim.text,
                "verdict": verdict,
                "value": value,
                "band": None if claim.band is None else list(claim.band),
                "interval": interval,
                "more_runs": _more_runs(claim, value, interval, drawn)
                if verdict == "undecided"
                else None,
            }
        )
    return out


def interval_of(
    value_of: Callable[[Metrics], Any], value: Any, drawn: Sequence[Metrics]
) -> list[float] | None:
    """95 % interval of a value by a paired bootstrap over the runs (Efron & Tibshirani 1993, 13).

    The percentiles of the draws, widened about the value by sqrt(n / (n - 1)) t / z, the factor by
    which the bootstrap understates the interval of the mean of n normal runs.

    Args:
        value_of: function of the metrics.
        value: its value over all runs.
        drawn: metrics of draws of the runs, the same runs for all filters; the first of all
            runs, each once. Each filter has the number of runs under `RUNS`.

    Returns:
        Lower and upper end; None: there are no draws, or the value is not a function of figures of
        single runs.
    """
    if not drawn or not isinstance(value, int | float) or not math.isfinite(value):
        return None
    again = np.array([value_of(metrics) for metrics in drawn], dtype=float)
    if not math.isclose(again[0], value, rel_tol=1e-9, abs_tol=1e-12):
        return None
    runs = _runs_of(drawn)
    wider = math.sqrt(runs / (runs - 1)) * stdtrit(runs - 1, 0.975) / ndtri(0.975)
    low, high = np.percentile(again[1:], [2.5, 97.5], method="inverted_cdf") - value
    if not np.isfinite(low + high) or low == high == 0.0:
        return None
    return [float(value + wider * min(low, 0.0)), float(value + wider * max(high, 0.0))]


def _verdict(
    claim: Claim,
    metrics: Metrics,
    value: float | int,
    interval: Sequence[float] | None,
    drawn: Sequence[Metrics],
) -> str:
    if claim.verdict is not None:
        verdict = claim.verdict(metrics)
        others = [] if interval is None else [claim.verdict(one) for one in drawn[1:]]
        decided = sum(one != verdict for one in others) <= 0.05 * len(others)
    else:
        ends = {_graded(claim, one) for one in (value, *(interval or ()))}
        verdict, decided = _graded(claim, value), len(ends) == 1
    return verdict if decided else "undecided"


def _graded(claim: Claim, value: float | int) -> str:
    return graded(_inside(value, claim.band), _inside(value, claim.partly))


def _more_runs(
    claim: Claim, value: float, interval: Sequence[float] | None, drawn: Sequence[Metrics]
) -> int | None:
    """Number of further runs after which the interval should contain no edge of the claim's bands.

    Its width falls with the square root of the number of runs. None if the value lies too close to
    an edge (`MOST_MORE`), or if no edge is in the interval.
    """
    needed = 0.0
    edges = [e for band in (claim.band, claim.partly) for e in band or () if e is not None]
    for edge, end in itertools.product(edges, interval or ()):
        if min(value, end) <= edge <= max(value, end):
            needed = max(needed, ((end - value) / (edge - value)) ** 2 if edge != value else np.inf)
    runs = _runs_of(drawn)
    return math.ceil(runs * (needed - 1.0)) if 1.0 <= needed < MOST_MORE else None


def _runs_of(drawn: Sequence[Metrics]) -> int:
    return next(iter(drawn[0].values()))[RUNS]


def rms_by_axis(statistics: Any, all_axes: Sequence[str] = ()) -> dict[str, Metric]:
    """RMS error of every axis of every block in its display unit, over counted runs and epochs.

    For the blocks in `all_axes` the RMS over all axes is added.
    """
    rms, out = statistics.pooled_rms, {}
    for block in statistics.blocks:
        ending = "mps" if block.display_unit == "m/s" else units.as_ending(block.display_unit)
        sizes = units.convert(rms[block.where], block.units, block.display_unit)
        out[f"{block.name}_rms_{ending}"] = sizes.tolist()
        if block.name in all_axes:
            out[f"{block.name}_rms_all_{ending}"] = float(np.sqrt(np.mean(sizes**2)))
    return out


def standard_metrics(statistics: Any) -> dict[str, Metric]:
    """RMS error of every block, consistency of the filter, and number of diverged runs."""
    rms, errors = statistics.pooled_rms, {}
    for block in statistics.blocks:
        size = float(np.linalg.norm(rms[block.where]))  # pooled over the axes
        shown = units.convert(size, block.units, block.display_unit)
        errors[f"{block.name}_rms_{units.as_ending(block.display_unit)}"] = float(shown)
    return errors | consistency(statistics) | {"diverged_runs": statistics.diverged}


def consistency(statistics: Any) -> dict[str, Metric]:
    """Metrics of the consistency of errors with the stated covariance, from campaign statistics.

    A NEES is the mean over runs and epochs, divided by its degrees of freedom, named by its states:
    ``nees_all_states`` or the name of a block. The ANEES is the mean over the runs of the NEES of
    all states at each epoch; the share of epochs inside its 95 % band is reported.
    """
    out: dict[str, Any] = {
        "error_over_sigma": statistics.overall_ratio().tolist(),
        "error_over_sigma_bounds": statistics.ratio_bounds().tolist(),
        "anees_share_inside": statistics.anees_share_inside(),
    } | statistics.mean_nees()
    for sensor in statistics.sensors:
        verdict = statistics.nis(sensor, TEST_LEVEL)
        out[f"nis_{sensor}"] = verdict.value
        out[f"nis_{sensor}_band"] = [verdict.low, verdict.high]
    return out


def consistency_claims(texts: Mapping[str, str], judged: str | None = None) -> dict[str, Claim]:
    """Claims "sigma", "anees" and "nis" on the metrics of `consistency`, with these texts.

    They concern one filter, `judged`, or the worst of all if None.
    """
    needs = () if judged is None else (judged,)

    def of(metrics: Metrics) -> list[Mapping[str, Any]]:
        return [metrics[name] for name in needs or metrics]

    def farthest(metrics: Metrics) -> float:
        """Grand mean NIS farthest from one."""
        every = [1.0, *(m[k] for m in of(metrics) for k in _grand_means(m))]
        return max(every, key=lambda nis: abs(nis - 1.0))

    return {
        "sigma": Claim(
            texts["sigma"],
            needs,
            lambda metrics: float(np.max([_largest_deviation(m) for m in of(metrics)])),
            (0.0, 0.05),
            tested=True,
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
            tested=True,
        ),
    }


def _largest_deviation(metrics: Mapping[str, Any]) -> float:
    """Largest significant deviation from one of the ratio of RMS error to sigma, over the states.

    The ratio scatters by 10 % in 50 runs, so its confidence bound nearer to one is compared.
    """
    low, high = np.transpose(metrics["error_over_sigma_bounds"])
    return float(np.max([*(low - 1.0), *(1.0 - high), 0.0]))


def _grand_means(metrics: Mapping[str, Any]) -> list[str]:
    return [k for k in metrics if k.startswith("nis_") and f"{k}_band" in metrics]


def _nis_inside(metrics: Mapping[str, Any]) -> bool:
    """True if the grand mean NIS of every sensor is inside its band."""
    return all(_inside(metrics[k], metrics[f"{k}_band"]) for k in _grand_means(metrics))


def _inside(value: float | int, band: Band | None) -> bool:
    if band is None:
        return False
    low, high = band
    return (low is None or value >= low) and (high is None or value <= high)
