"""A filter is a value: JAX takes it as an argument, and another number is no other program."""

import dataclasses
import inspect
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.tree_util import Partial
from rule_table import SEEN, START, L, M, N, T, Y, line

from robins.filters import (
    Filter,
    Model,
    Motion,
    OnlineFilter,
    Rule,
    Sensor,
    adaptive,
    at_master,
    channel,
    delayed,
    distributed,
    federated,
    guarded,
    imm,
    iterated,
    kalman,
    mode,
    particle,
    run,
    unscented,
)
from robins.filters import rules as of_rules
from robins.filters.machine import _predict, _update
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
from robins.filters.run import _scan
from robins.filters.values import as_data, content, kind, number, split_numbers, value

EYE = jnp.eye(N)
MODEL = line()
KEYS = [jax.random.key(seed) for seed in (0, 1)]


def with_rule(rule):
    """A filter of the one rule."""
    return kalman(rules=[rule])


# What makes a rule or a filter, and two sets of numbers that one program must serve.
NUMBERS = {
    "gate": (gate, {"probability": 0.99, "patience": 5}, {"probability": 0.9, "patience": 7}),
    "huber": (huber, {"probability": 0.9, "patience": 3}, {"threshold": 2.0, "patience": 4}),
    "igg3": (igg3, {}, {"k0": 1.0, "k1": 5.0, "floor": 0.1, "patience": 3}),
    "student_t": (student_t, {}, {"dof": 4.0, "patience": 3}),
    "correntropy": (correntropy, {}, {"kernel": 4.0, "patience": 3}),
    "sage_husa": (sage_husa, {}, {"forgetting": 0.95, "floor": 0.2, "ceiling": 50.0}),
    "innovation_fading": (innovation_fading, {}, {"limit": 50.0, "reach": 4.0}),
    "fading_memory": (fading_memory, {"factor": 1.0}, {"factor": 1.1}),
    "variational_bayes": (
        variational_bayes,
        {},
        {"forgetting": 0.9, "initial_dof": 8.0, "floor": 0.1, "ceiling": 50.0},
    ),
    "strong_tracking": (strong_tracking, {}, {"rho": 0.9, "beta": 2.0, "limit": 50.0}),
    "discriminator": (discriminator, {}, {"probability": 0.9, "rho": 0.9, "limit": 20.0}),
    "h_infinity": (
        h_infinity,
        {"gamma": 20.0, "weight": EYE},
        {"gamma": math.inf, "weight": 2 * EYE, "margin": 0.1},
    ),
    "adaptive_h_infinity": (
        adaptive_h_infinity,
        {"weight": EYE},
        {"weight": 2 * EYE, "zeta": 2.0, "floor": 1.5, "ceiling": 30.0},
    ),
    "equality": (
        equality,
        {"g": np.eye(1, N), "d": np.zeros(1), "gate": 0.9},
        {"g": 2 * np.eye(1, N), "d": np.ones(1), "gate": 0.99},
    ),
    "inequality": (
        inequality,
        {"g": np.eye(1, N), "lower": [-1.0], "upper": [1.0]},
        {"g": 2 * np.eye(1, N), "lower": [-2.0], "upper": [3.0]},
    ),
    "consider": (consider, {"states": [3]}, {"states": [3]}),
    "projection": (projection, {"sensors": "y"}, {"sensors": "y"}),
    "constant_gain": (
        constant_gain,
        {"gains": {"y": SEEN.T}},
        {"gains": {"y": 0.3 * SEEN.T}},
    ),
    "channel_inflation": (
        channel_inflation,
        {"lambda_": 0.5, "B": SEEN.T},
        {"lambda_": 0.25, "B": 2 * SEEN.T},
    ),
    "only": (lambda p: only("y", gate(p)), {"p": 0.9}, {"p": 0.99}),
    "kalman": (lambda p: with_rule(gate(p)), {"p": 0.9}, {"p": 0.99}),
    "imm": (
        lambda stay, p: imm([kalman(), with_rule(huber(p))], [[stay, 1 - stay], [0.5, 0.5]]),
        {"stay": 0.9, "p": 0.9},
        {"stay": 0.8, "p": 0.99},
    ),
    "imm, motions": (
        lambda q: imm(
            [mode(kalman(), Motion(MODEL.motion.step, q * EYE)), kalman()], np.full((2, 2), 0.5)
        ),
        {"q": 1.0},
        {"q": 2.0},
    ),
    "adaptive": (adaptive, {}, {"scales": (1.0, 4.0, 32.0)}),
    "federated": (
        lambda share, p: federated(
            [channel("y", with_rule(gate(p))), channel("z", kalman())], shares=[share, 1 - share]
        ),
        {"share": 0.5, "p": 0.9},
        {"share": 0.3, "p": 0.99},
    ),
    "distributed": (
        lambda p: distributed([channel("y", with_rule(gate(p))), channel("z", kalman())]),
        {"p": 0.9},
        {"p": 0.99},
    ),
    "at_master": (lambda p: at_master(kalman(), "y", with_rule(gate(p))), {"p": 0.9}, {"p": 0.99}),
    "guarded": (
        lambda p: guarded(with_rule(gate(p)), kalman(), "y", ["z"]),
        {"p": 0.9},
        {"p": 0.99},
    ),
    "delayed": (lambda p: delayed(with_rule(gate(p)), MODEL, 2), {"p": 0.9}, {"p": 0.99}),
    "particle": (lambda k: particle(10, KEYS[k]), {"k": 0}, {"k": 1}),
}
# Numbers that are kinds, and why: each chooses what is compiled.
KINDS = {
    "alpha, beta, kappa": (unscented, {"alpha": 1.0}, {"alpha": 0.5}, "signs choose sums"),
    "iterations of a weight": (student_t, {}, {"iterations": 4}, "an unrolled loop"),
    "iterations of a linearisation": (iterated, {}, {"iterations": 3}, "a loop's first steps"),
    "patience to agree in": (
        lambda n: gate(patience=n, recovery="reinitialise"),
        {"n": 3},
        {"n": 4},
        "refusals remembered",
    ),
    "window": (innovation_fading, {}, {"window": 3}, "innovations remembered"),
    "particles": (lambda n: particle(n, KEYS[0]), {"n": 10}, {"n": 20}, "their number"),
    "delay": (lambda n: delayed(kalman(), MODEL, n), {"n": 2}, {"n": 3}, "steps remembered"),
    "components": (consider, {"states": [2]}, {"states": [3]}, "which states there are"),
}


def shape(tree):
    """Key of a compilation by JAX: structure, and types of the leaves."""
    leaves, structure = jax.tree_util.tree_flatten(tree)
    return structure, [jax.typeof(x) for x in leaves]


@pytest.mark.parametrize("name", NUMBERS)
def test_another_number_is_no_other_program(name):
    make, one, other = NUMBERS[name]
    first, again, changed = make(**one), make(**one), make(**other)
    assert shape(first) == shape(again) == shape(changed)
    assert content(first) == content(again)
    assert (content(first) == content(changed)) == (one is other or str(one) == str(other))
    keys = [x for x in jax.tree_util.tree_leaves(first) if not jnp.issubdtype(x.dtype, float)]
    assert all(jnp.issubdtype(x.dtype, jax.dtypes.prng_key) for x in keys), "whole numbers"


def test_the_table_leaves_out_no_rule_and_no_filter():
    made = {name for name in of_rules.__all__ if name[0].islower() and "per_step" not in name}
    assert made - {"with_gains", "with_gamma"} <= set(NUMBERS)


@pytest.mark.parametrize("name", KINDS)
def test_a_number_that_decides_a_shape_or_a_sign_is_a_kind(name):
    make, one, other, _ = KINDS[name]
    assert shape(make(**one)) != shape(make(**other))
    assert len(KINDS) <= 10


def test_a_changed_number_of_a_run_and_of_a_stream_compiles_nothing():
    def sizes():
        return [one._cache_size() for one in (_scan, _predict, _update)]

    seen = []
    for p in (0.9, 0.99):
        it = kalman(rules=[gate(p), huber(p)])
        online = OnlineFilter(it, line(p), START)
        online.predict()
        online.update(Y[0])
        seen.append((run(it, line(p), START, Y).log_likelihood, sizes()))
    (one, before), (other, after) = seen
    assert one != other
    assert before == after


ROBUST = kalman(rules=[gate(0.999), huber(0.9), h_infinity(300.0, L)])


@jax.jit
def log_likelihood(filter_, y):
    """Log-likelihood of a run."""
    return run(filter_, MODEL, START, y).log_likelihood


def test_slopes_in_the_numbers_of_a_filter_are_right():
    """Check by finite differences, each leaf scaled as a whole."""
    y = np.nan_to_num(Y[:8], nan=0.3)
    slopes = jax.tree_util.tree_leaves(jax.jit(jax.grad(log_likelihood))(ROBUST, y))
    leaves, structure = jax.tree_util.tree_flatten(ROBUST)
    seen = 0
    for i, (leaf, slope) in enumerate(zip(leaves, slopes, strict=True)):
        assert np.all(np.isfinite(slope))
        whole = np.isfinite(leaf)
        along = float(np.sum(np.where(whole, leaf, 0.0) * np.where(whole, slope, 0.0)))
        low, high = (
            float(log_likelihood(structure.unflatten([*leaves[:i], s * leaf, *leaves[i + 1 :]]), y))
            for s in (1 - 1e-6, 1 + 1e-6)
        )
        assert along == pytest.approx((high - low) / 2e-6, rel=1e-5, abs=1e-6)
        seen += along != 0.0
    assert seen >= 2, "gamma, the weight and the limit of huber matter here"


def test_a_batch_of_thresholds_is_one_program_and_the_runs_one_by_one():
    thresholds = np.array([1.0, 2.0, 3.0, math.inf])
    stacked = huber(threshold=thresholds, patience=None)
    both = jax.vmap(lambda rule: log_likelihood(kalman(rules=[rule]), Y))(stacked)
    alone = [
        log_likelihood(kalman(rules=[huber(threshold=k, patience=None)]), Y) for k in thresholds
    ]
    np.testing.assert_allclose(both, alone, rtol=1e-12)
    assert len(set(np.asarray(both).tolist())) == len(thresholds)


# ------------------------------------------------------------------------------------ the machinery


@value
class Line:
    """A line, for these tests."""

    slope: object
    name: str = kind()

    def __call__(self, x):
        return self.slope * x


def test_a_transformation_makes_a_value_without_its_checks():
    line = Line(number("a slope must be positive", 2, lambda s: s > 0.0), "a")
    assert line.slope.dtype == float
    assert jax.tree_util.tree_map(lambda _: None, line).slope is None
    assert jax.vmap(lambda one: one(3.0))(dataclasses.replace(line, slope=jnp.ones(4))).shape == (
        4,
    )
    assert float(jax.grad(lambda one: one(3.0))(line).slope) == 3.0
    assert "__eq__" not in vars(Line)


def test_numbers_are_checked_where_they_are_known():
    with pytest.raises(ValueError, match="a slope must be positive, got -1"):
        number("a slope must be positive", -1, lambda s: s > 0.0)
    with pytest.raises(TypeError, match="a slope must be positive, got 'two'"):
        number("a slope must be positive", "two")
    assert jax.grad(lambda k: number("", k, lambda s: s > 9.0) ** 2)(3.0) == 6.0


def test_a_plain_function_is_a_kind_and_a_partial_is_data():
    def double(x):
        return 2 * x

    plain, bound = Line(double, "f"), Line(Partial(double, jnp.ones(2)), "f")
    assert jax.tree_util.tree_leaves(plain) == []
    assert len(jax.tree_util.tree_leaves(bound)) == 1
    assert shape(plain) == shape(Line(double, "f")) != shape(Line(lambda x: 2 * x, "f"))
    assert jax.tree_util.tree_leaves(as_data(double)) == []
    assert as_data(bound.slope) is bound.slope


@pytest.mark.parametrize("pair", [(0.0, -0.0), (1.0, 1.0 + 2e-16), (math.nan, 1.0)])
def test_numbers_with_other_bits_are_other_content(pair):
    one, other = (gate(0.9), *pair)[1:]
    assert content(Line(np.float64(one), "a")) != content(Line(np.float64(other), "a"))
    assert content(Line(np.float64(one), "a")) == content(Line(np.float64(one), "a"))


def test_numbers_part_from_a_tree_and_join_to_it():
    def tree(*numbers):
        a, b, c, d = map(np.float64, numbers)
        return {"a": np.array([[a, 0.0], [-1.0, b]]), "b": (3, np.array([])), "c": c, "d": -d}

    given = tree(2.0, np.nextafter(1.0, 2.0), np.inf, 0.0)
    numbers, joined, key = split_numbers(given)
    np.testing.assert_array_equal(numbers, [2.0, np.nextafter(1.0, 2.0)])
    assert content(joined(numbers)) == content(given)
    assert content(joined(numbers + 1.5)) == content(tree(3.5, 2.5 + 2**-52, np.inf, 0.0))
    # what is left out of the program is not in its key; zeros, ones and what is not finite are
    same = {(5.0, 7.0, np.inf, 0.0): True}
    same |= dict.fromkeys([(1.0, 7.0, np.inf, 0.0), (5.0, 7.0, 9.0, 0.0)], False)
    same |= {(5.0, 7.0, np.inf, 1.0): False}
    assert [split_numbers(tree(*other))[2] == key for other in same] == list(same.values())
    assert split_numbers(tree(2.0, 7.0, np.inf, -0.0))[2] != key


def test_a_number_of_python_is_told_from_one_that_is_an_argument():
    first, second = ((0.5, np.float64(2.0)), (np.float64(2.0), 0.5))
    assert split_numbers(first)[2] != split_numbers(second)[2]


def test_numbers_of_filters_part_and_join():
    for filter_ in (kalman(rules=[gate()]), imm([kalman(), kalman()], np.full((2, 2), 0.5))):
        numbers, joined, _ = split_numbers(filter_)
        assert numbers.size
        assert content(joined(numbers)) == content(filter_)


def test_a_rule_of_functions_is_a_value_too():
    def widen(memory, transition):
        return memory, transition._replace(noise=2.0 * transition.noise)

    one, other = (kalman(rules=[Rule(process=widen)]) for _ in range(2))
    assert shape(one) == shape(other)
    wide = Model(Motion(MODEL.motion.step, 2.0 * MODEL.motion.noise), MODEL.sensors)
    np.testing.assert_array_equal(
        run(one, MODEL, START, Y).mean, run(kalman(), wide, START, Y).mean
    )


def test_a_model_is_a_value_and_its_functions_are_kinds():
    assert shape(line(1.0)) == shape(line(2.0))
    assert len(jax.tree_util.tree_leaves(MODEL)) >= 2
    assert inspect.isclass(Sensor)
    assert isinstance(kalman(), Filter)
    assert Y.shape == (T, M)
