"""A function of numbers and of a run, at many points and for many runs, on all cores."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from time import thread_time
from typing import Any

import jax
import numpy as np

from robins.campaign.compilation import CompilationTrigger
from robins.campaign.machine import available_cores, threads
from robins.campaign.memory import CHUNK_BYTES, LEAST, concurrent_chunks, width_of
from robins.errors import require
from robins.program.interpreter import interpreted_rounds
from robins.program.kinds import is_key
from robins.program.stages import StagedFunction

Tree = Any  # a pytree of arrays


class ManyRuns:
    """A pure function ``(numbers, arrays of a run) -> results``, interpreted for many runs.

    It is compiled meanwhile where that pays, with the same bits. What has no place in a program JAX
    computes. Numbers that differ between points are arguments of the program; the others are part
    of it, until they differ from those of the first point.
    """

    def __init__(self, function: Callable[[Tree, Tree], Tree]):
        self._function = function
        self._first: list[Any] = []  # leaves of the first point
        self._differ: list[int] = []  # those that are arguments
        self._staged: StagedFunction | None = None
        self._refused: list[str] = []  # reasons of programs since replaced

    def __call__(
        self,
        points: Sequence[Tree],
        arrays: Tree,
        progress: Callable[[float], None] = lambda share: None,
    ) -> Tree:
        """Compute all runs at all points.

        Args:
            points: numbers, all of one structure and of the same shapes, in any call.
            arrays: with a leading axis of runs.
            progress: called with the share done.

        Returns:
            NumPy arrays with leading axes of points and of runs.

        Raises:
            ValueError: there is no point, or no run.
            jax.errors.JAXTypeError: the function cannot be traced.
        """
        runs = len(jax.tree_util.tree_leaves(arrays)[0])
        require(len(points) > 0 and runs > 0, "there must be points and runs", (len(points), runs))
        numbers = self._varying_leaves(points)
        staged = self._staged
        if staged is None:
            staged = self._staged = self._traced(points[0], numbers, arrays)
            self._hand_over = CompilationTrigger([staged])

        def given(at: np.ndarray) -> tuple[Tree, Tree]:
            of_runs = jax.tree_util.tree_map(lambda x: x[at % runs], arrays)
            return {k: x[at // runs] for k, x in numbers.items()}, of_runs

        found = self._computed(staged, len(points) * runs, given, progress)
        shape = len(points), runs
        return jax.tree_util.tree_map(lambda x: x.reshape(*shape, *x.shape[1:]), found)

    @property
    def notes(self) -> list[str]:
        """Reasons why parts stayed with JAX in any call, each once."""
        refused = [*self._refused, *map(str, self._staged.refused if self._staged else [])]
        return [f"a part stays with JAX, as {why}" for why in dict.fromkeys(refused)]

    def _varying_leaves(self, points: Sequence[Tree]) -> dict[int, np.ndarray]:
        """The leaves that are arguments, by number, each with a leading axis of points."""
        leaves = list(map(jax.tree_util.tree_leaves, points))
        self._first = self._first or leaves[0]
        each = list(zip(*leaves, strict=True))
        differ = [k for k, some in enumerate(each) if not _are_equal(self._first[k], some)]
        if not set(differ) <= set(self._differ):
            self._differ = sorted({*differ, *self._differ})
            if self._staged is not None:
                self._refused += map(str, self._staged.refused)
                self._staged = None
        return {k: np.stack(list(map(np.asarray, each[k]))) for k in self._differ}

    def _traced(
        self, point: Tree, numbers: Mapping[int, np.ndarray], arrays: Tree
    ) -> StagedFunction:
        """The function, staged, with the numbers that differ and a run as arguments."""
        tree, fixed = jax.tree_util.tree_structure(point), dict(enumerate(self._first))

        def function(numbers: Mapping[int, Any], of_run: Tree) -> Tree:
            return self._function(tree.unflatten((fixed | dict(numbers)).values()), of_run)

        shapes = jax.tree_util.tree_map(
            lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), (dict(numbers), arrays)
        )
        return StagedFunction(function, *shapes, engine=interpreted_rounds)

    def _computed(
        self,
        staged: StagedFunction,
        runs: int,
        given: Callable[[np.ndarray], tuple[Tree, Tree]],
        progress: Callable[[float], None],
    ) -> Tree:
        """Results of as many runs, in chunks, one on each core."""
        each = -(-runs // available_cores())
        width = min(width_of(staged.bytes_of_run, CHUNK_BYTES), -(-each // LEAST) * LEAST)
        workers = concurrent_chunks(staged.bytes_of_run, width, available_cores())

        def chunk(begin: int) -> Tree:
            begun, count = thread_time(), min(width, runs - begin)
            found = staged(*given(np.arange(begin, begin + width).clip(max=runs - 1)))
            self._hand_over.record_time(width, thread_time() - begun, runs - begin - count)
            return jax.tree_util.tree_map(
                lambda x: x[:count] if is_key(x.dtype) else np.asarray(x)[:count], found
            )

        begins, ahead, done = range(0, runs, width), deque[Any](), []
        with threads(workers) as pool:
            for k in range(len(begins) + workers):
                if k < len(begins):
                    ahead.append(pool.submit(chunk, begins[k]))
                if k >= workers:
                    done.append(ahead.popleft().result())
                    progress(len(done) / len(begins))
        return jax.tree_util.tree_map(_end_to_end, *done)


def _are_equal(first: Tree, others: Sequence[Tree]) -> bool:
    """Compare the bits of numbers: NaN is NaN, and -0 is not 0."""
    bits = np.asarray(first).tobytes()
    return all(one is first or np.asarray(one).tobytes() == bits for one in others)


def _end_to_end(*parts: Tree) -> Tree:
    """Join arrays of NumPy, or keys of JAX."""
    return (jax.numpy if is_key(parts[0].dtype) else np).concatenate(parts)
