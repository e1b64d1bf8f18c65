"""The precision of the reals of a program in C: the type, and how numbers and texts are written.

A program is traced in double precision. In single precision the same text computes with floats:
numbers are rounded once, as they are written. A number too large for a float is the largest float,
and one too small is the least normal one, so that bounds stay finite and what guards a division
stays above zero; the bits of a word stay those of a double.
"""

from __future__ import annotations

import re
from typing import NamedTuple, SupportsFloat

import numpy as np


class Precision(NamedTuple):
    """Type of reals.

    Attributes:
        kind: their type in C.
        suffix: of a literal, and of a function of ``math.h``.
        dtype: their type in NumPy.
        sine: the file with the polynomials of sine and cosine.
    """

    kind: str
    suffix: str
    dtype: type[np.floating]
    sine: str

    def number(self, value: SupportsFloat | str) -> str:
        """C literal of a real, exact after rounding to this precision."""
        number = float(value)
        if np.isnan(number):
            return "NAN"
        if np.isinf(number):
            return "INFINITY" if number > 0 else "-INFINITY"
        return f"{self.rounded(number)!s}{self.suffix}"

    def rounded(self, number: float) -> float | np.floating:
        """Nearest finite number of this precision; zero for zero only."""
        if self.dtype is np.float64:
            return number
        info = np.finfo(self.dtype)
        least = float(info.tiny) if number else 0.0
        return self.dtype(np.copysign(np.clip(abs(number), least, float(info.max)), number))

    def text(self, double: str) -> str:
        """C text, written for doubles, in this precision; comments stay as they are."""
        if self.dtype is np.float64:
            return double
        return _WRITTEN.sub(self._in_single, double)

    def _in_single(self, found: re.Match[str]) -> str:
        literal = found[0]
        if literal.startswith("/*"):
            return literal
        if literal.startswith("FROM_C"):
            return f"{literal[:-1]}{self.suffix})"
        return _OTHER.get(literal) or self.number(literal)


DOUBLE = Precision("double", "", np.float64, "sine.h")
SINGLE = Precision("float", "f", np.float32, "sine_single.h")

_OTHER = {"typedef double real": "typedef float real", "DBL_MAX": "FLT_MAX"}
_NUMBER = r"(?<![\w.])(?:\d+\.\d*(?:[eE][+-]?\d+)?|\d+[eE][+-]?\d+)"
_WRITTEN = re.compile(
    rf"/\*.*?\*/|^FROM_C2?\(\w+, \w+\)|{'|'.join(_OTHER)}|{_NUMBER}", re.DOTALL | re.MULTILINE
)
