"""The barometer: chi-square of samples against the covariance its model has."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from scipy.linalg import toeplitz

from robins.sim.air_data import observe_height
from robins.sim.random import Component, stream

RUNS, COUNT = 1000, 20
KEYS = jax.vmap(lambda run: stream(4, run, Component.BAROMETER))(jnp.arange(RUNS))
KEY = KEYS[0]
HEIGHT = 2e4 + np.arange(COUNT) * 3.0
PRESENT = np.arange(COUNT) % 4 != 2


def errors(*arguments, **named):
    observe = jax.jit(jax.vmap(lambda key: observe_height(key, HEIGHT, *arguments, **named)))
    return np.asarray(observe(KEYS)) - HEIGHT


@pytest.mark.parametrize(
    ("bias", "covariance"),
    [
        ({}, 400.0 * np.eye(COUNT)),
        ({"bias_sigma_m": 30.0}, 400.0 * np.eye(COUNT) + 900.0),
        (
            {"bias_sigma_m": 30.0, "bias_tau_s": 8.0, "step_s": 2.0},
            400.0 * np.eye(COUNT) + 900.0 * toeplitz(np.exp(-0.25 * np.arange(COUNT))),
        ),
    ],
)
def test_samples_have_the_covariance_of_the_model(bias, covariance):
    error = errors(20.0, PRESENT, **bias)
    assert np.all(np.isnan(error[:, ~PRESENT]))
    x = error[:, PRESENT].T
    statistic = np.sum(x * np.linalg.solve(covariance[np.ix_(PRESENT, PRESENT)], x), axis=0)
    assert stats.kstest(statistic, stats.chi2(PRESENT.sum()).cdf).pvalue > 1e-3
    low, high = stats.chi2.ppf([1e-4, 1.0 - 1e-4], x.size)
    assert low < statistic.sum() < high


def test_the_bias_leaves_the_white_noise_alone():
    there = np.ones(COUNT, bool)
    white = observe_height(KEY, np.zeros(COUNT), 1.0, there)
    bias = observe_height(KEY, np.zeros(COUNT), 0.0, there, 7.0)
    assert len(set(np.asarray(bias).tolist())) == 1
    both = observe_height(KEY, np.zeros(COUNT), 20.0, there, 7.0)
    np.testing.assert_allclose(both, 20.0 * white + bias, rtol=1e-13)
    exact = np.asarray(observe_height(KEY, HEIGHT, 0.0, PRESENT))
    np.testing.assert_array_equal(exact[PRESENT], HEIGHT[PRESENT])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: observe_height(KEY, HEIGHT, -1.0, PRESENT), "sigma_m must be"),
        (lambda: observe_height(KEY, HEIGHT[:4], 1.0, PRESENT), "height_m must have shape"),
        (lambda: observe_height(KEY, HEIGHT, 1.0, PRESENT, -2.0), "bias_sigma_m must be"),
        (lambda: observe_height(KEY, HEIGHT, 1.0, PRESENT, 2.0, 0.0), "bias_tau_s must be"),
        (lambda: observe_height(KEY, HEIGHT, 1.0, PRESENT, 2.0, 60.0), "wants step_s"),
        (lambda: observe_height(KEY, HEIGHT, 1.0, PRESENT, 2.0, 60.0, 0.0), "step_s must be"),
        (lambda: observe_height(KEY, HEIGHT, 1.0, PRESENT[:0]), "E at least one"),
    ],
)
def test_what_cannot_be_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
