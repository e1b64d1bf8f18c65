"""The command `bound`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from robins.cli import cache
from robins.cli.frame import command_line, only_json
from robins.cli.progress import Progress


def tell_bound(scenario: str, *, out: Path, as_json: bool, **options: Any) -> None:
    """Compute the bound of a scenario and tell it."""
    cache.enable()
    command = command_line()
    with only_json(as_json), Progress() as progress:
        from robins.workbench import bound_scenario

        done, table = bound_scenario(
            scenario, out=out, command=command, progress=progress, **options
        )
    if as_json:
        click.echo((done.path / "summary.json").read_text("utf-8"), nl=False)
        return
    from rich.console import Console

    Console().print(table)
    click.echo(f"\nResult: {done.path}")
    click.echo(f"Report: {done.path / 'report.html'}   (open it in a browser)")
    click.echo(f"Next:   robins run {scenario}   shows how near the filters come")
