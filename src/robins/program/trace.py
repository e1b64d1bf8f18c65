"""Tracing of a function of JAX to a program: its jaxpr, walked with arrays of nodes for values.

Each primitive has a rule, in `robins.program.primitives`: arrays of nodes in, arrays of nodes out.
A rule that only moves data moves nodes, and so leaves no code.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any

import jax
import numpy as np
from jax.extend import core as jex
from jax.typing import ArrayLike
from jaxtyping import PyTree

from robins import _float64  # noqa: F401
from robins.program.calls import Calls, forget, results_of
from robins.program.kinds import Equation, Variable, kind_of, numbers_of
from robins.program.nodes import Graph, Node
from robins.program.refusal import ProgramError
from robins.program.refused import REFUSED

# Scalar operations up to which a loop or a factorisation is written out: all of a filter of nine
# states, not the thirty samples of an IMU between two fixes.
UNROLL = 10_000

UNKNOWN = "this version of robins does not know it"

# What may leave the range of its type, with whole numbers of fewer than 64 bits.
OVERFLOWING = {
    *("add", "sub", "mul", "neg", "abs", "shift_left", "integer_pow", "square", "dot_general"),
    *("reduce_sum", "reduce_prod", "cumsum", "cumprod"),
}

Nodes = np.ndarray  # of nodes, in the shape of the array that they stand for

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
    """An array among the arguments or results: what it is made of, and where in them it lies."""

    shape: tuple[int, ...]
    dtype: Any
    kind: str
    path: str


def counts(leaves: Sequence[Leaf]) -> tuple[int, int]:
    """Number of reals, and of all other numbers, of some arrays."""
    sizes = {True: 0, False: 0}
    for leaf in leaves:
        sizes[leaf.kind == "real"] += int(np.prod(leaf.shape))
    return sizes[True], sizes[False]


@dataclass(frozen=True)
class Program:
    """A function as scalars.

    Attributes:
        graph: its nodes.
        inputs: arrays in the order of the function's leaves; ``input`` nodes count their entries,
            reals by themselves and all other kinds by themselves.
        outputs: arrays of nodes, and
        results: what they are.
        structure: pytrees of the arguments and of the results.
        zeros: of an argument, by its number, which entries it takes to be zero.
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
        return self.graph.live([n for nodes in self.outputs for n in nodes.ravel().tolist()])


def line_of(equation: Equation) -> str:
    """File and line of the user's code that an equation comes from."""
    from jax._src import source_info_util

    frame = source_info_util.user_frame(equation.source_info.traceback)
    return f"{frame.file_name}:{frame.start_line}" if frame else ""


class Walk:
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
        self._constants: dict[int, tuple[Any, Nodes]] = {}  # by id, which the value keeps its own
        self.inputs: list[Leaf] = []

    def taken(
        self, shape: tuple[int, ...], dtype: Any, path: str = "", zero: np.ndarray | None = None
    ) -> Nodes:
        """Nodes of one more argument; zero: (shape) which of its entries are known to be zero."""
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
        """A function of nodes on all entries of arrays of one shape."""
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
        """Whole numbers as a type of fewer than 64 bits holds them; all others as they are."""
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
            raise ProgramError(
                f"'{name}' has no place in a program of scalars: {REFUSED.get(name, UNKNOWN)}",
                line_of(equation),
                "write it with other operations, or run this filter by JAX",
            )
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

    def function(
        self, function: Callable[..., PyTree], *args: Nodes, like: Sequence[PyTree]
    ) -> list[Nodes]:
        """Results of a function of JAX on arrays of nodes, which stand for arrays `like` these."""
        return self.closed(jax.make_jaxpr(function)(*like), *args)


def _leaves(tree: PyTree, root: str) -> list[Leaf]:
    """The arrays of a pytree of shapes."""
    found = []
    for path, leaf in jax.tree_util.tree_flatten_with_path(tree)[0]:
        where = root + jax.tree_util.keystr(path)
        found.append(Leaf(leaf.shape, leaf.dtype, kind_of(leaf.dtype, where), where))
    return found


def trace(function: Callable[..., PyTree], *args: PyTree, unroll: int | None = UNROLL) -> Program:
    """A pure function of JAX as a program of scalars.

    Args:
        function: of pytrees of arrays; nothing else of it is looked at than its jaxpr.
        args: arguments of the shapes and types that the program will be given; their values do not
            matter. What the function holds otherwise is known, and folded.
        unroll: the number of scalar operations up to which a loop or a factorisation is written
            out; above, it is a loop or a call. Written out it is faster, and longer. None writes
            out everything that is known to end. Arrays in no loop (`jax.lax.scan`,
            `robins.linalg.rows.each_row`) are written out entry by entry.

    Raises:
        ProgramError: it does something that has no place in a program; the message names the line.
    """
    jaxpr, given, results = _jaxpr(function, args)
    return _program(jaxpr, given, results, unroll, {})


def trace_step(
    function: Callable[..., PyTree], state: PyTree, *args: PyTree, unroll: int | None = UNROLL
) -> Program:
    """A step from a state to the next, ``(state, *args) -> (state, ...)``, as a program.

    Zeros of the state that every step leaves zero are structural, as in `trace_steps`.

    Args:
        function: the step; the first of its results has the structure of the state.
        state: one to begin with: its zeros matter.
        args: as in `trace`.
        unroll: as in `trace`.

    Raises:
        ProgramError: as in `trace`; or the first result is no state.
    """
    return trace_steps([(function, args)], state, unroll=unroll)[0]


def trace_steps(
    steps: Sequence[tuple[Callable[..., PyTree], tuple[PyTree, ...]]],
    state: PyTree,
    unroll: int | None = UNROLL,
) -> list[Program]:
    """Steps that change one state, each ``(state, *args) -> (state, ...)``, as programs.

    Zeros of the state that all steps leave zero are structural, such as those above the diagonal
    of a factor. Which they are follows by induction: those are tried that are zero in the state
    given; those are dropped for which any step leaves anything but a known zero; and so on until
    none is dropped. The programs are for states that have them, as the one given and all that
    follow from it; `Native` refuses others.

    Args:
        steps: functions, and their arguments after the state.
        state: as in `trace_step`.
        unroll: as in `trace`.

    Raises:
        ProgramError: as in `trace_step`.
    """
    leaves, tree = jax.tree_util.tree_flatten(state)
    jaxprs = [_jaxpr(function, (state, *args)) for function, args in steps]
    for _, _, results in jaxprs:
        first = results[0] if isinstance(results, tuple) and results else None
        if jax.tree_util.tree_structure(first) != tree:
            raise ProgramError(
                "the first result of a step has another structure than its state",
                fix="return (state, ...)",
            )
    zeros = {k: positive_zeros(numbers_of(leaf)) for k, leaf in enumerate(leaves)}

    def made(zeros: Zeros, calls: Calls) -> list[Program]:
        return [_program(*jaxpr, unroll, zeros, calls) for jaxpr in jaxprs]

    return lasting(made, zeros)


def positive_zeros(a: np.ndarray) -> np.ndarray:
    """Mask of the entries of an array that are reals and +0."""
    if a.dtype != np.float64:
        return np.zeros(a.shape, bool)
    return np.asarray((a == 0.0) & ~np.signbit(a))


Zeros = dict[int, np.ndarray]  # of an argument, by its number, entries that are zero


def lasting(made: Callable[[Zeros, Calls], list[Program]], zeros: Zeros) -> list[Program]:
    """The programs of steps that change one state, with those of some zeros of it that last.

    Args:
        made: the programs that take some entries of their first arguments for zero, whose next
            values their first results are; and the calls of earlier attempts.
        zeros: the entries to try.
    """
    calls: Calls = {}
    while True:
        programs, kept = made(zeros, calls), zeros
        forget(calls, [program.graph for program in programs])
        for program in programs:
            zero = program.graph.constant(0, "real")
            kept = {k: np.asarray(m & (program.outputs[k] == zero)) for k, m in kept.items()}
        if all(np.array_equal(kept[k], zeros[k]) for k in zeros):
            return programs
        zeros = kept


def _jaxpr(
    function: Callable[..., PyTree], args: tuple[PyTree, ...]
) -> tuple[jex.ClosedJaxpr, PyTree, PyTree]:
    """The jaxpr of a function, and what it takes and gives as pytrees of shapes."""

    def shape(x: ArrayLike) -> jax.ShapeDtypeStruct:
        array = jax.typeof(x)
        return jax.ShapeDtypeStruct(array.shape, array.dtype, weak_type=array.weak_type)

    given = jax.tree_util.tree_map(shape, args)
    jaxpr, results = jax.make_jaxpr(function, return_shape=True)(*given)
    return jaxpr, given, results


def _program(
    jaxpr: jex.ClosedJaxpr,
    given: PyTree,
    results: PyTree,
    unroll: int | None,
    zeros: Zeros,
    calls: Calls | None = None,
) -> Program:
    """The program of a jaxpr, some entries of its arguments known to be zero."""
    import robins.program.primitives  # noqa: F401

    walk = Walk(Graph(), unroll, calls)
    nodes = [
        walk.taken(leaf.shape, leaf.dtype, leaf.path, zeros.get(index))
        for index, leaf in enumerate(_leaves(given, "arguments"))
    ]
    outputs = walk.closed(jaxpr, *nodes)
    structures = tuple(jax.tree_util.tree_structure(tree) for tree in (given, results))
    leaves = _leaves(results, "results")
    return Program(*(walk.graph, walk.inputs, outputs, leaves, structures, zeros))
