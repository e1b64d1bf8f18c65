"""NumPy or JAX, by what is given: arithmetic is written once, and needs no JAX for NumPy arrays."""

import sys
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, Shaped

from robins import _float64  # noqa: F401  # pyright: ignore[reportUnusedImport]  for its effect

# For annotations: an array of NumPy or JAX, where the result is of the same library; one of the
# shape "*b" of leading axes; either kind of array, or a number.
Real = Any
Each = Float[Real, "*b"]
if TYPE_CHECKING:
    from jax.typing import ArrayLike as ArrayLike
else:
    ArrayLike = Shaped[Real, "..."] | float | int


def library(*given: Real) -> ModuleType:
    """NumPy if all are arrays of NumPy, else `jax.numpy`, imported when it is first needed."""
    if all(isinstance(one, np.ndarray) for one in given):
        return np
    import jax.numpy as jnp

    return jnp


def is_traced(one: Real) -> bool:
    """True for an array that JAX traces, of which no number is known."""
    core = sys.modules.get("jax.core")
    return core is not None and isinstance(one, core.Tracer)
