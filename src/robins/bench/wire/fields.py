"""Messages and their fields: numbers with units and limits.

All numbers are little endian; lengths of vectors are fixed, so that firmware needs no heap.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, NamedTuple

Values = Mapping[str, Any]
"""Values of a message by field: a number, or numbers (length,)."""
WireType = Literal["u8", "u16", "u32", "u64", "f64"]
SIZES: dict[WireType, int] = {"u8": 1, "u16": 2, "u32": 4, "u64": 8, "f64": 8}


class Field(NamedTuple):
    """A field of a message: a number or a vector."""

    name: str
    kind: WireType
    length: int
    unit: str  # "1": a pure number
    text: str
    limits: tuple[float, float] | None = None  # in a valid frame; None: those of its type
    missing: bool = False  # whether NaN stands for a missing number

    @property
    def span(self) -> str:
        """The limits in words."""
        if self.limits is None:
            return ""
        return "{:g} to {:g}".format(*self.limits) + (" or NaN" if self.missing else "")


class Message(NamedTuple):
    """A message from one part of the bench to another."""

    number: int
    name: str
    text: str
    fields: tuple[Field, ...]

    @property
    def size(self) -> int:
        """Bytes of a payload."""
        return sum(f.length * SIZES[f.kind] for f in self.fields)


def f64(name: str, length: int, unit: str, text: str, most: float, missing: bool = False) -> Field:
    """Floats from ``-most`` to ``most``."""
    return Field(name, "f64", length, unit, text, (-most, most), missing)


def size(name: str, length: int, unit: str, text: str, most: float) -> Field:
    """Floats that are never negative; NaN: not known."""
    return Field(name, "f64", length, unit, text, (0.0, most), True)


def message(number: int, name: str, text: str, *fields: Field) -> Message:
    """A message."""
    return Message(number, name, text, fields)
