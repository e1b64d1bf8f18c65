"""A scan of one run by the interpreter: nothing is compiled, and rows are taken in C."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import Any

import jax
import numpy as np

from robins.program.interpreter import interpreter_of_one
from robins.program.kept import by_name, kept, results_of
from robins.program.lanes import Rounds
from robins.program.memory import LIVE_UNROLL, form
from robins.program.refusal import ProgramError
from robins.program.trace import Program, trace

Body = Callable[[Any, Any], tuple[Any, Any]]  # of what is carried and a row; to these of the next


def scan(body: Body, content: Hashable, carry: Any, rows: Any) -> tuple[Any, Any]:
    """Return ``jax.lax.scan(body, carry, rows)`` with arrays of NumPy for results.

    Args:
        body: pure; looked at when its program is not in the user's cache.
        content: what the body holds. Bodies of equal content are the same one, in other processes
            too if it is numbers and functions of robins.
        carry: pytree of arrays; a round leaves the same shapes and types.
        rows: pytree of arrays with a leading axis of rounds, at least one.

    Raises:
        ProgramError: the body does what has no place in a program, or leaves another form.
        BuildError: there is no interpreter.
    """
    taken, tree = jax.tree_util.tree_flatten((carry, rows))
    arrays = [np.asarray(x) for x in taken]
    begun = jax.tree_util.tree_structure(carry)
    count, length = begun.num_leaves, len(arrays[-1])
    first = [*arrays[:count], *(a[0] for a in arrays[count:])]

    def write() -> Program:
        program = trace(body, *jax.tree_util.tree_unflatten(tree, first), unroll=LIVE_UNROLL)
        left = [(leaf.shape, leaf.dtype) for leaf in program.results[:count]]
        parts = program.structure[1].children()
        if (
            len(parts) != 2
            or parts[0] != begun
            or left != [(a.shape, a.dtype) for a in first[:count]]
        ):
            raise ProgramError("a round leaves what is carried in another form than it takes")
        return program

    interpreter = interpreter_of_one()
    try:
        key = content, tree, tuple(map(form, first))
        program, tape, _ = kept(["scan", by_name(key)], write, interpreter)
    except LookupError:
        program = write()
        tape = interpreter.tape(program)
    _, told = results_of(program)
    if told is None:
        shapes = jax.eval_shape(body, *jax.tree_util.tree_unflatten(tree, first))
        told = jax.tree_util.tree_structure(shapes[1])
    rounds = Rounds(program, length, count, 0, engine=lambda _: interpreter.rounds(tape))
    found = [a[0] for a in rounds(1, [(a, False) for a in arrays])]
    return begun.unflatten(found[:count]), told.unflatten(found[count:])
