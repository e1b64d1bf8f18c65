"""Disturbances: moments against closed forms, steps in time against hand-worked numbers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from robins.sim.disturbance import (
    drift_step,
    outlier_factor,
    student_t,
    window_factor,
)

N = 200_000
KEY = jax.random.key(7, impl="threefry2x32")


def test_outliers_strike_their_share():
    factor = np.asarray(outlier_factor(KEY, (N,), 0.05, 10.0))
    assert set(np.unique(factor)) == {1.0, 10.0}
    # binomial, four sigma
    assert np.mean(factor == 10.0) == pytest.approx(0.05, abs=4.0 * np.sqrt(0.05 * 0.95 / N))
    assert np.all(np.asarray(outlier_factor(KEY, (5, 3), 0.0, 10.0)) == 1.0)
    assert np.all(np.asarray(outlier_factor(KEY, (5, 3), 1.0, 10.0)) == 10.0)


def test_student_t_has_unit_variance_and_its_own_tails():
    x = np.asarray(student_t(KEY, (N,), 5.0))
    # variance of x^2 from the kurtosis 3 + 6/(dof - 4) = 9
    assert np.mean(x**2) == pytest.approx(1.0, abs=4.0 * np.sqrt(8.0 / N))
    assert stats.kstest(x, stats.t(5.0, scale=np.sqrt(3.0 / 5.0)).cdf).pvalue > 1e-3
    assert stats.kstest(x, stats.norm.cdf).pvalue < 1e-3


def test_the_window_steps_up_and_down():
    t = jnp.array([0.0, 1.0, 2.0, 2.999, 3.0, 4.0])
    np.testing.assert_array_equal(window_factor(t, 1.0, 3.0, 20.0), [1, 20, 20, 20, 1, 1])


def test_a_drift_step_integrates_from_its_moment_on():
    begin, dt = jnp.array([0.0, 1.0, 2.0, 3.0]), jnp.array([1.0, 1.0, 1.0, 2.0])
    value, turned = drift_step(begin, dt, 2.25, jnp.array([1.0, -2.0, 0.0]))
    np.testing.assert_allclose(value[:, 0], [0.0, 0.0, 1.0, 1.0])
    np.testing.assert_allclose(turned[:, 0], [0.0, 0.0, 0.75, 2.0])
    np.testing.assert_allclose(turned[:, 1], [0.0, 0.0, -1.5, -4.0])
    np.testing.assert_allclose(turned[:, 2], 0.0)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: outlier_factor(KEY, (3,), 1.5, 10.0), "share is 1.5"),
        (lambda: outlier_factor(KEY, (3,), 0.5, -1.0), "factor is -1.0"),
        (lambda: student_t(KEY, (3,), 2.0), "dof is 2.0; Student's t has a variance only above 2"),
    ],
)
def test_what_is_no_distribution_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
