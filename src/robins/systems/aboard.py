"""The instruments that a filter has: as it believes them, and what it takes of each."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from robins.filters import Sensor
from robins.systems.study import Instrument

Taken = tuple[tuple[str, Any], ...]
"""Name of each sensor of a filter, and `Instrument.taken`."""


def filter_instruments(
    instruments: Iterable[Instrument], given: Any, course: Any
) -> tuple[tuple[Sensor, ...], Taken]:
    """Instruments as a filter believes them, and what it takes of the world, of those it has."""
    every = [(i, i.believed(given, course)) for i in instruments]
    there = [(i, sensor) for i, sensor in every if sensor is not None]
    return tuple(sensor for _, sensor in there), tuple((i.name, i.taken) for i, _ in there)


def taken(of: Taken, world: Any) -> dict[str, Any]:
    """``y`` and ``aux`` of the `Case` of a filter with these sensors; pure."""
    seen = {name: take(world) if take else (world.readings[name], None) for name, take in of}
    aux = {name: aux for name, (_, aux) in seen.items() if aux is not None}
    return {"y": {name: y for name, (y, _) in seen.items()}, "aux": aux}
