"""The summary as tables for a terminal."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rich.console import Console, Group
from rich.table import Table
from rich.text import Text

from robins.report import numbers

_COLOURS = {"reproduced": "green", "partly": "yellow", "not": "red"}


def table(summary: Mapping[str, Any]) -> Group:
    """Metrics by filter, claims with verdicts and refused samples, as something rich can print."""
    parts: list[Any] = []
    filters = summary["filters"]
    names = dict.fromkeys(name for values in filters.values() for name in values)
    if names:
        metrics = _new("metric")
        for name in filters:
            metrics.add_column(Text(name), justify="right")
        for name in names:
            cells = [numbers.show(values.get(name)) for values in filters.values()]
            metrics.add_row(Text(str(numbers.label(name))), *map(Text, cells))
        parts.append(metrics)
    if summary["claims"]:
        claims = _new("verdict", "claim")
        claims.add_column("found", justify="right")
        claims.add_column("band", justify="right")
        for claim in summary["claims"]:
            verdict = claim["verdict"]
            claims.add_row(
                Text(verdict, style=_COLOURS[verdict]),
                Text(claim["text"]),
                numbers.show(claim["value"]),
                numbers.band(claim["band"]),
            )
        parts += [Text(), claims, Text(numbers.verdict(summary["claims"]))]
    refused = {reason: n for reason, n in summary["counts"].items() if n}
    if refused:
        told = ", ".join(f"{numbers.words(r)} {n}" for r, n in refused.items())
        parts += [Text(), Text(f"Refused samples: {told}")]
    return Group(*parts)


def plain(summary: Mapping[str, Any], width: int = 100) -> str:
    """The same as plain text."""
    console = Console(width=width, color_system=None, force_terminal=False)
    with console.capture() as capture:
        console.print(table(summary))
    return capture.get()


def _new(*columns: str) -> Table:
    made = Table(box=None, pad_edge=False, header_style="bold", padding=(0, 2, 0, 0))
    for column in columns:
        made.add_column(column)
    return made
