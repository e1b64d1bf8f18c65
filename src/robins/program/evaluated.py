"""A function computed once, without a compiler.

JAX compiles each operation on arrays of a new shape for some 20 ms, and the start of a filter is
dozens of them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import numpy as np
from jax.core import Tracer

from robins.program.nodes import Graph
from robins.program.refusal import ProgramError
from robins.program.trace import Walk

Data = Any  # a pytree of arrays
T = TypeVar("T")


def evaluated(function: Callable[..., T], *args: Data) -> T:
    """Return ``function(*args)``, computed by folding the constants of its program.

    Args:
        function: pure. One with a routine in it, such as eigenvalues, or with what has no place in
            a program is computed by JAX; so is any where JAX traces.
        args: as it takes.
    """
    import robins.program.primitives  # noqa: F401

    given = jax.tree_util.tree_leaves(args)
    if any(isinstance(a, Tracer) for a in given):
        return function(*args)
    jaxpr, shapes = jax.make_jaxpr(function, return_shape=True)(*args)
    walk = Walk(Graph())
    try:
        found = walk.closed(jaxpr, *[walk.constants(np.asarray(a)) for a in given])
        known = list(map(walk.known, found))
    except ProgramError:
        return function(*args)
    if any(x is None for x in known):
        return function(*args)
    leaves, tree = jax.tree_util.tree_flatten(shapes)
    arrays = [np.asarray(x, s.dtype) for x, s in zip(known, leaves, strict=True)]
    return jax.tree_util.tree_unflatten(tree, jax.device_put(arrays))
