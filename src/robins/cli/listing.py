"""The command `list`."""

from __future__ import annotations

import json
from importlib.resources import files
from pathlib import Path
from typing import Any

import click

from robins.cli import cache
from robins.cli.frame import only_json
from robins.cli.problem import examples


def listing(as_json: bool) -> None:
    """Print what there is: systems with their filters and claims, benches, problems of design."""
    cache.enable()
    with only_json(as_json):
        from robins.systems import SYSTEMS
    known = inventory(SYSTEMS.values())
    if as_json:
        click.echo(json.dumps(known, indent=2))
        return
    for system in known["systems"]:
        click.secho(system["name"], bold=True, nl=False)
        click.echo(f"  {system['summary']}")
        click.echo(f"  scenarios  {', '.join(system['scenarios']) or 'none'}")
        click.echo(f"  filters    {', '.join(system['filters'])}")
        click.echo(f"  logs       {'yes, with `robins replay`' if system['replays'] else 'no'}")
        for claim in system["claims"]:
            click.echo(f"  claim      {claim['id']}: {claim['text']}")
        click.echo()
    click.secho("bench", bold=True, nl=False)
    click.echo("  the satellite part by part over serial lines, `robins bench up`")
    click.echo(f"  scenarios  {', '.join(known['bench'])}, and those of the satellite\n")
    click.secho("design", bold=True, nl=False)
    click.echo("  gains between H2 and H-infinity, `robins design`")
    click.echo(f"  problems   {', '.join(known['designs'])}\n")
    if known["scenarios"]:
        click.echo(f"Next:   robins run {known['scenarios'][0]}")


def inventory(systems: Any) -> dict[str, Any]:
    """What there is, as it is printed with ``--json``."""
    told = [
        {
            "name": system.name,
            "summary": system.summary,
            "scenarios": [f"{system.name}/{name}" for name in system.scenarios],
            "filters": list(system.filters),
            "claims": [{"id": claim["id"], "text": claim["text"]} for claim in system.claims],
            "replays": system.replay is not None,
        }
        for system in systems
    ]
    return {
        "scenarios": [name for system in told for name in system["scenarios"]],
        "systems": told,
        "filters": list(dict.fromkeys(name for system in told for name in system["filters"])),
        "claims": [claim | {"system": s["name"]} for s in told for claim in s["claims"]],
        "bench": _benches(),
        "designs": examples(),
    }


def _benches() -> list[str]:
    """Scenarios of the bench, looked up without it: its packages are an extra."""
    folder = files("robins") / "bench" / "run" / "scenarios"
    return sorted(Path(f.name).stem for f in folder.iterdir() if f.name.endswith(".toml"))
