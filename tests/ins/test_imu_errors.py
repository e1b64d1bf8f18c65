"""Error models: figures into SI, closed forms against spectra, refusals, models as pytrees."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import dblquad, quad
from scipy.optimize import minimize_scalar

from robins.ins.imu_errors import (
    FIGURES,
    MARKOV_PEAK,
    ImuErrorModel,
    TriadErrors,
    allan_deviation,
    grade,
    mean_sigma,
)
from robins.units import UnitError

DEG_H = np.pi / 180.0 / 3600.0
G = 9.80665


def test_a_data_sheet_becomes_si():
    model = ImuErrorModel.from_datasheet(
        gyro={
            "bias": ["10 deg/h", "20 deg/h", "0 deg/h"],
            "bias_instability": "2 deg/h",
            "correlation_time": "5 min",
            "noise": "0.1 deg/sqrt(h)",
            "rate_random_walk": "3 deg/h/sqrt(h)",
            "drift_per_hour": "0.5 deg/h",
            "scale_factor": "200 ppm",
            "misalignment": "1 mrad",
            "g_sensitivity": "1 deg/h/g",
            "quantisation": "2 arcsec",
            "full_scale": "400 deg/s",
        },
        accel={
            "bias": "1 mg",
            "noise": "100 ug/sqrt(Hz)",
            "rate_random_walk": "10 ug/sqrt(h)",
            "drift_per_hour": "20 ug",
            "quantisation": "1 mm/s",
            "full_scale": "10 g",
        },
    )
    gyro, accel = model.gyro, model.accel
    none = np.ones((3, 3)) - np.eye(3)
    for got, wanted in [
        (gyro.bias_sigma, DEG_H * np.array([10.0, 20.0, 0.0])),
        (gyro.markov_sigma, np.full(3, 2.0 * DEG_H / MARKOV_PEAK)),
        (gyro.markov_tau_s, np.full(3, 300.0)),
        (gyro.white, np.full(3, np.deg2rad(0.1) / 60.0)),
        (gyro.walk, np.full(3, 3.0 * DEG_H / 60.0)),
        (gyro.ramp, np.full(3, 0.5 * DEG_H / 3600.0)),
        (gyro.scale_sigma, np.full(3, 2e-4)),
        (gyro.misalignment_sigma, 1e-3 * none),
        (gyro.g_sensitivity_sigma, np.full((3, 3), DEG_H / G)),
        (gyro.quantum, np.full(3, np.deg2rad(2.0 / 3600.0))),
        (gyro.full_scale, np.full(3, np.deg2rad(400.0))),
        (accel.bias_sigma, np.full(3, 1e-3 * G)),
        (accel.white, np.full(3, 1e-4 * G)),
        (accel.walk, np.full(3, 1e-5 * G / 60.0)),
        (accel.ramp, np.full(3, 2e-5 * G / 3600.0)),
        (accel.quantum, np.full(3, 1e-3)),
        (accel.full_scale, np.full(3, 10.0 * G)),
    ]:
        np.testing.assert_allclose(got, wanted, rtol=1e-14)
    for absent in (gyro.bias, gyro.scale, accel.markov_sigma, accel.scale_sigma):
        assert absent is None


def test_names_of_the_white_noise():
    a = ImuErrorModel.from_datasheet({"arw": "0.6 deg/sqrt(h)"}, {"vrw": "0.06 m/s/sqrt(h)"})
    given = {"noise": "0.01 deg/s/sqrt(Hz)"}, {"noise": "0.001 m/s^2/sqrt(Hz)"}
    b = ImuErrorModel.from_datasheet(*given)
    np.testing.assert_allclose(a.gyro.white, b.gyro.white, rtol=1e-14)
    np.testing.assert_allclose(a.accel.white, b.accel.white, rtol=1e-14)


@pytest.mark.parametrize(
    ("gyro", "accel", "message"),
    [
        ({"bais": "1 deg/h"}, {}, r"no figure 'bais' in the gyro; did you mean 'bias'\?"),
        ({"vrw": "1 ug/sqrt(Hz)"}, {}, "no figure 'vrw' in the gyro"),
        ({}, {"g_sensitivity": "1 deg/h/g"}, "no figure 'g_sensitivity' in the accel"),
        ({"bias": "1 deg/sqrt(h)"}, {}, r"gyro\.bias: .*angle rate"),
        ({"bias": "1"}, {}, r"gyro\.bias: .*unit"),
        ({}, {"bias": ["1 mg", "2 mg", "3"]}, r"accel\.bias: .*unit"),
        ({"bias": ["1 deg/h", "2 deg/h"]}, {}, r"gyro: bias_sigma must be .* shape \(3,\)"),
        ({"bias": "-1 deg/h"}, {}, "gyro: bias_sigma must not be negative"),
        ({"noise": "1 deg/sqrt(h)", "arw": "1 deg/sqrt(h)"}, {}, "white is given twice"),
        ({"bias_instability": "1 deg/h"}, {}, "gyro: bias_instability and correlation_time"),
        ({}, {"correlation_time": "1 h"}, "accel: bias_instability and correlation_time"),
        ({"full_scale": "0 deg/s"}, {}, "gyro: full_scale must be positive"),
    ],
)
def test_bad_data_sheets_are_refused(gyro, accel, message):
    with pytest.raises(ValueError, match=message):
        ImuErrorModel.from_datasheet(gyro, accel)


def test_a_unit_of_another_kind_is_a_unit_error():
    with pytest.raises(UnitError, match=r"gyro\.noise"):
        ImuErrorModel.from_datasheet({"noise": "0.1 deg/h"})


@pytest.mark.parametrize(
    ("errors", "message"),
    [
        ({"white": [1.0, 2.0]}, r"white must be a number or of shape \(3,\), got shape \(2,\)"),
        ({"misalignment": [1.0, 2.0, 3.0]}, r"misalignment must be .* shape \(3, 3\)"),
        ({"bias": np.nan}, "bias must be finite"),
        ({"full_scale": np.inf}, "full_scale must be finite.*None stands for"),
        ({"walk": [1.0, -1.0, 1.0]}, "walk must not be negative"),
        ({"markov_sigma": 1.0}, "markov_sigma and markov_tau_s belong together"),
        ({"markov_tau_s": 1.0}, "markov_sigma and markov_tau_s belong together"),
        ({"markov_sigma": 1.0, "markov_tau_s": 0.0}, "markov_tau_s must be positive"),
        ({"misalignment": np.eye(3)}, "misalignment has a diagonal"),
    ],
)
def test_bad_models_are_refused(errors, message):
    with pytest.raises(ValueError, match=message):
        TriadErrors(**errors)


def test_g_sensitivity_of_accelerometers_is_refused():
    with pytest.raises(ValueError, match="an error of gyros"):
        ImuErrorModel(accel=TriadErrors(g_sensitivity=1e-6))


def test_a_number_stands_for_all_axes():
    errors = TriadErrors(bias=-1.0, scale=2.0, misalignment=3.0, g_sensitivity=4.0)
    np.testing.assert_array_equal(errors.bias, [-1.0, -1.0, -1.0])
    np.testing.assert_array_equal(errors.scale, [2.0, 2.0, 2.0])
    np.testing.assert_array_equal(errors.misalignment, 3.0 * (np.ones((3, 3)) - np.eye(3)))
    np.testing.assert_array_equal(errors.g_sensitivity, 4.0 * np.eye(3))


def test_models_are_pytrees_that_stack_and_trace():
    models = [
        ImuErrorModel(TriadErrors(white=w, markov_sigma=1.0, markov_tau_s=9.0)) for w in (1.0, 2.0)
    ]
    assert len(jax.tree.leaves(models[0])) == 3
    stacked = jax.tree.map(lambda *x: np.stack(x), *models)
    assert stacked.gyro.white.shape == (2, 3)
    assert stacked.gyro.bias is None
    total = jax.vmap(lambda m: jnp.sum(m.gyro.white) + jnp.sum(m.gyro.markov_tau_s))(stacked)
    np.testing.assert_array_equal(total, [30.0, 33.0])
    shapes = jax.tree.map(np.shape, stacked)  # leaves that are no numbers must not be checked
    assert shapes.gyro.white == (2, 3)
    slope = jax.grad(lambda w: jnp.sum(TriadErrors(white=w).white ** 2))(2.0)
    np.testing.assert_allclose(slope, 12.0)


def test_the_peak_of_the_markov_curve():
    errors = TriadErrors(markov_sigma=1.0, markov_tau_s=1.0)
    peak = minimize_scalar(lambda t: -allan_deviation(errors, t)[0], (1.5, 1.9, 2.5), tol=1e-12)
    np.testing.assert_allclose(-peak.fun, MARKOV_PEAK, rtol=1e-9)
    np.testing.assert_allclose(peak.x, 1.893, atol=5e-4)


@pytest.mark.parametrize("tau", [0.3, 2.0, 40.0])
@pytest.mark.parametrize(
    ("errors", "spectrum"),
    [
        (TriadErrors(white=2.0), lambda f: 4.0),
        (TriadErrors(walk=0.5), lambda f: 0.25 / (2.0 * np.pi * f) ** 2),
        (
            TriadErrors(markov_sigma=3.0, markov_tau_s=5.0),
            lambda f: 2.0 * 9.0 * 5.0 / (1.0 + (2.0 * np.pi * f * 5.0) ** 2),
        ),
    ],
    ids=["white", "walk", "markov"],
)
def test_allan_curves_are_integrals_of_the_spectrum(errors, spectrum, tau):
    # IEEE Std 952: sigma^2 = 4 int_0^inf S(f) sin^4(pi f tau) / (pi f tau)^2 df, two-sided S.
    def integrand(x):  # x = pi f tau
        return spectrum(x / (np.pi * tau)) * np.sin(x) ** 4 / x**2

    whole = [quad(integrand, k * np.pi, (k + 1) * np.pi)[0] for k in range(400)]
    # The rest, over 1/x: sin^4 is 3/8 on average.
    rest = 0.375 * quad(lambda u: spectrum(1.0 / (u * np.pi * tau)), 0.0, 1.0 / (400 * np.pi))[0]
    variance = 4.0 / (np.pi * tau) * (sum(whole) + rest)
    np.testing.assert_allclose(allan_deviation(errors, tau), np.sqrt(variance), rtol=1e-6)


def test_allan_curves_of_the_other_terms_and_their_sum():
    tau = np.array([0.5, 8.0])
    # Rounding errors of successive angles are independent, of variance quantum^2 / 12.
    second_difference = (1.0 + 4.0 + 1.0) * 0.3**2 / 12.0
    np.testing.assert_allclose(
        allan_deviation(TriadErrors(quantum=0.3), tau)[:, 1] ** 2,
        second_difference / (2.0 * tau**2),
    )
    # Neighbouring means of a ramp differ by slope * tau.
    of_ramp = allan_deviation(TriadErrors(ramp=-0.2), tau)[:, 2]
    np.testing.assert_allclose(of_ramp, 0.2 * tau / np.sqrt(2.0))
    parts = [
        {"white": [1.0, 2.0, 3.0]},
        {"walk": 0.2},
        {"ramp": 0.1},
        {"quantum": 0.5},
        {"markov_sigma": 0.3, "markov_tau_s": 4.0},
    ]
    both = TriadErrors(**{k: v for part in parts for k, v in part.items()})
    squares = sum(allan_deviation(TriadErrors(**part), tau) ** 2 for part in parts)
    np.testing.assert_allclose(allan_deviation(both, tau) ** 2, squares)
    assert np.all(allan_deviation(TriadErrors(bias=1.0), tau) == 0.0)


def test_the_markov_curve_at_short_times_is_that_of_the_random_walk():
    errors = TriadErrors(markov_sigma=2.0, markov_tau_s=1e5)
    walk = TriadErrors(walk=2.0 * np.sqrt(2.0 / 1e5))
    tau = np.array([0.01, 1.0, 9.9, 10.1, 100.0])
    ratio = allan_deviation(errors, tau) / allan_deviation(walk, tau)
    series = np.sqrt(1.0 - 0.75e-5 * tau + 0.35e-10 * tau**2)
    np.testing.assert_allclose(ratio, np.tile(series[:, None], 3), rtol=1e-7)


def test_mean_sigma_from_autocovariances():
    duration = 7.0

    def mean_of(autocovariance):
        area = dblquad(autocovariance, 0.0, duration, 0.0, lambda t: t)[0]  # half of the square
        return np.sqrt(2.0 * area) / duration

    markov = TriadErrors(markov_sigma=3.0, markov_tau_s=5.0)
    fading = mean_of(lambda s, t: 9.0 * np.exp(-(t - s) / 5.0))
    np.testing.assert_allclose(mean_sigma(markov, duration), fading, rtol=1e-8)
    walk = TriadErrors(walk=2.0)
    np.testing.assert_allclose(mean_sigma(walk, duration), mean_of(lambda s, t: 4.0 * s), rtol=1e-8)
    more = {"walk": 2.0, "bias_sigma": [1.0, 0.0, 2.0], "bias": 9.0}
    sum_of = TriadErrors(markov_sigma=3.0, markov_tau_s=5.0, **more)
    squares = mean_sigma(markov, duration) ** 2 + mean_sigma(walk, duration) ** 2
    wanted = squares + np.array([1.0, 0.0, 4.0])
    np.testing.assert_allclose(mean_sigma(sum_of, duration) ** 2, wanted)
    np.testing.assert_allclose(mean_sigma(TriadErrors(white=2.0), 16.0), 0.5)
    np.testing.assert_allclose(mean_sigma(TriadErrors(quantum=6.0), 2.0), np.sqrt(6.0) / 2.0)
    with pytest.raises(ValueError, match="duration_s must be a positive number"):
        mean_sigma(walk, 0.0)


def test_grades_get_worse_from_first_to_last():
    assert list(FIGURES) == ["navigation", "tactical", "industrial MEMS", "consumer MEMS"]
    models = [grade(name) for name in FIGURES]
    for sensor in ("gyro", "accel"):
        for name in ("bias_sigma", "markov_sigma", "white", "scale_sigma", "misalignment_sigma"):
            sizes = [np.max(getattr(getattr(m, sensor), name)) for m in models]
            assert np.all(np.diff(sizes) >= 0.0), (sensor, name)
    navigation = models[0].gyro
    np.testing.assert_allclose(navigation.bias_sigma, 0.01 * DEG_H)


def test_an_unknown_grade_is_refused():
    with pytest.raises(ValueError, match=r"'tactcal' in robins; did you mean 'tactical'\?"):
        grade("tactcal")
