"""N runs as one `vmap` in chunks of fixed shape.

A chunk is the unit of everything: of compilation (one shape, the last chunk padded), of memory, of
progress and, for stores and clusters, of work. Run number k draws the same random numbers in any
chunk of any campaign.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from robins.filters import Solution, Step, run
from robins.filters.consistency import block_nees, nees
from robins.manifold import local
from robins.systems.system import Contender, Problem

CHUNK = 64  # runs; large enough to fill a core's vectors, small enough for the cache


def _kept(step: Step) -> Any:
    """What a campaign keeps of a step: enough for errors, bounds and innovations."""
    info = {name: (i.innovation, i.sigma, i.nis, i.dof, i.code) for name, i in step.info.items()}
    return step.posterior, info


def _record(problem: Problem, contender: Contender, index: Array) -> dict[str, Any]:
    """One run of one filter, from its number to what statistics need."""
    case = problem.simulate(index)
    solution: Solution = run(
        contender.filter, contender.model, case.start, case.y, case.u, case.aux, keep=_kept
    )
    posterior, info = solution.steps
    blocks = {b.name: jax.vmap(partial(block_nees, block=b.where)) for b in problem.blocks}
    return {
        "error": jax.vmap(local)(posterior.mean, case.truth),
        "sigma": posterior.sigma,
        "nees": jax.vmap(nees)(posterior, case.truth),
        "block_nees": {name: f(posterior, case.truth) for name, f in blocks.items()},
        "mean": posterior.mean,
        "innovation": {k: v[0] for k, v in info.items()},
        "innovation_sigma": {k: v[1] for k, v in info.items()},
        "nis": {k: v[2] for k, v in info.items()},
        "dof": {k: v[3] for k, v in info.items()},
        "code": {k: v[4] for k, v in info.items()},
    }


def chunks(
    problem: Problem,
    name: str,
    runs: int,
    chunk: int = CHUNK,
    first: int = 0,
    progress: Callable[[int], None] | None = None,
) -> Iterator[dict[str, Any]]:
    """Run a filter of a problem over runs first .. first + runs - 1.

    Args:
        problem: what to simulate.
        name: which of its contenders.
        runs: how many.
        chunk: runs per batch.
        first: number of the first run.
        progress: called with the number of runs done after each chunk.

    Yields:
        NumPy records with a leading axis of at most ``chunk`` runs: error (E, n), sigma, nees (E,),
        block_nees by block, mean, and by sensor innovation, innovation_sigma, nis, dof, code.

    Raises:
        ValueError: runs or chunk is not positive, or there is no such contender.
    """
    if runs < 1 or chunk < 1:
        raise ValueError(f"runs and chunk must be at least 1, got {runs} and {chunk}")
    if name not in problem.contenders:
        raise ValueError(f"no filter '{name}'; this problem has {sorted(problem.contenders)}")
    width = min(chunk, runs)
    batch = jax.jit(jax.vmap(partial(_record, problem, problem.contenders[name])))
    for begin in range(first, first + runs, width):
        count = min(width, first + runs - begin)
        # the last chunk is padded with runs that are computed and thrown away
        record = batch(jnp.arange(begin, begin + width))
        yield jax.tree_util.tree_map(lambda x, c=count: np.asarray(x)[:c], record)
        if progress is not None:
            progress(begin - first + count)
