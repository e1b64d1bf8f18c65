"""Parameter classes: what a system can be told, with kinds of quantities and their bounds."""

from __future__ import annotations

import operator
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any, get_args, get_origin

import pydantic
from pydantic_core import core_schema

from robins import units
from robins.scenario import ranges


@dataclass(frozen=True)
class Quantity:
    """Marks a float, or a tuple of floats, as a quantity of a kind: text with a unit, kept as SI.

    Bounds are texts too: ``above`` and ``below`` exclude the bound, ``least`` and ``most`` include
    it. A side without one has that of the kind, `robins.scenario.ranges`. On a tuple of fixed
    length each item is a quantity, and one serves for all.

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
        """The lower bound, then the upper: its word, its text, and how it is kept."""
        low = ("at least", self.least or ranges.LEAST[self.kind], operator.ge)
        high = ("at most", self.most or ranges.MOST[self.kind], operator.le)
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
        """How pydantic checks a field of this kind."""
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
                self.read(value, unit_needed=info.mode == "json")  # one slip, one message
                return (value,) * len(items)
            return tuple(value) if isinstance(value, list) else value

        return core_schema.with_info_before_validator_function(on_each_axis, each)


def default(text: str, *more: str) -> Any:
    """The default of a field, written as in a scenario; several texts for several axes."""
    return pydantic.Field(default=[text, *more] if more else text, validate_default=True)


class Parameters(pydantic.BaseModel):
    """Base of all parameter classes: unchangeable, no unknown key, no silent conversion.

    A truth value is no number, text is no number, NaN is refused.
    """

    model_config = pydantic.ConfigDict(
        frozen=True, extra="forbid", strict=True, allow_inf_nan=False, protected_namespaces=()
    )

    @classmethod
    def __pydantic_init_subclass__(cls, **kwargs: Any) -> None:
        """Refuse a default that would stay text."""
        for name, info in cls.model_fields.items():
            marked = any(isinstance(m, Quantity) for m in info.metadata)
            if marked and isinstance(info.default, str) and not info.validate_default:
                raise TypeError(f"{cls.__name__}.{name}: write default({info.default!r})")
