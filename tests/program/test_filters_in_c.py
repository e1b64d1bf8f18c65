"""Whole steps of filters in C against JAX: every way, every rule, filters of filters."""

import jax.numpy as jnp
import numpy as np
import pytest
from machines import runs_the_same
from rule_table import ACTING, CIRCLE, FACING, HOLDING, RULES, START, SYSTEM, M, Y, line
from two_sensors import CHANNELS, SYSTEMS, by_sensor, split
from two_sensors import Y as OF_TWO

from robins.filters import (
    Code,
    ModeFamily,
    Model,
    Sensor,
    adaptive,
    cubature,
    distributed,
    federated,
    guarded,
    imm,
    kalman,
    particle,
    taylor,
    unscented,
)
from robins.filters.composite.adaptive import excited
from robins.filters.iterated import iterated
from robins.manifold import Angle

WAYS = {
    "derivatives": taylor(),
    "sigma points": unscented(),
    "narrow sigma points": unscented(0.1, 2.0, 0.0),
    "sigma points with a deficit": unscented(1.0, 0.0, -1.0),
    "cubature": cubature(),
    "points used again": unscented(redraw=False),
    "iterated": iterated(iterations=3),
}
MODEL = line()


def worst(rows: np.ndarray, rounds: int = 4) -> np.ndarray:
    """Rows again and again, with infinities and numbers that cannot be squared among them."""
    y = np.tile(rows, (rounds, 1))
    count = len(rows)
    y[count + 3] = np.inf
    y[count + 9, 1] = -np.inf
    y[2 * count + 5, 0] = 1e200
    y[3 * count + 2] = -1e290
    return y


DATA = worst(Y)


@pytest.mark.parametrize("form", ["sqrt", "joseph"])
@pytest.mark.parametrize("way", WAYS)
def test_every_way_and_form(way, form):
    got, _ = runs_the_same(kalman(WAYS[way], form=form), MODEL, START, {"y": DATA})
    codes = set(np.unique(got[1]["y"].code).tolist())
    assert codes >= {Code.DONE, Code.MISSING, Code.PARTLY_MISSING, Code.NOT_FINITE}


# Between them every rule, in filters where it acts; and what no filter there has.
FILTERS = {**ACTING, **HOLDING, "projection": [RULES["projection"]], "only": [RULES["gate only"]]}


def test_no_rule_is_left_out():
    there = {rule.name for rules in FILTERS.values() for rule in rules}
    assert there >= {name.split()[0] for name in RULES}


@pytest.mark.parametrize("name", FILTERS)
def test_every_rule(name):
    forms = ["joseph", "sqrt"] if name in ("robust", "learning", "gated") else ["sqrt"]
    way = unscented() if name in ("gated", "h_infinity", "bounded") else taylor()
    runs_the_same(kalman(way, FILTERS[name], forms[0]), MODEL, START, {"y": DATA})


def test_all_rules_in_one_filter_on_a_curved_model():
    curved = Sensor(lambda x, aux: SYSTEM.H @ x + 0.01 * x[:M] ** 2, jnp.array(SYSTEM.W), M)
    model = Model(MODEL.motion, (curved,))
    runs_the_same(kalman(unscented(), list(RULES.values())), model, START, {"y": Y})


def test_a_state_on_a_circle():
    y = (Angle(np.linspace(3.0, 3.4, 40)), np.tile(Y[:, 1:], (2, 1))[:40])
    runs_the_same(kalman(unscented()), CIRCLE, FACING, {"y": y})


S = SYSTEMS[0]
TWO = split(S)
MADE = {
    "federated, scalar, with a master": federated(
        CHANNELS, sharing="scalar", shares=[0.6, 0.1], master=0.3
    ),
    "federated, by diagonals": federated(CHANNELS, shares="diagonal", timeout=5),
    "zero-reset": federated(CHANNELS, mode="zero-reset"),
    "distributed": distributed(CHANNELS, "mean"),
    "guarded": guarded(kalman(), kalman(), "a", "b"),
    "mixture": imm([kalman(), kalman(unscented())], [[0.9, 0.1], [0.2, 0.8]]),
    "mixture of a family": imm(
        ModeFamily(
            lambda g: kalman(rules=[excited((slice(None),), g)]), jnp.array([[1.0], [3.0], [9.0]])
        ),
        [[0.8, 0.1, 0.1], [0.1, 0.8, 0.1], [0.1, 0.1, 0.8]],
    ),
    "bank over the noise": adaptive((1.0, 10.0)),
}


# Of few particles the factor is singular and its directions are chance: enough of them here.
CLOUDS = {
    "of the state": (particle(10, 3, regularise=0.1), DATA),
    "of some components": (particle(16, 3, sampled=[0, 2]), Y),
}


@pytest.mark.parametrize("name", CLOUDS)
def test_clouds_of_particles(name):
    filter_, y = CLOUDS[name]
    runs_the_same(filter_, MODEL, START, {"y": y}, unroll=200)


@pytest.mark.parametrize("name", MADE)
def test_filters_of_filters(name):
    runs_the_same(MADE[name], TWO, S.start(), by_sensor(OF_TWO[0]))


LONG = 10_000  # steps
# What is considered only is never seen, and a memory that fades lets it grow without bound.
LASTING = {
    **FILTERS,
    "robust": [rule for rule in FILTERS["robust"] if rule.name != "consider"],
    "considering": [RULES["consider"]],
}


@pytest.mark.parametrize("name", [*LASTING, *MADE])
def test_ten_thousand_steps(name):
    if name in MADE:
        y = np.tile(OF_TWO[0], (LONG // len(OF_TWO[0]), 1))
        runs_the_same(MADE[name], TWO, S.start(), by_sensor(y))
    else:
        runs_the_same(kalman(rules=LASTING[name]), MODEL, START, {"y": worst(Y, LONG // len(Y))})
