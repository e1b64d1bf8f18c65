"""Any two rules compose, in either order: finite, a covariance, and both say what they did."""

import itertools
import os

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from robins.filters import Belief, Model, Motion, Sensor, kalman, run, taylor, unscented
from robins.filters.rules import (
    adaptive_h_infinity,
    channel_inflation,
    consider,
    constant_gain,
    correntropy,
    discriminator,
    equality,
    fading_memory,
    gate,
    h_infinity,
    huber,
    igg3,
    inequality,
    innovation_fading,
    only,
    projection,
    sage_husa,
    strong_tracking,
    student_t,
    variational_bayes,
)

N, M = 4, 2
SEEN = jnp.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]])
# Position and rate on two axes, seen a little curved; the last state is what `consider` leaves.
MODEL = Model(
    Motion(
        lambda x, u: jnp.stack([x[0] + 0.1 * x[1], x[1], x[2] + 0.1 * x[3], x[3]]),
        jnp.array([0.01, 0.1, 0.01, 0.1]),
    ),
    (Sensor(lambda x, aux: SEEN @ x + 0.01 * x[:2] ** 2, jnp.array([0.5, 0.4]), M),),
)
START = Belief.of(jnp.array([0.0, 1.0, 0.0, -1.0]), np.diag([1.0, 0.25, 1.0, 0.25]))
# An ordinary sample, one far off with a component missing, and one after it.
Y = jnp.array([[0.2, 0.1], [9.0, jnp.nan], [0.3, -0.4]])

RULES = {
    "gate": gate(),
    "huber": huber(),
    "igg3": igg3(),
    "student_t": student_t(),
    "correntropy": correntropy(),
    "sage_husa": sage_husa(),
    "innovation_fading": innovation_fading(),
    "fading_memory": fading_memory(1.02),
    "variational_bayes": variational_bayes(),
    "strong_tracking outside": strong_tracking(form="outside"),
    "strong_tracking lumped": strong_tracking(form="lumped"),
    "strong_tracking multiple": strong_tracking(form="multiple"),
    "strong_tracking projected": strong_tracking(form="projected"),
    "discriminator": discriminator(),
    "h_infinity": h_infinity(10.0, jnp.eye(N)),
    "adaptive_h_infinity": adaptive_h_infinity(jnp.eye(N)[:2]),
    "equality": equality(jnp.array([[1.0, 0.0, 1.0, 0.0]]), jnp.array([0.5])),
    "inequality": inequality(jnp.array([[1.0, 0.0, 0.0, 0.0]]), [-10.0], [10.0]),
    "consider": consider([3]),
    "projection": projection("y"),
    "constant_gain": constant_gain({"y": 0.3 * SEEN.T}),
    "channel_inflation": channel_inflation(0.5, SEEN.T),
    "gate only": only("y", gate()),
}
SILENT = {"consider"}  # says nothing that StepInfo does not say
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
