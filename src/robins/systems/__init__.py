"""Systems, one per problem, with model, scenarios, filters and claims; and their registry.

A system of your own needs no entry here: `robins.systems.finding` takes it from your file or
package.

Names are imported on first use: a program that needs the model of a single system, such as a
process of the test bench, does not wait for the others, and `robins.systems.catalogue` lists all
systems without importing any.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

from robins.errors import lazy
from robins.systems.catalogue import SUMMARIES, installed, summaries

if TYPE_CHECKING:
    from robins.systems.study import (
        Case,
        Contender,
        Instrument,
        Limit,
        Output,
        Problem,
        Scenario,
        SensorAxes,
        StateBlock,
        Study,
        System,
        View,
    )

__all__ = [
    "SYSTEMS",
    "Case",
    "Contender",
    "Instrument",
    "Limit",
    "Output",
    "Problem",
    "Scenario",
    "SensorAxes",
    "StateBlock",
    "Study",
    "System",
    "View",
]


class _Registry(Mapping[str, "System"]):
    """Systems by name, each imported on first access."""

    def __getitem__(self, name: str) -> System:
        if name in SUMMARIES:
            return importlib.import_module(f"{__name__}.{name.replace('-', '_')}").SYSTEM
        point = installed()[name]
        finding = importlib.import_module(f"{__name__}.finding")
        return finding.as_system(name, point.load(), f"entry point {point.value}")

    def __contains__(self, name: object) -> bool:
        return name in summaries()

    def __iter__(self) -> Iterator[str]:
        return iter(summaries())

    def __len__(self) -> int:
        return len(summaries())


SYSTEMS: Mapping[str, System] = _Registry()


__getattr__ = lazy(__name__, dict.fromkeys(__all__, f"{__name__}.study"))
