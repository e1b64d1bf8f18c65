"""The commands `run`, `demo` and `replay`: the workbench does it, here it is told."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from robins.cli import cache
from robins.cli.frame import command_line, only_json
from robins.cli.progress import Progress


def simulate(scenario: str, *, out: Path, as_json: bool, **options: Any) -> dict[str, Any]:
    """Run a scenario, tell what came out, return its summary."""
    cache.enable()
    command = command_line()
    with only_json(as_json), Progress() as progress:
        from robins.workbench import run_scenario

        done = run_scenario(scenario, out=out, command=command, progress=progress, **options)
    _tell(done, as_json)
    if not as_json:
        seed = options["seed"] + 1
        click.echo(f"Next:   robins run {scenario} --seed {seed}   repeats it with other noise")
    return done.summary


def navigate(log: Sequence[Path], *, out: Path, as_json: bool, **options: Any) -> None:
    """Replay a log and tell what came out."""
    cache.enable()
    command = command_line()
    with only_json(as_json), Progress() as progress:
        from robins.workbench import replay_log

        done = replay_log(
            log, out=out, command=command, progress=progress, findings=_warn, **options
        )
    _tell(done, as_json)
    if not as_json:
        click.echo(
            "Next:   robins allan STILL_LOG   finds the noise of your unit, if it is not set"
        )


def align(scenario: str, master: Path, slave: Path, *, out: Path, as_json: bool, **options: Any):
    """Align a recorded slave to its master and tell what came out."""
    cache.enable()
    command = command_line()
    with only_json(as_json), Progress() as progress:
        from robins.workbench import align_pair

        done = align_pair(
            scenario,
            master,
            slave,
            out=out,
            command=command,
            progress=progress,
            findings=_warn,
            **options,
        )
    _tell(done, as_json)
    if not as_json:
        click.echo(
            f"Next:   robins run COPY   simulates such a pair; COPY is {scenario} with your units"
        )


def _warn(findings: Sequence[Any]) -> None:
    for finding in findings:
        if finding.severity != "error":  # errors end the command and are told there
            click.echo(f"robins: {finding}", err=True)


def _tell(done: Any, as_json: bool) -> None:
    """Print a finished result: the JSON of its folder, or tables and where everything is."""

    def warn() -> None:
        for warning in done.summary["warnings"]:
            click.secho(f"Warning: {warning}", fg="yellow", bold=True, err=as_json)

    if as_json:
        click.echo((done.path / "summary.json").read_text("utf-8"), nl=False)
        return warn()
    from rich.console import Console

    from robins.report import table

    console = Console()
    console.print(table(done.summary, console.width))
    for note in done.notes:
        click.echo(note)
    warn()
    click.echo(f"\nResult: {done.path}")
    report = done.summary["files"].get("report")
    if report:
        click.echo(f"Report: {done.path / report}   (open it in a browser)")
