"""Types of arrays and the kinds of scalars that hold their numbers."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Any

import jax
import numpy as np
from jax.extend import core as jex

from robins.program.refusal import ProgramError

if TYPE_CHECKING:  # to a checker, abstract values have neither shape nor type
    Equation = Variable = Any
else:
    Equation, Variable = jex.JaxprEqn, jex.Var | jex.Literal

KEY = "key<fry>"  # of Threefry 2x32, JAX's generator

KNOWN = {"f8": "real", "b1": "flag", "u4": "word", "u8": "word64"}


@lru_cache
def is_key(dtype: Any) -> bool:
    """True if a type is one of JAX's keys of random numbers."""
    return bool(jax.numpy.issubdtype(dtype, jax.dtypes.prng_key))


@lru_cache(maxsize=1024)  # a few types; where: the path of an argument
def kind_of(dtype: Any, where: str = "") -> str:
    """The kind of scalar that holds numbers of a type.

    Raises:
        ProgramError: no kind does: single precision, complex numbers, keys of another generator.
    """
    if is_key(dtype):
        if str(dtype) == KEY:
            return "word64"
        raise ProgramError(
            f"keys of type {dtype} have no place in a program", where, "use those of threefry2x32"
        )
    dtype = np.dtype(dtype)
    if (found := KNOWN.get(f"{dtype.kind}{dtype.itemsize}")) is not None:
        return found
    if dtype.kind == "i":
        return "whole"
    raise ProgramError(f"numbers of type {dtype} have no place in a program", where, "use float64")


def numbers_of(value: Any) -> np.ndarray:
    """NumPy array of an array; a key as one number, its first word in the upper half."""
    if not is_key(getattr(value, "dtype", np.float64)):
        return np.asarray(value)
    words = np.asarray(jax.random.key_data(value)).astype(np.uint64)
    return np.asarray(words[..., 0] << np.uint64(32) | words[..., 1])


def array_of(numbers: np.ndarray, dtype: Any) -> np.ndarray | jax.Array:
    """Array of a type from its numbers: the inverse of `numbers_of`."""
    if not is_key(dtype):
        return numbers.astype(dtype)
    words = numbers.astype(np.uint64)[..., None] >> np.array([32, 0], np.uint64)
    return jax.random.wrap_key_data(jax.numpy.asarray(words.astype(np.uint32)), impl="threefry2x32")
