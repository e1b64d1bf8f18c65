"""Primitives that read and write at indices, known or not.

Where an index is known, nodes are moved. Where it is not, each entry is chosen among all
candidates: few by a chain of selects, many by an index into an array of C.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from robins.program.kinds import Equation
from robins.program.nodes import Node
from robins.program.walk import JaxprWriter, Nodes, rule

SIZES = tuple[int, ...]
# Axes of an array that index vectors address; its batch axes, and those of the indices.
Axes = tuple[Sequence[Any], Sequence[Any], Sequence[Any]]


def _clamped(walk: JaxprWriter, index: Node, most: int) -> Node:
    """Index clamped between 0 and its largest value."""
    graph = walk.graph
    kind = graph.kind[index]
    if most == 0:
        return graph.constant(0, kind)
    lowest = graph.apply("max", index, graph.constant(0, kind))
    return graph.apply("min", lowest, graph.constant(most, kind))


def window(walk: JaxprWriter, a: Nodes, start: list[Node], sizes: SIZES) -> Nodes:
    """Window of an array, shifted inside where it would reach beyond an end."""
    graph = walk.graph
    for axis, (index, size) in enumerate(zip(start, sizes, strict=True)):
        most = a.shape[axis] - size
        at = _clamped(walk, index, most)
        views = [np.take(a, range(k, k + size), axis) for k in range(most + 1)]
        if (value := graph.known(at)) is not None:
            a = views[int(value)]
        elif views[0].size == 0:
            a = views[0]
        else:
            a = walk.each(lambda *nodes, at=at: graph.pick(nodes, at), *views)
    return a


def _inside(walk: JaxprWriter, start: list[Node], shape: SIZES, sizes: SIZES) -> Node:
    """Flag of a window that lies inside an array."""
    graph = walk.graph
    found = graph.constant(True, "flag")
    for index, n, size in zip(start, shape, sizes, strict=True):
        kind = graph.kind[index]
        low = graph.apply("le", graph.constant(0, kind), index)
        high = graph.apply("le", index, graph.constant(max(0, n - size), kind))
        found = graph.apply("and", found, graph.apply("and", low, high))
        if size > n:
            return graph.constant(False, "flag")
    return found


def _places(
    walk: JaxprWriter, start: list[Node], shape: SIZES, sizes: SIZES
) -> Iterator[tuple[tuple[slice, ...], Node]]:
    """Every window that a start may mean, with the flag that it does."""
    graph = walk.graph
    ranges = []
    for index, n, size in zip(start, shape, sizes, strict=True):
        value = graph.known(index)
        ranges.append(range(n - size + 1) if value is None else [int(value)])
    for place in itertools.product(*ranges):
        here = graph.constant(True, "flag")
        for index, k in zip(start, place, strict=True):
            same = graph.apply("eq", index, graph.constant(k, graph.kind[index]))
            here = graph.apply("and", here, same)
        yield tuple(slice(k, k + size) for k, size in zip(place, sizes, strict=True)), here


@rule("dynamic_slice")
def _dynamic_slice(walk: JaxprWriter, equation: Equation, a: Nodes, *start: Nodes) -> Nodes:
    return window(walk, a, [s.item() for s in start], tuple(equation.params["slice_sizes"]))


@rule("dynamic_update_slice")
def _dynamic_update(
    walk: JaxprWriter, equation: Equation, a: Nodes, new: Nodes, *start: Nodes
) -> Nodes:
    out = a.copy()
    most = [n - size for n, size in zip(a.shape, new.shape, strict=True)]
    inside = [_clamped(walk, s.item(), m) for s, m in zip(start, most, strict=True)]
    if new.size:
        for place, here in _places(walk, inside, a.shape, new.shape):
            out[place] = walk.select(np.full(new.shape, here), new, out[place])
    return out


def _drops(equation: Equation) -> bool:
    """True if a window outside is left out, not moved inside."""
    return getattr(equation.params["mode"], "name", "") == "FILL_OR_DROP"


def _starts(
    walk: JaxprWriter, indices: Nodes, batch: tuple[int, ...], rank: int, of: Axes
) -> list[Node]:
    """Start of the window of one index vector, in all axes of the array."""
    axes, along, by = of
    start = [walk.graph.constant(0, "whole")] * rank
    for k, axis in enumerate(axes):
        start[axis] = walk.graph.convert(indices[(*batch, k)].item(), "whole")
    for axis, dim in zip(along, by, strict=True):
        start[axis] = walk.graph.constant(batch[dim], "whole")
    return start


def _windows(
    shape: SIZES, sizes: SIZES, indices: np.ndarray, of: Axes
) -> tuple[np.ndarray, np.ndarray]:
    """Places of the entries of windows (batch..., *sizes) in an array, for indices that are known.

    Windows are shifted inside; the mask (batch...) marks those that lay inside before.
    """
    axes, along, by = of
    start = np.zeros((*indices.shape[:-1], len(shape)), np.int64)
    start[..., list(axes)] = indices
    for axis, dim in zip(along, by, strict=True):
        lengths = [-1 if k == dim else 1 for k in range(indices.ndim - 1)]
        start[..., axis] = np.arange(indices.shape[dim]).reshape(lengths)
    most = np.subtract(shape, sizes)
    inside = np.asarray(np.all((start >= 0) & (start <= most), axis=-1))
    strides = np.cumprod([1, *shape[:0:-1]])[::-1]
    begin = np.clip(start, 0, most) @ strides
    within = np.tensordot(strides, np.indices(sizes), 1)
    return begin.reshape(*begin.shape, *[1] * len(sizes)) + within, inside


def _gather_windows(equation: Equation) -> tuple[SIZES, SIZES, Axes]:
    """Sizes of the windows of a gather, those that are left in the result, and its axes."""
    d = equation.params["dimension_numbers"]
    sizes = tuple(int(n) for n in equation.params["slice_sizes"])
    gone = {*d.collapsed_slice_dims, *d.operand_batching_dims}
    kept = tuple(n for axis, n in enumerate(sizes) if axis not in gone)
    return sizes, kept, (d.start_index_map, d.operand_batching_dims, d.start_indices_batching_dims)


def _window_axes_moved(equation: Equation, found: np.ndarray) -> np.ndarray:
    """Move the last axes, of a window, to where the primitive puts them."""
    offsets = [int(k) for k in equation.params["dimension_numbers"].offset_dims]
    others = [k for k in range(found.ndim) if k not in offsets]
    return np.moveaxis(found, range(found.ndim), [*others, *offsets])


def gathered(equation: Equation, indices: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Places that a gather reads at known indices; -1 for the fill value outside."""
    sizes, kept, axes = _gather_windows(equation)
    found, inside = _windows(places.shape, sizes, indices, axes)
    if _drops(equation):
        found = np.where(inside.reshape(*inside.shape, *[1] * len(sizes)), found, -1)
    return _window_axes_moved(equation, found.reshape(*inside.shape, *kept))


def _updates(equation: Equation, rank: int, new: Nodes) -> tuple[Nodes, SIZES, Axes]:
    """Numbers to be scattered, window axes last; the sizes of a window, and its axes."""
    d = equation.params["dimension_numbers"]
    windows = [int(k) for k in d.update_window_dims]
    rows = new.transpose([*(k for k in range(new.ndim) if k not in windows), *windows])
    gone = {*d.inserted_window_dims, *d.operand_batching_dims}
    kept = iter(new.shape[k] for k in windows)
    sizes = tuple(1 if axis in gone else next(kept) for axis in range(rank))
    axes = d.scatter_dims_to_operand_dims, d.operand_batching_dims, d.scatter_indices_batching_dims
    return rows, sizes, axes


def scattered(
    equation: Equation, indices: np.ndarray, places: np.ndarray, new: np.ndarray
) -> np.ndarray:
    """Places of an array after a scatter of other places at known indices."""
    rows, sizes, axes = _updates(equation, places.ndim, new)
    at, inside = _windows(places.shape, sizes, indices, axes)
    rows = rows.reshape(at.shape)
    if _drops(equation):
        at, rows = at[inside], rows[inside]
    found = places.copy()
    found.reshape(-1)[at.ravel()] = rows.ravel()
    return found


@rule("gather")
def _gather(walk: JaxprWriter, equation: Equation, a: Nodes, indices: Nodes) -> Nodes:
    known = walk.known(indices)
    if known is not None:
        at = gathered(equation, known, np.arange(a.size).reshape(a.shape))
        return np.append(a, walk.constants(filling(equation)))[at]
    sizes, kept, axes = _gather_windows(equation)
    batches = indices.shape[:-1]
    found = np.zeros((*batches, *kept), dtype=np.int64)
    outside = walk.constants(filling(equation)).item()
    for batch in np.ndindex(*batches):
        start = _starts(walk, indices, batch, a.ndim, axes)
        one = window(walk, a, start, sizes).reshape(kept)
        if _drops(equation):
            inside = _inside(walk, start, a.shape, sizes)
            one = walk.select(np.full(kept, inside), one, np.full(kept, outside))
        found[batch] = one
    return _window_axes_moved(equation, found)


def filling(equation: Equation) -> np.ndarray:
    """The number that a gather gives outside of its array."""
    dtype, value = np.dtype(equation.outvars[0].aval.dtype), equation.params["fill_value"]
    if value is None:
        value = {"f": np.nan, "b": True}.get(dtype.kind)
    if value is None:
        value = np.iinfo(dtype).min if dtype.kind == "i" else np.iinfo(dtype).max
    return np.asarray(value, dtype)


JOINED = {
    "scatter": None,
    "scatter-add": "add",
    "scatter-sub": "sub",
    "scatter-mul": "mul",
    "scatter-min": "min",
    "scatter-max": "max",
}


@rule(*JOINED)
def _scatter(walk: JaxprWriter, equation: Equation, a: Nodes, indices: Nodes, new: Nodes) -> Nodes:
    join = JOINED[equation.primitive.name]
    rows, sizes, axes = _updates(equation, a.ndim, new)
    out = a.copy()
    for batch in np.ndindex(*indices.shape[:-1]):
        start = _starts(walk, indices, batch, a.ndim, axes)
        if not _drops(equation):
            most = [n - size for n, size in zip(a.shape, sizes, strict=True)]
            start = [_clamped(walk, s, m) for s, m in zip(start, most, strict=True)]
        elif walk.graph.known(_inside(walk, start, a.shape, sizes)) is np.False_:
            continue
        update = rows[batch].reshape(sizes)
        for place, here in _places(walk, start, a.shape, sizes):
            joined = update if join is None else walk.apply(join, out[place], update)
            out[place] = walk.select(np.full(sizes, here), joined, out[place])
    return out
