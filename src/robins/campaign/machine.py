"""Machines of a campaign: programs on all cores, interpreted or compiled, or batches of JAX.

All have the same random numbers and, to rounding, the same results; JAX is the reference. The two
kinds of programs have the same bits. The interpreter (`robins.program.interpreter`) begins at once
and gives way to compiled lanes where a campaign is long enough (`robins.campaign.compilation`). JAX
computes what has no place in a program, and where there is no interpreter.
"""

from __future__ import annotations

import os
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from functools import partial
from time import monotonic, thread_time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from robins.campaign.compilation import CompilationTrigger
from robins.campaign.memory import (
    CHUNK_BYTES,
    LEAST,
    MEMORY,
    concurrent_chunks,
    filled,
    memory_note,
    release_memory,
    width_of,
)
from robins.campaign.monte_carlo import (
    batch_of,
    blocks_of,
    bytes_of_batch,
    contender,
    first_runs,
    one_record,
    record,
    rejoined_record,
    split_record,
    traced,
    worlds,
)
from robins.campaign.plan import Chunk
from robins.errors import RobinsError
from robins.manifold import State
from robins.program import CPP, BuildError, compiler
from robins.program.interpreter import interpreted_rounds, interpreter_of_many
from robins.program.lanes import compiled_rounds
from robins.program.stages import StagedFunction
from robins.systems.study import Problem

MACHINES = ("vm", "c", "jax")
BETWEEN_S = 1.0  # between two releases of memory
COMPILERS = 3  # at once, in addition to that of the worlds: some take a gigabyte
NUMBER = jax.ShapeDtypeStruct((), int)  # shape of the number of a run
STACK = 1 << 28  # bytes of a thread's stack, on which lanes hold all that a step computes

Taken = Callable[[str, Any], Any]  # (filter's name, its record of a chunk) -> what is kept

# World of the first run (with the first chunk), number of runs, what is kept by filter.
Simulated = tuple[Any, int, Callable[[str], Any]]


def whole_record(name: str, record: PyTree) -> PyTree:
    """Return a record unchanged, for machines that keep all of it."""
    return record


class JaxMachine:
    """Chunks as batches of JAX, one after the other."""

    name = "jax"

    def __init__(self, problem: Problem, why: Sequence[str] = ()):
        """Prepare batches, not traced yet; why: notes on the choice of this machine."""
        self.problem = problem
        self.notes = self._why = list(why)
        self._batch = batch_of(problem)
        self._programs: dict[str, Future[Any]] = {}  # being compiled

    def width(self, runs: int) -> int:
        """Number of runs in a chunk, for a campaign of this size, limited by the memory that JAX
        needs.
        """
        width = filled(runs)
        each = -(-bytes_of_batch(self.problem, self._batch, width) // width)
        width = min(width, width_of(each, MEMORY))
        self.notes = [*self._why, *memory_note(each, width)]
        return width

    def chunks(self, runs: int, chunk: int = 0, taken: Taken = whole_record) -> Iterator[Simulated]:
        """Simulate a chunk; its filters run when their results are requested.

        Args:
            runs: number of runs.
            chunk: runs at a time; not given, by the memory that they need.
            taken: what is kept of the record of a filter.
        """
        first, width = True, filled(runs, chunk or self.width(runs))
        with self._compiling(width):
            for batch, count in worlds(self.problem, runs, width, batch=self._batch):
                held = [batch]
                del batch
                yield (
                    first_run(held[0]) if first else None,
                    count,
                    partial(self._of, held, count, taken),
                )
                held.clear()  # before the next is simulated
                first = False

    @contextmanager
    def _compiling(self, width: int) -> Iterator[None]:
        """Compile the filters meanwhile, on other cores, in the order in which they will run."""
        others = available_cores() - 1
        if not others:
            yield
            return
        programs = traced(self.problem, self._batch, width)
        with threads(min(others, COMPILERS)) as pool:
            # contenders that differ in numbers are the same program
            distinct = {id(one.jaxpr): one for one in programs.values()}
            begun = {
                key: pool.submit(lambda one=one: one.lower().compile())
                for key, one in distinct.items()
            }
            self._programs = {name: begun[id(one.jaxpr)] for name, one in programs.items()}
            yield
            self._programs = {}

    def _of(self, held: list[PyTree], count: int, taken: Taken, name: str) -> PyTree:
        if name in self._programs:
            self._programs[name].result()  # wait for it: the call uses it
        return taken(name, record(self.problem, name, held[0], count))

    def compute(
        self,
        chunk: Chunk,
        width: int,
        names: Sequence[str],
        taken: Taken = whole_record,
        left: int = 0,
    ) -> dict[str, PyTree]:
        """Compute a chunk, filled up to a width, and keep what is `taken` of each filter.

        Args:
            chunk: of runs.
            width: of all chunks.
            names: of filters.
            taken: from the record of a filter.
            left: runs that are still to be computed after these.
        """
        batch, _ = next(worlds(self.problem, width, width, chunk.begin, self._batch))
        return {name: taken(name, record(self.problem, name, batch, chunk.runs)) for name in names}

    def histories(self, chunk: Chunk, width: int, names: Sequence[str]) -> dict[str, PyTree]:
        """All that was recorded of some filters over one chunk."""
        return self.compute(chunk, width, names)


class LaneMachine:
    """Chunks as programs in lanes, one on each core.

    Attributes:
        name: "c" where the programs are compiled, "vm" where they are interpreted first.
        bytes_of_run: approximate peak memory of the histories of a run.
    """

    def __init__(self, problem: Problem, name: str = "vm"):
        self.problem, self.name = problem, name
        self._engine = interpreted_rounds if name == "vm" else compiled_rounds
        self._simulate = StagedFunction(problem.simulate, NUMBER, engine=self._engine)
        self._world = jax.eval_shape(problem.simulate, NUMBER)
        self._filters = {name: self._staged(name, named=True) for name in problem.contenders}
        stages = (self._simulate, *self._filters.values())
        self.bytes_of_run = max(one.bytes_of_run for one in stages)
        self._hand_over = CompilationTrigger(stages) if name == "vm" else None

    def _staged(self, name: str, named: bool = False) -> StagedFunction:
        """Record of a filter; named: in two parts, of which the second is kept of one run."""
        problem = self.problem
        one = partial(one_record, blocks_of(problem), contender(problem, name), over=one_by_one)
        return StagedFunction(
            (lambda world: split_record(one(world))) if named else one,
            self._world,
            named=named,
            engine=self._engine,
        )

    @property
    def notes(self) -> list[str]:
        """Parts that JAX computes, with the reason."""
        of = {"the simulation": self._simulate, **self._filters}
        return [
            f"{name}: a part stays with JAX, as {why}"
            for name, staged in of.items()
            for why in staged.refused
        ] + memory_note(self.bytes_of_run, LEAST)

    def width(self, runs: int) -> int:
        """Number of runs in a chunk, for a campaign of this size, limited by memory."""
        return min(width_of(self.bytes_of_run, CHUNK_BYTES), -(-runs // LEAST) * LEAST)

    def chunks(self, runs: int, chunk: int = 0, taken: Taken = whole_record) -> Iterator[Simulated]:
        """Simulate chunks and run their filters, on all cores, ahead of the requests.

        Args:
            runs: number of runs.
            chunk: runs at a time; not given, by the memory that they need.
            taken: what is kept of the record of a filter, called in the thread that computed it.
                Arrays that figures show of one run have a leading axis of one there.
        """
        width = chunk or self.width(runs)
        workers = concurrent_chunks(self.bytes_of_run, width, available_cores())
        begins, ahead_by = range(width, runs, width), workers + 1
        with threads(workers) as pool:

            def submitted(begin: int) -> Future[dict[str, PyTree]]:
                count = min(width, runs - begin)
                of = partial(self._chunk, begin, width, count, self._filters, taken)
                return pool.submit(of, runs - begin - count)

            # The first chunk compiles: each filter on a core of its own.
            count = min(width, runs)
            world = pool.submit(self._worlds, 0, width, count).result()
            first = {n: pool.submit(self._of, n, world, count, taken) for n in self._filters}
            named = first_run(world)
            del world
            yield named, count, lambda name: first[name].result()
            wait(first.values())
            ahead = deque(map(submitted, begins[:ahead_by]))
            returned = monotonic()
            for k, begin in enumerate(begins):
                found = ahead.popleft().result()
                if monotonic() - returned > BETWEEN_S:
                    release_memory()
                    returned = monotonic()
                ahead.extend(map(submitted, begins[k + ahead_by : k + ahead_by + 1]))
                yield None, min(width, runs - begin), found.__getitem__

    def compute(
        self,
        chunk: Chunk,
        width: int,
        names: Sequence[str],
        taken: Taken = whole_record,
        left: int = 0,
    ) -> dict[str, PyTree]:
        """Compute a chunk, filled up to a width, and keep what is `taken` of each filter.

        Args:
            chunk: of runs.
            width: of all chunks.
            names: of filters.
            taken: from the record of a filter.
            left: runs that are still to be computed after these.
        """
        of = partial(self._chunk, chunk.begin, width, chunk.runs)
        return with_stack(partial(of, names, taken, left))

    def histories(self, chunk: Chunk, width: int, names: Sequence[str]) -> dict[str, PyTree]:
        """All that was recorded of some filters over one chunk."""

        def computed() -> dict[str, PyTree]:
            world = self._worlds(chunk.begin, width, chunk.runs)
            return {name: first_runs(self._staged(name)(world), chunk.runs) for name in names}

        return with_stack(computed)

    def _worlds(self, begin: int, width: int, runs: int) -> PyTree:
        sys.audit("robins.simulate", runs)  # counted by tests
        return self._simulate(np.arange(begin, begin + width))

    def _of(self, name: str, world: PyTree, count: int, taken: Taken) -> PyTree:
        """Run a filter, and keep what is `taken` of its record without the padding runs."""
        return taken(name, rejoined_record(*first_runs(self._filters[name](world), count)))

    def _chunk(
        self, begin: int, width: int, count: int, names: Iterable[str], taken: Taken, left: int
    ) -> dict[str, PyTree]:
        """Compute the filters of some runs, and record the time that took; as `compute`."""
        begun, world = thread_time(), self._worlds(begin, width, count)
        found = {name: self._of(name, world, count, taken) for name in names}
        if self._hand_over is not None:
            self._hand_over.record_time(width, thread_time() - begun, left)
        return found


@contextmanager
def threads(count: int) -> Iterator[ThreadPoolExecutor]:
    """Thread pool with stacks large enough for lanes and compilers; exit cancels pending work."""
    before = threading.stack_size(STACK)
    pool = ThreadPoolExecutor(count)
    try:
        yield pool
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
        threading.stack_size(before)


def with_stack(function: Callable[[], PyTree]) -> PyTree:
    """Call a function on a stack that is large enough for lanes."""
    with threads(1) as pool:
        return pool.submit(function).result()


def first_worlds(problem: Problem, count: int) -> State:
    """First runs of a problem, with a leading axis, by the interpreter where possible."""
    sys.audit("robins.simulate", count)  # counted by tests
    simulate = StagedFunction(problem.simulate, NUMBER, engine=interpreted_rounds)
    return jax.device_put(with_stack(lambda: simulate(np.arange(count))))


def first_run(world: PyTree) -> PyTree:
    """First world of a leading axis of runs, copied so that the others can be freed."""

    def first(x: jax.Array | np.ndarray) -> jax.Array | np.ndarray:
        if jnp.issubdtype(x.dtype, jax.dtypes.prng_key):
            return x[0]
        return np.array(np.asarray(x)[0])  # an index of JAX would be a program for each shape

    return jax.device_put(jax.tree_util.tree_map(first, world))


def one_by_one(function: Callable[..., PyTree], rows: PyTree) -> PyTree:
    """Apply a function to one row after the other: a loop, which lanes support."""
    return jax.lax.map(function, rows)


def available_cores() -> int:
    """Number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def check_machine(name: str) -> None:
    """Refuse a machine that is not available, before anything is computed.

    Raises:
        RobinsError: there is no such machine, or no compiler for it.
    """
    if name and name not in MACHINES:
        raise RobinsError(f"no machine '{name}'", "--machine", "say vm, c or jax")
    try:
        if name == "c":
            compiler(CPP)
        if name == "vm":
            interpreter_of_many()
    except BuildError as error:
        where = f"--machine {name}: {error.where}" if error.where else f"--machine {name}"
        raise RobinsError(error.what, where, f"{error.fix}, or take --machine jax") from error


def machine_for(problem: Problem, name: str = "") -> JaxMachine | LaneMachine:
    """The machine of a campaign.

    Args:
        problem: to be simulated.
        name: one of `MACHINES`; not given, the interpreter, or JAX where that cannot be.

    Raises:
        RobinsError: the machine is not available, or a filter calls Python at its steps.
    """
    check_machine(name)
    if name == "jax":
        return JaxMachine(problem)
    for which, contender_ in problem.contenders.items():
        if why := contender_.on_host:
            if not name:
                return JaxMachine(problem)
            what = f"filter '{which}' cannot be a program: {why}"
            fix = "say jax, or choose other filters by --filters"
            raise RobinsError(what, f"--machine {name}", fix)
    if not name:
        try:
            interpreter_of_many()
        except BuildError as error:
            return JaxMachine(
                problem, [f"JAX computed, as the interpreter cannot be built: {error}"]
            )
    return LaneMachine(problem, name or "vm")
