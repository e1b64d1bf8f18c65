"""Filters of real systems in C against JAX, over the first epochs of a simulated run.

Some are cheap enough to wait for; `make certify` walks all filters of all studies.
"""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from machines import runs_the_same

from robins.campaign.monte_carlo import contender, solved
from robins.program import BuildError, ProgramError
from robins.systems import SYSTEMS
from robins.systems.catalogue import SUMMARIES
from robins.workbench.scenarios import read_scenario

EPOCHS = 40
UNROLL = 300

# A scenario of every study.
STUDIES = (
    "airship/s1",
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
    """What all filters of a scenario are given, simulated once."""
    problem = read_scenario(name, ("runs=1",)).problem((), 0)
    return jax.jit(problem.simulate)(jnp.asarray(0))


def check(name, filter_):
    """That a filter of a scenario runs in C as by JAX."""
    problem = read_scenario(name, ("runs=1",)).problem((filter_,), 0)
    one = contender(problem, filter_)
    case = one.case(world_of(name))
    if case.loop is not None:  # its readings are known when it has run
        case = solved(one.filter, one.model, case, lambda step: ())[1]
    u, y, aux = jax.tree.map(
        lambda x: np.asarray(x)[:EPOCHS], (case.u, dict(case.y), dict(case.aux))
    )
    runs_the_same(one.filter, one.model, case.start, y, u, aux, unroll=UNROLL)


@pytest.mark.parametrize(
    ("name", "filter_"),
    [("transfer-alignment/s0", "kf"), ("gnss/city", "ls"), ("rocket/a1", "gyro")],
)
def test_a_filter_of_a_system(name, filter_):
    check(name, filter_)


@pytest.mark.parametrize("name", STUDIES)
def test_every_filter_of_a_study(name):
    # A smoother runs the filter that it is named after.
    filters = [f for f in read_scenario(name, ()).study.filters if not f.endswith("+rts")]
    differs = {}
    for filter_ in filters:
        try:
            check(name, filter_)
        except (AssertionError, ProgramError, BuildError) as error:
            differs[filter_] = str(error)[:200]
    assert not differs


def test_no_study_is_left_out():
    walked = [read_scenario(name, ()).study for name in STUDIES]
    for system in SUMMARIES:
        for study in SYSTEMS[system].studies.values():
            assert any(study is one for one in walked), system
