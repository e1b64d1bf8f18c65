"""A state that stays in the memory of C between calls, and programs that step it.

`Native` takes a function's arguments apart and puts its results together at every call. Here the
state is never taken apart: every program has it at the head of its arguments and of its results,
and these lie in one memory, so that a call copies only the other arguments and results.
Programs are kept for the process, so that a filter made again is not traced again, and those with
names in the user's cache (`robins.program.kept`).
"""

from __future__ import annotations

import ctypes
from collections import OrderedDict
from collections.abc import Callable, Hashable
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import PyTree

from robins.program.interpreter import interpreted_step, interpreter_of_one
from robins.program.kept import cached_by_name, cached_value, second_result
from robins.program.kinds import kind_of
from robins.program.names import Tree
from robins.program.native import Engine, Step, address
from robins.program.refusal import ProgramError
from robins.program.trace import trace
from robins.program.walk import Leaf, MemorySlot, Program, slots

Function = Callable[..., Any]  # of a state and arguments
# A program, the structure of its result apart from the state, and what makes steps of it.
Made = tuple[Program, Any, Callable[[], Step]]
LIVE_UNROLL = 300  # of 15 states as fast as written out, and compiled in two thirds of the time
_MOST = 128  # programs remembered; the least recently used are forgotten
_known: OrderedDict[Hashable, Made] = OrderedDict()
_FLOAT = np.dtype(float)
_PYTHON = {float: _FLOAT, int: np.dtype(np.int64), bool: np.dtype(bool)}


class Reader:
    """Reader of a pytree from its slots in memory."""

    def __init__(self, result_slots: list[MemorySlot], tree: Tree):
        """Set up a reader for slots and the structure whose leaves they hold."""
        self._tree = tree
        self._blank = [None] * len(result_slots)
        self._arrays = [
            (k, slice(s.first, s.last), s.shape if len(s.shape) > 1 else None)
            for k, s in enumerate(result_slots)
            if s.is_real and s.shape
        ]
        self._numbers = [
            (k, s.first) for k, s in enumerate(result_slots) if s.is_real and not s.shape
        ]
        self._others = [
            (k, slice(s.first, s.last) if s.shape else s.first, s.shape, np.dtype(s.dtype))
            for k, s in enumerate(result_slots)
            if not s.is_real
        ]

    def read(self, reals: np.ndarray, others: np.ndarray) -> PyTree:
        """A pytree: views of the reals, copies of all else, scalars of NumPy."""
        leaves: list[Any] = self._blank.copy()
        for k, at, shape in self._arrays:
            leaves[k] = reals[at] if shape is None else reals[at].reshape(shape)
        for k, at in self._numbers:
            leaves[k] = reals[at]
        for k, at, shape, dtype in self._others:
            if shape:
                leaves[k] = others[at].astype(dtype).reshape(shape)
            else:
                leaves[k] = others[at] if dtype == np.int64 else others[at].astype(dtype)
        return self._tree.unflatten(leaves)


Form = tuple[tuple[int, ...], Any, bool]


def form(x: Any) -> Form:
    """Shape and type of an argument, and whether the type is weak: programs differ by these."""
    if (dtype := _PYTHON.get(type(x))) is not None:
        return (), dtype, dtype.kind != "b"
    array = x if hasattr(x, "dtype") else np.asarray(x)
    return array.shape, array.dtype, getattr(array, "weak_type", False)


def _leaf(shape: tuple[int, ...], dtype: Any, path: str) -> Leaf:
    if not isinstance(dtype, np.dtype):  # keys of random streams
        raise ProgramError(f"{dtype} has no place in a program", path, "run this filter by JAX")
    return Leaf(shape, dtype, kind_of(dtype, path), path)


class _Call(NamedTuple):
    """A compiled function in the memory of a state."""

    tree: Any  # of its arguments after the state
    forms: list[Form]  # of these
    views: list[np.ndarray]  # where they go
    run: Any
    pointers: tuple[ctypes.c_void_p, ...]
    begin: tuple[int, int]  # in the memories, of the result, and
    end: tuple[int, int]  # behind it
    result: Reader  # of the result, counted from there

    def matches(self, leaves: list[ArrayLike], tree: Tree) -> bool:
        """True if it was traced for arguments like these."""
        return tree == self.tree and all(map(_alike, leaves, self.forms))


def _alike(x: Any, known: Form) -> bool:
    if type(x) in (np.ndarray, np.float64):
        return x.shape == known[0] and x.dtype == known[1] and not known[2]
    return form(x) == known


class NativeState:
    """A state in the memory of C, and functions that step it.

    Attributes:
        state: as a pytree of arrays, a copy; assign to go on from another of the same shapes.
    """

    def __init__(
        self,
        state: PyTree,
        content: Hashable,
        engine: Engine = interpreted_step,
        unroll: int | None = LIVE_UNROLL,
        persistent: bool = False,
    ):
        """Lay a state out in memory.

        Args:
            state: a pytree of arrays.
            content: what the functions hold, by which those of equal names are distinguished in
                this process.
            engine: what makes steps of programs: `interpreted_step`, or `compiled_step`.
            unroll: as in `trace`.
            persistent: content and names distinguish functions in other processes too, if they have
                texts (`names.by_name`): then programs of the interpreter are kept in the user's
                cache.

        Raises:
            ProgramError: the state holds numbers that have no place in a program.
        """
        self._persistent = persistent
        self._content, self._how = content, (engine, unroll)
        leaves, self._tree = jax.tree_util.tree_flatten(state)
        paths = jax.tree_util.tree_flatten_with_path(state)[0]
        self._forms = [form(x) for x in leaves]
        self._leaves = [
            _leaf(shape, dtype, "state" + jax.tree_util.keystr(path))
            for (shape, dtype, _), (path, _) in zip(self._forms, paths, strict=True)
        ]
        self._slots, self._reals, self._others = slots(self._leaves)
        self._reader = Reader(self._slots, self._tree)
        self._x = np.zeros(max(self._reals, 1))
        self._k = np.zeros(max(self._others, 1), np.int64)
        self._calls: dict[Hashable, _Call] = {}
        self._pytree: Any = None
        self.state = state

    @property
    def state(self) -> PyTree:
        """Current state."""
        if self._pytree is None:
            reals, others = self._x[: self._reals].copy(), self._k[: self._others]
            self._pytree = self._reader.read(reals, others)
        return self._pytree

    @state.setter
    def state(self, state: PyTree) -> None:
        leaves, tree = jax.tree_util.tree_flatten(state)
        if tree != self._tree:
            raise ProgramError(f"a state of another structure than the first one: {tree}")
        for leaf, known in zip(leaves, self._leaves, strict=True):
            shape, dtype, _ = form(leaf)
            if shape != known.shape or not np.can_cast(dtype, known.dtype, "same_kind"):
                raise ProgramError(
                    f"{dtype}{shape} was given where the first state has "
                    f"{known.dtype}{known.shape}",
                    known.path,
                )
        for slot, leaf in zip(self._slots, leaves, strict=True):
            slot.view(self._x, self._k)[...] = leaf
        self._pytree = None

    def step(self, name: Hashable, function: Function, *args: PyTree) -> PyTree:
        """Step the state by ``(state, *args) -> (state, result)``; gives the result.

        Args:
            name: of the function; with equal content and name it is the same function.
            function: a pure function of JAX; traced when there is no program of its name yet for
                arguments of these shapes.
            args: numbers and NumPy arrays are the fastest.

        Raises:
            ProgramError: the function does what has no place in a program, or the state that it
                gives is of another form than it takes.
            BuildError: the compiler refuses the program.
        """
        leaves, tree = jax.tree_util.tree_flatten(args)
        call = self._calls.get(name)
        if call is None or not call.matches(leaves, tree):
            call = self._calls[name] = self._call(name, function, args, leaves, tree)
        for view, leaf in zip(call.views, leaves, strict=True):
            view[...] = leaf
        call.run(*call.pointers)
        self._pytree = None
        (x, k), (x_end, k_end) = call.begin, call.end
        reals, others = self._x[x:x_end].copy(), self._k[k:k_end]
        return call.result.read(reals, others)

    def _call(
        self,
        name: Hashable,
        function: Function,
        args: tuple[PyTree, ...],
        leaves: list[ArrayLike],
        tree: Tree,
    ) -> _Call:
        """Bind a function to this memory, enlarging it if needed."""
        forms = [form(x) for x in leaves]
        key = (self._content, name, self._tree, tuple(self._forms), tree, tuple(forms), self._how)
        make = partial(self._made, key[:-1], function, args)
        program, result, step = cached_value(_known, key, make, _MOST)
        count = len(self._slots)
        begin = self._reals, self._others
        given, *after = slots(program.inputs[count:], begin)
        result_slots, *end = slots(program.results[count:])
        wanted = [max(a, b + e) for a, b, e in zip(after, begin, end, strict=True)]
        if wanted[0] > len(self._x) or wanted[1] > len(self._k):
            self._calls.clear()  # they point to the old memory
            self._x = np.append(self._x, np.zeros(max(0, wanted[0] - len(self._x))))
            more = np.zeros(max(0, wanted[1] - len(self._k)), np.int64)
            self._k = np.append(self._k, more)
        x, k = map(address, (self._x, self._k))
        views = [slot.view(self._x, self._k) for slot in given]
        ends, read = (begin[0] + end[0], begin[1] + end[1]), Reader(result_slots, result)
        return _Call(tree, forms, views, step(), (x, k, x, k), begin, ends, read)

    def _made(self, key: Hashable, function: Function, args: tuple) -> Made:
        """A program of a function; that of the interpreter from the user's cache, if it is there.

        Args:
            key: what the program depends on.
            function: as in `step`.
            args: likewise.
        """
        engine, unroll = self._how
        write = partial(self._traced, function, args)
        if self._persistent and engine is interpreted_step:
            interpreter = interpreter_of_one()
            program, tape = cached_by_name("step", (key, unroll), write, interpreter)
            step = interpreter.steps(tape)
        else:
            program = write()
            step = engine(program)
        return program, second_result(program, function, self.state, *args), step

    def _traced(self, function: Function, args: tuple) -> Program:
        program = trace(function, self.state, *args, unroll=self._how[1])
        parts = jax.tree_util.treedef_children(program.structure[1])
        now = [(leaf.shape, leaf.kind) for leaf in program.results[: len(self._leaves)]]
        if (
            len(parts) != 2
            or parts[0] != self._tree
            or now != [(leaf.shape, leaf.kind) for leaf in self._leaves]
        ):
            raise ProgramError(
                "a step gives a state of another form than it takes", fix="return (state, result)"
            )
        return program
