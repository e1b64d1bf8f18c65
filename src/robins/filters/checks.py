"""Checks of arguments that several filters share."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, get_args

import numpy as np

from robins.errors import require


def one_of(what: str, given: Any, known: Any) -> None:
    """Refuse a name that is none of those of a `Literal` or a sequence.

    Raises:
        ValueError: ``what must be 'a', 'b' or 'c', got 'd'``.
    """
    names = get_args(known) or tuple(known)
    *most, last = map(repr, names)
    require(given in names, f"{what} must be {', '.join(most)} or {last}", repr(given))


def sensor_names(what: str, given: str | Sequence[str]) -> tuple[str, ...]:
    """A name, or several.

    Raises:
        ValueError: there is none.
    """
    names = (given,) if isinstance(given, str) else tuple(given)
    require(names, f"{what}: name at least one sensor")
    return names


def finite_numbers(what: str, given: Any) -> np.ndarray:
    """An array of floats from real and finite numbers.

    Raises:
        TypeError: they are not real numbers.
        ValueError: one is not finite.
    """
    array = np.asarray(given)
    if array.dtype.kind not in "iuf":
        raise TypeError(f"{what} holds {array.dtype}: real numbers are wanted")
    array = array.astype(float)
    require(np.all(np.isfinite(array)), f"{what} has entries that are not finite numbers")
    return array
