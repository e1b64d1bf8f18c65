"""The command `list`: an overview without importing a system, or the details of one."""

from __future__ import annotations

import json
import tomllib
from importlib.resources import files
from typing import Any

import click

from robins.cli import cache
from robins.cli.frame import BadInput, only_json


def listing(name: str | None, as_json: bool) -> None:
    """Print what there is: an overview, the details of a system, or all of it as JSON."""
    from robins.systems.catalogue import SUMMARIES

    if name is not None and name not in SUMMARIES:
        raise BadInput(f"no system '{name}'; there are {', '.join(SUMMARIES)}.")
    if name is None and not as_json:
        _overview()
        return
    cache.enable()
    with only_json(as_json):
        from robins.systems import SYSTEMS

        told = [_told(SYSTEMS[one]) for one in ([name] if name else SUMMARIES)]
    if as_json:
        click.echo(json.dumps(told[0] if name else _inventory(told), indent=2))
    else:
        _details(told[0])


def _overview() -> None:
    """One line a scenario, one a problem of design."""
    from robins.systems.catalogue import SUMMARIES

    for system, summary in SUMMARIES.items():
        _section(system, summary, _titles(system))
    _section("bench", "the satellite part by part over serial lines, `robins bench up`", _benches())
    _section("design", "gains between H2 and H-infinity, `robins design`", _designs())
    click.echo("Next:   robins list SYSTEM   tells its filters and claims")
    first = next(name for system in SUMMARIES for name in _titles(system))
    click.echo(f"        robins run {first}")


def _section(name: str, summary: str, titles: dict[str, str]) -> None:
    click.secho(name, bold=True, nl=False)
    click.echo(f"  {summary}")
    for scenario, title in titles.items():
        click.echo(f"  {scenario:<29}{title}")
    click.echo()


def _details(system: dict[str, Any]) -> None:
    """Filters, claims and scenarios of a system."""
    _section(system["name"], system["summary"], _titles(system["name"]))
    click.echo(f"filters  {', '.join(system['filters'])}")
    click.echo(f"logs     {'yes, with `robins replay`' if system['replays'] else 'no'}")
    for claim in system["claims"]:
        click.echo(f"claim    {claim['id']}: {claim['text']}")
    first = next(iter(system["scenarios"]), None)
    next_ = f"run {first}" if first else f"replay LOG --system {system['name']}"
    click.echo(f"\nNext:   robins {next_}")


def _told(system: Any) -> dict[str, Any]:
    """A system, as it is printed with ``--json``."""
    from robins.systems.catalogue import SUMMARIES

    return {
        "name": system.name,
        "summary": SUMMARIES[system.name],
        "scenarios": list(_titles(system.name)),
        "filters": list(system.filters),
        "claims": [{"id": claim["id"], "text": claim["text"]} for claim in system.claims],
        "replays": system.replay is not None,
    }


def _inventory(told: list[dict[str, Any]]) -> dict[str, Any]:
    """What there is, as it is printed with ``--json``."""
    return {
        "scenarios": [name for system in told for name in system["scenarios"]],
        "systems": told,
        "filters": list(dict.fromkeys(name for system in told for name in system["filters"])),
        "claims": [claim | {"system": s["name"]} for s in told for claim in s["claims"]],
        "bench": list(_benches()),
        "designs": list(_designs()),
    }


def _titles(system: str) -> dict[str, str]:
    """Of the scenarios of a system, by the names that `robins run` takes."""
    from robins.systems.catalogue import listed

    return {f"{system}/{name}": scenario.title for name, scenario in listed(system).items()}


def _benches() -> dict[str, str]:
    """Titles of the bench's scenarios, looked up without it: its packages are an extra."""
    return _packaged("bench", "run", "scenarios")


def _designs() -> dict[str, str]:
    return _packaged("cli", "problems")


def _packaged(*folder: str) -> dict[str, str]:
    """Titles of the files in a folder of the package, by their names."""
    found = {
        file.name.removesuffix(".toml"): tomllib.loads(file.read_text("utf-8"))["title"]
        for file in files("robins").joinpath(*folder).iterdir()
        if file.name.endswith(".toml")
    }
    return dict(sorted(found.items()))
