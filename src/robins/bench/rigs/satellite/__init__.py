"""The satellite on the bench: seven parts, each a function of what reaches it over its line.

- `messages`: what they say. `faults`: what may go wrong with sensors and actuators.
- `kit`: the numbers that they are given before a run; `preparing` makes them.
- `vehicle`: plant, rate table, actuators, gyro, star sensor.
- `computers`: attitude determination and control.
- `errors`, `judging`, `view`: what came of it, for people.

What processes of parts do not need is imported when it is asked for: so they start sooner.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from robins.bench.rig import Judged, Rig, View
from robins.bench.rigs.satellite.computers import acm, adm
from robins.bench.rigs.satellite.kit import Kit
from robins.bench.rigs.satellite.messages import SENDS, TAKES, WIRE
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
"""How each part is made of a kit."""


def _parameters() -> Any:
    from robins.systems.satellite.parameters import AttitudeLoop

    return AttitudeLoop


def _prepare(setup: Any, given: Any) -> Kit:
    from robins.bench.rigs.satellite.preparing import kit_for

    table_ = None if setup.table is None else setup.table.table()
    return kit_for(given, setup.filter, setup.seed, table=table_)


def _flies() -> dict[str, Path]:
    from robins.systems.satellite import SYSTEM

    named = {f"satellite/{name}": path for name, path in SYSTEM.scenarios.items()}
    return {"satellite/s1": named["satellite/s1"]} | named


def _filters() -> Sequence[str]:
    from robins.systems.satellite.study import FILTERS

    return ["mekf", *(name for name in FILTERS if name != "mekf")]


def _scenarios() -> dict[str, Path]:
    return {
        path.stem: path for path in sorted((Path(__file__).parent / "scenarios").glob("*.toml"))
    }


def _options() -> dict[str, Any]:
    from robins.bench.rigs.satellite.setup import Carrier

    return {"table": (Carrier | None, None)}


def _said() -> tuple[Mapping[str, Any], Mapping[str, Any]]:
    from robins.bench.rigs.satellite.faults import PARAMETERS, SAID

    return SAID, PARAMETERS


def _view() -> View:
    from robins.bench.rigs.satellite.view import VIEW

    return VIEW


def _inside(kit: Any) -> Mapping[str, np.ndarray]:
    from robins.bench.rigs.satellite.errors import inside

    return inside(kit)


def _judge(flight: Any, ran: Any) -> Judged:
    from robins.bench.rigs.satellite.judging import judge

    return judge(flight, ran)


RIG = Rig(
    name="satellite",
    wire=WIRE,
    build=BUILD,
    sends=SENDS,
    takes=TAKES,
    parameters=_parameters,
    prepare=_prepare,
    truth="motion",
    kept=("motion", "estimate", "innovation", "wheels"),
    flies=_flies,
    filters=_filters,
    scenarios=_scenarios,
    options=_options,
    said=_said,
    view=_view,
    inside=_inside,
    judge=_judge,
    example="adm",
)

__all__ = ["BUILD", "RIG", "Kit", "acm", "actuators", "adm", "gyro", "plant", "star", "table"]
