"""Fading of a filter that does not see all of its states: how far it goes, and from when on."""

import jax.numpy as jnp
import numpy as np
import pytest
from interpreted import run

from robins.filters import Belief, Code, Model, Motion, Sensor, kalman
from robins.filters.rules.innovation_fading import innovation_fading

STEPS = 60
WINDOW = 4
SIGMA = np.array([1.0, 2.0, 0.0])  # the third is known exactly, and stays so
NOISE = np.diag([0.5, 0.0, 0.0])
# What is measured goes by far more than the noise says, so nearly every step wants to fade.
Y = 10.0 + np.cumsum(5.0 * np.random.default_rng(0).normal(size=(STEPS, 1)), axis=0)
MODEL = Model(
    Motion(lambda x, u: x, jnp.asarray(NOISE)), (Sensor(lambda x, aux: x[:1], jnp.ones(1), 1),)
)
START = Belief(jnp.zeros(3), jnp.diag(jnp.asarray(SIGMA)))


def answer(**limits):
    solution = run(kalman(rules=[innovation_fading(WINDOW, 3.0, **limits)]), MODEL, START, Y)
    info = solution.steps.info["y"]
    assert set(np.asarray(info.code).tolist()) <= {Code.DONE}
    sigma = np.sqrt(np.diagonal(solution.covariance, axis1=1, axis2=2))
    return sigma, np.asarray(info.notes["innovation_fading.lambda"])


@pytest.fixture(scope="module")
def free():
    return answer()


def test_what_nobody_sees_grows_with_every_fading(free):
    sigma, factor = free
    assert np.sum(factor > 1.0) > 40
    # nothing moves the second state and no measurement reaches it: the factors alone are in it
    np.testing.assert_allclose(sigma[:, 1], 2.0 * np.sqrt(np.cumprod(factor)), rtol=1e-9)
    assert sigma[-1, 1] > 1e6
    np.testing.assert_array_equal(sigma[:, 2], 0.0)


def test_reach_stops_before_it_is_passed(free):
    wanted = free[1]
    sigma, factor = answer(reach=10.0)
    np.testing.assert_allclose(sigma[:, 1], 2.0 * np.sqrt(np.cumprod(factor)), rtol=1e-9)
    assert 10.0 < sigma[-1, 1] <= 20.0  # within one factor, of three at most, of the bound
    faded = np.flatnonzero(factor > 1.0)
    # the same until the first that would have led too far, and nothing much after it
    first = np.flatnonzero(2.0 * np.sqrt(np.cumprod(wanted)) > 20.0)[0]
    np.testing.assert_allclose(factor[:first], wanted[:first], rtol=1e-9)
    assert factor[first] == 1.0
    assert np.prod(factor[faded]) <= 100.0
    # and a state known exactly stays so, without forbidding the others to fade
    np.testing.assert_array_equal(sigma[:, 2], 0.0)


def test_a_reach_that_is_never_met_changes_nothing(free):
    sigma, factor = answer(reach=1e20)
    np.testing.assert_array_equal(sigma, free[0])
    np.testing.assert_array_equal(factor, free[1])


def test_nothing_fades_before_the_window_is_full(free):
    _, factor = free
    assert np.all(factor[: WINDOW - 1] == 1.0)
    # what filled it is counted: without the window the first innovation alone would have faded
    assert Y[0, 0] ** 2 - 1.0 > SIGMA[0] ** 2 + NOISE[0, 0] ** 2
    assert factor[WINDOW - 1] > 1.0
