"""The seven parts of the satellite, each a function of what reaches it over its line.

- `kit`: the numbers that they are given before a run; `preparing` makes them.
- `vehicle`: plant, rate table, actuators.
- `sensors`: gyro, star sensor.
- `computers`: attitude determination and control.
"""

from collections.abc import Callable, Mapping

from robins.bench.parts.satellite.computers import acm, adm
from robins.bench.parts.satellite.kit import Kit
from robins.bench.parts.satellite.vehicle import actuators, gyro, plant, star, table
from robins.bench.parts.station import Part

BUILD: Mapping[str, Callable[[Kit], Part]] = {
    "plant": plant,
    "table": table,
    "gyro": gyro,
    "star": star,
    "adm": adm,
    "acm": acm,
    "actuators": actuators,
}
"""How each part is made of a kit."""

__all__ = ["BUILD", "Kit", "acm", "actuators", "adm", "gyro", "plant", "star", "table"]
