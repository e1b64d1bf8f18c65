"""The satellite on the bench: seven parts, each a function of what reaches it over its line.

- `messages`: their messages. `faults`: faults of sensors and actuators.
- `kit`: the numbers that they are given before a run; `preparing` makes them.
- `vehicle`: plant, rate table, actuators, gyro, star sensor.
- `computers`: attitude determination and control. `reference`: target attitude.
- `errors`, `judging`, `view`: evaluation of a run, and its page.

What processes of parts do not need is imported where it is used, so they start sooner.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from robins.bench.rig import Rig, later, named, packaged
from robins.bench.rigs.satellite.computers import acm, adm
from robins.bench.rigs.satellite.kit import Kit
from robins.bench.rigs.satellite.messages import CONSOLE, SENDS, TAKES, WIRE
from robins.bench.rigs.satellite.vehicle import actuators, gyro, plant, star, table

BUILD = {
    "plant": plant,
    "table": table,
    "gyro": gyro,
    "star": star,
    "adm": adm,
    "acm": acm,
    "actuators": actuators,
}
"""Functions that make each part from a kit."""


def _flies() -> dict[str, Path]:
    from robins.systems.satellite import SYSTEM

    of = {f"satellite/{name}": path for name, path in SYSTEM.scenarios.items()}
    return {"satellite/s1": of["satellite/s1"]} | of


def _filters() -> list[str]:
    names = named("robins.systems.satellite.study:FILTERS")
    return ["mekf", *(name for name in names if name != "mekf")]


RIG = Rig(
    name="satellite",
    wire=WIRE,
    build=BUILD,
    sends=SENDS,
    takes=TAKES,
    parameters=lambda: named("robins.systems.satellite.parameters:AttitudeLoop"),
    prepare=later(f"{__name__}.preparing:prepare"),
    console=CONSOLE,
    refuses=later(f"{__name__}.reference:refuses"),
    truth="motion",
    kept=("motion", "estimate", "innovation", "wheels", *CONSOLE),
    flies=_flies,
    filters=_filters,
    scenarios=packaged(__file__),
    options=lambda: {
        "table": (named(f"{__name__}.setup:Carrier") | None, None),
        "machine": (Literal["jax", "vm", "c"], "jax"),
    },
    said=later(f"{__name__}.faults:said"),
    view=lambda: named(f"{__name__}.view:VIEW"),
    topics=later(f"{__name__}.topics:topics"),
    inside=later(f"{__name__}.errors:inside"),
    judge=later(f"{__name__}.judging:judge"),
    example="adm",
    exported="adm",
)

__all__ = ["BUILD", "RIG", "Kit", "acm", "actuators", "adm", "gyro", "plant", "star", "table"]
