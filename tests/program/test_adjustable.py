"""Numbers of a filter in its state, in JAX and in C, against filters that are made with them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from robins.filters import Belief, Model, Motion, OnlineFilter, Sensor, kalman, run
from robins.filters.composite.adjustable import adjustable, adjusted, named_numbers
from robins.filters.rules import h_infinity, huber

LIMIT = "rules[0].inner.limit"
MODEL = Model(
    Motion(lambda x, u: x, np.array([0.1])), (Sensor(lambda x, aux: x, np.array([1.0]), 1),)
)
START = Belief.of(np.zeros(1), np.eye(1))
Y = 3.0 * np.random.default_rng(0).normal(size=(40, 1))


def made(threshold):
    return kalman(rules=[huber(threshold=threshold)])


def begun(threshold):
    """The state to begin with, of a filter of threshold 2, with the number of another one."""
    state = adjustable(made(2.0), [LIMIT]).init(START, MODEL.dims)
    return adjusted(state, {LIMIT: named_numbers(made(threshold))[LIMIT]})


@pytest.mark.parametrize("threshold", [2.0, 1.0, 0.5])
def test_a_number_that_is_set_is_that_of_a_filter_made_with_it(threshold):
    found = run(adjustable(made(2.0), [LIMIT]), MODEL, begun(threshold), Y)
    wanted = run(made(threshold), MODEL, START, Y)
    np.testing.assert_array_equal(found.mean, wanted.mean)
    np.testing.assert_array_equal(found.covariance, wanted.covariance)
    after = adjustable(made(2.0), [LIMIT]).reset(found.final, START)
    assert after.memory.numbers[LIMIT] is found.final.memory.numbers[LIMIT]
    np.testing.assert_array_equal(after.belief.mean, START.mean)


def test_in_c_it_is_an_input_of_each_step():
    """Set while it runs, as a board would."""
    inside = adjustable(made(2.0), [LIMIT])
    each = {machine: OnlineFilter(inside, MODEL, begun(2.0), machine) for machine in ("jax", "c")}
    for k, y in enumerate(Y):
        for one in each.values():
            if k == 10:
                number = named_numbers(made(0.5))[LIMIT]
                one.state = adjusted(jax.tree.map(jnp.asarray, one.state), {LIMIT: number})
            one.predict()
            one.update(y)
        found, wanted = (each[machine].belief for machine in ("c", "jax"))
        np.testing.assert_allclose(found.mean, wanted.mean, rtol=1e-12, atol=1e-13)
    before = run(made(2.0), MODEL, START, Y[:10]).final.belief
    wanted = run(made(0.5), MODEL, before, Y[10:]).mean[-1]
    np.testing.assert_allclose(found.mean, wanted, rtol=1e-12)


def test_what_a_rule_reports_is_of_the_number_that_is_set():
    """A gamma that exists, and one that does not: the search for the least is by the rule alone."""
    rule = h_infinity(50.0, np.eye(1))
    name = "rules[0].inverse"
    inside = adjustable(kalman(rules=[rule]), [name])
    assert np.isfinite(run(inside, MODEL, START, Y).mean).all()
    small = named_numbers(kalman(rules=[h_infinity(0.2, np.eye(1))]))[name]
    state = adjusted(inside.init(START, MODEL.dims), {name: small})
    with pytest.raises(Exception, match="gamma") as alone:
        run(kalman(rules=[h_infinity(0.2, np.eye(1))]), MODEL, START, Y)
    with pytest.raises(type(alone.value)) as found:
        run(inside, MODEL, state, Y)
    assert str(found.value) == str(alone.value)


def test_names_shapes_and_kinds_are_checked():
    with pytest.raises(ValueError, match=r"no number 'gamma'.*rules\[0\]\.inner\.limit"):
        adjustable(made(2.0), ["gamma"])
    state = begun(2.0)
    with pytest.raises(ValueError, match=r"no number 'x'.*limit"):
        adjusted(state, {"x": 1.0})
    with pytest.raises(ValueError, match=r"shape \(65,\), got \(2,\)"):
        adjusted(state, {LIMIT: np.ones(2)})
    with pytest.raises(TypeError, match="must be real"):
        adjusted(state, {LIMIT: 1j})
    np.testing.assert_array_equal(adjusted(state, {LIMIT: 3.0}).memory.numbers[LIMIT], 3.0)
