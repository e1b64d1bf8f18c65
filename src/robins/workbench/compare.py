"""The commands `compare` and `verify`: two results side by side, and whether one is whole.

Examples::

    robins compare results/before results/after
    robins verify results/before
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, NamedTuple

import numpy as np

from robins import results, scenario
from robins.results import Probability
from robins.workbench.options import Option, Where

Differing = dict[str, tuple[Any, Any]]
"""What two results have under one name, by name."""


class Comparison(NamedTuple):
    """Differences between two results; where one has nothing it has None.

    Attributes:
        scenarios: their names.
        asked: seed, runs, machine and parameters that differ, by name.
        versions: of packages that differ.
        metrics: by filter and name, of the filters and metrics that both have.
        missing: filters that only one of them has: those of the first, those of the second.
        claims: verdicts that differ, by id.
    """

    scenarios: tuple[Any, Any]
    asked: Differing
    versions: Differing
    metrics: dict[str, Differing]
    missing: tuple[list[str], list[str]]
    claims: Differing

    @property
    def changed(self) -> dict[str, Differing]:
        """The metrics that differ."""
        return {
            name: differ
            for name, some in self.metrics.items()
            if (differ := {k: pair for k, pair in some.items() if pair[0] != pair[1]})
        }


def compare(
    first: Annotated[Where, Option(metavar="FIRST")],
    second: Annotated[Where, Option(metavar="SECOND")],
) -> Comparison:
    """Compare the result folders FIRST and SECOND: parameters, versions, metrics and verdicts.

    A metric that differs is shown with the ratio of the second to the first, by component.

    Raises:
        robins.results.ResultError: one of them is not a result folder, or is damaged.
    """
    a, b = results.read(first), results.read(second)
    told = [
        {k: r.summary.get(k) for k in ("seed", "runs", "machine")}
        | _flat(scenario.mapping_of(r.manifest["scenario"]["text"]))
        for r in (a, b)
    ]
    one, other = a.summary["filters"], b.summary["filters"]
    verdicts = [{c["id"]: c["verdict"] for c in r.summary["claims"]} for r in (a, b)]
    return Comparison(
        (a.summary["scenario"], b.summary["scenario"]),
        _differing(*told),
        _differing(a.manifest["versions"], b.manifest["versions"]),
        {
            name: {k: (one[name][k], other[name][k]) for k in one[name] if k in other[name]}
            for name in one
            if name in other
        },
        ([name for name in one if name not in other], [name for name in other if name not in one]),
        _differing(*verdicts),
    )


def _differing(a: Mapping[str, Any], b: Mapping[str, Any]) -> Differing:
    return {k: (a.get(k), b.get(k)) for k in dict.fromkeys([*a, *b]) if a.get(k) != b.get(k)}


def _flat(mapping: Mapping[str, Any], under: str = "") -> dict[str, Any]:
    """One table of nested tables, with dotted names as `--set` takes them."""
    found: dict[str, Any] = {}
    for key, value in mapping.items():
        if isinstance(value, Mapping):
            found |= _flat(value, f"{under}{key}.")
        else:
            found[f"{under}{key}"] = value
    return found


def ratios(pair: Sequence[Any]) -> list[float]:
    """The second over the first, of each component; NaN where one is not a number."""
    a, b = (np.atleast_1d(np.array(Probability.share_of(x), dtype=object)) for x in pair)
    if a.shape != b.shape:
        return [float("nan")]
    numbers = [
        (float(x), float(y)) if _is_number(x) and _is_number(y) else (np.nan, np.nan)
        for x, y in zip(a, b, strict=True)
    ]
    return [y / x if x else (1.0 if y == x else float("nan")) for x, y in numbers]


def _is_number(x: Any) -> bool:
    return isinstance(x, int | float) and not isinstance(x, bool)


def lines(found: Comparison) -> list[str]:
    """A comparison for people."""
    told = [f"{found.scenarios[0]} and {found.scenarios[1]}"]
    for title, pairs in (
        ("Asked for", found.asked),
        ("Versions", found.versions),
        ("Verdicts", found.claims),
    ):
        told += [f"{title}:"] if pairs else []
        told += [f"  {name}: {a} -> {b}" for name, (a, b) in pairs.items()]
    for name, which in zip(found.missing, ("first", "second"), strict=True):
        told += [f"Only the {which} has {', '.join(name)}."] if name else []
    count = sum(map(len, found.metrics.values()))
    changed = found.changed
    for name, some in changed.items():
        told.append(f"{name}:")
        width = max(map(len, some))
        for key, pair in some.items():
            a, b = (_shown(x) for x in pair)
            by = ", ".join(f"{r:.3g}" for r in ratios(pair))
            told.append(f"  {key:<{width}}  {a} -> {b}   ({by} times)")
    differ = sum(map(len, changed.values()))
    return [*told, f"{differ} of {count} metrics differ."]


def _shown(value: Any) -> str:
    if (found := Probability.read(value)) is not None:
        return "{:.5g} ({:.2g} to {:.2g})".format(*found[:3])
    if isinstance(value, list):
        return f"[{', '.join(map(_shown, value))}]"
    return f"{value:.5g}" if isinstance(value, float) else str(value)


def verify(where: Annotated[Where, Option(metavar="FOLDER")]) -> dict[str, Any]:
    """Check every file of the result FOLDER against its checksum; bad input if one is damaged.

    Returns:
        ``scenario``, ``files`` (how many), ``whole``.

    Raises:
        robins.results.ResultError: it is not a result folder, incomplete or damaged; the message
            names the file.
    """
    found = results.read(where)
    return {
        "scenario": found.summary["scenario"],
        "files": len(found.manifest["files"]),
        "whole": True,
    }
