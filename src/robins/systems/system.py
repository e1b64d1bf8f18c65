"""What a system offers: studies to simulate, logs to replay, pairs to align."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from robins.results import Outcome
from robins.scenario import Parameters
from robins.systems.catalogue import listed
from robins.systems.study import Study


class Alignment(NamedTuple):
    """How a system takes a recorded master and slave in the place of its simulation."""

    study: str  # whose scenarios serve as configurations
    parameters: type[Parameters]
    filters: tuple[str, ...]
    align: Callable[..., Outcome]  # (dataset with a master, parameters, filters, progress)


class System(NamedTuple):
    """One entry of the registry."""

    name: str  # as in the catalogue, which knows its summary and its scenarios
    studies: Mapping[str, Study]
    replay_filters: tuple[str, ...] = ()
    replay_parameters: type[Parameters] | None = None
    replay_default: Path | None = None  # configuration of a log that comes without one
    replay: Callable[..., Outcome] | None = None  # (dataset, parameters, filters, progress)
    # roll, pitch, yaw [rad] of the body axes as seen from the sensor's, from replay parameters
    orientation: Callable[[Any], tuple[float, float, float]] = lambda parameters: (0.0, 0.0, 0.0)
    alignment: Alignment | None = None

    @property
    def scenarios(self) -> dict[str, Path]:
        """Packaged scenario files by name."""
        return {name: scenario.path for name, scenario in listed(self.name).items()}

    @property
    def filters(self) -> tuple[str, ...]:
        """Names of all filters, each once."""
        named = [name for study in self.studies.values() for name in study.filters]
        return tuple(dict.fromkeys([*named, *self.replay_filters]))

    @property
    def claims(self) -> tuple[Mapping[str, str], ...]:
        """Ids and texts of what scenarios check, each once: studies may share claims."""
        every = (item for study in self.studies.values() for item in study.claims.items())
        told = dict.fromkeys((key, claim.text) for key, claim in every)
        return tuple({"id": key, "text": text} for key, text in told)
