"""The summary as tables for a terminal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from rich.console import Group
from rich.table import Table
from rich.text import Text

from robins.report import numbers
from robins.report.numbers import Summary

_GAP = 2  # columns between columns
_COLOURS = {"reproduced": "green", "partly": "yellow", "not": "red", "undecided": "cyan"}


def table(summary: Summary, width: int = 100) -> Group:
    """Metrics by filter, claims with verdicts and refused samples, as a rich renderable.

    Filters that do not fit side by side into ``width`` columns are shown in further tables.
    """
    parts: list[Any] = []
    filters = summary["filters"]
    names = list(dict.fromkeys(name for values in filters.values() for name in values))
    labels = [str(numbers.label(name)) for name in names]
    cells = {f: [numbers.marked(v, name) for name in names] for f, v in filters.items()}
    if sentence := summary.get("verdict"):
        parts.append(
            Text(sentence, style=f"bold {_COLOURS.get(numbers.verdict_class(sentence), '')}")
        )
    for group in _groups(cells, width - max(map(len, labels), default=0)) if names else ():
        metrics = _new("metric")
        for name in group:
            metrics.add_column(Text(name), justify="right")
        for row, metric in enumerate(names):
            if any(metric in filters[name] for name in group):
                metrics.add_row(Text(labels[row]), *(Text(cells[name][row]) for name in group))
        parts += [Text(), metrics] if parts else [metrics]
    if any(numbers.outside(v, name) for v in filters.values() for name in names):
        parts.append(Text(f"{numbers.MARK.strip()} outside its band"))
    if summary["claims"]:
        claims = _new("verdict", "claim")
        claims.add_column("found", justify="right")
        claims.add_column("band", justify="right")
        for claim in summary["claims"]:
            verdict = claim["verdict"]
            claims.add_row(
                Text(verdict, style=_COLOURS[verdict]),
                Text(claim["text"]),
                numbers.claim_value(claim["value"], claim.get("interval")),
                numbers.band(claim["band"]),
            )
        parts += [Text(), claims, Text(numbers.verdict(summary["claims"]))]
    refused = {reason: n for reason, n in summary["counts"].items() if n}
    if refused:
        listed = ", ".join(f"{numbers.words(r)} {n}" for r, n in refused.items())
        parts += [Text(), Text(f"Refused samples: {listed}")]
    return Group(*parts)


def _groups(cells: Mapping[str, Sequence[str]], room: int) -> list[list[str]]:
    """Groups of filters whose columns fit into the width, at least one in each group."""
    groups: list[list[str]] = []
    left = 0
    for name, column in cells.items():
        wanted = max(len(name), *map(len, column)) + _GAP
        if not groups or wanted > left:
            groups.append([])
            left = room
        groups[-1].append(name)
        left -= wanted
    return groups


def _new(*columns: str) -> Table:
    made = Table(box=None, pad_edge=False, header_style="bold", padding=(0, _GAP, 0, 0))
    for column in columns:
        made.add_column(column)
    return made
