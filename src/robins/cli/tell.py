"""The last lines of every command: the result, where it is, and what to do next."""

from __future__ import annotations

import importlib
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from robins.cli import cache
from robins.cli.frame import command_line, only_json
from robins.cli.progress import Progress

if TYPE_CHECKING:
    from robins.results import Outcome, Result

_DRAWING = 0.85  # share of the time after which a result is written


def carry_out(name: str, *given: Any, out: Path, as_json: bool, **settings: Any) -> Outcome:
    """Have the workbench compute, write what it found as a result, tell it.

    Args:
        name: of the function of `robins.workbench`.
        *given: its arguments.
        out: the result folder, which is refused before anything is computed.
        as_json: print one object for scripts and nothing else to standard output.
        **settings: its keyword arguments.
    """
    cache.enable()
    command = command_line()
    with only_json(as_json), Progress() as progress:
        workbench = importlib.import_module("robins.workbench")
        drawing = workbench.part(progress, _DRAWING, 1.0)
        with workbench.publishing(out, command=command, progress=drawing) as publish:
            computing = workbench.part(progress, 0.0, _DRAWING)
            outcome = getattr(workbench, name)(*given, progress=computing, **settings)
            result = publish(outcome)
    tell(outcome, result, as_json)
    return outcome


def tell(outcome: Outcome, result: Result, as_json: bool) -> None:
    """Print what was found and where it is: one object, or tables and sentences."""

    def warn() -> None:
        for warning in outcome.warnings:
            click.secho(f"Warning: {warning}", fg="yellow", bold=True, err=as_json)

    if as_json:
        click.echo((result.path / outcome.for_scripts).read_text("utf-8"), nl=False)
        return warn()
    from rich.console import Console

    from robins.report import table

    console = Console()
    if outcome.title:
        click.secho(f"{outcome.title}\n", bold=True)
    for one in outcome.tables or [table(result.summary, console.width)]:
        click.echo(one) if isinstance(one, str) else console.print(one)
    for note in outcome.notes:
        click.echo(note)
    warn()
    click.echo(f"\nResult: {result.path}")
    click.echo(f"Report: {result.report}   (open it in a browser)")
    for line in outcome.last_lines:
        click.echo(line.replace("{out}", str(result.path)))


def say(data: Any, text: str, as_json: bool) -> None:
    """Print what has no folder: one object for scripts, or text."""
    click.echo(json.dumps(data, indent=2, ensure_ascii=False) if as_json else text)
