"""Tests of tests: right filters pass, wrong ones fail, and the bands are the book's."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal
from dense_kalman import System
from interpreted import run
from scipy import stats

from robins import manifold
from robins.filters import Belief, kalman
from robins.filters.analysis.consistency import (
    anees,
    grand_mean_nis,
    nees,
    normalised_sq,
    whitened_innovations,
    whiteness,
)
from robins.filters.chi_square import chi2_band
from robins.rotation import Rotation

# ---------------------------------------------------------------------- one number


def test_nees_is_the_quadratic_form():
    rng = np.random.default_rng(0)
    A = rng.normal(size=(5, 5))
    P, m, x = A @ A.T, rng.normal(size=5), rng.normal(size=5)
    belief = Belief.of(jnp.array(m), P)
    want = (x - m) @ np.linalg.solve(P, x - m)
    assert float(nees(belief, jnp.array(x))) == pytest.approx(want, rel=1e-10)
    part = slice(1, 4)
    marginal = (x - m)[part] @ np.linalg.solve(P[part, part], (x - m)[part])
    square = normalised_sq(jnp.array(x - m)[part], belief.factor[part])
    assert float(square) == pytest.approx(marginal, rel=1e-10)


def test_nees_of_an_attitude_is_of_the_rotation_between():
    attitude = Rotation.from_euler(0.1, 0.2, 3.1)
    phi = jnp.array([0.01, -0.03, 0.02])
    belief = Belief((attitude, jnp.zeros(1)), jnp.diag(jnp.array([0.1, 0.1, 0.2, 0.3])))
    truth = (attitude.retract(phi), jnp.array([0.6]))
    turned = 0.1**2 + 0.3**2 + 0.1**2
    assert float(nees(belief, truth)) == pytest.approx(turned + 4.0, rel=1e-12)
    error = manifold.local(belief.mean, truth)
    square = normalised_sq(error[:3], belief.factor[:3])
    assert float(square) == pytest.approx(turned, rel=1e-12)


def test_what_is_known_exactly_does_not_count():
    # The first state is a constant: QR of such a factor loses every pivot after it.
    rng = np.random.default_rng(1)
    A = np.zeros((4, 4))
    A[1:] = rng.normal(size=(3, 4))
    error = np.array([0.0, 0.3, -0.5, 1.0])
    belief = Belief.of(jnp.zeros(4), A @ A.T)
    want = error[1:] @ np.linalg.solve((A @ A.T)[1:, 1:], error[1:])
    assert float(nees(belief, jnp.array(error))) == pytest.approx(want, rel=1e-9)
    assert float(normalised_sq(jnp.array(error)[:1], belief.factor[:1])) == 0.0


# ---------------------------------------------------------------------- bands


def test_the_band_of_fifty_runs_of_fifteen_states():
    # Bar-Shalom, Li & Kirubarajan: chi-square with 750 degrees of freedom over 50
    np.testing.assert_allclose(chi2_band(15, 50), [13.5201, 16.5557], atol=5e-5)
    np.testing.assert_allclose(chi2_band(1), [9.820691e-4, 5.023886], rtol=1e-6)
    np.testing.assert_allclose(chi2_band(2, 1, 0.9), -2 * np.log([0.95, 0.05]), rtol=1e-12)
    many = chi2_band(np.array([[1.0, 2.0], [3.0, 15.0]]), 50)
    assert many.shape == (2, 2, 2)
    np.testing.assert_allclose(many[1, 1], chi2_band(15, 50))


def test_the_band_holds_as_many_as_it_says():
    draws = stats.chi2.rvs(3, size=(20_000, 10), random_state=1).mean(axis=1)
    low, high = chi2_band(3, 10, 0.9)
    assert abs(np.mean((draws > low) & (draws < high)) - 0.9) < 4 * np.sqrt(0.09 / 20_000)
    assert abs(np.mean(draws < low) - 0.05) < 4 * np.sqrt(0.05 * 0.95 / 20_000)


def test_the_grand_mean_leaves_out_what_was_not_measured():
    nis = np.array([[2.0, np.nan, 3.0], [1.0, 0.0, 4.0]])
    dof = np.array([[2, 0, 2], [1, 0, 3]])
    verdict = grand_mean_nis(nis, dof)
    assert verdict.value == pytest.approx(10.0 / 8.0)
    low, high = stats.chi2.ppf([0.025, 0.975], 8) / 8
    assert (verdict.low, verdict.high) == pytest.approx((low, high))
    assert verdict.inside
    assert not verdict._replace(value=high * 1.01).inside
    nothing = grand_mean_nis(np.zeros(3), np.zeros(3, dtype=int))
    assert np.isnan(nothing.value)
    assert not nothing.inside


# ------------------------------------------------------------------------- right and wrong filters

RUNS, STEPS = 50, 100
SYSTEM = System(
    F=np.array([[1.0, 0.1, 0.005], [0.0, 1.0, 0.1], [0.0, 0.0, 0.98]]),
    G=np.diag([0.01, 0.05, 0.2]),
    H=np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
    W=np.diag([0.5, 0.3]),
    m0=np.zeros(3),
    P0=np.diag([1.0, 1.0, 0.5]),
)
EKF = kalman()


@pytest.fixture(scope="module")
def campaign():
    """50 runs of the system, and a function that filters them with Q and R scaled."""
    rng = np.random.default_rng(11)
    x = rng.multivariate_normal(SYSTEM.m0, SYSTEM.P0, size=RUNS)
    truth, y = np.empty((STEPS, RUNS, 3)), np.empty((STEPS, RUNS, 2))
    for k in range(STEPS):
        x = x @ SYSTEM.F.T + rng.normal(size=(RUNS, 3)) @ SYSTEM.G.T
        truth[k], y[k] = x, x @ SYSTEM.H.T + rng.normal(size=(RUNS, 2)) @ SYSTEM.W.T
    truth, y = jnp.array(truth.swapaxes(0, 1)), jnp.array(y.swapaxes(0, 1))

    @jax.jit
    def filtered(model, start):
        def one(truth, y):
            solution = run(EKF, model, start, y)
            info = solution.steps.info["y"]
            values = jax.vmap(nees)(solution.steps.posterior, truth)
            return values, info.nis, info.dof, whitened_innovations(info)

        return jax.vmap(one)(truth, y)

    def tried(q=1.0, r=1.0):
        wrong = SYSTEM._replace(G=np.sqrt(q) * SYSTEM.G, W=np.sqrt(r) * SYSTEM.W)
        values, nis, dof, white = filtered(wrong.model(), wrong.start())
        mean, band, share = anees(np.asarray(values), 3)
        assert np.mean((mean >= band[0]) & (mean <= band[1])) == share
        return share, grand_mean_nis(np.asarray(nis), np.asarray(dof)), np.asarray(white)

    return tried


def test_a_right_filter_is_found_right(campaign):
    share, verdict, white = campaign()
    assert share >= 0.9
    assert verdict.inside
    flat = white.reshape(-1, 2)
    np.testing.assert_allclose(np.cov(flat.T), np.eye(2), atol=4 * np.sqrt(2 / len(flat)))
    inside = [whiteness(one[:, i]).inside for one in white for i in range(2)]
    # 100 tests of 95 %: binomial, four standard deviations
    assert np.mean(inside) > 0.95 - 4 * np.sqrt(0.95 * 0.05 / 100)


def test_a_filter_wrong_by_four_is_found_out_and_by_a_fifth_in_r(campaign):
    for q, r in ((4.0, 1.0), (0.25, 1.0), (1.0, 4.0), (1.0, 0.25)):
        share, verdict, _ = campaign(q, r)
        assert share < 0.9
        assert not verdict.inside
    for r in (1.2, 1 / 1.2):
        assert not campaign(r=r)[1].inside


def test_innovations_of_a_slow_filter_are_not_white(campaign):
    _, _, white = campaign(q=1e-4)
    assert np.mean([whiteness(one[:, 1]).inside for one in white]) < 0.5


# ---------------------------------------------------------------------- whiteness


def coloured(memory: float, count: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    noise = rng.normal(size=count + 100)
    return scipy.signal.lfilter([1.0], [1.0, -memory], noise)[100:]


@pytest.mark.parametrize(("missing", "count"), [(0.0, 500), (0.3, 1000)])
def test_whiteness_tells_colour_from_chance(missing, count):
    def share(memory):
        found = []
        for seed in range(200):
            x = coloured(memory, count, seed)
            x[np.random.default_rng(seed + 1000).random(count) < missing] = np.nan
            found.append(whiteness(x).inside)
        return np.mean(found)

    # the level it claims, four standard deviations, and the small-sample excess of the statistic
    assert abs(share(0.0) - 0.95) < 4 * np.sqrt(0.95 * 0.05 / 200) + 0.01
    assert share(0.3) < 0.05


def test_whiteness_is_the_statistic_of_ljung_and_box():
    x = coloured(0.2, 80, 1)
    d = x - x.mean()
    r = np.array([d[k:] @ d[:-k] for k in range(1, 6)]) / (d @ d)
    want = 80 * 82 * np.sum(r**2 / (80 - np.arange(1, 6)))
    verdict = whiteness(x, lags=5, level=0.9)
    assert verdict.value == pytest.approx(want, rel=1e-12)
    assert verdict.high == pytest.approx(stats.chi2.ppf(0.9, 5))


def test_whiteness_of_too_little():
    with pytest.raises(ValueError, match="over 20 lags wants 60 samples, got 59"):
        whiteness(np.arange(59.0))
    with pytest.raises(ValueError, match="never changes"):
        whiteness(np.ones(80))


def test_whitened_innovations_are_of_what_was_used():
    # Two sensors with noise in common, the second missing at times, and a third that repeats it.
    H = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 1.0, 0.0]])
    W = np.array([[0.5, 0.0, 0.0], [0.3, 0.2, 0.0], [0.3, 0.2, 0.0]])
    system = SYSTEM._replace(H=H, W=W)
    y = np.random.default_rng(3).normal(size=(30, 3))
    y[:, 2] = y[:, 1]
    y[::4, 1:] = np.nan
    info = run(EKF, system.model(), system.start(), y).steps.info["y"]
    white = np.asarray(whitened_innovations(info))
    there = np.isfinite(y)
    there[:, 2] = False
    np.testing.assert_array_equal(np.isfinite(white), there)
    np.testing.assert_allclose(np.nansum(white**2, axis=1), info.nis, rtol=1e-12)


def test_nees_batches():
    rng = np.random.default_rng(5)
    factor = np.tril(rng.normal(size=(4, 6, 3, 3))) + 2 * np.eye(3)
    mean, truth = rng.normal(size=(2, 4, 6, 3))
    beliefs = Belief(jnp.array(mean), jnp.array(factor))
    values = jax.vmap(jax.vmap(nees))(beliefs, jnp.array(truth))
    white = np.linalg.solve(factor, (truth - mean)[..., None])[..., 0]
    np.testing.assert_allclose(values, np.sum(white**2, axis=-1), rtol=1e-12)
