"""The command `list`: what there is to run, listed without importing a system.

Examples::

    robins list
    robins list ins-gnss
    robins list --json
"""

from __future__ import annotations

import tomllib
from importlib.resources import files
from importlib.resources.abc import Traversable
from typing import Annotated, Any

from robins.systems import catalogue
from robins.workbench.options import Option

_ROBINS = files("robins")
_RIGS = _ROBINS.joinpath("bench", "rigs")
BENCH, _BENCH = "bench", "vehicles part by part over serial lines, `robins bench up`"


def overview() -> dict[str, tuple[str, dict[str, str]]]:
    """Summary of every system, of the bench and of design, with the titles of what each can run."""
    entries = {name: (text, titles(name)) for name, text in catalogue.summaries().items()}
    design = "gains between H2 and H-infinity, `robins design`"
    return entries | {"bench": (_BENCH, rigs() | _benches()), "design": (design, designs())}


def inventory(system: Annotated[str | None, Option(metavar="[SYSTEM]")] = None) -> dict[str, Any]:
    """List the systems and their scenarios, or the filters and claims of SYSTEM.

    With --json it prints everything, or SYSTEM alone.

    Args:
        system: its name, or "file.py:study"; "bench", or a rig that is not a system: the bench; all
            where not given.

    Raises:
        robins.systems.finding.UnknownSystem: there is no such system.
    """
    if system == BENCH or (system in rigs() and system not in catalogue.summaries()):
        return {"name": BENCH, "summary": _BENCH, "rigs": rigs(), "scenarios": _benches()}
    if system is not None:
        return _system_entry(system)
    entries = [_system_entry(name) for name in catalogue.summaries()]
    return {
        "scenarios": [name for one in entries for name in one["scenarios"]],
        "systems": entries,
        "filters": list(dict.fromkeys(name for one in entries for name in one["filters"])),
        "claims": [claim | {"system": one["name"]} for one in entries for claim in one["claims"]],
        "rigs": list(rigs()),
        "bench": list(_benches()),
        "designs": list(designs()),
    }


def _system_entry(name: str) -> dict[str, Any]:
    from robins.systems.finding import find_system  # imports a system, which an overview need not

    system = find_system(name)
    return {
        "name": name,
        "summary": catalogue.summaries().get(name, ""),
        "scenarios": [name] if catalogue.is_file(name) else list(titles(name)),
        "filters": list(system.filters),
        "default": system.default or None,
        "claims": [{"id": claim["id"], "text": claim["text"]} for claim in system.claims],
        "replays": system.replay is not None,
    }


def titles(system: str) -> dict[str, str]:
    """Titles of the scenarios of a system, by the names that `run` takes."""
    return {f"{system}/{k}": one.title for k, one in catalogue.listed(system).items()}


def rigs() -> dict[str, str]:
    """Sentences on the rigs of the bench, by the names that `bench up` takes.

    Read from the first lines of their modules, without the bench: its packages are an extra.
    """
    files = {one.name: one.joinpath("__init__.py") for one in _RIGS.iterdir() if one.is_dir()}
    found = {name: file.read_text("utf-8") for name, file in files.items() if file.is_file()}
    first = {name: text.removeprefix('"""').partition("\n")[0] for name, text in found.items()}
    return {name.replace("_", "-"): line.rstrip('."') for name, line in sorted(first.items())}


def _benches() -> dict[str, str]:
    every = (rig.joinpath("scenarios") for rig in _RIGS.iterdir())
    found = [_titled(folder) for folder in every if folder.is_dir()]
    return dict(sorted((name, title) for one in found for name, title in one.items()))


def designs() -> dict[str, str]:
    """Titles of the problems of design that come with robins."""
    return _titled(_ROBINS.joinpath("workbench", "problems"))


def _titled(folder: Traversable) -> dict[str, str]:
    """Titles of the files in a folder of the package, by their names."""
    found = {
        file.name.removesuffix(".toml"): tomllib.loads(file.read_text("utf-8"))["title"]
        for file in folder.iterdir()
        if file.name.endswith(".toml")
    }
    return dict(sorted(found.items()))
