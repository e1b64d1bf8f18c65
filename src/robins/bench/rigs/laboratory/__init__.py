"""The whole test bench of a satellite: dynamics, kinematics and a star simulator of their own.

It is the rig `satellite` except for three parts. The plant is two computers: `dynamics` sends the
turn of the craft in a step, `kinematics` the attitude after it, which dynamics receives in the next
step. `sky` is the star simulator: it shows the stars in the field of view to the star sensor, whose
camera adds its errors, identifies the stars and solves. So a real star sensor can be tested.

All messages of the satellite are also those of this rig, with `turn` and `stars` in addition.

`parts` has the new parts, and the same run inside one program.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import numpy as np
import pydantic

from robins.bench.broker.faults import DeviceFault, DeviceFaults, LinkFault, nothing
from robins.bench.rig import later, named
from robins.bench.rigs.satellite import SatelliteRig, messages
from robins.bench.wire.fields import Values, f64, message
from robins.bench.wire.schema import Wire

if TYPE_CHECKING:
    from robins.bench.evaluation import PageView

__all__ = ["RIG", "STARS", "TAKES", "WIRE"]

STARS = 48  # shown at most: those that a camera reports, and some at the edge of its field of view
_SPLIT = {"plant": ("dynamics", "kinematics"), "star": ("sky", "star")}

# fmt: off
WIRE = Wire(
    tuple(part for old in messages.PARTS for part in _SPLIT.get(old, (old,))),
    (
        *messages.WIRE.data,
        message(32, "turn", "How the craft turns in the step, from the dynamics to the kinematics.",
            f64("gibbs_b", 3, "1", "tangent of half the turn, along its axis, body axes", 1e3),
            f64("omega_b", 3, "rad/s", "rate against inertial at the end of the step", 1e3),
        ),
        message(33, "stars", "What the star simulator shows the star sensor, brightest first.",
            f64("vectors_s", 3 * STARS, "1", "unit vectors, sensor axes; NaN: no star", 2.0, True),
            f64("magnitude", STARS, "1", "of each; NaN: no star", 50.0, True),
        ),
    ),
)
# fmt: on

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


def _hide_brightest(said: Values, fault: LinkFault, _: int) -> Values:
    """Star field without its brightest stars."""
    said["vectors_s"][: 3 * fault.stars] = np.nan
    said["magnitude"][: fault.stars] = np.nan
    return said


_DEVICE_FAULTS: dict[str, DeviceFault] = {
    "dark": DeviceFault("sky", "stars", "blind", nothing),
    "hidden": DeviceFault("sky", "stars", "said", _hide_brightest, ("stars",)),
}
"""Star simulator that shows nothing, or all but the brightest ``stars``."""
_STARS = Annotated[int, pydantic.Field(ge=1, le=STARS)]
_OFFERED: tuple[dict[str, Any], ...] = (
    {"label": "sky: dark", "fault": {"kind": "dark"}},
    {"label": "sky: without the brightest star", "fault": {"kind": "hidden"}},
)


class LaboratoryRig(SatelliteRig):
    """The satellite, with dynamics, kinematics and a star simulator."""

    name = "laboratory"
    wire = WIRE
    sends: ClassVar = SENDS
    takes: ClassVar = TAKES
    build: ClassVar = {
        **SatelliteRig.build,
        **{p: f"{__name__}.parts:{p}" for p in ("dynamics", "kinematics", "sky", "star")},
    }
    prepare = later(f"{__name__}.parts:prepare")
    inside = later(f"{__name__}.parts:inside")

    def flies(self) -> dict[str, Path]:
        """Scenario of the satellite with a camera."""
        return {"laboratory/stars": named("robins.systems.satellite:SYSTEM").scenarios["stars"]}

    def device_faults(self) -> DeviceFaults:
        """Faults of the satellite and of the star simulator."""
        kinds, parameters = super().device_faults()
        return {**kinds, **_DEVICE_FAULTS}, {**parameters, "stars": (_STARS, 1)}

    def view(self) -> PageView:
        """Page of the satellite, with the faults of the star simulator."""
        shown = super().view()
        return shown._replace(offered=(*shown.offered, *_OFFERED))


RIG = LaboratoryRig()
