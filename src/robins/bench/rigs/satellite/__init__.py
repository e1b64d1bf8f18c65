"""The satellite on the bench: seven parts, each a function of the messages on its line.

- `messages`: their messages.
- `config`: their input before a run.
- `vehicle`: plant, rate table, actuators, gyro, star sensor.
- `computers`: attitude determination and control. `reference`: target attitude.
- `judging`: evaluation of a run, and its page.

Modules that parts do not need are imported where they are used, so that processes start sooner.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import numpy as np
import pydantic

from robins.bench.broker.faults import DeviceFault, DeviceFaults, LinkFault, ParameterTable
from robins.bench.rig import Rig, later, named
from robins.bench.rigs.satellite.messages import CONSOLE, SENDS, TAKES, WHEELS, WIRE
from robins.bench.wire.fields import Values
from robins.scenario import Parameters, Quantity, default

if TYPE_CHECKING:
    from robins.sim.rate_table import RateTable


class RateTableParameters(Parameters):
    """A rate table with a lag; without one the gyro turns with the craft exactly."""

    lag: Annotated[float, Quantity("time", above="0 s")] = default("20 ms")
    rate_limit: Annotated[float, Quantity("angle rate", above="0 deg/s")] = default("100 deg/s")
    acceleration_limit: Annotated[float, Quantity("angular acceleration", above="0 rad/s^2")] = (
        default("10 rad/s^2")
    )

    def table(self) -> RateTable:
        """Rate table of the simulation."""
        from robins.sim.rate_table import rate_table

        return rate_table(self.lag, self.rate_limit, self.acceleration_limit)


_SECOND_NS = 1_000_000_000


def _rotated_about_z(said: Values, fault: LinkFault, _: int) -> Values:
    """Attitude turned about body z."""
    from robins.rotation import multiply

    half = 0.5 * fault.angle
    about_z = np.array([math.cos(half), 0.0, 0.0, math.sin(half)])
    return {**said, "q_ib": np.asarray(multiply(said["q_ib"], about_z))}


def _flip_sign(said: Values, _: LinkFault, now_ns: int) -> Values:
    """Quaternion of opposite sign in every other second."""
    odd = (now_ns + 1) // _SECOND_NS % 2 == 1
    return {**said, "q_ib": -said["q_ib"]} if odd else said


def _no_attitude(*_: Any) -> Values:
    return {"q_ib": np.full(4, np.nan), "factor": np.zeros(9), "stars": 0}


def _without_wheel(said: Values, fault: LinkFault, _: int) -> Values:
    said["wheel_torque"][fault.wheel] = 0.0
    return said


DEVICE_FAULTS: dict[str, DeviceFault] = {
    "stuck": DeviceFault("star", "star", "repeated"),
    "turned": DeviceFault("star", "star", "sensed", _rotated_about_z, ("angle",)),
    "lost": DeviceFault("star", "star", "blind", _no_attitude),
    "sign": DeviceFault("star", "star", "said", _flip_sign),
    "wheel": DeviceFault(
        "actuators", "actuation", "said", _without_wheel, ("wheel",), needs="wheel"
    ),
}
"""Star sensor that repeats its last attitude, that sends one turned by ``angle`` about its
boresight z, none at all, or one of the opposite sign, which is no fault; a wheel, by its number
from 0, without torque."""

_WHEEL: Any = Annotated[int, pydantic.Field(ge=0, lt=WHEELS)]
PARAMETERS: dict[str, Any] = {
    "angle": (
        Annotated[float, Quantity("angle", above="0 deg", most="180 deg")],
        default("10 deg"),
    ),
    "wheel": (_WHEEL | None, None),
}


_ALL = {"share": 0.02}
OFFERED: tuple[dict[str, Any], ...] = (
    {"label": "star: wrong by 10 deg", "fault": {"kind": "turned"}},
    {"label": "star: stuck", "fault": {"kind": "stuck"}},
    {"label": "star: lost", "fault": {"kind": "lost"}},
    {"label": "star: sign flips", "fault": {"kind": "sign"}},
    {"label": "star: link silent", "fault": {"kind": "silent", "link": "star"}},
    {"label": "gyro: link silent", "fault": {"kind": "silent", "link": "gyro"}},
    {"label": "wheel 0: no torque", "fault": {"kind": "wheel", "wheel": 0}},
    {"label": "all links: 2 % of frames damaged", "fault": {"kind": "bit errors", **_ALL}},
    {"label": "all links: 2 % of frames lost", "fault": {"kind": "loss", **_ALL}},
)
"""Faults that the page offers."""


class SatelliteRig(Rig):
    """The satellite."""

    name = "satellite"
    wire = WIRE
    sends: ClassVar = SENDS
    takes: ClassVar = TAKES
    console = CONSOLE
    code = f"{__name__}.vehicle"
    build: ClassVar = {part: f"{__name__}.computers:{part}" for part in ("adm", "acm")}
    parameters = "robins.systems.satellite.parameters:AttitudeLoop"
    truth = "motion"
    kept = ("motion", "estimate", "innovation", "wheels", *CONSOLE)
    example = exported = "adm"
    prepare = later(f"{__name__}.config:prepare")
    refuses = later(f"{__name__}.reference:refuses")
    topics = later(f"{__name__}.judging:topics")
    inside = later(f"{__name__}.judging:inside")
    judge = later(f"{__name__}.judging:judge")
    view = later(f"{__name__}.judging:view")

    def flies(self) -> dict[str, Path]:
        """Scenarios of the satellite, s1 first."""
        found = named("robins.systems.satellite:SYSTEM").scenarios
        return {f"satellite/{name}": found[name] for name in ("s1", *found)}

    def filters(self) -> list[str]:
        """Filters of its study, the MEKF first."""
        names = named("robins.systems.satellite.study:FILTERS")
        return ["mekf", *(name for name in names if name != "mekf")]

    def options(self) -> ParameterTable:
        """Rate table with a lag, and the machine by which parts compute."""
        return {
            "table": (RateTableParameters | None, None),
            "machine": (Literal["jax", "vm", "c"], "jax"),
        }

    def device_faults(self) -> DeviceFaults:
        """Faults of star sensor and wheels."""
        return DEVICE_FAULTS, PARAMETERS


RIG = SatelliteRig()

__all__ = ["RIG", "RateTableParameters", "SatelliteRig"]
