"""Map of a function over the rows of arrays: a batch for JAX, a loop in a program.

`jax.vmap` does not keep the function of one row, so a program of scalars (`robins.program`) would
unroll all rows: a bank of nine modes as nine filters. The JAX primitive ``each_row`` keeps it. JAX
compiles, batches and differentiates the primitive as `jax.vmap` of the function.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, TypeVar

import jax
from jax.core import ShapedArray
from jax.extend import core as jex
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array, ArrayLike

from robins.errors import require

T = TypeVar("T")
Tree = Any  # a pytree of arrays
Param = Any  # a parameter of the primitive

_each_row = jex.Primitive("each_row")
_each_row.multiple_results = True


def each_row(function: Callable[..., T], *args: Tree) -> T:
    """Return ``jax.vmap(function)(*args)``.

    Args:
        function: function of one row of each argument; it may close over other values.
        args: pytrees of arrays with an equal leading axis.

    Raises:
        ValueError: there is no array, or their leading axes differ.
    """
    leaves, tree = jax.tree_util.tree_flatten(args)
    rows = list(map(jax.typeof, leaves))
    counts = {a.shape[:1] for a in rows}
    require(len(counts) == 1 and counts != {()}, "arrays must have equal numbers of rows", counts)
    rows = [jax.ShapeDtypeStruct(a.shape[1:], a.dtype, weak_type=a.weak_type) for a in rows]

    def flat(*row: Array) -> T:
        return function(*jax.tree_util.tree_unflatten(tree, row))

    closed, shapes = jax.make_jaxpr(flat, return_shape=True)(*rows)
    # Values that the function closes over are further arguments, the same for each row.
    inner = closed.jaxpr
    jaxpr = jex.Jaxpr(
        [],
        [*inner.constvars, *inner.invars],
        inner.outvars,
        inner.eqns,
        inner.effects,
        debug_info=jex.DebugInfo("each_row", "row", None, None),
    )
    found = _each_row.bind(
        *closed.consts,
        *leaves,
        jaxpr=jex.ClosedJaxpr(jaxpr, ()),
        shared=len(closed.consts),
        count=leaves[0].shape[0],
    )
    return jax.tree_util.tree_unflatten(jax.tree_util.tree_structure(shapes), found)


def _batched(*args: ArrayLike, jaxpr: jex.ClosedJaxpr, shared: int, count: int) -> list[Array]:
    axes = [None] * shared + [0] * (len(args) - shared)
    return jax.vmap(jex.jaxpr_as_fun(jaxpr), axes, axis_size=count)(*args)


@_each_row.def_abstract_eval
def _shapes(
    *args: ShapedArray, jaxpr: jex.ClosedJaxpr, shared: int, count: int
) -> list[ShapedArray]:
    return [aval.update(shape=(count, *aval.shape)) for aval in jaxpr.out_avals]


def _by_vmap(
    args: Sequence[ArrayLike], dims: Sequence[int | None], **params: Param
) -> tuple[list[Array], list[int]]:
    found = jax.vmap(partial(_batched, **params), dims)(*args)
    return found, [0] * len(found)


def _jvp(
    primals: Sequence[ArrayLike], tangents: Sequence[ArrayLike | ad.Zero], **params: Param
) -> tuple[list[Array], list[Array | ad.Zero]]:
    known = [ad.instantiate_zeros(t) for t in tangents]
    found, slopes = jax.jvp(partial(_batched, **params), tuple(primals), tuple(known))
    whole = jax.dtypes.float0  # tangent type of integers and booleans
    zeros = [ad.Zero(ShapedArray(s.shape, whole)) if s.dtype == whole else s for s in slopes]
    return found, zeros


_each_row.def_impl(_batched)
mlir.register_lowering(_each_row, mlir.lower_fun(_batched, multiple_results=True))
batching.primitive_batchers[_each_row] = _by_vmap
ad.primitive_jvps[_each_row] = _jvp
