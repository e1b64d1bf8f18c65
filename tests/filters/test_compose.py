"""Any two rules compose, in either order: finite, a covariance, and both say what they did."""

import jax.numpy as jnp
import numpy as np
import pytest
from interpreted import run
from rule_table import RULES, SILENT, START, SYSTEM, M, line

from robins.filters import Model, Sensor, kalman, taylor, unscented

# The model of the table, seen a little curved.
CURVED = Sensor(lambda x, aux: SYSTEM.H @ x + 0.01 * x[:M] ** 2, jnp.array(SYSTEM.W), M)
MODEL = Model(line().motion, (CURVED,))
# An ordinary sample, one far off with a component missing, and one after it.
Y = jnp.array([[0.002, 0.9, 0.1], [0.09, jnp.nan, 9.0], [0.003, 0.8, -0.4]])
NAMES = list(RULES)


def check(names, way, form="sqrt"):
    # A run hands the state on in a loop, which takes no other structure than it began with.
    solution = run(kalman(way, [RULES[name] for name in names], form), MODEL, START, Y)
    info = solution.steps.info["y"]
    assert np.all(np.isfinite(solution.mean)), names
    assert not np.any(solution.steps.prediction.code), names
    assert set(info.code.tolist()) <= {0, 2, 3}, names
    spread = np.linalg.eigvalsh(solution.covariance)
    assert np.all(spread[:, 0] > -1e-12 * spread[:, -1]), names
    said = {note.split(".")[0] for note in info.notes}
    assert said >= {name.split()[0] for name in names} - SILENT, names


@pytest.mark.parametrize("turn", [1, -1], ids=["as listed", "in reverse"])
@pytest.mark.parametrize("form", ["sqrt", "joseph"])
def test_all_rules_in_one_filter(turn, form):
    # Each of them before each other one, in one direction or the other. The first filter that
    # combines them all need not be a good one; it must be a sound one.
    check([n for n in NAMES[::turn] if form == "sqrt" or n != "equality"], unscented(), form)


@pytest.mark.parametrize("i", range(len(NAMES)), ids=NAMES)
def test_any_two_rules_run_in_either_order(i):
    for j in range(len(NAMES)):
        check((NAMES[i], NAMES[j]), taylor() if (i + j) % 2 else unscented())
