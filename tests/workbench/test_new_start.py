"""The entry points of an exported filter tell how far off a reading may be, and begin anew."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from robins.export.runs import entry_functions, reset_function
from robins.filters import Belief, Code, Model, Motion, Sensor, imm, kalman
from robins.filters.rules import sage_husa
from robins.program import Native, trace_steps

F = np.array([[1.0, 0.1], [0.0, 1.0]])
H = np.array([[1.0, 0.0], [1.0, 0.5]])
Q, R = np.array([1e-3, 1e-2]), np.array([0.1, 0.3])
MODEL = Model(
    Motion(lambda x, u: F @ x, Q),
    (Sensor(lambda x, aux: H @ x, R, 2, "fix"),),
)
START = Belief.of(np.array([2.0, 1.0]), np.array([[1.0, 0.2], [0.2, 0.5]]))
OTHER = Belief(jnp.array([-3.0, 0.4]), jnp.array([[0.3, 0.0], [-0.1, 0.2]]))
FILTERS = {
    "kalman": kalman(),
    "adaptive": kalman(rules=[sage_husa(0.98)]),  # learns R
    "bank": imm([kalman(), kalman(rules=[sage_husa(0.9)])], [[0.9, 0.1], [0.2, 0.8]]),
}
ROWS = {"predict": (None,), "update_fix": (np.zeros(2), None)}


def arrays(tree):
    return [np.asarray(leaf) for leaf in jax.tree_util.tree_leaves(tree)]


@pytest.fixture(scope="module", params=FILTERS)
def board(request):
    """The filter, its first state, and its entry points in C."""
    filter_ = FILTERS[request.param]
    first = filter_.init(START, MODEL.dims)
    functions = {**entry_functions(filter_, MODEL, ROWS), "reset": reset_function(filter_, first)}
    steps = [(functions[name], args) for name, args in {**ROWS, "reset": (START,)}.items()]
    programs = trace_steps(steps, first)
    return filter_, first, dict(zip(functions, map(Native, programs), strict=True))


def later(entries, state, steps=30):
    """The state after some readings."""
    rng = np.random.default_rng(1)
    for _ in range(steps):
        state, _ = entries["predict"](state, None)
        state, _ = entries["update_fix"](state, rng.normal(0.0, 3.0, 2), None)
    return state


def test_an_update_tells_the_sigma_of_its_innovation(board):
    filter_, first, entries = board
    state, _ = entries["predict"](first, None)
    P = F @ np.array([[1.0, 0.2], [0.2, 0.5]]) @ F.T + np.diag(Q**2)
    sigma = np.sqrt(np.diag(H @ P @ H.T + np.diag(R**2)))
    for y, want in (([2.5, np.nan], [sigma[0], np.nan]), ([2.5, 2.0], sigma)):
        _, told = entries["update_fix"](state, np.array(y), None)
        if filter_ is FILTERS["kalman"]:  # the others learn R before
            np.testing.assert_allclose(told.sigma, want, rtol=1e-12)
        by_jax = filter_.update(state, MODEL.sensors[0], jnp.array(y), None)[1]
        np.testing.assert_allclose(told.sigma, by_jax.sigma, rtol=1e-12)


def test_it_begins_anew_as_it_began(board):
    _, first, entries = board
    state = later(entries, first)
    assert not all(map(np.array_equal, arrays(state), arrays(first)))
    again, told = entries["reset"](state, START)
    assert int(told.code) == Code.DONE
    for got, want in zip(arrays(again), arrays(first), strict=True):
        np.testing.assert_array_equal(got, want)


def test_of_another_belief_it_is_the_reset_of_the_filter_at_the_start(board):
    filter_, first, entries = board
    lost = jax.tree_util.tree_map(  # no number of it is used
        lambda x: np.where(np.asarray(x) != 0, np.nan, x) if x.dtype == float else x, first
    )
    below = OTHER._replace(factor=OTHER.factor.at[0, 1].set(7.0))
    for state in (later(entries, first), lost):
        got, told = entries["reset"](state, below)
        assert int(told.code) == Code.DONE
        for a, b in zip(arrays(got), arrays(filter_.reset(first, OTHER)), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-14, atol=0.0)
    # A filter that was made for that belief goes on with the same numbers.
    fresh = later(entries, filter_.init(OTHER, MODEL.dims))
    for a, b in zip(arrays(later(entries, got)), arrays(fresh), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("wrong", [np.nan, np.inf])
def test_a_belief_that_is_not_finite_is_not_taken(board, wrong):
    _, first, entries = board
    state = later(entries, first, 3)
    for belief in (
        OTHER._replace(mean=OTHER.mean.at[1].set(wrong)),
        OTHER._replace(factor=OTHER.factor.at[1, 0].set(wrong)),
    ):
        got, told = entries["reset"](state, belief)
        assert int(told.code) == Code.NOT_FINITE
        for a, b in zip(arrays(got), arrays(state), strict=True):
            np.testing.assert_array_equal(a, b)
