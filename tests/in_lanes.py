"""A function of one run over many of them, by the interpreter, which compiles nothing.

In the function what is done at each epoch is a loop, `jax.lax.map`: written out it is a program as
long as the run.
"""

from collections.abc import Callable
from functools import cache
from typing import Any

import jax

from robins.campaign.machine import with_stack
from robins.program.interpreter import interpreted_rounds
from robins.program.stages import StagedFunction


def each(function: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """The function of a batch, whose leading axis is runs; traced once for each shape."""

    @cache
    def staged(tree, leaves):
        shapes = jax.tree.unflatten(tree, leaves)
        return StagedFunction(function, shapes, engine=interpreted_rounds)

    def of(batch):
        leaves, tree = jax.tree.flatten(batch)
        one = tuple(jax.ShapeDtypeStruct(x.shape[1:], x.dtype) for x in leaves)
        return with_stack(lambda: staged(tree, one)(batch))

    return of
