"""Evaluation of a function that is called once, without a compiler.

JAX takes some 20 ms to compile each operation on arrays of a new shape, and the initialisation of a
filter has dozens of them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import numpy as np
from jax.core import Tracer

from robins.program.nodes import Graph
from robins.program.primitives.control import size_of
from robins.program.refusal import ProgramError
from robins.program.walk import JaxprWriter

Data = Any  # a pytree of arrays of numbers
T = TypeVar("T")
MOST = 20_000  # operations, folded in 0.2 s


def evaluated(function: Callable[..., T], *args: Data) -> T:
    """Return ``function(*args)``, computed by folding the constants of its program.

    JAX computes it where the arguments are traced, and functions that cannot be traced or folded:
    with too many operations, with routines such as eigenvalues, or with primitives that have no
    place in a program.

    Args:
        function: pure. It is traced, so it cannot check values: refuse bad numbers before. A real
            that it converts to a whole number must be in the range of that type.
        args: arguments of the function.
    """
    given = jax.tree_util.tree_leaves(args)
    if any(isinstance(a, Tracer) for a in given):
        return function(*args)
    try:
        jaxpr, shapes = jax.make_jaxpr(function, return_shape=True)(*args)
        walk = JaxprWriter(Graph())
        if size_of(jaxpr.jaxpr) > MOST:
            return function(*args)
        found = walk.closed(jaxpr, *[walk.constants(np.asarray(a)) for a in given])
    except (ProgramError, TypeError):  # JAX raises TypeError where traced numbers are read
        return function(*args)
    known = list(map(walk.known, found))
    if any(x is None for x in known):
        return function(*args)
    leaves, tree = jax.tree_util.tree_flatten(shapes)
    arrays = [np.asarray(x, s.dtype) for x, s in zip(known, leaves, strict=True)]
    return jax.tree_util.tree_unflatten(tree, jax.device_put(arrays))
