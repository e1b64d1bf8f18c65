"""Tracing of a function of JAX to a program: its jaxpr, walked with arrays of nodes for values."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import jax
import numpy as np
from jax.extend import core as jex
from jax.typing import ArrayLike
from jaxtyping import PyTree

from robins import _float64  # noqa: F401
from robins.program import primitives  # noqa: F401
from robins.program.calls import Calls, drop_templates
from robins.program.kinds import kind_of, numbers_of
from robins.program.nodes import Graph
from robins.program.refusal import ProgramError
from robins.program.walk import JaxprWriter, Leaf, Program

# Scalar operations up to which a loop or a factorisation is written out: all of a filter of nine
# states, not the thirty samples of an IMU between two fixes.
UNROLL = 10_000


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
        function: of pytrees of arrays; only its jaxpr is used.
        args: arguments of the shapes and types that the program will be given; their values do not
            matter. Values that the function holds are constants, and folded.
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
        state: the initial one, whose zeros matter.
        args: as in `trace`.
        unroll: as in `trace`.

    Raises:
        ProgramError: as in `trace`; or the first result is not a state.
    """
    return trace_steps([(function, args)], state, unroll=unroll)[0]


def trace_steps(
    steps: Sequence[tuple[Callable[..., PyTree], tuple[PyTree, ...]]],
    state: PyTree,
    unroll: int | None = UNROLL,
) -> list[Program]:
    """Steps that change one state, each ``(state, *args) -> (state, ...)``, as programs.

    Zeros of the state that all steps leave zero are structural, such as those above the diagonal
    of a factor. They are found by induction: all zeros of the given state are tried; those that any
    step does not leave a known zero are dropped, until none is dropped any more. The programs are
    for states with these zeros, as the given one and all that follow from it; `Native` refuses
    others.

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

    return with_preserved_zeros(made, zeros)


def positive_zeros(a: np.ndarray) -> np.ndarray:
    """Mask of the entries of an array that are reals and +0."""
    if a.dtype != np.float64:
        return np.zeros(a.shape, bool)
    return np.asarray((a == 0.0) & ~np.signbit(a))


Zeros = dict[int, np.ndarray]  # by index of an argument, mask of its zero entries


def with_preserved_zeros(
    made: Callable[[Zeros, Calls], list[Program]], zeros: Zeros
) -> list[Program]:
    """Programs of steps of one state, with those of the given zeros that all steps preserve.

    Args:
        made: (zeros, calls of earlier attempts) -> programs that take these entries of their first
            arguments, the state, for zero; their first results are its next value.
        zeros: the entries to try.
    """
    calls: Calls = {}
    while True:
        programs, kept = made(zeros, calls), zeros
        drop_templates(calls, [program.graph for program in programs])
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
    """Program of a jaxpr with some entries of its arguments known to be zero."""
    walk = JaxprWriter(Graph(), unroll, calls)
    nodes = [
        walk.taken(leaf.shape, leaf.dtype, leaf.path, zeros.get(index))
        for index, leaf in enumerate(_leaves(given, "arguments"))
    ]
    outputs = walk.closed(jaxpr, *nodes)
    structures = tuple(jax.tree_util.tree_structure(tree) for tree in (given, results))
    leaves = _leaves(results, "results")
    return Program(*(walk.graph, walk.inputs, outputs, leaves, structures, zeros))
