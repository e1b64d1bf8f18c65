"""Primitives that reduce, cumulate or sort: sums, products, extremes."""

from __future__ import annotations

import functools

import numpy as np

from robins.program.kinds import Equation, kind_of
from robins.program.nodes import Node
from robins.program.walk import JaxprWriter, Nodes, rule

REDUCED = {
    "reduce_sum": ("add", 0),
    "reduce_prod": ("mul", 1),
    "reduce_max": ("max", -np.inf),
    "reduce_min": ("min", np.inf),
    "reduce_and": ("and", True),
    "reduce_or": ("or", False),
    "reduce_xor": ("xor", 0),
}


def _empty(walk: JaxprWriter, kind: str, number: float | int) -> Node:
    """Value of a reduction over no entries."""
    if kind == "whole" and not np.isfinite(number):
        number = np.iinfo(np.int64).min if number < 0 else np.iinfo(np.int64).max
    return walk.graph.constant(number, kind)


def fold(
    walk: JaxprWriter, op: str, number: float | int, a: Nodes, axes: tuple[int, ...], kind: str
) -> Nodes:
    """An array with some axes reduced, in the order of its entries."""
    kept = [axis for axis in range(a.ndim) if axis not in axes]
    rows = a.transpose([*kept, *axes]).reshape(*(a.shape[k] for k in kept), -1)
    if rows.shape[-1] == 0:
        return np.full(rows.shape[:-1], _empty(walk, kind, number))
    flat = rows.reshape(-1, rows.shape[-1]).tolist()
    join = functools.partial(walk.graph.apply, op)
    found = [functools.reduce(join, _finite(walk, row) if op == "and" else row) for row in flat]
    return np.array(found, dtype=np.int64).reshape(rows.shape[:-1])


def _finite(walk: JaxprWriter, row: list[Node]) -> list[Node]:
    """Flags to be joined by "and", their tests for finiteness replaced by one.

    x - x is zero of a finite number, NaN of any other: a sum of them is zero if all are finite, and
    costs two operations a number, none of them on flags.
    """
    graph = walk.graph
    checks = [n for n in row if graph.op[n] == "is_finite"]
    if len(checks) < 3:
        return row
    nothing = [graph.apply("sub", *2 * graph.args[n]) for n in checks]
    total = functools.reduce(functools.partial(graph.apply, "add"), nothing)
    one = graph.apply("eq", total, graph.constant(0, "real"))
    return [one, *(n for n in row if graph.op[n] != "is_finite")]


@rule(*REDUCED)
def _reduced(walk: JaxprWriter, equation: Equation, a: Nodes) -> Nodes:
    op, number = REDUCED[equation.primitive.name]
    kind = kind_of(equation.invars[0].aval.dtype)
    return fold(walk, op, number, a, tuple(map(int, equation.params["axes"])), kind)


CUMULATED = {"cumsum": "add", "cumprod": "mul", "cummax": "max", "cummin": "min"}


@rule(*CUMULATED)
def _cumulated(walk: JaxprWriter, equation: Equation, a: Nodes) -> Nodes:
    op, axis = CUMULATED[equation.primitive.name], equation.params["axis"]
    back = equation.params["reverse"]
    rows = np.moveaxis(np.flip(a, axis) if back else a, axis, 0)
    out = [np.asarray(row) for row in rows]
    for k in range(1, len(out)):
        out[k] = walk.apply(op, out[k - 1], out[k])
    found = np.moveaxis(np.stack(out), 0, axis) if out else a
    return np.flip(found, axis) if back else found


@rule("argmax", "argmin")
def _arg(walk: JaxprWriter, equation: Equation, a: Nodes) -> Nodes:
    """Index of the first extreme; a NaN is more extreme than any number."""
    graph, (axis,) = walk.graph, equation.params["axes"]
    most = equation.primitive.name == "argmax"

    def first(row: list[Node]) -> Node:
        best, at = row[0], graph.constant(0, "whole")
        for k, node in enumerate(row[1:], 1):
            more = graph.apply("lt", *((best, node) if most else (node, best)))
            if graph.kind[node] == "real":
                nan = graph.apply("ne", node, node)
                more = graph.apply("or", more, nan)
                more = graph.apply("and", more, graph.apply("eq", best, best))
            best = graph.select(more, node, best)
            at = graph.select(more, graph.constant(k, "whole"), at)
        return at

    rows = np.moveaxis(a, axis, -1)
    found = [first(row) for row in rows.reshape(-1, rows.shape[-1]).tolist()]
    return np.array(found, dtype=np.int64).reshape(rows.shape[:-1])


@rule("sort")
def _sort(walk: JaxprWriter, equation: Equation, *arrays: Nodes) -> list[Nodes]:
    """Stable bubble sort: n (n - 1) / 2 comparisons of neighbours, none of them a branch."""
    axis, keys = equation.params["dimension"], equation.params["num_keys"]
    graph = walk.graph
    rows = [[np.asarray(row) for row in np.moveaxis(a, axis, 0)] for a in arrays]

    def less(p: int, q: int) -> Nodes:
        """Flag of row p coming before row q."""
        found: Nodes | None = None
        for row in reversed(rows[:keys]):
            real = graph.kind[int(row[p].ravel()[0])] == "real"
            lower = walk.apply("lt_to" if real else "lt", row[p], row[q])
            if found is not None:
                same = walk.apply("eq", row[p], row[q])
                found = walk.apply("or", lower, walk.apply("and", same, found))
            else:
                found = lower
        assert found is not None
        return found

    if arrays[0].size == 0:
        return list(arrays)
    for last in range(len(rows[0]) - 1, 0, -1):
        for k in range(last):
            swap = less(k + 1, k)
            for row in rows:
                low, high = row[k], row[k + 1]
                row[k], row[k + 1] = (walk.select(swap, high, low), walk.select(swap, low, high))
    return [np.moveaxis(np.stack(row), 0, axis) for row in rows]
