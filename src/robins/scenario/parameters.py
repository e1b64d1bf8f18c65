"""Parameter classes of systems, with kinds of quantities and their bounds.

Each kind has a range, which keeps errors of a power of ten or of a unit out of a simulation; it is
wider than the values of any vehicle. A parameter with a narrower range declares its own bounds.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any, get_args, get_origin

import numpy as np
import pydantic
from pydantic_core import core_schema

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
"""Greatest magnitude of each kind."""

LEAST: dict[str, str] = {
    kind: "0 K" if kind == "temperature" else f"-{most}" for kind, most in MOST.items()
}
"""Least value of each kind."""

assert MOST.keys() == units.KINDS.keys(), "every kind has a range"

Share = Annotated[float, pydantic.Field(ge=0.0, le=1.0)]
"""A share, from 0 to 1."""

Positive = Annotated[float, pydantic.Field(gt=0.0, le=1e6)]
"""A factor or a figure above zero."""

Dof = Annotated[float, pydantic.Field(gt=2.0, le=1e6)]
"""Degrees of freedom of a Student's t distribution with finite variance (above 2)."""

Entry = Annotated[float, pydantic.Field(ge=-1e3, le=1e3)]
"""An entry of a matrix, or of a vector that gives a direction."""


@dataclass(frozen=True)
class Quantity:
    """Marks a float, or a tuple of floats, as a quantity of a kind: text with a unit, kept as SI.

    Bounds are texts too: ``above`` and ``below`` exclude the bound, ``least`` and ``most`` include
    it; the default is the bound of the kind, in `robins.scenario.parameters`. In a tuple of fixed
    length each item is a quantity, and a single text sets all.

    Raises:
        KeyError: unknown kind.
        robins.units.UnitError: a bound that is not of that kind.
    """

    kind: str
    above: str | None = None
    least: str | None = None
    below: str | None = None
    most: str | None = None

    def __post_init__(self):
        units.KINDS[self.kind]
        for _, bound, _ in self._bounds():
            units.parse(bound, self.kind)

    def _bounds(self) -> list[tuple[str, str, Callable[[float, float], bool]]]:
        """Lower and upper bound: keyword, text, and comparison."""
        low = ("at least", self.least or LEAST[self.kind], operator.ge)
        high = ("at most", self.most or MOST[self.kind], operator.le)
        return [
            low if self.above is None else ("above", self.above, operator.gt),
            high if self.below is None else ("below", self.below, operator.lt),
        ]

    def read(self, value: Any, *, unit_needed: bool = True) -> float:
        """SI value of a text; of a plain number too, taken as SI, where no unit is needed.

        Raises:
            robins.units.UnitError: not such a quantity, or out of bounds.
        """
        plain = not unit_needed and not isinstance(value, str)
        si = units.parse(value, "ratio" if plain else self.kind)
        low, high = self._bounds()
        for (word, bound, kept), (other, end, _) in ((low, high), (high, low)):
            if not kept(si, units.parse(bound, self.kind)):
                raise units.UnitError(f"must be {word} {bound} and {other} {end}")
        return si

    def __get_pydantic_core_schema__(self, source: Any, handler: pydantic.GetCoreSchemaHandler):
        """Schema by which pydantic checks a field of this kind."""
        if get_origin(source) is not tuple:
            return core_schema.with_info_before_validator_function(
                lambda value, info: self.read(value, unit_needed=info.mode == "json"),
                handler(source),
            )
        items = [a if a is Ellipsis else Annotated[a, self] for a in get_args(source)]
        each = handler.generate_schema(tuple[tuple(items)])
        if Ellipsis in items:
            return each

        def on_each_axis(value, info):
            if isinstance(value, str | int | float):
                self.read(value, unit_needed=info.mode == "json")  # one message per error
                return (value,) * len(items)
            return tuple(value) if isinstance(value, list) else value

        return core_schema.with_info_before_validator_function(on_each_axis, each)


def default(text: str, *more: str) -> Any:
    """The default of a field, written as in a scenario; several texts for several axes."""
    return pydantic.Field(default=[text, *more] if more else text, validate_default=True)


class Parameters(pydantic.BaseModel):
    """Base of all parameter classes: immutable, without unknown keys or silent conversions.

    Booleans and texts are not numbers, and NaN is refused.
    """

    model_config = pydantic.ConfigDict(
        frozen=True, extra="forbid", strict=True, allow_inf_nan=False, protected_namespaces=()
    )

    @classmethod
    def __pydantic_init_subclass__(cls, **kwargs: Any) -> None:
        """Refuse a default text that would not be converted."""
        for name, info in cls.model_fields.items():
            marked = any(isinstance(m, Quantity) for m in info.metadata)
            if marked and isinstance(info.default, str) and not info.validate_default:
                raise TypeError(f"{cls.__name__}.{name}: write default({info.default!r})")


class Span(Parameters):
    """A time span from `begin` (included) to `end` (excluded)."""

    begin: Annotated[float, Quantity("time", least="0 s")]
    end: Annotated[float, Quantity("time", above="0 s")]

    @pydantic.model_validator(mode="after")
    def _check_order(self) -> Span:
        if self.end <= self.begin:
            raise ValueError(f"end ({self.end:g} s) must come after begin ({self.begin:g} s)")
        return self

    def holds(self, time_s: Any) -> np.ndarray:
        """Mask of the times in the span, with a tolerance for rounding of times on a grid."""
        time = np.asarray(time_s, float)
        return (time >= self.begin - 1e-9) & (time < self.end - 1e-9)
