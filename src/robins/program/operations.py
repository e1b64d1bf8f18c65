"""Scalar operations: one row each, with its value on known numbers and its form in C.

A program computes with five kinds of scalars. In C they are typedefs, of `scalars.h` or `lanes.h`,
so that one text serves a single number and a vector of lanes.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np
import scipy.special
from jax.extend.random import threefry_2x32

KINDS: dict[str, type[np.generic]] = {
    "real": np.float64,
    "flag": np.bool_,
    "whole": np.int64,  # all signed integers
    "word": np.uint32,
    "word64": np.uint64,
}


class Operation(NamedTuple):
    """A scalar operation on arguments of one kind.

    Attributes:
        fold: its value on NumPy scalars, where all arguments are known.
        infix: the operator in C; where there is none, a function of `scalars.h` or of C's
            mathematics is called, ``real_sin(x)``: kind of the first argument, name of the row.
        gives: the kind of the result; None is the kind of the arguments.
        commutes: whether the order of two arguments does not matter, to the bit.
    """

    fold: Callable[..., Any]
    infix: str = ""
    gives: str | None = None
    commutes: bool = False


def _rem(a: np.number, b: np.number) -> np.number:
    return np.fmod(a, b) if b != 0 or isinstance(a, np.floating) else a


def _div(a: np.number, b: np.number) -> np.number:
    if isinstance(a, np.floating):
        return a / b
    return type(a)(math.trunc(int(a) / int(b))) if b != 0 else type(a)(-1)


def _total(a: np.number) -> tuple[bool, np.number | float, bool]:
    """A key of the total order of numbers: -0 before 0, NaN last."""
    return (bool(a != a), a if a == a else 0.0, not np.signbit(a)) if a == a else (True, 0.0, True)


def _away(a: np.number) -> np.number:
    return np.copysign(np.floor(np.abs(a) + 0.5), a)


def _wrap(a: np.number, half: np.number) -> np.number:
    """Wrap a whole number into [-half, half), as two's complement does on overflow."""
    number, most = int(a), int(half)
    return np.int64((number + most) % (2 * most) - most)


def _threefry(key: np.uint64, number: np.uint64) -> np.uint64:
    four = np.array([key >> 32, key, number >> 32, number], np.uint64).astype(np.uint32)
    high, low = np.asarray(threefry_2x32(four[:2], four[2:])).astype(np.uint64)
    return high << np.uint64(32) | low


_OF_NUMPY = (
    *("abs", "sign", "sqrt", "cbrt", "floor", "ceil", "sin", "cos", "tan", "sinh", "cosh", "tanh"),
    *("exp", "exp2", "expm1", "log", "log1p", "nextafter"),
)
_INVERSE = ("sin", "cos", "tan", "tan2", "sinh", "cosh", "tanh")  # after "a", in NumPy "arc"

OPERATIONS: dict[str, Operation] = {
    "add": Operation(lambda a, b: a + b, "+", commutes=True),
    "sub": Operation(lambda a, b: a - b, "-"),
    "mul": Operation(lambda a, b: a * b, "*", commutes=True),
    "div": Operation(_div),
    "rem": Operation(_rem),
    "neg": Operation(lambda a: -a, "-"),
    "max": Operation(np.maximum),  # NaN if either is
    "min": Operation(np.minimum),
    "pow": Operation(np.power),
    "eq": Operation(lambda a, b: a == b, gives="flag", commutes=True),
    "ne": Operation(lambda a, b: a != b, gives="flag", commutes=True),
    "lt": Operation(lambda a, b: a < b, gives="flag"),
    "le": Operation(lambda a, b: a <= b, gives="flag"),
    "lt_to": Operation(lambda a, b: _total(a) < _total(b), gives="flag"),
    "le_to": Operation(lambda a, b: _total(a) <= _total(b), gives="flag"),
    "and": Operation(lambda a, b: a & b, "&", commutes=True),
    "or": Operation(lambda a, b: a | b, "|", commutes=True),
    "xor": Operation(lambda a, b: a ^ b, "^", commutes=True),
    "not": Operation(lambda a: ~a),
    "shift_left": Operation(np.left_shift),
    "shift_right": Operation(np.right_shift),
    "is_finite": Operation(np.isfinite, gives="flag"),
    "round_even": Operation(np.round),
    "round_away": Operation(_away),
    **{name: Operation(getattr(np, name)) for name in _OF_NUMPY},
    **{f"a{name}": Operation(getattr(np, f"arc{name}")) for name in _INVERSE},
    "erf": Operation(scipy.special.erf),
    "erfc": Operation(scipy.special.erfc),
    "erf_inv": Operation(lambda a: np.float64(jax.lax.erf_inv(a))),
    "lgamma": Operation(scipy.special.gammaln),
    "wrap": Operation(_wrap),
    "threefry": Operation(_threefry),
}
