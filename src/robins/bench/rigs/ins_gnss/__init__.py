"""INS/GNSS on the bench: inertial unit, receiver, navigation computer, each on its own line.

The samples come from a simulated drive, from a recorded log, or from boards. The computer runs
`robins.systems.ins_gnss.LiveInsGnss`, whose epochs are those of `robins replay`, or it is a C
program: `robins.systems.ins_gnss.aboard`, and the C in this folder.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import numpy as np

from robins.bench.broker.faults import DeviceFault, DeviceFaults, LinkFault, ParameterTable
from robins.bench.rig import Rig, later, named
from robins.bench.wire.fields import Field, Values, f64, message, size
from robins.bench.wire.schema import Wire
from robins.scenario import Quantity, default

__all__ = ["FLAGS", "RIG", "SUSPECTS", "WIRE"]

FLAGS = ("starting", "refused", "rest", "saturated", "disturbed", "doubtful", "behind", "outlier")
"""Bits of `state.flags`, from the lowest: `robins.systems.streaming.Flag`."""
SUSPECTS = "imu", "gnss_position"
"""Instruments in `wrong`, as `robins.systems.ins_gnss.model` names them."""
_SPEED, _FAR = 1e5, 1e9  # m/s, m: far beyond any vehicle
_TIME = Field("time", "u64", 1, "ns", "of the clock that samples and fixes share")
_PLACE = (
    f64("lat", 1, "rad", "latitude", 0.5 * math.pi, True),
    f64("lon", 1, "rad", "longitude", 2.0 * math.pi, True),
    f64("alt", 1, "m", "height above the ellipsoid", _FAR, True),
)
_NAVIGATED = (
    _TIME,
    f64("q_nb", 4, "1", "forward-right-down to north-east-down, scalar first", 2.0, True),
    f64("v_n", 3, "m/s", "north, east, down", _SPEED, True),
    *_PLACE,
    size("sigma", 9, "rad, m/s, m", "stated of attitude, velocity, position, each NED", _FAR),
    size("wrong", len(SUSPECTS), "1", f"probability that it is: {', '.join(SUSPECTS)}", 1.001),
)

# fmt: off
WIRE = Wire(
    ("imu", "gnss", "navigation"),
    (
        message(16, "sample", "A sample of the inertial unit, along its own axes; NaN: missing.",
            _TIME,
            f64("omega_s", 3, "rad/s", "turn rate", 1e4, True),
            f64("f_s", 3, "m/s^2", "specific force", 1e6, True),
        ),
        message(17, "fix", "What the receiver found of its antenna; NaN: not found.",
            _TIME,
            *_PLACE,
            size("sigma", 3, "m", "stated, north, east, down", _FAR),
            f64("v_n", 3, "m/s", "north, east, down", _SPEED, True),
            size("sigma_v", 3, "m/s", "stated, north, east, down", _FAR),
            Field("quality", "u8", 1, "1", "of RTKLIB: 1 fix, 2 float, 5 single; 0: not told"),
        ),
        message(18, "state", "The unit at the stamp of the newest sample.",
            *_NAVIGATED,
            Field("flags", "u8", 1, "1", ", ".join(f"bit {k}: {t}" for k, t in enumerate(FLAGS))),
        ),
        message(19, "epoch", "What the filter says at the end of a block, with all fixes.",
            *_NAVIGATED,
        ),
    ),
)
# fmt: on


def _shift_fix(values: Values, fault: LinkFault, _: int) -> Values:
    """Fix shifted to the north."""
    return {**values, "lat": values["lat"] + fault.shift / 6.378137e6}


def _outage(values: Values, *_: Any) -> Values:
    """GNSS outage: time stamp only, all values NaN, quality 0."""
    nothing = np.full(3, np.nan)
    return {**values, "lat": np.nan, "lon": np.nan, "alt": np.nan, "v_n": nothing, "quality": 0}


_DEVICE_FAULTS = {
    "shifted": DeviceFault("gnss", "fix", "sensed", _shift_fix, ("shift",)),
    "stuck": DeviceFault("gnss", "fix", "repeated"),
    "blind": DeviceFault("gnss", "fix", "blind", _outage),
}
_SHIFT = Annotated[float, Quantity("length", least="-100 km", most="100 km")]


class InsGnssRig(Rig):
    """Inertial unit, receiver and navigation computer."""

    name = "ins-gnss"
    wire = WIRE
    sends: ClassVar = {"imu": ("sample",), "gnss": ("fix",), "navigation": ("state", "epoch")}
    takes: ClassVar = {"imu": (), "gnss": (), "navigation": ("sample", "fix")}
    code = f"{__name__}.navigating"
    parameters = f"{code}:NavigationParameters"
    kept = ("state", "epoch")
    exported = "navigation"
    prepare = later(f"{code}:prepare")
    timing = later(f"{code}:timing")
    view = later(f"{code}:view")
    topics = later(f"{code}:topics")
    judge = later(f"{code}:judge")
    aboard = later(f"{code}:aboard")

    def flies(self) -> dict[str, Path]:
        """Simulated drive, and a recorded walk."""
        drive = named("robins.systems.ins_gnss:SYSTEM").scenarios["drive"]
        return {"ins-gnss/drive": drive, "ins-gnss/walk": drive.with_name("walk.toml")}

    def filters(self) -> list[str]:
        """Filters that do not wait for the end of a log."""
        of = "robins.systems.ins_gnss.log"
        return [name for name in named(f"{of}:NAMES") if name not in named(f"{of}:SMOOTHED")]

    def options(self) -> ParameterTable:
        """Machine that steps the filter; left out: as `LiveInsGnss` chooses."""
        return {"machine": (Literal["jax", "vm", "c"] | None, None)}

    def device_faults(self) -> DeviceFaults:
        """Faults of the receiver."""
        return _DEVICE_FAULTS, {"shift": (_SHIFT, default("30 m"))}


RIG = InsGnssRig()
