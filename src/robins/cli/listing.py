"""The command `list`: an overview, without importing a system, or the details of one system."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import click

from robins.cli import cache
from robins.cli.frame import only_json
from robins.cli.printing import print_data


def listing(system: str | None, as_json: bool) -> None:
    """Print an overview, the details of a system, or all of it as JSON."""
    from robins import workbench

    name, sections = system, workbench.overview()
    if name is None and not as_json:
        first = next(scenario for _, titles in sections.values() for scenario in titles)
        click.echo("\n\n".join(_section(name, *inventory) for name, inventory in sections.items()))
        click.echo("\nNext:   robins list SYSTEM   lists its filters and claims")
        click.echo(f"        robins run {first}")
        return
    cache.enable()
    with only_json(as_json):
        inventory = workbench.inventory(name)
    if name is None:
        return print_data(inventory, "", as_json)
    if "rigs" in inventory:
        rig = name if name in inventory["rigs"] else next(iter(inventory["rigs"]))
        words = f"{_section('bench', *sections['bench'])}\n\nNext:   robins bench up {rig}"
        return print_data(inventory, words, as_json)
    section = sections.get(name, (inventory["summary"], {}))
    return print_data(inventory, _details(inventory, *section), as_json)


def _section(name: str, summary: str, titles: Mapping[str, str]) -> str:
    lines = [f"  {scenario:<29}{title}" for scenario, title in titles.items()]
    return "\n".join([f"{click.style(name, bold=True)}  {summary}", *lines])


def _details(system: Mapping[str, Any], summary: str, titles: Mapping[str, str]) -> str:
    """Scenarios, filters and claims of a system."""
    first = next(iter(system["scenarios"]), None)
    next_ = f"run {first}" if first else f"replay LOG --system {system['name']}"
    default = system["default"] or ("all of these run" if first == system["name"] else "none")
    return "\n".join(
        [
            f"{_section(system['name'], summary, titles)}\n",
            f"filters  {', '.join(system['filters'])}",
            f"default  {default}",
            f"logs     {'yes, with `robins replay`' if system['replays'] else 'no'}",
            *(f"claim    {claim['id']}: {claim['text']}" for claim in system["claims"]),
            f"\nNext:   robins {next_}",
        ]
    )
