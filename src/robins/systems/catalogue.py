"""Catalogue of systems and their scenarios, listed without importing one.

In addition to the systems of robins these are the systems of installed packages: an entry point of
the group "robins.systems" names a `robins.systems.System` or `Study`, and the TOML files in the
folder `scenarios` next to its module are its scenarios.
"""

from __future__ import annotations

import tomllib
from functools import cache
from importlib.metadata import entry_points
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

SUMMARIES = {
    "ins-gnss": "loosely coupled INS/GNSS: a simulated drive with an outage, and recorded logs",
    "transfer-alignment": "a slave IMU on a flexing mount aligns itself to a master INS",
    "airship": "a stratospheric airship in the wind: SINS, stars, radar, barometer and air data",
    "rocket": "a spinning sounding rocket: attitude from MEMS gyro and magnetometer, federated",
    "satellite": "a satellite's attitude in closed loop: gyro, star sensor, mixed H2/H-infinity",
    "gnss": "tight GNSS of a car: robust pseudoranges, wheels, yaw gyro; a city, recorded logs",
    "marg": "orientation from gyro, accelerometer and magnetometer, of recorded logs",
}


@cache
def installed() -> dict[str, Any]:
    """Entry points of the systems of other packages, by name; names of robins take precedence.

    Each is an `EntryPoint` of the standard library, or of its backport where that is installed.
    """
    found = entry_points(group="robins.systems")
    return {point.name: point for point in found if point.name not in SUMMARIES}


def summaries() -> dict[str, str]:
    """One-sentence summary of each system; for an installed package, the summary of the package."""

    def sentence(point: Any) -> str:
        return "" if point.dist is None else str(point.dist.metadata["Summary"])

    return SUMMARIES | {name: sentence(point) for name, point in installed().items()}


def is_file(name: str) -> bool:
    """True if a name refers to a Python file, such as "my_system.py:study"."""
    return name.partition(":")[0].endswith(".py")


class ListedScenario(NamedTuple):
    """A scenario file with its title and study."""

    path: Path
    title: str
    study: str  # "" where the system has only one


@cache
def listed(system: str) -> dict[str, ListedScenario]:
    """Packaged scenarios of a system by name, grouped by study.

    A file of its folder without a number of runs configures a replay and is not a scenario.

    Args:
        system: name; a system without a folder `scenarios` has none.
    """
    found: dict[str, ListedScenario] = {}
    for path in _files(system):
        content: dict[str, Any] = tomllib.loads(path.read_text("utf-8"))
        if "runs" in content:
            found[path.stem] = ListedScenario(path, content["title"], content.get("study", ""))
    studies = list(dict.fromkeys(scenario.study for scenario in found.values()))
    return dict(sorted(found.items(), key=lambda item: studies.index(item[1].study)))


def replay_files(system: str) -> dict[str, Path]:
    """Packaged configurations of replays of a system, by name."""
    return {path.stem: path for path in _files(system) if path.stem not in listed(system)}


def _files(system: str) -> list[Path]:
    home = Path(__file__).parent / system.replace("-", "_")
    if system in installed():
        spec = find_spec(installed()[system].module)
        home = Path(str(spec.origin if spec else "")).parent
    return sorted((home / "scenarios").glob("*.toml"))
