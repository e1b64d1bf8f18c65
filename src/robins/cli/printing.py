"""Last lines of every command: the answer, the place of its result, the next step."""

from __future__ import annotations

import contextlib
import importlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from robins.cli import cache
from robins.cli.frame import command_line, only_json
from robins.cli.progress import Progress

if TYPE_CHECKING:
    from robins.results import Outcome, Result


def carry_out(name: str, *given: Any, out: Path, as_json: bool, **settings: Any) -> Outcome:
    """Run a function of the workbench, print the outcome, and write it as a result.

    Args:
        name: of the function of `robins.workbench`.
        *given: its arguments.
        out: the result folder; an unusable one is refused before anything is computed.
        as_json: print one object for scripts and nothing else to standard output.
        **settings: its keyword arguments.
    """
    command, writing = command_line(), Progress("drawing figures")
    with contextlib.ExitStack() as held:
        cache.enable()  # may print a note, on its own line
        with only_json(as_json), Progress() as progress:
            workbench = importlib.import_module("robins.workbench")
            folder = workbench.publishing(out, command=command, progress=writing)
            publish = held.enter_context(folder)
            outcome = getattr(workbench, name)(*given, progress=progress, **settings)
        print_and_write(outcome, lambda: publish(outcome), writing, as_json)
    return outcome


def print_and_write(
    outcome: Outcome, write: Callable[[], Result], writing: Progress, as_json: bool
) -> None:
    """Print an outcome, write it, and print its place; or print one object for scripts.

    Args:
        outcome: of a command.
        write: makes its result folder.
        writing: shows the progress of `write`.
        as_json: print one object only, once it is written.
    """
    try:
        if not as_json:
            _print_answer(outcome)
            click.echo("\nWriting the report ...")
    except OSError:  # standard output is closed: the result is written all the same
        write()
        raise
    with only_json(as_json), writing:
        result = write()
    if as_json:
        click.echo((result.path / outcome.for_scripts).read_text("utf-8"), nl=False)
        return _warn(outcome, as_json)
    click.echo(f"Result: {result.path}")
    click.echo(f"Report: {result.report}   (open it in a browser)")
    for line in outcome.last_lines:
        click.echo(line.replace("{out}", str(result.path)))


def _print_answer(outcome: Outcome) -> None:
    """Print tables, notes and warnings."""
    from rich.console import Console

    from robins.report import table
    from robins.results import plain

    console = Console()
    if outcome.title:
        click.secho(f"{outcome.title}\n", bold=True)
    for one in outcome.tables or [table(plain(outcome.summary), console.width)]:
        click.echo(one) if isinstance(one, str) else console.print(one)
    for note in outcome.notes:
        click.echo(note)
    _warn(outcome, as_json=False)


def _warn(outcome: Outcome, as_json: bool) -> None:
    for warning in outcome.warnings:
        click.secho(f"Warning: {warning}", fg="yellow", bold=True, err=as_json)


def print_data(data: Any, text: str, as_json: bool) -> None:
    """Print data without a result folder: one object for scripts, or text."""
    click.echo(json.dumps(data, indent=2, ensure_ascii=False) if as_json else text)
