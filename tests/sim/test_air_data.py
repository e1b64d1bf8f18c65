"""Air data, the error of the wind, and the Gauss-Markov process under both."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from drawn import assert_variance
from scipy import stats
from scipy.linalg import cho_factor, cho_solve, toeplitz

from robins.sim.air_data import observe_air, wind_estimate_error
from robins.sim.random import Component, gauss_markov, stream

RUNS, COUNT = 800, 24
KEYS = jax.vmap(lambda run: stream(2, run, Component.AIR_DATA))(jnp.arange(RUNS))
KEY = KEYS[0]
rng = np.random.default_rng(1)
TRUE = rng.normal(size=(COUNT, 3)) * 10.0
PRESENT = np.arange(COUNT) % 3 != 1
SIGMA = np.array([0.3, 0.1, 1.0])


def batch(function):
    return np.asarray(jax.jit(jax.vmap(function))(KEYS))


def test_air_data_err_white_on_each_axis():
    error = batch(lambda key: observe_air(key, TRUE, SIGMA, PRESENT)) - TRUE
    assert np.all(np.isnan(error[:, ~PRESENT]))
    error = error[:, PRESENT].reshape(-1, 3)
    assert_variance(error, SIGMA**2)
    for axis in range(3):
        assert stats.kstest(error[:, axis] / SIGMA[axis], "norm").pvalue > 1e-3
    table = np.corrcoef(error.T) - np.eye(3)
    assert np.abs(table).max() < 4.0 / len(error) ** 0.5


def test_numbers_do_not_depend_on_sigma_presence_or_the_length_of_the_run():
    observe = jax.jit(observe_air)
    unit = np.asarray(observe(KEY, np.zeros((COUNT, 3)), 1.0, np.ones(COUNT, bool)))
    some = np.asarray(observe(KEY, TRUE, SIGMA, PRESENT))
    np.testing.assert_allclose(some[PRESENT], (TRUE + SIGMA * unit)[PRESENT], rtol=1e-15)
    few = observe_air(KEY, np.zeros((5, 3)), 1.0, np.ones(5, bool))
    np.testing.assert_array_equal(few, unit[:5])
    exact = np.asarray(observe(KEY, TRUE, 0.0, PRESENT))
    np.testing.assert_array_equal(exact[PRESENT], TRUE[PRESENT])
    wind = np.asarray(wind_estimate_error(KEY, COUNT, 1.0, 1.0, 50.0))
    uneven = wind_estimate_error(KEY, COUNT, 1.0, (0.3, 2.0), 50.0)
    np.testing.assert_allclose(uneven, wind * [0.3, 2.0], rtol=1e-15)


@pytest.mark.parametrize(("step", "tau"), [(0.5, 50.0), (20.0, 50.0), (1e4, 50.0)])
def test_the_error_of_the_wind_is_gauss_markov_at_any_step(step, tau):
    error = batch(lambda key: wind_estimate_error(key, COUNT, step, (0.3, 0.6), tau))
    factor = cho_factor(toeplitz(np.exp(-step / tau * np.arange(COUNT))))
    for axis, sigma in enumerate((0.3, 0.6)):
        x = error[..., axis].T / sigma
        statistic = np.sum(x * cho_solve(factor, x), axis=0)
        assert stats.kstest(statistic, stats.chi2(COUNT).cdf).pvalue > 1e-3
        assert_variance(x[0], 1.0)
        assert_variance(x[-1], 1.0)
    product = np.mean(error[..., 0] * error[..., 1], axis=0) / 0.18
    assert np.abs(product).max() < 4.5 / RUNS**0.5


def test_air_and_wind_of_one_key_are_independent():
    air = batch(lambda key: observe_air(key, jnp.zeros((1, 3)), 1.0, jnp.ones(1, bool)))[:, 0]
    wind = batch(lambda key: wind_estimate_error(key, 1, 1.0, 1.0, 50.0))[:, 0]
    table = np.corrcoef(np.concatenate([air, wind], 1).T)
    assert np.abs(table[:3, 3:]).max() < 4.5 / RUNS**0.5


def test_an_endless_correlation_is_a_constant():
    x = np.asarray(gauss_markov(KEY, 9, 2, 1.0, (np.inf, 1.0)))
    np.testing.assert_array_equal(x[:, 0], x[0, 0])
    assert len(set(x[:, 1])) == 9
    np.testing.assert_array_equal(gauss_markov(KEY, 1, 2, 1.0, (np.inf, 1.0)), x[:1])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: observe_air(KEY, TRUE, -1.0, PRESENT), "sigma_m_s must be a finite number from 0"),
        (lambda: observe_air(KEY, TRUE[:3], 1.0, PRESENT), r"v_air_b must have shape \(24, 3\)"),
        (lambda: observe_air(KEY, TRUE, [1.0, 2.0], PRESENT), r"a number or of shape \(3,\)"),
        (lambda: observe_air(KEY, TRUE, 1.0, True), r"present must have shape \(E,\)"),
        (lambda: wind_estimate_error(KEY, 0, 1.0, 1.0, 1.0), "count is 0"),
        (lambda: wind_estimate_error(KEY, 3, 0.0, 1.0, 1.0), "step_s must be .* above 0, got 0.0"),
        (lambda: wind_estimate_error(KEY, 3, 1.0, np.nan, 1.0), "sigma_m_s must be"),
        (lambda: wind_estimate_error(KEY, 3, 1.0, 1.0, 0.0), "tau_s must be a number above 0"),
    ],
)
def test_what_cannot_be_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
