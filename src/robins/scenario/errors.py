"""What is raised for a scenario that cannot be used."""

from __future__ import annotations

from collections.abc import Iterable

from robins.errors import RobinsError


class ScenarioError(RobinsError, ValueError):
    """A scenario that cannot be used; `faults` has one line for each thing that is wrong."""

    def __init__(self, faults: Iterable[str]):
        self.faults = tuple(faults)
        super().__init__("\n".join(self.faults))


def named(source: str, fault: str) -> str:
    """The line of a fault, with the file or other source in front."""
    return f"{source}: {fault}" if source else fault
