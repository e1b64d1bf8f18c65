"""Filters of real systems in C against JAX, over the first epochs of a simulated run."""

import tomllib

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from machines import runs_the_same

from robins import scenario
from robins.campaign.monte_carlo import contender
from robins.systems.finding import find_system

EPOCHS = 40
# System, scenario, study, filter.
CASES = [
    ("transfer-alignment", "s0", "kf"),
]


@pytest.mark.parametrize(("system", "name", "filter_"), CASES)
def test_a_filter_of_a_system(system, name, filter_):
    found = find_system(system)
    text = found.scenarios[name].read_text()
    study = found.studies[tomllib.loads(text)["study"]]
    problem = study.problem(scenario.parse(study.parameters, text, []), (filter_,), 0)
    world = jax.jit(problem.simulate)(jnp.asarray(0))
    one = contender(problem, filter_)
    case = one.case(world)
    u, y, aux = jax.tree.map(
        lambda x: np.asarray(x)[:EPOCHS], (case.u, dict(case.y), dict(case.aux))
    )
    runs_the_same(one.filter, one.model, case.start, y, u, aux, unroll=3000)
