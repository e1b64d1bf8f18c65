"""Checks of arguments that several filters share."""

from __future__ import annotations

from collections.abc import Sequence
from typing import get_args

import numpy as np
from jaxtyping import ArrayLike

from robins.errors import require

Matrix = ArrayLike | Sequence[object]  # given by a user: an array or rows of numbers, unchecked


def one_of(what: str, given: str, known: object) -> None:
    """Refuse a name that is not in a `Literal` or a sequence.

    Raises:
        ValueError: ``what must be 'a', 'b' or 'c', got 'd'``.
    """
    names = get_args(known) or tuple(known)  # type: ignore[arg-type]
    *most, last = map(repr, names)
    require(given in names, f"{what} must be {', '.join(most)} or {last}", repr(given))


def sensor_names(what: str, given: str | Sequence[str]) -> tuple[str, ...]:
    """Tuple of one name or several.

    Raises:
        ValueError: there is none.
    """
    names = (given,) if isinstance(given, str) else tuple(given)
    require(names, f"{what}: name at least one sensor")
    return names


def matrix(
    what: str, given: Matrix, rows: int | None = None, columns: int | None = None
) -> np.ndarray:
    """Matrix of finite floats; refuse a shape other than (rows, columns), where these are given.

    Raises:
        TypeError: it is not of real numbers.
        ValueError: it is not a matrix, of another shape or not finite; the message names the entry.
    """
    try:
        numbers = np.asarray(given)
    except ValueError as error:
        raise ValueError(f"{what} is no matrix: its rows differ in length") from error
    if numbers.dtype.kind not in "iuf":
        raise TypeError(f"{what} holds {numbers.dtype}, real numbers are wanted")
    shape = numbers.shape
    require(len(shape) == 2, f"{what} has shape {shape}, a matrix (rows of numbers) is wanted")
    wanted = (shape[0] if rows is None else rows, shape[1] if columns is None else columns)
    require(shape == wanted, f"{what} is {shape}, must be {wanted}")
    numbers = numbers.astype(float)
    if not np.isfinite(numbers).all():
        row, column = np.argwhere(~np.isfinite(numbers))[0]
        raise ValueError(f"{what}[{row}, {column}] is {numbers[row, column]}, not a finite number")
    return numbers


def square(what: str, given: Matrix) -> np.ndarray:
    """Square matrix of finite floats; errors as of `matrix`."""
    numbers = matrix(what, given)
    return matrix(what, numbers, *2 * numbers.shape[:1])


def positive(what: str, given: Matrix, of_infinity: str) -> None:
    """Require a positive number; infinity is allowed.

    Raises:
        TypeError: it is not one real number.
        ValueError: it is not positive; the message states what infinity would mean.
    """
    number = np.asarray(given)
    if number.ndim or number.dtype.kind not in "iuf":
        raise TypeError(f"{what} must be one real number, got {given!r}")
    require(number > 0.0, f"{what} must be positive, or inf for {of_infinity}; got {given}")


def finite_numbers(what: str, given: Matrix) -> np.ndarray:
    """Array of floats from real and finite numbers.

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
