"""Outcome of a command, before any of it is written."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import xarray as xr

from robins.results.summary import Json

Progress = Callable[[float, str], None]  # share done in 0..1, what is being done


def ignore_progress(share: float, what: str) -> None:
    """Ignore progress."""


@dataclass(frozen=True)
class Outcome:
    """Outcome of a command: all contents of its result folder, its report and its last lines.

    The computing room (a system, a campaign) fills in the first fields, and `robins.workbench` the
    rest. In `last_lines`, ``{out}`` stands for the folder.
    """

    solution: xr.Dataset | None = None  # None: there is nothing to draw
    metrics: dict[str, dict[str, Json]] = field(default_factory=dict)  # by filter, or by axis
    claims: list[dict[str, Json]] = field(default_factory=list)
    counts: dict[str, int] = field(default_factory=dict)
    files: dict[str, bytes | Path] = field(default_factory=dict)  # further ones; a path is moved in
    notes: list[str] = field(default_factory=list)  # sentences for the reader
    warnings: list[str] = field(default_factory=list)  # reasons to doubt the figures
    setting: str = ""  # "path=value" that the figures ask for, where there is one
    verdict: str = ""  # "Consistent: ...", "With care: ..." or "Do not trust: ..."

    # of the request
    scenario: str = ""  # its name
    seed: int = 0
    runs: int = 1
    parameters: str = ""  # TOML, with what the command line changed
    device: str = "cpu"
    machine: str = ""  # of a campaign: programs, interpreted ("vm") or compiled ("c"), or "jax"

    # of the presentation
    title: str = ""
    figures: tuple[str, ...] = ()  # names of the figures to draw; empty: all
    tables: list[Any] = field(default_factory=list)  # texts or rich tables; empty: the metrics
    last_lines: list[str] = field(default_factory=list)  # further places to look, next steps
    for_scripts: str = "summary.json"  # the file that --json prints
    failure: str = ""  # reason why it is incomplete; it is still written as a result

    @property
    def summary(self) -> dict[str, Json]:
        """Contents of `summary.json`."""
        return {
            "scenario": self.scenario,
            "seed": self.seed,
            "runs": self.runs,
            **({"machine": self.machine} if self.machine else {}),
            **({"verdict": self.verdict} if self.verdict else {}),
            "filters": self.metrics,
            "claims": self.claims,
            "counts": self.counts,
            "warnings": self.warnings,
        }
