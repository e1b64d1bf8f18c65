"""Turbulence against the published spectra: their transforms by quadrature, samples by chi-square.

The covariance of the samples wanted is the cosine transform of the spectrum, found numerically
from the formula in print. Where n samples of a run have the covariance C, x' C^-1 x is chi-square
distributed with n degrees of freedom: every variance and every correlation at once.
"""

import inspect
from functools import cache, partial
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from scipy.integrate import quad
from scipy.linalg import cho_factor, cho_solve, toeplitz

from robins.sim import wind
from robins.sim.random import Component, stream
from robins.sim.wind import dryden, gusts, von_karman

RUNS, COUNT = 600, 24
SIGMA, AIRSPEED, LENGTH = (1.5, 0.8), 12.0, (400.0, 250.0)
KEYS = jax.vmap(lambda run: stream(11, run, Component.WIND))(jnp.arange(RUNS))
KEY = KEYS[0]
MAKERS = {"dryden": dryden, "von_karman": von_karman}


def published(form, across, wave):
    """One-sided spectrum over L W, of unit variance and unit length (MIL-F-8785C)."""
    if form == "dryden":
        if across:
            return (1.0 + 3.0 * wave**2) / (np.pi * (1.0 + wave**2) ** 2)
        return 2.0 / (np.pi * (1.0 + wave**2))
    x = (1.339 * wave) ** 2
    if across:
        return (1.0 + 8.0 / 3.0 * x) / (np.pi * (1.0 + x) ** (11.0 / 6.0))
    return 2.0 / (np.pi * (1.0 + x) ** (5.0 / 6.0))


@cache
def correlation(form, across, distance):
    """Transform of the spectrum at a distance in lengths."""
    waves = {"weight": "cos", "wvar": distance, "limlst": 400} if distance else {"limit": 400}
    return quad(lambda w: published(form, across, w), 0.0, np.inf, **waves)[0]


@partial(jax.jit, static_argnums=1)
def drydens(keys, count, step, sigma, length, direction=0.0):
    return jax.vmap(lambda key: dryden(key, count, step, AIRSPEED, sigma, length, direction))(keys)


def von_karmans(keys, count, step, sigma, length, direction=0.0):
    return jax.vmap(lambda key: von_karman(key, count, step, AIRSPEED, sigma, length, direction))(
        keys
    )


BATCHES = {"dryden": drydens, "von_karman": von_karmans}


def drawn(form, step, count=COUNT, runs=RUNS, direction=0.0, sigma=SIGMA):
    """(runs, count, 2) samples; one compilation for all steps."""
    return np.asarray(BATCHES[form](KEYS[:runs], count, step, sigma, LENGTH, direction))


def chi_square(x, form, across, lengths):
    """The statistic of each run for samples that many lengths apart."""
    row = [correlation(form, across, float(lengths * k)) for k in range(x.shape[1])]
    return np.sum(x.T * cho_solve(cho_factor(toeplitz(row)), x.T), axis=0)


@pytest.mark.parametrize("form", MAKERS)
@pytest.mark.parametrize("step", [0.4, 5.0, 60.0])
def test_samples_have_the_published_spectrum_at_any_step(form, step):
    x = drawn(form, step)
    for axis, across in ((0, False), (1, True)):
        unit = x[..., axis] / SIGMA[axis]
        lengths = step * AIRSPEED / LENGTH[axis]
        statistic = chi_square(unit, form, across, lengths)
        assert stats.kstest(statistic, stats.chi2(COUNT).cdf).pvalue > 1e-3
        low, high = stats.chi2.ppf([1e-4, 1.0 - 1e-4], RUNS * COUNT)
        assert low < statistic.sum() < high
        # the first and the last sample alone: steady from the start to the end
        low, high = stats.chi2.ppf([1e-4, 1.0 - 1e-4], RUNS) / RUNS
        for end in (0, -1):
            assert low < np.mean(unit[:, end] ** 2) < high
        # and the chi-square does tell lengths apart, where there is any correlation
        if step < 60.0:
            wrong = chi_square(unit, form, across, 1.3 * lengths)
            assert stats.kstest(wrong, stats.chi2(COUNT).cdf).pvalue < 1e-6
    both = np.mean(x[..., 0] / SIGMA[0] * x[..., 1] / SIGMA[1], axis=0)
    assert np.abs(both).max() < 4.5 / np.sqrt(RUNS)


@pytest.mark.parametrize("form", MAKERS)
def test_the_periodogram_follows_the_spectrum(form):
    """Averaged over runs and bands, with the frequencies that sampling folds back added."""
    count, runs, step = 2048, 200, 0.5
    x = drawn(form, step, count, runs)
    window = np.hanning(count)
    frequency = 2.0 * np.pi * np.fft.rfftfreq(count, step)
    bands = np.geomspace(frequency[4], frequency[-1], 9)
    for axis, across in ((0, False), (1, True)):
        time = LENGTH[axis] / AIRSPEED
        power = np.abs(np.fft.rfft(window[:, None] * x[..., axis].T, axis=0)) ** 2
        density = np.mean(power, axis=1) * step / np.pi / np.sum(window**2) / SIGMA[axis] ** 2
        folds = np.arange(-2000, 2001)[:, None] * (2.0 * np.pi / step)
        wanted = time * np.sum(published(form, across, time * np.abs(frequency + folds)), axis=0)
        for low, high in pairwise(bands):
            inside = (frequency >= low) & (frequency < high)
            # neighbours of a Hann window are correlated: about half as many are independent
            spread = 1.0 / np.sqrt(runs * max(1.0, 0.5 * inside.sum()))
            ratio = np.mean(density[inside] / wanted[inside])
            assert ratio == pytest.approx(1.0, abs=4.5 * spread + 0.005)


@pytest.mark.parametrize("across", [False, True])
def test_the_correlation_of_von_karman_is_the_transform_of_his_spectrum(across):
    for distance in (0.0, 0.01, 0.3, 1.0, 4.0):
        got = wind._correlation(np.array([distance / wind._A]), across)
        # The constant in print, 1.339, is rounded in the fifth place.
        wanted = correlation("von_karman", across, distance)
        np.testing.assert_allclose(got, wanted, rtol=0.0, atol=3e-5)


def test_a_circle_twice_as_long_as_the_record_is_enough():
    for step in np.geomspace(1e-5, 30.0, 40):
        for count in (1, 2, 5, 33, 513):
            for across in (False, True):
                root = wind._root_spectrum(count, float(step), across)
                assert len(root) > count - 1
                assert np.all(root > 0.0)


@pytest.mark.parametrize("form", MAKERS)
def test_along_and_across_are_turned_to_north_and_east(form):
    plain = drawn(form, 5.0)
    turned = drawn(form, 5.0, direction=np.pi / 2.0)
    wanted = np.stack([-plain[..., 1], plain[..., 0]], -1)
    np.testing.assert_allclose(turned, wanted, atol=1e-14)


@pytest.mark.parametrize("form", MAKERS)
def test_sigma_scales_and_zero_is_calm(form):
    unit = drawn(form, 5.0, sigma=(1.0, 1.0))
    np.testing.assert_allclose(drawn(form, 5.0), unit * SIGMA, rtol=1e-14)
    np.testing.assert_array_equal(drawn(form, 5.0, sigma=(0.0, 0.0)), np.zeros_like(unit))


def test_above_two_thousand_feet_both_components_have_the_length_of_the_standard():
    for maker, length_ft in ((dryden, 1750.0), (von_karman, 2500.0)):
        default = inspect.signature(maker).parameters["length_m"].default
        assert default == pytest.approx(length_ft * 0.3048)


def test_gusts_of_the_same_stream_are_other_numbers():
    wind = jax.vmap(lambda key: gusts(key, COUNT, 0.0, np.inf, 1.0))(KEYS)
    white = drawn("dryden", 1e4)  # so long a step that the samples are independent
    table = np.corrcoef(np.concatenate([wind, white], 2).reshape(-1, 4).T)
    assert np.abs(table[:2, 2:]).max() < 4.0 / np.sqrt(RUNS * COUNT)


@pytest.mark.parametrize("form", MAKERS)
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((0, 1.0, 10.0, 1.0), "count is 0"),
        ((5, 0.0, 10.0, 1.0), "step_s must be a finite number above 0"),
        ((5, 1.0, -10.0, 1.0), "airspeed_m_s must be"),
        ((5, 1.0, 10.0, (1.0, -1.0)), "sigma_m_s must be"),
        ((5, 1.0, 10.0, (1.0, 1.0, 1.0)), r"sigma_m_s must be a number or of shape \(2,\)"),
        ((5, 1.0, 10.0, 1.0, 0.0), "length_m must be"),
        ((5, 1.0, 10.0, 1.0, 500.0, np.inf), "direction_rad must be"),
    ],
)
def test_what_cannot_be_is_refused(form, arguments, message):
    with pytest.raises(ValueError, match=message):
        MAKERS[form](KEY, *arguments)


def test_von_karman_says_what_it_cannot_do():
    with pytest.raises(ValueError, match="must be plain numbers, not traced"):
        jax.jit(lambda airspeed: von_karman(KEY, 5, 1.0, airspeed, 1.0))(10.0)
    with pytest.raises(ValueError, match="so short that the samples do not differ"):
        von_karman(KEY, 5, 1e-30, 10.0, 1.0)
