"""The whole test bench of a satellite: dynamics, kinematics and a star simulator of their own.

It is the rig `satellite` but for three parts. The plant is two computers: `dynamics` sends how the
craft turns in a step, `kinematics` where it then points, which dynamics receives in the next step.
`sky` is the star simulator: it shows the stars before the star sensor, whose camera adds its
errors, identifies the stars and solves. So a real star sensor can be shown a sky.

All messages of the satellite are also those of this rig, with `turn` and `stars` in addition.

- `parts`: the parts that are new, and the same run inside one program.
- `faults`: of the star simulator.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from robins.bench.rig import Rig, later, named, packaged
from robins.bench.rigs import satellite
from robins.bench.rigs.laboratory.parts import STARS, dynamics, kinematics, sky, star
from robins.bench.rigs.satellite import messages
from robins.bench.wire.fields import f64, message
from robins.bench.wire.schema import Wire

__all__ = ["BUILD", "RIG", "SENDS", "TAKES", "WIRE"]

_SPLIT = {"plant": ("dynamics", "kinematics"), "star": ("sky", "star")}

WIRE = Wire(
    tuple(part for old in messages.PARTS for part in _SPLIT.get(old, (old,))),
    (
        *messages.WIRE.data,
        message(
            32,
            "turn",
            "How the craft turns in the step, from the dynamics to the kinematics.",
            f64("gibbs_b", 3, "1", "tangent of half the turn, along its axis, body axes", 1e3),
            f64("omega_b", 3, "rad/s", "rate against inertial at the end of the step", 1e3),
        ),
        message(
            33,
            "stars",
            "What the star simulator shows the star sensor, brightest first.",
            f64("vectors_s", 3 * STARS, "1", "unit vectors, sensor axes; NaN: no star", 2.0, True),
            f64("magnitude", STARS, "1", "of each; NaN: no star", 50.0, True),
        ),
    ),
)

SENDS = {part: sent for part, sent in messages.SENDS.items() if part != "plant"} | {
    "dynamics": ("turn",),
    "kinematics": messages.SENDS["plant"],
    "sky": ("stars",),
}
TAKES = {part: taken for part, taken in messages.TAKES.items() if part != "plant"} | {
    "dynamics": (*messages.TAKES["plant"], "motion"),
    "kinematics": ("turn",),
    "sky": ("motion",),
    "star": ("stars", "gyro", "estimate"),
}
BUILD = {part: build for part, build in satellite.BUILD.items() if part != "plant"} | {
    "dynamics": dynamics,
    "kinematics": kinematics,
    "sky": sky,
    "star": star,
}
"""Functions that make each part from a kit."""


def _flies() -> dict[str, Path]:
    from robins.systems.satellite import SYSTEM

    return {"laboratory/stars": SYSTEM.scenarios["stars"]}


RIG: Rig = replace(
    satellite.RIG,
    name="laboratory",
    wire=WIRE,
    build=BUILD,
    sends=SENDS,
    takes=TAKES,
    prepare=later(f"{__name__}.parts:prepare"),
    flies=_flies,
    scenarios=packaged(__file__),
    said=later(f"{__name__}.faults:said"),
    view=lambda: named(f"{__name__}.faults:view")(),
    inside=later(f"{__name__}.parts:inside"),
)
