"""Allan deviation: against allantools, dense quadratic forms, and Monte Carlo of known noises."""

import allantools
import numpy as np
import pytest
from scipy.signal import fftconvolve, lfilter
from scipy.stats import norm

from robins.ins.allan import (
    AllanFit,
    NoiseCoefficients,
    deviation,
    fit,
    in_field_units,
    term_curves,
    triad_errors,
)
from robins.ins.allan_noise import moments
from robins.ins.imu_errors import FLICKER_FLAT, TriadErrors, allan_deviation
from robins.units import parse

DT = 0.5
UNIT = dict(zip("QNBKR", np.eye(5), strict=True))


def white_rate(rng, n, axes):
    """Mean rates over each sample of white noise with N = 1."""
    return rng.standard_normal((n, axes)) / np.sqrt(DT)


def walking_rate(rng, n, axes):
    """Mean rates over each sample of a random walk with K = 1."""
    steps = rng.standard_normal((n, axes))
    # What the mean over a sample knows of the walk beyond its ends: a Brownian bridge.
    bridge = rng.standard_normal((n, axes)) / np.sqrt(12.0)
    return np.sqrt(DT) * (np.cumsum(steps, 0) - steps / 2.0 + bridge)


def quantised_rate(rng, n, axes):
    """Rates whose integral is in error by independent roundings with Q = 1."""
    return np.diff(rng.standard_normal((n + 1, axes)), axis=0) / DT


def flicker_rate(rng, n, axes, finer=6):
    """Mean rates over each sample of 1/f noise with B = 1 (Kasdin 1995), oversampled."""
    length = 2 * n * finer
    k = np.arange(1, length)
    response = np.concatenate([[1.0], np.cumprod((k - 0.5) / k)])
    drawn = rng.standard_normal((length, axes))
    rates = np.empty((n, axes))
    for axis in range(axes):  # one by one: the spectra of all take 500 MB
        x = fftconvolve(drawn[:, axis], response)[length // 2 : length]
        rates[:, axis] = x.reshape(n, finer).mean(1)
    return rates


NOISES = {"Q": quantised_rate, "N": white_rate, "B": flicker_rate, "K": walking_rate}


def dense_form(n, m):
    """A with v = rates @ A @ rates, the overlapping Allan variance at cluster size m."""
    means = np.lib.stride_tricks.sliding_window_view(np.eye(n), m, axis=0).mean(-1)
    second = means[m:] - means[:-m]
    return second.T @ second / (2 * len(second))


def dense_covariance(n):
    """Covariance of n rates of unit Q, N and K, exactly."""
    roundings = np.diff(np.eye(n + 1), axis=0) / DT
    k = np.arange(n)
    walk = (np.minimum.outer(k, k) + 0.5 - np.eye(n) / 6.0) * DT
    return {"Q": roundings @ roundings.T, "N": np.eye(n) / DT, "K": walk}


def test_squares_are_averaged_over_the_stretches_between_gaps():
    """Curve and covariance of white noise, by dense forms of three stretches."""
    lengths, sizes = np.array([40, 9, 26]), np.array([1, 2, 5, 12])
    rate = np.random.default_rng(3).standard_normal((75, 2))
    time_ns = np.arange(75) * 500_000_000 + np.repeat([0, 10**10, 3 * 10**10], lengths)
    forms = np.zeros((len(sizes), 75, 75))
    ends = np.cumsum(lengths)
    for form, m in zip(forms, sizes, strict=True):
        count = np.maximum(lengths + 1 - 2 * m, 0)
        for end, n, rows in zip(ends, lengths, count, strict=True):
            if rows:
                part = slice(end - n, end)
                form[part, part] = dense_form(n, m) * rows / count.sum()
    curve = deviation(rate, time_ns=time_ns, clusters=sizes)
    assert (curve.dt_s, curve.stretches) == (DT, (40, 9, 26))
    want = np.einsum("na,mnk,ka->ma", rate, forms, rate)
    np.testing.assert_allclose(curve.deviation**2, want, rtol=1e-12)
    own = deviation(rate, time_ns=time_ns).clusters[-1]
    assert sum(n // own for n in lengths if n >= 2 * own) >= 9
    assert sum(n // (own + 1) for n in lengths if n >= 2 * (own + 1)) < 9
    found = moments(sizes, lengths, DT).covariance(UNIT["N"])
    dense = 2.0 * np.einsum("ink,jkn->ij", forms, forms) / DT**2
    np.testing.assert_allclose(found, dense, rtol=1e-9)


@pytest.mark.parametrize("n", [60, 700])
def test_moments_are_those_of_the_dense_quadratic_form(n):
    sizes = np.array([1, 2, 5, 14]) if n == 60 else np.array([3, 20, 70])
    found = moments(sizes, n, DT)
    forms = [dense_form(n, m) for m in sizes]
    single = dense_covariance(n)
    for mix in ({"Q": 1.0}, {"N": 1.0}, {"K": 1.0}, {"Q": 0.3, "N": 2.0, "K": 0.7}):
        p = sum(c * UNIT[term] for term, c in mix.items())
        sigma = sum(c * single[term] for term, c in mix.items())
        products = [form @ sigma for form in forms]
        mean = [np.trace(f) for f in products]
        np.testing.assert_allclose(found.mean @ p, mean, rtol=1e-9)
        wanted = [[2.0 * np.sum(f * g.T) for g in products] for f in products]
        # Sixty lags are summed one by one; of 700 some are interpolated.
        near = 1e-9 if n == 60 else 2e-3
        np.testing.assert_allclose(found.covariance(p), wanted, rtol=near)
        freedom = 2.0 * np.square(mean) / np.diag(wanted)
        np.testing.assert_allclose(found.degrees_of_freedom(p), freedom, rtol=near)


def test_a_ramp_adds_its_square_and_makes_the_noise_count_more():
    n, sizes, slope = 60, np.array([1, 2, 5, 14]), 0.8
    found = moments(sizes, n, DT)
    forms = [dense_form(n, m) for m in sizes]
    sigma = dense_covariance(n)["N"]
    drift = slope * DT * np.arange(n)
    p = UNIT["N"] + slope**2 * UNIT["R"]
    mean = [np.trace(f @ sigma) + drift @ f @ drift for f in forms]
    np.testing.assert_allclose(found.mean @ p, mean, rtol=1e-9)
    wanted = [
        [2 * np.trace(f @ sigma @ g @ sigma) + 4 * drift @ f @ sigma @ g @ drift for g in forms]
        for f in forms
    ]
    np.testing.assert_allclose(found.covariance(p), wanted, rtol=1e-9)


@pytest.mark.parametrize(("term", "alpha"), [("Q", 2), ("N", 0), ("B", -1), ("K", -2)])
def test_degrees_of_freedom_are_those_of_greenhall_and_riley(term, alpha):
    # Their large-cluster approximations; they call rate noises by the exponent of the spectrum.
    n, sizes = 100_000, np.array([100, 1000, 5000, 11000])
    got = moments(sizes, n, DT).degrees_of_freedom(UNIT[term])
    wanted = [allantools.edf_greenhall(alpha, 2, m, n + 1, overlapping=True) for m in sizes]
    np.testing.assert_allclose(got, wanted, rtol=0.006)


def test_deviation_equals_allantools():
    rng = np.random.default_rng(1)
    rate = 0.3 + white_rate(rng, 5000, 3) + 0.1 * walking_rate(rng, 5000, 3)
    got = deviation(rate, dt_s=DT, clusters=[1, 2, 3, 10, 77, 555, 2500])
    for axis in range(3):
        _, wanted, _, count = allantools.oadev(
            rate[:, axis], rate=1.0 / DT, data_type="freq", taus=got.tau_s
        )
        assert len(count) in (6, 7)  # allantools leaves out a size with one second difference
        np.testing.assert_allclose(got.deviation[: len(count), axis], wanted, rtol=1e-12)


def test_one_axis_times_and_default_clusters():
    rng = np.random.default_rng(2)
    rate = rng.standard_normal(2000)
    a = deviation(rate, time_ns=10**15 + 5_000_000 * np.arange(2000))
    b = deviation(rate[:, None], dt_s=0.005)
    assert a.deviation.shape == (len(a.tau_s), 1)
    np.testing.assert_array_equal(a.deviation, b.deviation)
    np.testing.assert_allclose(a.tau_s, b.tau_s, rtol=1e-12)
    assert a.clusters[0] == 1
    assert a.clusters[-1] == 2000 // 9
    assert np.all(np.diff(np.log10(a.clusters)) <= np.log10(2.0) + 1e-12)
    wide = deviation(rate, dt_s=0.005, confidence=0.99)
    assert np.all(wide.lower < a.lower)
    assert np.all(wide.upper > a.upper)


MIXES = {"white": {"N": 1.0}, "walk": {"K": 1.0}, "all": {"Q": 0.4, "N": 1.0, "B": 0.2, "K": 0.05}}


@pytest.fixture(scope="module")
def records():
    """Many records of each mix; four terms take longer ones."""
    rng = np.random.default_rng(3)
    sizes = {"white": (4096, 400), "walk": (4096, 400), "all": (9100, 120)}
    return {
        name: sum(c * NOISES[term](rng, *sizes[name]) for term, c in mix.items())
        for name, mix in MIXES.items()
    }


@pytest.mark.parametrize("name", MIXES)
def test_the_true_curve_lies_between_the_bounds_as_often_as_stated(records, name):
    got = deviation(records[name], dt_s=DT, confidence=0.9)
    p = sum(c**2 * UNIT[term] for term, c in MIXES[name].items())
    truth = np.sqrt(moments(got.clusters, got.n_samples, DT).mean @ p)[:, None]
    inside = np.mean((got.lower <= truth) & (truth <= got.upper), axis=1)
    # Four sigma of a share, and above and below missed about alike.
    assert np.all(np.abs(inside - 0.9) < 4.0 * np.sqrt(0.9 * 0.1 / got.edf.shape[1])), inside
    too_high, too_low = np.mean(got.lower > truth), np.mean(got.upper < truth)
    assert 0.03 < too_high < 0.07
    assert 0.03 < too_low < 0.07


def test_the_fit_finds_each_noise_within_its_interval(records):
    got = fit(deviation(records["all"], dt_s=DT), "QNBK", confidence=0.9)
    for term, true in MIXES["all"].items():
        value, lower, upper = (getattr(c, term) for c in (got.value, got.lower, got.upper))
        assert np.all((lower <= value) & (value <= upper))
        assert np.mean((lower <= true) & (true <= upper)) > 0.8  # 0.9 less four sigma of a share
        # The squares have errors of mean zero and of the sigma that the intervals claim.
        z = (value**2 - true**2) / ((upper**2 - value**2) / norm.ppf(0.95))
        assert abs(z.mean()) < 4.0 / np.sqrt(len(z)), term
        assert abs(z.std() - 1.0) < 4.0 / np.sqrt(2.0 * len(z)), term
    assert np.all(got.value.R == 0.0)
    assert np.all(got.upper.R == 0.0)
    # The weighted squared residual of the right terms has the mean of a chi-square.
    error = np.mean(got.chi2 - got.dof)
    assert abs(error) < 4.0 * got.chi2.std() / np.sqrt(len(got.chi2))


def test_terms_that_are_missing_show_in_the_residual(records):
    whole = deviation(records["all"], dt_s=DT)
    assert np.median(fit(whole, "N").chi2) > 10.0 * np.median(fit(whole, "QNBK").chi2)


@pytest.mark.parametrize(
    ("term", "terms"), [("Q", "QN"), ("N", "NBK"), ("B", "NBK"), ("K", "NBK"), ("Q", "QNR")]
)
def test_a_noise_alone_is_found_and_the_others_are_not(term, terms):
    rng = np.random.default_rng(4)
    axes, true = 60, 2.0
    got = fit(deviation(true * NOISES[term](rng, 2000, axes), dt_s=DT), terms)
    lower, upper = getattr(got.lower, term), getattr(got.upper, term)
    assert np.all(lower > 0.0)
    assert np.mean((lower <= true) & (true <= upper)) > 0.85
    for other in set(terms) - {term}:
        assert np.mean(getattr(got.lower, other) > 0.0) < 0.1


def low_passed(rate, samples):
    """Through a filter of first order, whose gain at rest is one."""
    kept = np.exp(-1.0 / samples)
    return lfilter([1.0 - kept], [1.0, -kept], rate, axis=0)[300:]


def averaged(rate, samples):
    return lfilter(np.full(samples, 1.0 / samples), [1.0], rate, axis=0)[300:]


COLOURED = {  # through what, how many samples that reaches at least, terms, walk
    "white": (lambda rate: rate[300:], 1.0, "NBK", 0.0),
    "low-passed, 2 samples": (lambda rate: low_passed(rate, 2.0), 2.0, "NK", 0.02),
    "low-passed, 10 samples": (lambda rate: low_passed(rate, 10.0), 10.0, "NK", 0.02),
    "mean of 20 samples": (lambda rate: averaged(rate, 20), 8.0, "NBK", 0.0),
}


@pytest.mark.parametrize("name", COLOURED)
def test_colour_at_short_times_does_not_bias_the_random_walk(name):
    through, reach, terms, walk = COLOURED[name]
    rng = np.random.default_rng(20)
    n, axes = 30_300, 60  # each axis is a record of its own
    rate = through(white_rate(rng, n, axes)) + walk * walking_rate(rng, n, axes)[300:]
    sizes = np.unique(np.rint(1.55 ** np.arange(19)).astype(int))
    got = fit(deviation(rate, dt_s=DT, clusters=sizes), terms)
    assert np.std(got.value.N) / np.sqrt(axes) < 0.01
    assert abs(np.mean(got.value.N) - 1.0) < 0.02
    assert np.mean((got.lower.N <= 1.0) & (got.upper.N >= 1.0)) > 0.8
    if name == "white":
        assert np.mean(got.from_s > DT) < 0.05
    else:
        assert np.all(got.from_s > reach * DT)


def test_a_ramp_is_found():
    rng = np.random.default_rng(5)
    n, axes, slope = 3000, 60, 2e-3
    rate = white_rate(rng, n, axes) + slope * DT * np.arange(n)[:, None]
    got = fit(deviation(rate, dt_s=DT), "NR", confidence=0.95)
    assert np.all(got.lower.R > 0.0)
    for term, true in (("R", slope), ("N", 1.0)):
        lower, upper = getattr(got.lower, term), getattr(got.upper, term)
        inside = np.mean((lower <= true) & (true <= upper))
        assert inside > 0.95 - 4.0 * np.sqrt(0.05 * 0.95 / axes)


def test_field_units():
    rng = np.random.default_rng(6)
    arw = parse("0.3 deg/sqrt(h)", "angle random walk")
    got = fit(deviation(arw * white_rate(rng, 9100, 3), dt_s=DT), "NBKR")
    gyro = in_field_units(got, "gyro")
    others = {"noise_density", "bias_instability", "rate_random_walk", "rate_ramp"}
    assert set(gyro) == {"angle_random_walk"} | others
    walk = gyro["angle_random_walk"]
    assert walk.unit == "deg/sqrt(h)"
    assert np.all(walk.lower < 0.31)
    assert np.all(walk.upper > 0.29)
    np.testing.assert_allclose(gyro["noise_density"].value * 60.0, walk.value, rtol=1e-12)
    degrees = np.rad2deg(got.upper.R) * 3600.0  # deg/h of drift in a second
    assert gyro["rate_ramp"].unit == "deg/h/h"
    np.testing.assert_allclose(gyro["rate_ramp"].upper, degrees * 3600.0, rtol=1e-12)
    accel = in_field_units(got, "accel")
    assert accel["velocity_random_walk"].unit == "m/s/sqrt(h)"
    np.testing.assert_allclose(accel["velocity_random_walk"].value, 60.0 * got.value.N, rtol=1e-12)
    np.testing.assert_allclose(accel["noise_density"].value, got.value.N / 9.80665e-6, rtol=1e-12)
    assert accel["ramp"].unit == "ug/h"


def test_term_curves_add_up_to_the_model():
    tau = np.array([0.1, 3.0, 200.0])
    terms = NoiseCoefficients(*(np.array([x, 2.0 * x]) for x in (0.1, 1.0, 0.3, 0.02, 1e-3)))
    curves = term_curves(terms, tau)
    assert curves.shape == (5, 3, 2)
    for axis, factor in enumerate((1.0, 2.0)):
        fast = {"quantum": 0.1 * np.sqrt(12.0) * factor, "white": factor}
        model = TriadErrors(**fast, walk=0.02 * factor, ramp=1e-3 * factor)
        rest = allan_deviation(model, tau)[:, 0] ** 2 + (FLICKER_FLAT * 0.3 * factor) ** 2
        np.testing.assert_allclose(np.sum(curves[:, :, axis] ** 2, axis=0), rest, rtol=1e-12)


GOOD = np.random.default_rng(7).standard_normal((100, 3))


def spoilt(row, axis, value):
    out = GOOD.copy()
    out[row, axis] = value
    return out


def times(*changes):
    time = 10_000_000 * np.arange(100)
    for row, shift in changes:
        time[row:] += shift
    return time


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"rate": GOOD}, "give either dt_s"),
        ({"rate": GOOD, "dt_s": 1.0, "time_ns": times()}, "give either dt_s"),
        ({"rate": GOOD, "dt_s": 0.0}, "dt_s must be a positive number"),
        ({"rate": GOOD, "dt_s": float("nan")}, "dt_s must be a positive number"),
        ({"rate": GOOD, "dt_s": 1.0, "confidence": 1.0}, "confidence must lie between"),
        ({"rate": GOOD[:17], "dt_s": 1.0}, "needs at least 18 samples, got 17"),
        ({"rate": GOOD[None], "dt_s": 1.0}, r"must have shape \(N,\) or \(N, axes\)"),
        ({"rate": spoilt(5, 2, np.nan), "dt_s": 1.0}, r"first at row 5, axis 2 \(nan\)"),
        ({"rate": spoilt(8, 0, np.inf), "dt_s": 1.0}, r"first at row 8, axis 0 \(inf\)"),
        ({"rate": spoilt(slice(None), 1, 4.0), "dt_s": 1.0}, "axis 1 is constant at 4"),
        ({"rate": np.arange(100.0) ** 1, "dt_s": 1.0}, "only a ramp"),
        ({"rate": GOOD, "time_ns": times((40, -10_000_000))}, "forward at row 40 .step 0 s"),
        ({"rate": GOOD, "time_ns": times((40, -30_000_000))}, "row 40 .step -0.02 s"),
        ({"rate": GOOD, "time_ns": times()[1:]}, "time_ns must be 100 integers"),
        ({"rate": GOOD, "time_ns": times() * 1e-9}, "time_ns must be 100 integers"),
        ({"rate": GOOD, "dt_s": 1.0, "clusters": [0, 3]}, "whole numbers of samples from 1 to 50"),
        ({"rate": GOOD, "dt_s": 1.0, "clusters": [3, 51]}, "whole numbers of samples from 1 to 50"),
        ({"rate": GOOD, "dt_s": 1.0, "clusters": [3.5]}, "whole numbers of samples from 1 to 50"),
    ],
)
def test_data_that_have_no_allan_deviation_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        deviation(**arguments)


def test_a_short_record_is_refused_with_the_length_that_would_do():
    short = deviation(GOOD, dt_s=0.5)
    with pytest.raises(ValueError, match=r"at least 450 s of data.*this record has 50 s"):
        fit(short, "NBK")
    long_enough = np.random.default_rng(8).standard_normal(901)
    assert np.all(fit(deviation(long_enough, dt_s=0.5), "NBK").lower.N > 0.0)


@pytest.mark.parametrize("terms", ["", "NN", "NX", "R"])
def test_terms_that_make_no_sense_are_refused(terms):
    with pytest.raises(ValueError, match="terms must be different letters out of QNBKR"):
        fit(deviation(GOOD, dt_s=1.0), terms)
    with pytest.raises(ValueError, match="confidence must lie"):
        fit(deviation(GOOD, dt_s=1.0), "N", confidence=0.0)


def some_fit(axes=3):
    value = NoiseCoefficients(*(np.full(axes, x) for x in (0.1, 0.2, 0.3, 0.4, 0.0)))
    lower = NoiseCoefficients(*(0.9 * x for x in value))
    lower.K[1:2] = 0.0  # not resolved on this axis
    lower.Q[:] = 0.0
    none = np.zeros(axes)
    return AllanFit(value, lower, value, none, none + 5, "QNBK", 0.95, none + 0.01)


def test_a_model_from_an_allan_fit():
    errors = triad_errors(some_fit(), correlation_time_s=50.0)
    np.testing.assert_array_equal(errors.white, [0.2, 0.2, 0.2])
    np.testing.assert_array_equal(errors.walk, [0.4, 0.0, 0.4])
    assert errors.quantum is None
    assert errors.ramp is None
    # The peak of the Markov curve lies at the flat part of the fit.
    alone = TriadErrors(markov_sigma=errors.markov_sigma, markov_tau_s=errors.markov_tau_s)
    curve = allan_deviation(alone, np.linspace(50.0, 150.0, 400))
    np.testing.assert_allclose(curve.max(0), 0.3 * FLICKER_FLAT, rtol=1e-5)
    assert triad_errors(some_fit()).markov_sigma is None
    with pytest.raises(ValueError, match="a triad has three axes"):
        triad_errors(some_fit(axes=1))
