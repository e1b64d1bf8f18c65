"""A multirotor on the bench, flown by PX4 or ArduPilot, unmodified, or by our autopilot.

The craft, its inertial unit with compass and barometer, its GNSS receiver and its autopilot each
have their own line. The part `autopilot` is ours, or a socket to the SITL of PX4 or ArduPilot.

- `flight`: parameters of a scenario, and evaluation of a run.
- `craft`: the physics and the instruments.
- `autopilots`: the autopilots.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import numpy as np
import pydantic

from robins.bench.broker.faults import DeviceFault, DeviceFaults, LinkFault, ParameterTable, nothing
from robins.bench.rig import Rig, later
from robins.bench.wire.fields import Field, Values, f64, message
from robins.bench.wire.schema import Wire
from robins.scenario import Quantity, default

if TYPE_CHECKING:
    from robins.bench.run.setup import Setup

__all__ = ["MOTORS", "RIG", "WIRE"]

MOTORS = ("front right", "rear left", "front left", "rear right")
"""Motors of an X quadrotor in the order of PX4 and ArduPilot, but numbered from 0."""
_RATE, _FORCE, _SPEED, _FAR = 1e4, 1e4, 1e3, 1e5  # rad/s, m/s^2, m/s, m: far beyond any flight

# fmt: off
WIRE = Wire(
    ("craft", "imu", "gnss", "autopilot"),
    (
        message(16, "motion", "The craft as it truly is at the end of the step.",
            f64("q_nb", 4, "1", "forward-right-down to north-east-down, scalar first", 2.0),
            f64("omega_b", 3, "rad/s", "turn rate, forward-right-down", _RATE),
            f64("p_n", 3, "m", "north, east, down of where it started", _FAR),
            f64("v_n", 3, "m/s", "north, east, down", _SPEED),
            f64("f_b", 3, "m/s^2", "specific force over the step, forward-right-down", _FORCE),
        ),
        message(17, "sample",
            "A sample of the inertial unit, forward-right-down; NaN: not measured this time.",
            f64("omega_b", 3, "rad/s", "turn rate", _RATE),
            f64("f_b", 3, "m/s^2", "specific force", _FORCE),
            f64("field_b", 3, "T", "magnetic flux density", 1.0, True),
            f64("pressure", 1, "Pa", "of the air", 2e5, True),
        ),
        message(18, "fix", "What the receiver found; NaN: nothing.",
            f64("lat", 1, "rad", "latitude", 2.0, True),
            f64("lon", 1, "rad", "longitude", 7.0, True),
            f64("alt", 1, "m", "height above mean sea level", _FAR, True),
            f64("v_n", 3, "m/s", "north, east, down", _SPEED, True),
        ),
        message(19, "motors", "What the autopilot asks of the motors.",
            Field("control", "f64", 4, "1", f"share of the most: {', '.join(MOTORS)}", (0.0, 1.0)),
            Field("answered", "u8", 1, "1", "0: the autopilot has not begun to control", (0, 1)),
        ),
    ),
)
# fmt: on


def _disturb_compass(values: Values, fault: LinkFault, _: int) -> Values:
    """Compass disturbed by a magnet on its right."""
    return {**values, "field_b": values["field_b"] + np.array([0.0, fault.field, 0.0])}


def _weaken_motor(values: Values, fault: LinkFault, _: int) -> Values:
    """Motor that gives a share of its command, or nothing."""
    share = np.ones(len(MOTORS))
    share[fault.motor] = fault.left
    return {**values, "control": values["control"] * share}


_DEVICE_FAULTS = {
    "magnet": DeviceFault("imu", "sample", "sensed", _disturb_compass, ("field",)),
    "blind": DeviceFault("gnss", "fix", "blind", nothing),
    "motor": DeviceFault(
        "autopilot", "motors", "said", _weaken_motor, ("motor", "left"), needs="motor"
    ),
}
_MOTOR: Any = Annotated[int, pydantic.Field(ge=0, lt=len(MOTORS))]
_FAULTS: dict[str, Any] = {
    "field": (
        Annotated[float, Quantity("magnetic field", least="-1 mT", most="1 mT")],
        default("20 uT"),
    ),
    "motor": (_MOTOR | None, None),
    "left": (Annotated[float, Quantity("ratio", least="0", most="1")], default("0 %")),
}
_OPTIONS: dict[str, Any] = {
    "autopilot": (Literal["own", "px4", "ardupilot"], "own"),
    "address": (str, "127.0.0.1"),  # of this machine, to which the autopilot connects
    "port": (Annotated[int, pydantic.Field(ge=0, le=65535)], 0),  # 0: that of the autopilot
}


class MultirotorRig(Rig):
    """The multirotor."""

    name = "multirotor"
    wire = WIRE
    sends: ClassVar = {
        "craft": ("motion",),
        "imu": ("sample",),
        "gnss": ("fix",),
        "autopilot": ("motors",),
    }
    takes: ClassVar = {
        "craft": ("motors",),
        "imu": ("motion",),
        "gnss": ("motion",),
        "autopilot": ("sample", "fix", "motion"),  # ArduPilot measures the motion by itself
    }
    code = f"{__name__}.craft"
    build: ClassVar = {"autopilot": f"{__name__}.autopilots:autopilot"}
    parameters = f"{__name__}.flight:Multirotor"
    truth = "motion"
    prepare = later(f"{__name__}.flight:prepare")
    judge = later(f"{__name__}.flight:judge")

    def options(self) -> ParameterTable:
        """Autopilot, and the address to which an external one connects."""
        return _OPTIONS

    def device_faults(self) -> DeviceFaults:
        """Faults of compass, receiver and motors."""
        return _DEVICE_FAULTS, _FAULTS

    def once(self, setup: Setup, part: str) -> str:
        """Reason why an external autopilot cannot be replayed: its state is in no record."""
        if part != "autopilot" or setup.autopilot == "own":
            return ""
        return f"'{part}' is {setup.autopilot}, a program whose state no record holds"


RIG = MultirotorRig()
