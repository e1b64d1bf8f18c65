"""Systems: one problem each, with model, scenarios, filters and claims; here is the registry.

Names are imported when they are asked for: who needs the model of one system alone, such as a
process of the test bench, does not wait for all of them.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from robins.systems.system import (
        Case,
        Contender,
        Limit,
        Outcome,
        Output,
        Problem,
        Progress,
        SensorAxes,
        StateBlock,
        Study,
        System,
    )

    SYSTEMS: dict[str, System]

_PACKAGES = ("ins_gnss", "transfer_alignment", "airship", "rocket", "satellite", "marg")

__all__ = [
    "SYSTEMS",
    "Case",
    "Contender",
    "Limit",
    "Outcome",
    "Output",
    "Problem",
    "Progress",
    "SensorAxes",
    "StateBlock",
    "Study",
    "System",
]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    if name == "SYSTEMS":
        every = (importlib.import_module(f"{__name__}.{package}").SYSTEM for package in _PACKAGES)
        found: Any = {system.name: system for system in every}
    else:
        found = getattr(importlib.import_module(f"{__name__}.system"), name)
    globals()[name] = found
    return found
