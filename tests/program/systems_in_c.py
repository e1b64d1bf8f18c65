"""Filters of real systems in C against JAX, over the first epochs of a simulated run."""

import gc
from functools import cache

import jax
import jax.numpy as jnp
from machines import runs_the_same

from robins.campaign.monte_carlo import contender, run_case
from robins.program import BuildError, ProgramError
from robins.workbench.scenarios import read_scenario

EPOCHS = 40
UNROLL = 300

AIRSHIP = "airship/s1"

# A scenario of every study.
STUDIES = (
    AIRSHIP,
    "gnss/city",
    "ins-gnss/drive",
    "rocket/a1",
    "rocket/b1",
    "satellite/s1",
    "transfer-alignment/s0",
    "transfer-alignment/a",
    "transfer-alignment/aircraft",
)


@cache
def world_of(name):
    """Inputs of all filters of a scenario, simulated once."""
    problem = read_scenario(name, ("runs=1",)).problem((), 0)
    return jax.jit(problem.simulate)(jnp.asarray(0))


def check(name, filter_):
    """Check a filter of a scenario in C against JAX."""
    problem = read_scenario(name, ("runs=1",)).problem((filter_,), 0)
    one = contender(problem, filter_)

    @jax.jit
    def given(world):
        case = one.case(world)
        if case.loop is not None:  # its readings are known when it has run
            case = run_case(one.filter, one.model, case, lambda step: ())[1]
        rows = case.u, dict(case.y), dict(case.aux)
        return case.start, jax.tree.map(lambda x: x[:EPOCHS], rows)

    start, rows = given(world_of(name))
    u, y, aux = jax.device_get(rows)
    runs_the_same(one.filter, one.model, start, y, u, aux, unroll=UNROLL)


def walk(name):
    """Differences of all filters of a scenario, by their names."""
    # A smoother runs the filter that it is named after; what is on request calls Python.
    filters = [f for f in read_scenario(name, ()).study.usual if not f.endswith("+rts")]
    differs = {}
    for filter_ in filters:
        try:
            check(name, filter_)
        except (AssertionError, ProgramError, BuildError) as error:
            differs[filter_] = str(error)[:200]
        jax.clear_caches()  # the programs of all filters together take 14 GB
        gc.collect()
    return differs
