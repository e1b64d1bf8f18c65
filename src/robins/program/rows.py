"""Calls that compute entry by entry, such as `jax.random.normal`, as rounds over their first axis.

A large array of random numbers is one equation of a jaxpr. Here it is a row of it, made in each
round: the generator is told the number of an entry, so that all bits are those of the whole array.
"""

from __future__ import annotations

from typing import Any

import jax
import numpy as np
from jax.extend import core as jex

from robins.program.kinds import kind_of
from robins.program.lanes import Rounds
from robins.program.nodes import Graph, Node
from robins.program.primitives.random import bits_of
from robins.program.refusal import ProgramError
from robins.program.primitives.control import called
from robins.program.trace import RULES, Leaf, Nodes, Program, Walk

WIDEST = 64  # entries of a row
ENTRYWISE = {
    *("add", "sub", "mul", "div", "neg", "max", "min", "abs", "and", "or", "xor", "not", "sqrt"),
    *("shift_right_logical", "shift_left", "convert_element_type", "bitcast_convert_type"),
    *("erf_inv", "select_n", "lt", "le", "gt", "ge", "eq", "ne", "floor", "log", "log1p", "exp"),
    *("random_fold_in", "clamp", "integer_pow", "square", "cos", "sin"),
}


def draws(equation: Any) -> int:
    """How many random numbers a call makes in one array, 0 if it does not."""
    inner = called(equation)
    if inner is None or len(equation.outvars) != 1:
        return 0
    shape = equation.outvars[0].aval.shape
    drawn = any(e.primitive.name == "random_bits" or draws(e) for e in inner.jaxpr.eqns)
    return int(np.prod(shape)) if drawn and shape and np.prod(shape[1:]) <= WIDEST else 0


def of_call(equation: Any) -> Rounds:
    """A call that makes one array, entry by entry, as rounds over its first axis.

    Raises:
        ProgramError: it does something else than that.
        BuildError: there is no compiler, or it refuses the program.
    """
    length = equation.outvars[0].aval.shape[0]
    graph = Graph()
    walk = Walk(graph)
    inputs, args, along = [_counter()], [], []
    index = graph.input(0, "whole")
    counted = {"real": 0, "other": 1}
    order = order_of(equation)
    nodes: dict[Any, Nodes] = {}
    for k in order:
        v = equation.invars[k]
        shape = v.aval.shape[1:] if goes_along(v, length) else v.aval.shape
        kind = kind_of(v.aval.dtype)
        pool = "real" if kind == "real" else "other"
        size = int(np.prod(shape))
        ids = [graph.input(counted[pool] + i, kind) for i in range(size)]
        counted[pool] += size
        nodes[k] = np.array(ids, dtype=np.int64).reshape(shape)
        inputs.append(Leaf(shape, v.aval.dtype, kind, f"arguments[{k}]"))
    args = [
        walk.constants(v.val) if isinstance(v, jex.Literal) else nodes[k]
        for k, v in enumerate(equation.invars)
    ]
    along = [not isinstance(v, jex.Literal) and goes_along(v, length) for v in equation.invars]
    inner = called(equation)
    (made,), (is_row,) = _Row(walk, length, index).walked(inner, args, along)
    aval = equation.outvars[0].aval
    if not is_row or made.shape != aval.shape[1:]:
        raise ProgramError("an array is not made entry by entry")
    after = graph.apply("add", index, graph.constant(1, "whole"))
    results = [_counter(), Leaf(aval.shape[1:], aval.dtype, kind_of(aval.dtype), "results[0]")]
    stays = sum(not along[k] for k in order)
    program = Program(graph, inputs, [np.array(after), made], results, (None, None))
    return Rounds(program, length, 1, stays)


def goes_along(v: Any, length: int) -> bool:
    """Whether an argument has a row for each round."""
    return bool(v.aval.shape) and v.aval.shape[0] == length


def order_of(equation: Any) -> list[int]:
    """The arguments that are no literals, those that stay before those that go along."""
    length = equation.outvars[0].aval.shape[0]
    free = [k for k, v in enumerate(equation.invars) if not isinstance(v, jex.Literal)]
    return sorted(free, key=lambda k: goes_along(equation.invars[k], length))


def _counter() -> Leaf:
    return Leaf((), np.dtype(np.int64), "whole", "round")


class _Row:
    """A walk in which arrays with the first axis are rows."""

    def __init__(self, walk: Walk, length: int, index: Node):
        self.walk, self.length, self.index = walk, length, index

    def walked(
        self, closed: Any, args: list[Nodes], along: list[bool]
    ) -> tuple[list[Nodes], list[bool]]:
        """What a jaxpr makes, and which of it are rows."""
        jaxpr = closed.jaxpr
        values = dict(zip(jaxpr.invars, zip(args, along, strict=True), strict=True))
        values.update(
            (v, (self.walk.constants(c), False))
            for v, c in zip(jaxpr.constvars, closed.consts, strict=True)
        )

        def read(v: Any) -> tuple[Nodes, bool]:
            if isinstance(v, jex.Literal):
                return self.walk.constants(v.val), False
            return values[v]

        for e in jaxpr.eqns:
            given = list(map(read, e.invars))
            arrays, rows = [a for a, _ in given], [r for _, r in given]
            inner = called(e)
            if inner is not None:
                made, of = self.walked(inner, arrays, rows)
            else:
                found, row = self._equation(e, arrays, rows)
                made, of = [found], [row]
            values.update(zip(e.outvars, zip(made, of, strict=True), strict=True))
        out = list(map(read, jaxpr.outvars))
        return [a for a, _ in out], [r for _, r in out]

    def _equation(self, e: Any, arrays: list[Nodes], rows: list[bool]) -> tuple[Nodes, bool]:
        name, shape = e.primitive.name, e.outvars[0].aval.shape
        starts = bool(shape) and shape[0] == self.length
        if name == "broadcast_in_dim" and starts and arrays[0].ndim == 0:
            return np.full(shape[1:], arrays[0]), True
        if name == "random_bits" and starts and not any(rows):
            dtype = e.outvars[0].aval.dtype
            return bits_of(self.walk, arrays[0], shape[1:], dtype, self.index), True
        if not any(rows):
            return self.walk.equation(e, *arrays)[0], False
        # What stays may have a first axis of one, along which it is the same.
        arrays = [
            a if row or a.ndim < len(shape) or a.shape[0] > 1 else a[0]
            for a, row in zip(arrays, rows, strict=True)
        ]
        entrywise = name in ENTRYWISE or name == "random_bits"
        if not entrywise or any(a.ndim >= max(len(shape), 1) for a in arrays):
            raise ProgramError(f"'{name}' does not compute entry by entry")
        return RULES[name](self.walk, e, *arrays), True
