"""Scan of one run by the interpreter: nothing is compiled, and the loop over rows is in C."""

from __future__ import annotations

import contextlib
from collections import OrderedDict
from collections.abc import Callable, Hashable
from functools import lru_cache, partial
from typing import Any

import jax
import numpy as np

from robins.errors import require
from robins.program.interpreter import interpreter_of_one
from robins.program.kept import cached_by_name, cached_value, second_result
from robins.program.kinds import is_key
from robins.program.lanes import KINDS, CompiledRounds
from robins.program.memory import LIVE_UNROLL, form
from robins.program.names import Tree
from robins.program.refusal import BuildError, ProgramError
from robins.program.tape import Tape
from robins.program.trace import trace
from robins.program.walk import Program

Data = Any  # a pytree of arrays
Body = Callable[[Data, Data], tuple[Data, Data]]  # (carry, row) -> (carry, kept)
Made = tuple[Program, Tape, Tree]  # and the structure of what a round keeps
_MOST = 32  # programs remembered; the least recently used are forgotten
_known: OrderedDict[Hashable, Made] = OrderedDict()


def scan(body: Body, content: Hashable, carry: Data, rows: Data) -> tuple[Data, Data]:
    """Return ``jax.lax.scan(body, carry, rows)`` with NumPy results.

    Args:
        body: pure; traced when its program is neither in memory nor in the user's cache. Bodies of
            one function (that of a `partial`) with equal content share a program.
        content: all values that the body holds. Other processes share the program too if function
            and content have texts (`robins.program.names.by_name`).
        carry: pytree of arrays; a round leaves the same shapes and types.
        rows: pytree of arrays, one at least, with an equal leading axis of rounds.

    Raises:
        ValueError: there are no rows, or arrays of them differ in length.
        ProgramError: the body does what has no place in a program, or changes the form of the
            carry; or an array is of a type that a program does not take.
        BuildError: there is no interpreter.
    """
    taken, tree = jax.tree_util.tree_flatten((carry, rows))
    arrays = list(map(_array, taken))
    count = jax.tree_util.tree_structure(carry).num_leaves
    lengths = {a.shape[:1] for a in arrays[count:]}
    require(len(lengths) == 1 and lengths != {()}, "rows must be arrays of one length", lengths)
    ((length,),) = lengths
    # without a round there is no row, but the same program
    row = [a[0] if length else np.zeros(a.shape[1:], a.dtype) for a in arrays[count:]]
    first, interpreter = [*arrays[:count], *row], interpreter_of_one()
    key = getattr(body, "func", body), content, tree, tuple(map(form, first))

    def made() -> Made:
        one = jax.tree_util.tree_unflatten(tree, first)
        write = partial(_written, body, one, count)
        program, tape = cached_by_name("scan", key, write, interpreter)
        return program, tape, second_result(program, body, *one)

    program, tape, keeps = cached_value(_known, key, made, _MOST)
    rounds = CompiledRounds(program, length, count, 0, engine=lambda _: interpreter.rounds(tape))
    found = [a[0] for a in rounds(1, [(a, False) for a in arrays])]
    begun, _ = tree.children()
    return begun.unflatten(found[:count]), keeps.unflatten(found[count:])


def named_scan(body: Body, carry: Data, rows: Data) -> tuple[Data, Data]:
    """`scan` with a body that its name identifies; by JAX where that is impossible.

    JAX computes it where there is no interpreter, or where it has no place in a program.

    Args:
        body: as of `scan`; a function, or a `partial` that binds functions as first arguments.
        carry: as of `scan`.
        rows: as of `scan`.

    Raises:
        ValueError: a `partial` binds arguments by name; or as of `scan`.
    """
    function, bound = getattr(body, "func", body), getattr(body, "args", ())
    require(not getattr(body, "keywords", None), "bind no arguments by name", body)
    if _can_interpret():
        with contextlib.suppress(ProgramError, BuildError):
            return scan(body, bound, carry, rows)
    return jax.device_get(_by_jax(function, bound, carry, rows))


@lru_cache
def _can_interpret() -> bool:
    """True if there is an interpreter; cached, so that a missing one is sought once only."""
    try:
        interpreter_of_one()
    except BuildError:
        return False
    return True


@partial(jax.jit, static_argnums=(0, 1))
def _by_jax(function: Body, bound: tuple, carry: Data, rows: Data) -> tuple[Data, Data]:
    return jax.lax.scan(partial(function, *bound), carry, rows)


def mapped_rows(function: Callable[[Data], Data], rows: Data) -> Data:
    """Return ``jax.vmap(function)(rows)`` with NumPy results, by `named_scan`."""
    return named_scan(partial(_alone, function), (), rows)[1]


def _alone(function: Callable[[Data], Data], carry: Data, row: Data) -> tuple[Data, Data]:
    return carry, function(row)


def _array(x: Data) -> np.ndarray:
    """Array of a type that rounds can take."""
    if is_key(getattr(x, "dtype", None)):
        raise ProgramError(
            "a key of JAX has no place in a scan", fix="pass jax.random.key_data(key)"
        )
    array = np.asarray(x)
    if f"{array.dtype.kind}{array.dtype.itemsize}" not in KINDS:
        fix = "convert them to int64 or float64"
        raise ProgramError(f"numbers of {array.dtype} have no place in a program", fix=fix)
    return array


def _written(body: Body, one: Data, count: int) -> Program:
    """Program of a body; one: a carry (of count arrays) and a row."""
    program = trace(body, *one, unroll=LIVE_UNROLL)
    forms = [(x.shape, x.dtype) for x in jax.tree_util.tree_leaves(one)[:count]]
    left = [(leaf.shape, leaf.dtype) for leaf in program.results[:count]]
    parts = program.structure[1].children()
    begun = jax.tree_util.tree_structure(one[0])
    if len(parts) != 2 or parts[0] != begun or left != forms:
        what = "a round leaves what is carried in another form than it takes"
        raise ProgramError(
            what, fix="return (carry, kept), the carry in the shapes and types given"
        )
    return program
