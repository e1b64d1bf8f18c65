"""Systems: one problem each, with model, scenarios, filters and claims; here is the registry.

Names are imported when they are asked for: who needs the model of one system alone, such as a
process of the test bench, does not wait for all of them, and `robins.systems.catalogue` tells of
all without importing one.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

from robins.systems.catalogue import SUMMARIES

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
        View,
    )
    from robins.systems.system import System

_OF_STUDY = {
    *("Case", "Contender", "Instrument", "Limit", "Output", "Problem", "Scenario"),
    *("SensorAxes", "StateBlock", "Study", "View"),
}
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
    """Systems by name; each is imported when it is taken out."""

    def __getitem__(self, name: str) -> System:
        if name not in SUMMARIES:
            raise KeyError(name)
        return importlib.import_module(f"{__name__}.{name.replace('-', '_')}").SYSTEM

    def __contains__(self, name: object) -> bool:
        return name in SUMMARIES

    def __iter__(self) -> Iterator[str]:
        return iter(SUMMARIES)

    def __len__(self) -> int:
        return len(SUMMARIES)


SYSTEMS: Mapping[str, System] = _Registry()


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module = "study" if name in _OF_STUDY else "system"
    found = getattr(importlib.import_module(f"{__name__}.{module}"), name)
    globals()[name] = found
    return found
