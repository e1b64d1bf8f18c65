"""Any two rules compose, in either order: finite, a covariance, and both say what they did."""

import itertools
import os

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rule_table import RULES, SILENT, START, SYSTEM, M, line

from robins.filters import Model, Sensor, kalman, run, taylor, unscented

# The model of the table, seen a little curved.
CURVED = Sensor(lambda x, aux: SYSTEM.H @ x + 0.01 * x[:M] ** 2, jnp.array(SYSTEM.W), M)
MODEL = Model(line().motion, (CURVED,))
# An ordinary sample, one far off with a component missing, and one after it.
Y = jnp.array([[0.002, 0.9, 0.1], [0.09, jnp.nan, 9.0], [0.003, 0.8, -0.4]])
NAMES = list(RULES)


def step(rules, way):
    one = kalman(way, rules)

    def go(state, row):
        state, prediction = one.predict(state, MODEL.motion, None)
        state, info = one.update(state, MODEL.sensors[0], row, None)
        return state, (prediction.code, info)

    return one.init(START, MODEL.dims), go


def heard(info, names):
    said = {note.split(".")[0] for note in info.notes}
    assert said >= {name.split()[0] for name in names} - SILENT, names


@pytest.mark.parametrize("first", NAMES)
def test_any_two_rules_fit_in_either_order(first):
    # Traced, which is what takes a rule apart: structure, shapes and kinds of what they hand on.
    for second in NAMES:
        state, go = step([RULES[first], RULES[second]], taylor())
        after, (_, info) = jax.eval_shape(go, state, Y[0])
        assert jax.tree.structure(after) == jax.tree.structure(state), (first, second)
        assert [x.shape for x in jax.tree.leaves(after)] == [
            jnp.shape(x) for x in jax.tree.leaves(state)
        ], (first, second)
        heard(info, (first, second))


def check(rules, names, way, form="sqrt"):
    one = kalman(way, rules, form)
    solution = run(one, MODEL, START, Y)
    assert np.all(np.isfinite(solution.mean)), names
    assert not np.any(solution.steps.prediction.code), names
    assert set(solution.steps.info["y"].code.tolist()) <= {0, 2, 3}, names
    spread = np.linalg.eigvalsh(solution.covariance)
    assert np.all(spread[:, 0] > -1e-12 * spread[:, -1]), names
    heard(solution.steps.info["y"], names)


@pytest.mark.parametrize("turn", [1, -1], ids=["as listed", "in reverse"])
@pytest.mark.parametrize("form", ["sqrt", "joseph"])
def test_all_rules_in_one_filter(turn, form):
    # Each of them before each other one, in one direction or the other. The first filter that
    # combines them all need not be a good one; it must be a sound one.
    names = [name for name in NAMES[::turn] if form == "sqrt" or name != "equality"]
    check([RULES[name] for name in names], names, unscented(), form)


RING = [(NAMES[i], NAMES[(i + 7) % len(NAMES)]) for i in range(0, len(NAMES), 2)]
PAIRS = list(itertools.permutations(NAMES, 2)) if "ROBINS_ALL_PAIRS" in os.environ else RING


@pytest.mark.parametrize(("first", "second"), PAIRS)
def test_pairs_run(first, second):
    # A few in every test run; ROBINS_ALL_PAIRS=1 runs each there is, which takes a quarter hour.
    way = taylor() if (NAMES.index(first) + NAMES.index(second)) % 2 else unscented()
    check([RULES[first], RULES[second]], (first, second), way)
