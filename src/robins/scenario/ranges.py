"""How large a parameter of a kind may be at all, and numbers without a unit.

A range keeps slips of a power of ten, and of a unit, out of a simulation; it is wider than what any
vehicle does. A parameter that is narrower by nature says so where it is declared.
"""

from __future__ import annotations

from typing import Annotated

import pydantic

from robins import units

MOST: dict[str, str] = {
    "angle": "360 deg",
    "angle rate": "100000 deg/s",
    "angular acceleration": "1e6 deg/s^2",
    "angle random walk": "1000 deg/sqrt(s)",
    "rate random walk": "1000 deg/s/sqrt(s)",
    "acceleration": "10000 g",
    "velocity random walk": "1000 m/s/sqrt(s)",
    "acceleration random walk": "1000 m/s^2/sqrt(s)",
    "g-sensitivity": "1000 deg/s/g",
    "length": "100000 km",
    "area": "1 km^2",
    "speed": "100 km/s",
    "position random walk": "1e6 m/sqrt(s)",
    "time": "3650 d",
    "frequency": "1 MHz",
    "inverse time": "1e6 1/s",
    "ratio": "1000",
    "magnetic field": "1 T",
    "magnetic noise": "1 T/sqrt(Hz)",
    "magnetic moment": "1e6 A m^2",
    "mass": "1e6 t",
    "moment of inertia": "1e9 kg m^2",
    "force": "1e9 N",
    "torque": "1e9 N m",
    "angular momentum": "1e9 N m s",
    "density": "1e5 kg/m^3",
    "pressure": "1e9 Pa",
    "temperature": "1e5 K",
    "specific force": "10000 g",
    "scale factor": "1000000 ppm",
}
"""The greatest magnitude of a kind."""

LEAST: dict[str, str] = {
    kind: "0 K" if kind == "temperature" else f"-{most}" for kind, most in MOST.items()
}
"""The least value of a kind."""

assert MOST.keys() == units.KINDS.keys(), "every kind has a range"

Share = Annotated[float, pydantic.Field(ge=0.0, le=1.0)]
"""A part of a whole."""

Positive = Annotated[float, pydantic.Field(gt=0.0, le=1e6)]
"""A factor or a figure above zero."""

Dof = Annotated[float, pydantic.Field(gt=2.0, le=1e6)]
"""Degrees of freedom of Student's t that has a variance."""

Entry = Annotated[float, pydantic.Field(ge=-1e3, le=1e3)]
"""An entry of a matrix, or of a vector that gives a direction."""
