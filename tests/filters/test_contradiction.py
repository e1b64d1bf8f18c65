"""Measurements without noise that contradict what is known exactly, or each other."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from robins.filters import Belief, Code, Sensor, Tally, imm, kalman, particle, unscented
from robins.filters.analysis.consistency import grand_mean_nis
from robins.filters.limits.constrain import constrain

ONE = kalman()
SENSOR = Sensor(lambda x, aux: aux[0] @ x, lambda x, aux: aux[1], 2)
MEAN, UNIT, NONE = np.array([2.0, -1.0]), np.eye(2), np.zeros((2, 2))
TWICE, ALONG = np.array([[1.0, 0.0], [1.0, 0.0]]), np.array([[1.0, 1.0], [2.0, 2.0]])
SHARED = np.array([[1.0, 0.0], [1.0, 0.0]])  # one noise on both components


def updated(factor, H, W, y, one=ONE):
    """The state, its belief being N(MEAN, factor factor'), after a measurement."""
    state = one.init(Belief(jnp.array(MEAN), jnp.array(factor)), {"y": 2})
    return one.update(state, SENSOR, jnp.array(y), (jnp.array(H), jnp.array(W)))


def possible(factor, H, W, y) -> bool:
    """Test for a residual in the range of its covariance, by the singular values of that."""
    wide = np.concatenate([H @ factor, W], axis=1)
    r = np.asarray(y) - H @ MEAN
    return bool(np.linalg.norm(r - wide @ np.linalg.pinv(wide, rcond=1e-10) @ r) < 1e-8)


@pytest.mark.parametrize(
    ("factor", "H", "W", "y", "code"),
    [
        (UNIT, TWICE, NONE, [1.0, 3.0], Code.CONTRADICTED),
        (UNIT, TWICE, NONE, [1.0, 1.0], Code.DONE),
        (1e6 * UNIT, TWICE, NONE, [1e7 / 3.0, (1e7 + 1e-8) / 3.0], Code.DONE),  # rounding
        (UNIT, ALONG, NONE, [3.0, 6.0], Code.DONE),
        (UNIT, ALONG, NONE, [3.0, 6.001], Code.CONTRADICTED),
        (UNIT, TWICE, SHARED, [1.0, 3.0], Code.CONTRADICTED),
        (UNIT, TWICE, SHARED, [1.0, 1.0], Code.DONE),
        (UNIT, TWICE, np.diag([0.1, 0.0]), [1.0, 3.0], Code.DONE),  # noise explains it
        (NONE, UNIT, NONE, [102.0, -1.0], Code.CONTRADICTED),
        (NONE, UNIT, NONE, [2.0, -1.0], Code.DONE),
        (np.diag([0.0, 1.0]), UNIT, NONE, [2.5, 7.0], Code.CONTRADICTED),
        (NONE, UNIT, 0.1 * UNIT, [102.0, -1.0], Code.DONE),
    ],
)
def test_an_exact_component_that_cannot_be_is_said(factor, H, W, y, code):
    assert possible(factor, H, W, y) == (code == Code.DONE)
    state, info = updated(factor, H, W, y)
    assert int(info.code) == code
    assert np.isinf(info.nis) == np.isneginf(info.log_likelihood) == (code != Code.DONE)
    assert np.all(np.isfinite(state.belief.mean))
    # What is not contradicted is used all the same.
    met = np.asarray(info.used) & ~np.any(W, axis=1)
    np.testing.assert_allclose((H @ state.belief.mean)[met], np.array(y)[met])
    tally = Tally.blank(("y",)).add_step(jnp.asarray(0), {"y": info})
    assert np.isinf(tally.nis["y"]) == (code != Code.DONE)
    verdict = grand_mean_nis(np.array([1.0, info.nis]), np.array([1, info.dof]))
    assert np.isinf(verdict.value) == (code != Code.DONE)


@pytest.mark.parametrize("one", [kalman(), kalman(unscented())], ids=["taylor", "unscented"])
def test_what_is_known_to_rounding_contradicts_nothing(one):
    # Three readings without noise of a state that is known to 1e-14 but for one direction: of two
    # that repeat the first to rounding, one may be used and the other is then known.
    H = np.random.default_rng(0).normal(size=(3, 4))
    sensor = Sensor(lambda x, aux: aux @ x, np.zeros((3, 3)), 3)

    @jax.jit
    def code(mean, factor, y):
        state = one.init(Belief(mean, factor), {"y": 3})
        return one.update(state, sensor, y, jnp.array(H))[1].code

    def trial(seed, off):
        rng = np.random.default_rng(seed)
        factor = np.tril(2e-14 * rng.normal(size=(4, 4)))
        factor[:, 0] = H[0]
        mean = 30.0 * rng.normal(size=4)
        y = H @ (mean + factor[:, 0] * rng.normal()) + off
        return int(code(jnp.array(mean), jnp.array(factor), jnp.array(y)))

    assert {trial(seed, 0.0) for seed in range(100)} == {Code.DONE}
    # and what cannot be is still found: the last reading is off by far more than rounding
    last = np.array([0.0, 0.0, 1e-3])
    assert {trial(seed, last) for seed in range(20)} == {Code.CONTRADICTED}


def test_what_is_missing_contradicts_nothing():
    assert int(updated(UNIT, TWICE, NONE, [1.0, np.nan])[1].code) == Code.PARTLY_MISSING


@pytest.mark.parametrize(
    "one", [imm([ONE, ONE], [[0.9, 0.1], [0.1, 0.9]]), particle(4, 0)], ids=["imm", "particle"]
)
def test_filters_of_filters_say_it_too(one):
    state, info = updated(NONE, UNIT, NONE, [102.0, -1.0], one)
    assert int(info.code) == Code.CONTRADICTED
    assert float(info.nis) == np.inf
    assert float(info.log_likelihood) == -np.inf
    np.testing.assert_array_equal(state.belief.mean, MEAN)


def test_a_constraint_that_contradicts_what_is_known_is_infinitely_far():
    known = Belief(jnp.array(MEAN), jnp.diag(jnp.array([0.0, 1.0])))
    assert float(constrain(known, UNIT, [2.5, 7.0]).nis) == np.inf
    assert float(constrain(known, UNIT, [2.0, 7.0]).nis) == pytest.approx(64.0)
