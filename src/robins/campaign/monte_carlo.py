"""N runs as one `vmap` in chunks of fixed shape.

A chunk is the unit of everything: of compilation (one shape, the last chunk padded), of memory, of
progress and, for stores and clusters, of work. Run number k draws the same random numbers in any
chunk of any campaign. A chunk of worlds is simulated once, and every filter sees it; filters that
differ only in numbers share compiled code.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.stages import Traced
from jaxtyping import Array, PyTree

from robins.campaign.memory import CHUNK, filled
from robins.errors import require
from robins.filters import Belief, Code, Step, Tally, run, run_closed
from robins.filters.analysis.consistency import normalised_sq
from robins.filters.run import checked, nothing
from robins.filters.values import as_data
from robins.manifold import State, local
from robins.program.liveness import bytes_of_jaxpr
from robins.systems.study import Case, Contender, Problem, View
from robins.systems.suspects import probabilities
from robins.systems.tables import updates

Blocks = tuple[tuple[str, int, int], ...]  # name, first and end of its reported components


def _kept(step: Step) -> PyTree:
    """Part of a step that a campaign keeps: enough for errors, bounds and innovations."""
    info = {name: u._replace(notes=step.info[name].notes) for name, u in updates(step).items()}
    return step.posterior, info, step.prediction.code == int(Code.DONE)


def _judged(
    blocks: Blocks, belief: Belief, truth: State, rows: Array | None, lost: Array
) -> dict[str, PyTree]:
    """Error and stated sigma of the reported components at one epoch."""
    whole, factor = local(belief.mean, truth), belief.factor
    error = whole if rows is None else rows @ whole
    stated = factor if rows is None else rows @ factor
    # A filter that could not predict is no longer at the time of the truth: it has diverged.
    error = jnp.where(lost, jnp.nan, error)
    parts = {name: (error[first:last], stated[first:last]) for name, first, last in blocks}
    return {
        "error": error,
        "sigma": jnp.sqrt(jnp.sum(stated * stated, -1)),
        "nees": normalised_sq(whole, factor),
        "block_nees": {name: normalised_sq(*part) for name, part in parts.items()},
    }


def reported_rows(reported: PyTree, case: Case) -> tuple[Array | None, int | None]:
    """Rows that map a tangent error to the reported components, and their axis of time if any.

    (r, n) or (E, r, n); None: all of the error is reported.
    """
    if case.rows is not None:
        return case.rows, 0
    return (None if reported is None else jnp.asarray(reported, float)), None


def run_case(
    filter_, model, case: Case, keep: Callable[[Step], PyTree]
) -> tuple[PyTree, Case, Tally]:
    """Kept parts of the steps of a filter, its case with all its inputs, and the tally.

    A case in closed loop has its truth and measurements only after the filter has run.
    """
    if case.loop is None:
        done = run(filter_, model, case.start, case.y, case.u, case.aux, keep=keep)
        return done.steps, case, done.tally
    done = run_closed(filter_, model, case.start, case.loop, keep)
    given = done.readings
    found = {"u": given.u, "y": given.y, "aux": given.aux, "truth": given.truth}
    case = case._replace(**found, rows=given.rows, outputs=given.outputs, loop=None)
    return done.steps, case, done.tally


def complete_case(filter_, model, case: Case) -> Case:
    """A case with all its inputs; in closed loop the filter is run to find them."""
    if case.loop is not None:
        return run_case(filter_, model, case, nothing)[1]
    checked(model, case.y, case.u, case.aux)
    return case


Over = Callable[[Callable[..., Any], Any], Any]  # maps a function over the rows of arrays


def at_once(function: Callable[..., PyTree], rows: PyTree) -> PyTree:
    """Apply a function to all rows in one batch."""
    return jax.vmap(function)(rows)


def one_record(
    blocks: Blocks, contender: Contender, world: PyTree, over: Over = at_once
) -> dict[str, PyTree]:
    """Record of one run of one filter: what statistics need."""
    steps, case, tally = run_case(contender.filter, contender.model, contender.case(world), _kept)
    posterior, info, moved = steps
    rows, along = reported_rows(contender.reported, case)
    lost = jnp.cumsum(~moved) > 0

    def judged(row: PyTree) -> dict[str, PyTree]:
        belief, truth, turned, lost = row
        return _judged(blocks, belief, truth, rows if along is None else turned, lost)

    return {
        **over(judged, (posterior, case.truth, None if along is None else rows, lost)),
        "dim": jnp.asarray(posterior.factor.shape[-1]),
        "mean": posterior.mean,
        "updates": info,
        "wrong": probabilities(contender.filter, info),
        "outputs": dict(case.outputs),
        "readings": dict(case.y),
        "tally": tally,
    }


@partial(jax.jit, static_argnames="blocks")
def _records(filter_, blocks: Blocks, model, case, reported, worlds) -> dict[str, PyTree]:
    contender = Contender(filter_, model, case, reported)
    return _each(partial(one_record, blocks, contender), worlds)


def _each(one: Callable[[PyTree], PyTree], many: PyTree) -> PyTree:
    """Apply `one` to each run of a batch.

    A single run is not vectorised: its branches stay branches, and it has the bits of `run` or
    `run_closed`, which a batch has to rounding only.
    """
    leaves, shape = jax.tree_util.tree_flatten(many)
    if leaves[0].shape[0] > 1:
        return jax.vmap(one)(many)
    alone = one(shape.unflatten([x[0] for x in leaves]))
    return jax.tree_util.tree_map(lambda x: x[None], alone)


def worlds(
    problem: Problem, runs: int, chunk: int = CHUNK, first: int = 0, batch: PyTree = None
) -> Iterator[tuple[PyTree, int]]:
    """Simulate runs first .. first + runs - 1, one chunk at a time, with `batch_of` the problem.

    Yields:
        What `Problem.simulate` returns, with a leading axis of ``filled(runs, chunk)``, and how
        many of them count: the last chunk is padded with runs to be thrown away.

    Raises:
        ValueError: runs or chunk is not positive.
    """
    require(min(runs, chunk) >= 1, f"runs and chunk must be at least 1, got {runs} and {chunk}")
    width, batch = filled(runs, chunk), batch or batch_of(problem)
    for begin in range(first, first + runs, width):
        sys.audit("robins.simulate", width)  # counted by tests
        yield batch(jnp.arange(begin, begin + width)), min(width, first + runs - begin)


def batch_of(problem: Problem) -> PyTree:
    """The simulation of a problem for many runs, compiled for each shape once."""
    return jax.jit(partial(_each, problem.simulate))


def bytes_of_batch(problem: Problem, batch: PyTree, width: int) -> int:
    """Approximate peak memory [bytes] of JAX for a chunk of this many runs.

    The traces are used again when a chunk of this width is computed.

    Args:
        problem: to be simulated.
        batch: its simulation, as `batch_of` gives it.
        width: runs of the chunk.
    """
    every = [batch.trace(_numbers(width)), *traced(problem, batch, width).values()]
    return max(bytes_of_jaxpr(one.jaxpr.jaxpr) for one in every)


def traced(problem: Problem, batch: Callable, width: int) -> dict[str, Traced]:
    """Programs of all filters, by name, for a chunk of this many runs; not compiled yet."""
    many = jax.eval_shape(batch, _numbers(width))
    return {name: _records.trace(*_given(problem, name), many) for name in problem.contenders}


def _numbers(width: int) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct((width,), jax.dtypes.canonicalize_dtype(int))


def _given(problem: Problem, name: str) -> tuple:
    """Arguments of `_records` before the worlds."""
    c = contender(problem, name)
    return c.filter, blocks_of(problem), c.model, c.case, c.reported


def contender(problem: Problem, name: str) -> Contender:
    """A contender of a problem, as data, so that contenders of one kind share compiled code.

    Raises:
        ValueError: there is none of this name.
    """
    if name not in problem.contenders:
        raise ValueError(f"no filter '{name}'; this problem has {sorted(problem.contenders)}")
    c = problem.contenders[name]
    return replace(c, case=as_data(c.case))


def record(problem: Problem, name: str, worlds: PyTree, count: int) -> dict[str, PyTree]:
    """Run a filter of a problem in a chunk of worlds.

    Returns:
        NumPy records with a leading axis of ``count`` runs. Of the reported components error and
        sigma (E, r) and block_nees by block; of the state mean, nees (E,) and dim (); by sensor
        updates, each a `robins.systems.tables.SensorUpdates`, and readings; by name the outputs; by
        suspect the probability that it is wrong (E,); the tally of its steps.

    Raises:
        ValueError: there is no such contender.
    """
    return first_runs(_records(*_given(problem, name), worlds), count)


def blocks_of(view: View) -> Blocks:
    """The blocks of a problem as arguments of compiled code."""
    return tuple((b.name, b.where.start, b.where.stop) for b in view.blocks)


_NEEDED = ("innovation", "sigma", "nis", "dof")  # fields of updates that statistics use


def split_record(record: dict[str, PyTree]) -> tuple[dict[str, PyTree], dict[str, PyTree]]:
    """Split a record: the part that statistics need of each run, and that of the first run only."""
    named = {"mean": record["mean"], "updates": record["updates"]}
    needed = {
        name: {field: getattr(u, field) for field in _NEEDED}
        for name, u in record["updates"].items()
    }
    return record | {"mean": None, "updates": needed}, named


def rejoined_record(needed: dict[str, PyTree], named: dict[str, PyTree]) -> dict[str, PyTree]:
    """Inverse of `split_record`; arrays of the first run only have a leading axis of one."""
    updates = {name: u._replace(**needed["updates"][name]) for name, u in named["updates"].items()}
    return needed | {"mean": named["mean"], "updates": updates}


def first_runs(records: PyTree, count: int) -> PyTree:
    """First runs of records with a leading axis of runs, as NumPy."""
    return jax.tree_util.tree_map(lambda x: np.asarray(x)[:count], records)
