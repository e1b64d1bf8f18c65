"""Faults of the star sensor and the wheels."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Any

import numpy as np
import pydantic

from robins.bench.broker.faults import Said
from robins.bench.rigs.satellite.messages import WHEELS
from robins.rotation import multiply
from robins.scenario import Quantity, default

_SECOND_NS = 1_000_000_000


def _turned(said: Mapping[str, Any], fault: Any, _: int) -> dict[str, Any]:
    """Times a turn about body z."""
    half = 0.5 * fault.angle
    about_z = np.array([math.cos(half), 0.0, 0.0, math.sin(half)])
    return {**said, "q_ib": np.asarray(multiply(said["q_ib"], about_z))}


def _sign(said: Mapping[str, Any], _: Any, now_ns: int) -> Mapping[str, Any]:
    """The opposite sign in every other second."""
    odd = (now_ns + 1) // _SECOND_NS % 2 == 1
    return {**said, "q_ib": -said["q_ib"]} if odd else said


def _lost(*_: Any) -> dict[str, Any]:
    return {"q_ib": np.full(4, np.nan), "factor": np.zeros(9), "stars": 0}


def _without_wheel(said: Mapping[str, Any], fault: Any, _: int) -> Mapping[str, Any]:
    said["wheel_torque"][fault.wheel] = 0.0
    return said


SAID: dict[str, Said] = {
    "stuck": Said("star", "star", "repeated"),
    "turned": Said("star", "star", "sensed", _turned, ("angle",)),
    "lost": Said("star", "star", "blind", _lost),
    "sign": Said("star", "star", "said", _sign),
    "wheel": Said("actuators", "actuation", "said", _without_wheel, ("wheel",), needs="wheel"),
}
"""A star sensor that says again and again what it said last, whose attitude is turned by ``angle``
about its boresight z, that says none, or one of the other sign, which is no fault; a wheel, by its
number from 0, that gives no torque."""

_WHEEL: Any = Annotated[int, pydantic.Field(ge=0, lt=WHEELS)]
PARAMETERS: dict[str, Any] = {
    "angle": (
        Annotated[float, Quantity("angle", above="0 deg", most="180 deg")],
        default("10 deg"),
    ),
    "wheel": (_WHEEL | None, None),
}


def said() -> tuple[Mapping[str, Said], Mapping[str, Any]]:
    """Faults of the satellite, and their parameters."""
    return SAID, PARAMETERS


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
