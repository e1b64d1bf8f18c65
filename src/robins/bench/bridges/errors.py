"""Errors of a bridge to another program."""

from __future__ import annotations

import importlib
import math
from collections.abc import Sequence
from types import ModuleType

import numpy as np

from robins.errors import RobinsError


class BridgeError(RobinsError, ValueError):
    """A value that a protocol cannot carry, or bytes that are not one of its messages."""


class BridgeClosed(RobinsError, ConnectionError):
    """The other end is not connected, or has disconnected."""

    bad_input = False


class BridgeTimeout(RobinsError, TimeoutError):
    """The other end did not answer in time."""

    bad_input = False


class MissingPackage(RobinsError, ImportError):
    """A bridge needs a package that is not installed."""

    bad_input = False


def needed(module: str, extra: str) -> ModuleType:
    """Import a module of an optional package.

    Raises:
        MissingPackage: it is not installed; names the extra that brings it.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        package = module.partition(".")[0]
        raise MissingPackage(
            f"this bridge needs the package '{package}' ({error})",
            fix=f"pip install 'robins[{extra}]'",
        ) from error


def finite(name: str, value: float | int, message: str) -> float:
    """Check a number for a message.

    Raises:
        BridgeError: it is NaN or infinite.
    """
    if not math.isfinite(value):
        raise BridgeError(f"{name} is {value}", message, "omit what is not known (None)")
    return float(value)


def vector(name: str, values: Sequence[float] | np.ndarray, message: str, size: int = 3):
    """Check the numbers of a vector field, and return them as a list of `size` floats.

    Raises:
        BridgeError: there are more or fewer, or one is NaN or infinite.
    """
    if len(values) != size:
        raise BridgeError(f"{name} has {size} components, got {len(values)}", message)
    return [finite(name, value, message) for value in values]


def as_integer(name: str, value: float | int, low: int, high: int, message: str) -> int:
    """Round to a whole number for a field that holds `low` to `high`.

    Raises:
        BridgeError: it is out of range, or not finite.
    """
    finite(name, value, message)
    number = round(value)
    if not low <= number <= high:
        raise BridgeError(
            f"{name} = {number} does not fit: its field holds {low} to {high}", message
        )
    return number
