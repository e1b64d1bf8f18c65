"""A walk through jaxprs with arrays of nodes for values, and the table of the primitives' rules.

The rule of a primitive takes arrays of nodes and gives arrays of nodes. A rule that only moves data
moves nodes, and so leaves no code. The rules are registered by `robins.program.primitives`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any, NamedTuple

import numpy as np
from jax.extend import core as jex
from jax.typing import ArrayLike

from robins import _float64  # noqa: F401
from robins.program.calls import Calls, results_of
from robins.program.kinds import Equation, Variable, kind_of, numbers_of
from robins.program.nodes import Graph, Node
from robins.program.refusal import ProgramError
from robins.program.refused import REFUSED

UNKNOWN = "this version of robins does not know it"

# Primitives whose results may overflow a type of whole numbers of fewer than 64 bits.
OVERFLOWING = {
    *("add", "sub", "mul", "neg", "abs", "shift_left", "integer_pow", "square", "dot_general"),
    *("reduce_sum", "reduce_prod", "cumsum", "cumprod"),
}

Nodes = np.ndarray  # of nodes, in the shape of the array that they stand for


def flat(arrays: Iterable[Nodes]) -> list[Node]:
    """List of the nodes of arrays, one after the other."""
    return [n for a in arrays for n in a.ravel().tolist()]


def shaped(nodes: Sequence[Node], shapes: Iterable[tuple[int, ...]]) -> list[Nodes]:
    """Split a list of nodes into arrays of these shapes."""
    out, at = [], 0
    for shape in shapes:
        end = at + int(np.prod(shape))
        out.append(np.array(nodes[at:end], dtype=np.int64).reshape(shape))
        at = end
    return out


Rule = Callable[..., Any]  # (walk, equation, *arrays) -> array, or a list of them
RULES: dict[str, Rule] = {}


def rule(*names: str) -> Callable[[Rule], Rule]:
    """Make a function the rule of some primitives."""

    def register(function: Rule) -> Rule:
        RULES.update(dict.fromkeys(names, function))
        return function

    return register


@dataclass(frozen=True)
class Leaf:
    """An array among the arguments or results: shape, type, kind, and path there."""

    shape: tuple[int, ...]
    dtype: Any
    kind: str
    path: str


class MemorySlot(NamedTuple):
    """Place of an array in the memory of the reals, or in that of all else."""

    is_real: bool
    first: int
    last: int
    shape: tuple[int, ...]
    dtype: Any

    def view(self, reals: np.ndarray, others: np.ndarray) -> np.ndarray:
        """View of the array in memory, writable."""
        pool = reals if self.is_real else others
        return pool[self.first : self.last].reshape(self.shape)


def slots(
    leaves: Sequence[Leaf], counted: tuple[int, int] = (0, 0)
) -> tuple[list[MemorySlot], int, int]:
    """The slots of arrays one after the other, and how many reals and others there are then.

    Args:
        leaves: the arrays.
        counted: reals and others before them.
    """
    reals, others = counted
    found = []
    for leaf in leaves:
        size, real = int(np.prod(leaf.shape)), leaf.kind == "real"
        at = reals if real else others
        found.append(MemorySlot(real, at, at + size, leaf.shape, leaf.dtype))
        reals, others = (reals + size, others) if real else (reals, others + size)
    return found, reals, others


def counts(leaves: Sequence[Leaf]) -> tuple[int, int]:
    """Number of reals, and of all other numbers, of some arrays."""
    return slots(leaves)[1:]


def lengths(leaves: Sequence[Leaf]) -> tuple[int, int]:
    """Lengths of the two C arrays (reals, others), at least 1 each."""
    reals, others = counts(leaves)
    return max(reals, 1), max(others, 1)


@dataclass(frozen=True)
class Program:
    """Program of scalars of a function.

    Attributes:
        graph: its nodes.
        inputs: arrays in the order of the function's leaves; ``input`` nodes number their entries,
            reals and all other kinds separately.
        outputs: arrays of nodes of the results.
        results: their shapes and types.
        structure: pytrees of the arguments and of the results.
        zeros: by index of an argument, mask of the entries that are assumed zero.
    """

    graph: Graph
    inputs: list[Leaf]
    outputs: list[Nodes]
    results: list[Leaf]
    structure: tuple[Any, Any]
    zeros: dict[int, np.ndarray] = field(default_factory=dict)

    @cached_property
    def live(self) -> list[Node]:
        """The nodes that its results need, in the order of computation."""
        return self.graph.live(flat(self.outputs))


def line_of(equation: Equation) -> str:
    """File and line of the user's code that an equation comes from."""
    from jax._src import source_info_util

    frame = source_info_util.user_frame(equation.source_info.traceback)
    return f"{frame.file_name}:{frame.start_line}" if frame else ""


class JaxprWriter:
    """A walk through jaxprs that writes into one graph.

    Attributes:
        graph: of nodes.
        inputs: arguments so far; reals count by themselves, all else too.
        unroll: as in `trace`.
        calls: those that earlier walks wrote with the same `unroll`.
    """

    def __init__(self, graph: Graph, unroll: int | None = None, calls: Calls | None = None):
        self.graph, self.unroll = graph, unroll
        self._calls: Calls = {} if calls is None else calls
        self._constants: dict[int, tuple[Any, Nodes]] = {}  # by id; holds the value too
        self.inputs: list[Leaf] = []

    def taken(
        self, shape: tuple[int, ...], dtype: Any, path: str = "", zero: np.ndarray | None = None
    ) -> Nodes:
        """Nodes of a further argument; zero: mask of its entries that are known to be zero."""
        leaf = Leaf(shape, dtype, kind_of(dtype, path), path or f"arguments[{len(self.inputs)}]")
        count = counts(self.inputs)[leaf.kind != "real"]
        self.inputs.append(leaf)
        ids = [self.graph.input(count + k, leaf.kind) for k in range(int(np.prod(shape)))]
        nodes = np.array(ids, dtype=np.int64).reshape(shape)
        return nodes if zero is None else np.where(zero, self.graph.constant(0, "real"), nodes)

    def stays_whole(self, size: int) -> bool:
        """True if so many scalar operations are a loop or a call, and not written out."""
        return self.unroll is not None and size > self.unroll

    def constants(self, value: ArrayLike) -> Nodes:
        """Nodes of known numbers."""
        if (found := self._constants.get(id(value))) is None:
            array = numbers_of(value)
            kind = kind_of(array.dtype)
            nodes = self.each(lambda x: self.graph.constant(x, kind), array)
            found = self._constants[id(value)] = value, nodes
        return found[1]

    def each(self, function: Callable[..., Node], *arrays: np.ndarray) -> Nodes:
        """Apply a function of nodes to all entries of arrays, broadcast to one shape."""
        shape = arrays[0].shape
        if any(a.shape != shape for a in arrays):
            arrays = tuple(np.broadcast_arrays(*arrays))
            shape = arrays[0].shape
        if not shape:
            return np.array(function(*[a.item() for a in arrays]), dtype=np.int64)
        flat = [a.ravel().tolist() for a in arrays]
        return np.array(list(map(function, *flat)), dtype=np.int64).reshape(shape)

    def apply(self, op: str, *arrays: Nodes) -> Nodes:
        """An operation on all entries."""
        return self.each(partial(self.graph.apply, op), *arrays)

    def wrapped(self, nodes: Nodes, dtype: Any) -> Nodes:
        """Wrap whole numbers into a type of fewer than 64 bits; leave all others as they are."""
        bits = 8 * np.dtype(dtype).itemsize
        if np.dtype(dtype).kind != "i" or bits == 64:
            return nodes
        half = self.graph.constant(2 ** (bits - 1), "whole")
        return self.each(lambda n: self.graph.apply("wrap", n, half), nodes)

    def select(self, condition: Nodes, new: Nodes, old: Nodes) -> Nodes:
        """``new`` where a condition holds, else ``old``."""
        return self.each(self.graph.select, condition, new, old)

    def known(self, nodes: Nodes) -> np.ndarray | None:
        """The numbers of an array, if all are known."""
        values = [self.graph.known(n) for n in nodes.ravel().tolist()]
        if any(v is None for v in values):
            return None
        return np.array(values).reshape(nodes.shape)

    def closed(self, jaxpr: jex.ClosedJaxpr, *args: Nodes) -> list[Nodes]:
        """Results of a closed jaxpr on arrays of nodes."""
        return self.open(jaxpr.jaxpr, [self.constants(c) for c in jaxpr.consts], args)

    def open(self, jaxpr: jex.Jaxpr, consts: Sequence[Nodes], args: Sequence[Nodes]) -> list[Nodes]:
        """Results of a jaxpr on arrays of nodes."""
        given = [*consts, *args]
        return results_of(
            self._calls, self.graph, jaxpr, given, lambda: self._written(jaxpr, given)
        )

    def _written(self, jaxpr: jex.Jaxpr, given: Sequence[Nodes]) -> list[Nodes]:
        values = dict(zip([*jaxpr.constvars, *jaxpr.invars], given, strict=True))

        def read(v: Variable) -> Nodes:
            return self.constants(v.val) if isinstance(v, jex.Literal) else values[v]

        for equation in jaxpr.eqns:
            found = self.equation(equation, *map(read, equation.invars))
            values.update(zip(equation.outvars, found, strict=True))
        return [read(v) for v in jaxpr.outvars]

    def equation(self, equation: Equation, *args: Nodes) -> list[Nodes]:
        """Results of an equation on arrays of nodes.

        Raises:
            ProgramError: there is no rule for it, or not for this use of it.
        """
        name = equation.primitive.name
        if name not in RULES:
            what = f"'{name}' has no place in a program of scalars: {REFUSED.get(name, UNKNOWN)}"
            fix = "write it with other operations, or run this filter by JAX"
            raise ProgramError(what, line_of(equation), fix)
        try:
            found = RULES[name](self, equation, *args)
        except ProgramError as error:
            if error.where:
                raise
            raise ProgramError(error.what, line_of(equation), error.fix) from None
        found = list(found) if isinstance(found, (list, tuple)) else [found]
        if name in OVERFLOWING:
            found = [self.wrapped(found[0], equation.outvars[0].aval.dtype)]
        return found
