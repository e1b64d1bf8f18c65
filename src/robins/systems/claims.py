"""Claims with a number: what a paper says, the figure that decides it, and the verdict."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

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


def _inside(value: float, band: Band) -> bool:
    low, high = band
    return (low is None or value >= low) and (high is None or value <= high)
