"""Scenarios and configurations: found by name, and recorded in a result."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax

from robins import scenario, systems
from robins.errors import hint, require_known
from robins.systems import Study, System
from robins.systems.catalogue import installed, is_file, listed, replay_files
from robins.systems.finding import find_system
from robins.systems.study import Problem
from robins.workbench.errors import InputError, refusing

Where = str | os.PathLike[str]


def find_scenario(
    name: str, recorded: bool = False, named_in: Where = ""
) -> tuple[System, str, str]:
    """System, name and text of a scenario.

    Args:
        name: "system/name" of a packaged one; a path that ends in .toml, which names its system by
            the key ``system``; or a system of the user's own, "file.py:study" or the name of an
            installed one, whose parameters then have their defaults.
        recorded: a recorded pair takes the place of the simulation.
        named_in: file or folder that names it; empty where the user does.

    Raises:
        InputError: there is no such scenario or file, the file names no system, or only a
            recorded pair fits it.
        robins.errors.RobinsError: it names code that the user has not confirmed.
    """
    if is_file(name) or name in installed():
        return (
            find_system(name, named_in=named_in),
            Path(name).name.replace(".py:", ":"),
            f'system = "{name}"\n',
        )
    known = systems.SYSTEMS
    packaged = {f"{s}/{k}": (s, one.path) for s in known for k, one in listed(s).items()}
    others = {f"{s}/{k}": (s, path) for s in known for k, path in replay_files(s).items()}
    if recorded:
        packaged |= others
    elif name in others:
        path = others[name][1]
        raise InputError(
            f"{name} describes what is recorded and simulates nothing. A recorded pair is given "
            f"with --master and --slave, another log with `robins replay LOG... {path}`. To "
            "simulate a pair, put your units into a copy of that file and run the copy"
        )
    if name in packaged:
        system, path = packaged[name]
        return known[system], name, path.read_text("utf-8")
    if not name.endswith(".toml"):
        raise InputError(
            f"no scenario '{name}'{hint(name, packaged)} `robins list` names those there are; "
            "a path must end in .toml, a study of your own is file.py:name"
        )
    text = scenario.read_text(name)
    chosen = scenario.mapping_of(text).get("system")
    if not isinstance(chosen, str) or not (is_file(chosen) or chosen in known):
        raise InputError(
            f'write system = "..." into its first lines, one of {", ".join(known)}, or '
            f"file.py:study for one of your own; it says {chosen!r}",
            name,
        )
    return find_system(chosen, Path(name).parent, name), Path(name).stem, text


def study_of(system: System, text: str, source: str) -> Study:
    """Study of a scenario.

    Raises:
        InputError: it names none of the system, which has several.
    """
    names = ", ".join(system.studies)
    chosen = scenario.mapping_of(text).get("study")
    if chosen is None and len(system.studies) == 1:
        return next(iter(system.studies.values()))
    if not isinstance(chosen, str) or chosen not in system.studies:
        raise InputError(
            f'write study = "..." into its first lines, one of {names}; it says {chosen!r}', source
        )
    return system.studies[chosen]


class Simulated(NamedTuple):
    """A scenario for simulation, as read."""

    system: System
    label: str  # its name
    text: str  # TOML, as it stands
    study: Study
    parameters: Any  # with the settings
    source: str  # how it was requested

    @property
    def own(self) -> tuple[str, ...]:
        """The filters that it names; else the usual ones of the study."""
        return self.parameters.filters or self.study.usual

    def problem(self, filters: Sequence[str], seed: int) -> Problem:
        """The problem of some of its filters.

        Raises:
            InputError: the parameters do not fit together.
        """
        with refusing(self.source):
            return self.study.problem(self.parameters, filters, seed)

    def parsed(self, settings: Sequence[str]) -> Any:
        """Parameters of the scenario with other settings.

        Raises:
            robins.scenario.ScenarioError: they do not fit.
        """
        return scenario.parse(self.study.parameters, self.text, settings, source=self.source)


def read_scenario(
    name: str, settings: Sequence[str], text: str = "", named_in: Where = ""
) -> Simulated:
    """A scenario by name, as `find_scenario`, or of another text.

    Raises:
        InputError, robins.scenario.ScenarioError: there is none, or it cannot be run.
    """
    system, label, found = find_scenario(name, named_in=named_in)
    text = text or found
    study = study_of(system, text, name)
    parameters = scenario.parse(study.parameters, text, settings, source=name)
    return Simulated(system, label, text, study, parameters, name)


def check_filters(where: str, known: Sequence[str], wanted: Sequence[str]) -> tuple[str, ...]:
    """The filters wanted, each once.

    Raises:
        InputError: one of them is not among the known.
    """
    with refusing(""):
        for name in wanted:
            require_known("filter", name, known, where)
    return tuple(dict.fromkeys(wanted))


def with_default_filter(one: Simulated) -> tuple[str, ...]:
    """Filters of a scenario, and the default filter of the system if the study has one."""
    return (*one.own, *(name for name in (one.system.default,) if name in one.study.filters))


def request_fields(text: str, settings: Sequence[str]) -> dict[str, Any]:
    """Fields of an outcome: the scenario as it was run, and the machine that ran it."""
    effective = scenario.text_of(scenario.override(scenario.mapping_of(text), settings))
    return {"parameters": effective if settings else text, "device": jax.devices()[0].device_kind}
