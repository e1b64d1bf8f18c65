"""Checks of a simulated sensor's inputs, where their values are known before compilation."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import PyTree

from robins import _float64  # noqa: F401
from robins.errors import require
from robins.filters.belief import Number
from robins.rotation import normalise

Listed = Number | Sequence[Number] | Sequence[Sequence[Number]]  # an array, or lists of numbers


def known(*values: PyTree) -> bool:
    """True if all are concrete numbers, not tracers of `jit`, `vmap` or `grad`."""
    return not any(isinstance(x, Tracer) for x in jax.tree_util.tree_leaves(values))


def number(
    name: str,
    value: Listed,
    low: float = -np.inf,
    high: float = np.inf,
    *,
    above: bool = False,
    endless: bool = False,
) -> None:
    """Refuse anything but a number, or an array of numbers, from low to high.

    Args:
        name: of the argument, for the message.
        value: the number or array; a traced one passes, for it has no value yet.
        low: least value.
        high: greatest value.
        above: refuse low itself too.
        endless: accept infinity.

    Raises:
        ValueError: the value is out of its range or not a number.
    """
    if not known(value):
        return
    x = np.asarray(value, float)
    inside = (x > low if above else x >= low) & (x <= high) & (endless | np.isfinite(x))
    if not np.all(inside):
        bounds = f" {'above' if above else 'from'} {low:g}" if np.isfinite(low) else ""
        bounds += f" to {high:g}" if np.isfinite(high) else ""
        finite = "" if endless else "finite "
        raise ValueError(f"{name} must be a {finite}number{bounds}, got {value}")


def vector(name: str, value: Listed, width: int, **bounds: Any) -> jax.Array:
    """A number or ``width`` of them, checked as `number` does, as a vector.

    Raises:
        ValueError: the shape is wrong, or a value is out of range.
    """
    x = jnp.asarray(value, float)
    if x.shape not in ((), (width,)):
        raise ValueError(f"{name} must be a number or of shape ({width},), got shape {x.shape}")
    number(name, value, **bounds)
    return jnp.broadcast_to(x, (width,))


def count_of(name: str, value: int) -> int:
    """A number of samples, at least one.

    Raises:
        ValueError: it is less than one.
    """
    require(value >= 1, f"{name} is {value}; at least one is wanted")
    return value


def rows(name: str, value: Listed, *shape: int) -> jax.Array:
    """An array of the shape that the other arguments imply.

    Raises:
        ValueError: the shape is another.
    """
    x = jnp.asarray(value, float)
    require(x.shape == shape, f"{name} must have shape {shape}", x.shape)
    return x


def unit_quaternion(name: str, value: Listed) -> jax.Array:
    """A quaternion (4,) of unit length to 1e-3, normalised.

    Raises:
        ValueError: the shape or the length is wrong.
    """
    q = rows(name, value, 4)
    number(f"{name} must be a unit quaternion: its length", jnp.sqrt(q @ q), 0.999, 1.001)
    return normalise(q)


def presence(present: Listed) -> jax.Array:
    """Check the (E,) bool mask of the epochs at which there is a sample.

    Raises:
        ValueError: not a list, or an empty one.
    """
    there = jnp.asarray(present, bool)
    if there.ndim != 1 or len(there) < 1:
        raise ValueError(f"present must have shape (E,), E at least one, got {there.shape}")
    return there
