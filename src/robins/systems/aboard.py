"""Instruments of a filter: its sensor models, and the measurements that it takes from a world."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from robins.filters import Sensor
from robins.systems.study import Instrument

Taken = tuple[tuple[str, Any], ...]
"""Pairs of a sensor's name and its `Instrument.taken`."""


def filter_instruments(
    instruments: Iterable[Instrument], given: Any, course: Any
) -> tuple[tuple[Sensor, ...], Taken]:
    """Sensor models of the instruments that a vehicle has, and how to take their measurements.

    An instrument whose `believed` gives None is left out.
    """
    every = [(i, i.believed(given, course)) for i in instruments]
    there = [(i, sensor) for i, sensor in every if sensor is not None]
    return tuple(sensor for _, sensor in there), tuple((i.name, i.taken) for i, _ in there)


def measurements_of(of: Taken, world: Any) -> dict[str, Any]:
    """Measurements ``y`` and auxiliary inputs ``aux`` of a filter's `Case`, by sensor; pure."""
    seen = {name: take(world) if take else (world.readings[name], None) for name, take in of}
    aux = {name: aux for name, (_, aux) in seen.items() if aux is not None}
    return {"y": {name: y for name, (y, _) in seen.items()}, "aux": aux}
