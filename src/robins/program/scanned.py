"""A scan of one run by the interpreter: nothing is compiled, and rows are taken in C."""

from __future__ import annotations

import contextlib
from collections import OrderedDict
from collections.abc import Callable, Hashable
from functools import partial
from typing import Any

import jax
import numpy as np

from robins.errors import require
from robins.program.interpreter import Interpreter, interpreter_of_one
from robins.program.kept import kept, results_of
from robins.program.kinds import is_key
from robins.program.lanes import KINDS, Rounds, Scan
from robins.program.memory import LIVE_UNROLL, form
from robins.program.names import by_name
from robins.program.refusal import ProgramError
from robins.program.tape import Tape
from robins.program.trace import Program, trace

Data = Any  # a pytree of arrays
Body = Callable[
    [Data, Data], tuple[Data, Data]
]  # of what is carried and a row; to these of the next
_MOST = 32  # programs remembered; the least recently used are forgotten


Made = tuple[Program, Tape, Data]  # and the structure of what a round keeps
_known: OrderedDict[Hashable, Made] = OrderedDict()


def scan(body: Body, content: Hashable, carry: Data, rows: Data) -> tuple[Data, Data]:
    """Return ``jax.lax.scan(body, carry, rows)`` with numbers of NumPy for results.

    Args:
        body: pure; looked at when its program is neither remembered nor in the user's cache. Bodies
            of one function (that of a `partial`) and equal content are the same one.
        content: all that the body holds. In other processes too they are the same if the function
            and the content have names there (`robins.program.names.by_name`).
        carry: pytree of arrays; a round leaves the same shapes and types.
        rows: pytree of arrays, one at least, with an equal leading axis of rounds.

    Raises:
        ValueError: there are no rows.
        ProgramError: the body does what has no place in a program, or leaves another form; or an
            array is of a type that a program does not take.
        BuildError: there is no interpreter.
    """
    taken, tree = jax.tree_util.tree_flatten((carry, rows))
    arrays = list(map(_array, taken))
    count = jax.tree_util.tree_structure(carry).num_leaves
    require(len(arrays) > count, "a scan needs an array of rows")
    length, interpreter = len(arrays[-1]), interpreter_of_one()
    # without a round there is no row, but the same program
    first = [
        *arrays[:count],
        *(a[0] if length else np.zeros_like(a, shape=a.shape[1:]) for a in arrays[count:]),
    ]
    key = getattr(body, "func", body), content, tree, tuple(map(form, first))
    made = _known.get(key)
    if made is None:
        one = jax.tree_util.tree_unflatten(tree, first)
        made = _known[key] = _made(body, key, one, count, interpreter)
        if len(_known) > _MOST:
            _known.popitem(last=False)
    _known.move_to_end(key)
    program, tape, keeps = made
    engine = partial(_rounds, interpreter, tape)
    rounds = Rounds(program, length, count, 0, engine=engine)
    found = [a[0] for a in rounds(1, [(a, False) for a in arrays])]
    begun, _ = tree.children()
    return begun.unflatten(found[:count]), keeps.unflatten(found[count:])


def _rounds(interpreter: Interpreter, tape: Tape, _: Program) -> tuple[Scan, int]:
    return interpreter.rounds(tape)


def _array(x: Data) -> np.ndarray:
    """An array that rounds can take."""
    if is_key(getattr(x, "dtype", None)):
        raise ProgramError("a key of JAX has no place in a scan", fix="give its key_data")
    array = np.asarray(x)
    if f"{array.dtype.kind}{array.dtype.itemsize}" not in KINDS:
        raise ProgramError(f"numbers of {array.dtype} have no place in a program")
    return array


def _made(body: Body, key: Hashable, one: Data, count: int, interpreter: Interpreter) -> Made:
    """The program of a body; from the user's cache if it is there.

    Args:
        body: as in `scan`.
        key: what the program depends on.
        one: what is carried, and a row.
        count: number of arrays that are carried.
        interpreter: that of one run.
    """
    text = ""
    with contextlib.suppress(LookupError):
        text = by_name(key)
    write = partial(_written, body, one, count)
    if text:
        program, tape, _ = kept(["scan", text], write, interpreter)
    else:
        program = write()
        tape = interpreter.tape(program)
    _, keeps = results_of(program)
    if keeps is None:
        keeps = jax.tree_util.tree_structure(jax.eval_shape(body, *one)[1])
    return program, tape, keeps


def _written(body: Body, one: Data, count: int) -> Program:
    program = trace(body, *one, unroll=LIVE_UNROLL)
    forms = [(x.shape, x.dtype) for x in jax.tree_util.tree_leaves(one)[:count]]
    left = [(leaf.shape, leaf.dtype) for leaf in program.results[:count]]
    parts = program.structure[1].children()
    begun = jax.tree_util.tree_structure(one[0])
    if len(parts) != 2 or parts[0] != begun or left != forms:
        raise ProgramError("a round leaves what is carried in another form than it takes")
    return program
