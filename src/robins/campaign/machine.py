"""On what a campaign runs: batches of JAX, or programs in lanes on all cores.

Both have the same random numbers and, to rounding, the same results; JAX is the reference. Lanes
are compiled for each problem, which takes from seconds to a minute and is kept on this machine:
they are chosen where JAX would take longer than that.
"""

from __future__ import annotations

import os
import threading
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from robins.campaign.monte_carlo import CHUNK, contender, cut, one_record, record, worlds
from robins.errors import RobinsError
from robins.program import CPP, BuildError, compiler
from robins.program.stages import Staged
from robins.systems.study import Problem

MACHINES = ("jax", "c", "cuda")
PAYS = 60.0  # seconds of JAX on one core for which it pays to compile lanes
LEAST = 8  # runs of a chunk in lanes
FEWEST = 100  # runs of which this is asked
NS = 0.5  # of JAX, for a scalar operation in a scan (measured: 0.4 to 0.8)
STACK = 1 << 28  # bytes of a thread's stack, on which lanes hold all that a step computes

Chunk = tuple[Any, int, Callable[[str], Any]]  # worlds, how many count, the record of a filter


class ByJax:
    """Chunks as batches of JAX, one after the other."""

    name = "jax"
    notes: tuple[str, ...] = ()

    def __init__(self, problem: Problem):
        self.problem = problem

    def chunks(self, runs: int, chunk: int = CHUNK) -> Iterator[Chunk]:
        """Simulate a chunk; its filters run when their records are asked for."""
        for batch, count in worlds(self.problem, runs, chunk):
            yield batch, count, partial(self._record, batch, count)

    def _record(self, batch: Any, count: int, name: str) -> Any:
        return record(self.problem, name, batch, count)


class InLanes:
    """Chunks as programs in lanes, one on each core."""

    name = "c"

    def __init__(self, problem: Problem):
        self.problem = problem
        number = jax.ShapeDtypeStruct((), jnp.asarray(0).dtype)
        self._simulate = Staged(problem.simulate, number)
        world = jax.eval_shape(problem.simulate, number)
        blocks = tuple((b.name, b.where.start, b.where.stop) for b in problem.blocks)
        self._filters = {
            name: Staged(
                partial(one_record, blocks, contender(problem, name), over=one_by_one), world
            )
            for name in problem.contenders
        }

    @property
    def operations(self) -> int:
        """About how many scalar operations a run is, in what is worth a program."""
        return sum(s.operations for s in (self._simulate, *self._filters.values()))

    @property
    def notes(self) -> list[str]:
        """What JAX has to do, and why."""
        of = {"the simulation": self._simulate, **self._filters}
        return [
            f"{name}: a loop stays with JAX, as {one.refused}"
            for name, staged in of.items()
            for one in staged.loops
            if one.refused
        ]

    def chunks(self, runs: int, chunk: int = CHUNK) -> Iterator[Chunk]:
        """Simulate chunks and run their filters, on all cores, ahead of what is asked for."""
        cores = available_cores()
        width = min(chunk, max(LEAST, -(-runs // cores)))
        before = threading.stack_size(STACK)
        pool = ThreadPoolExecutor(cores)
        begins, ahead_by = range(width, runs, width), cores + 1
        try:
            # The first chunk compiles: each filter on a core of its own.
            world = pool.submit(self._worlds, 0, width).result()
            first = {name: pool.submit(one, world) for name, one in self._filters.items()}
            yield world, min(width, runs), lambda name: cut(first[name].result(), runs)
            ahead = deque(pool.submit(self._chunk, begin, width) for begin in begins[:ahead_by])
            for k, begin in enumerate(begins):
                world, found = ahead.popleft().result()
                for later in begins[k + ahead_by : k + ahead_by + 1]:
                    ahead.append(pool.submit(self._chunk, later, width))
                yield world, min(width, runs - begin), partial(_of, found, runs - begin)
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
            threading.stack_size(before)

    def _worlds(self, begin: int, width: int) -> Any:
        return self._simulate(jnp.arange(begin, begin + width))

    def _chunk(self, begin: int, width: int) -> tuple[Any, dict[str, Any]]:
        world = self._worlds(begin, width)
        return world, {name: staged(world) for name, staged in self._filters.items()}


def _of(found: dict[str, Any], count: int, name: str) -> Any:
    """The record of a filter, without the runs that only fill a chunk."""
    return cut(found[name], count)


def one_by_one(function: Callable[..., Any], rows: Any) -> Any:
    """All rows one after the other: a loop, which lanes can do."""
    return jax.lax.map(function, rows)


def available_cores() -> int:
    """How many cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def check_machine(name: str) -> None:
    """Refuse a machine that is not there, before anything is computed.

    Raises:
        RobinsError: there is no such machine, or no compiler for it.
    """
    if name == "cuda":
        raise RobinsError(
            "campaigns do not run as a kernel of a GPU yet", "--machine cuda", "say jax or c."
        )
    if name == "c":
        compiler(CPP)


def has_compiler() -> bool:
    """Whether lanes can be compiled here."""
    try:
        compiler(CPP)
    except BuildError:
        return False
    return True


def machine_for(problem: Problem, runs: int, name: str = "") -> ByJax | InLanes:
    """The machine of a campaign.

    Args:
        problem: to be simulated.
        runs: how many.
        name: one of `MACHINES`; not given, lanes where they pay and there is a compiler.

    Raises:
        RobinsError: the machine asked for is not there.
    """
    check_machine(name)
    if name == "jax" or (not name and (runs < FEWEST or not has_compiler())):
        return ByJax(problem)
    lanes = InLanes(problem)
    if name or runs * lanes.operations * NS * 1e-9 > PAYS:
        return lanes
    return ByJax(problem)
