"""The airship on the bench: inertial navigation, radar, stars, air data, and the computer.

It runs any filter of the study that takes the measurements of the paper, with or without the wind.
A step is an epoch of the filter; a measurement that is not sent in a step is missing in it.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, ClassVar

import numpy as np

from robins.bench.broker.faults import DeviceFault, DeviceFaults, LinkFault, nothing
from robins.bench.rig import Rig, later, named
from robins.bench.wire.fields import Field, Values, f64, message, size
from robins.bench.wire.schema import Wire
from robins.scenario import Quantity, default

__all__ = ["RIG", "WIRE"]

_TURN, _SPEED, _FAR = 10.0, 1e5, 1e9  # rad, m/s, m: far beyond any airship

# fmt: off
WIRE = Wire(
    ("sins", "radar", "star", "air", "navigation"),
    (
        message(16, "increment",
            "What the inertial unit felt over the step, in body axes at its beginning.",
            f64("dt", 1, "s", "length", 1e4),
            f64("theta_b", 3, "rad", "turn", _TURN),
            f64("dv_b", 3, "m/s", "specific force, integrated once", _SPEED),
            f64("dr_b", 3, "m", "and twice", _FAR),
        ),
        message(17, "fix", "Radar and barometer; NaN: not seen.",
            f64("place", 2, "m", "north and east from the datum", _FAR, True),
            f64("heading", 1, "rad", "clockwise from north", _TURN, True),
            f64("alt", 1, "m", "height above the ellipsoid", _FAR, True),
        ),
        message(18, "attitude", "What the star sensor sees; NaN: nothing.",
            f64("euler", 3, "rad", "pitch, roll, heading", _TURN, True),
        ),
        message(19, "wind", "Forecast and air data, for filters that take them; NaN: missing.",
            f64("wind_n", 2, "m/s", "thought to blow, towards north and east", _SPEED, True),
            f64("through_b", 3, "m/s", "velocity through the air, body axes", _SPEED, True),
        ),
        message(20, "state", "The airship at the end of the step.",
            f64("q_nb", 4, "1", "forward-right-down to north-east-down, scalar first", 2.0),
            f64("v_n", 3, "m/s", "north, east, down", _SPEED),
            f64("lat", 1, "rad", "latitude", 0.5 * math.pi),
            f64("lon", 1, "rad", "longitude", 2.0 * math.pi),
            f64("alt", 1, "m", "height above the ellipsoid", _FAR),
            size("sigma", 9, "rad, m/s, m", "stated of attitude, velocity, position, NED", _FAR),
            Field("held", "u8", 1, "1", "1: no increment came, the one before was taken", (0, 1)),
        ),
    ),
)
# fmt: on


def _shift_fix(values: Values, fault: LinkFault, _: int) -> Values:
    """Offset the radar fix, as a match with a wrong place does."""
    return {**values, "place": values["place"] + np.array([fault.shift, 0.0])}


_DEVICE_FAULTS = {
    "shifted": DeviceFault("radar", "fix", "sensed", _shift_fix, ("shift",)),
    "blind": DeviceFault("star", "attitude", "blind", nothing),
    "stuck": DeviceFault("air", "wind", "repeated"),
}
_SHIFT = Annotated[float, Quantity("length", least="-100 km", most="100 km")]


class AirshipRig(Rig):
    """The airship."""

    name = "airship"
    wire = WIRE
    sends: ClassVar = {
        "sins": ("increment",),
        "radar": ("fix",),
        "star": ("attitude",),
        "air": ("wind",),
        "navigation": ("state",),
    }
    takes: ClassVar = {
        **dict.fromkeys(("sins", "radar", "star", "air"), ()),
        "navigation": ("increment", "fix", "attitude", "wind"),
    }
    code = f"{__name__}.flying"
    parameters = "robins.systems.airship.parameters:Airship"
    kept = ("state",)
    prepare = later(f"{code}:prepare")
    timing = later(f"{code}:timing")
    filters = later(f"{code}:filters")
    inside = later(f"{code}:inside")
    judge = later(f"{code}:judge")

    def flies(self) -> dict[str, Path]:
        """Scenarios of the airship."""
        found = named("robins.systems.airship:SYSTEM").scenarios
        return {f"airship/{name}": path for name, path in sorted(found.items())}

    def device_faults(self) -> DeviceFaults:
        """Faults of radar, star sensor and air data."""
        return _DEVICE_FAULTS, {"shift": (_SHIFT, default("200 m"))}


RIG = AirshipRig()
