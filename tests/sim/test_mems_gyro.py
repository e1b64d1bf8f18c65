"""A MEMS gyro: no error, each error alone, and what they grow to."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from drawn import rotation
from scipy import stats
from scipy.spatial.transform import Rotation

from robins.sim.free_body import FreeBody, coning_start, free_body
from robins.sim.gyro import MemsGyro, delta_angles, integrate_angles
from robins.sim.random import Component, stream

DEG = np.pi / 180.0
KEY = stream(4, 2, Component.IMU)
DT = 0.1
STILL = np.tile([1.0, 0.0, 0.0, 0.0], (601, 1))
CHEAP = MemsGyro(5 * DEG / 3600.0, 5 * DEG / 3600.0, 300.0, 0.5 * DEG, 1e-3)

measure = jax.jit(delta_angles)


@pytest.fixture(scope="module", name="q_nb")
def coning():
    body = FreeBody(0.7, 1.0 / 3000.0, 1.0 / 400.0)
    q0, omega0 = coning_start(60 * DEG, 10 * DEG, 60 * DEG, 20 * DEG, body)
    flight = stream(4, 2, Component.TRAJECTORY)
    return np.asarray(free_body(flight, body, q0, omega0, DT, 600, 0.02 * DEG)[0])


def test_a_perfect_gyro_reports_the_turn_between_attitudes(q_nb):
    theta, errors = measure(KEY, q_nb, DT, MemsGyro())
    true = rotation(q_nb)
    np.testing.assert_allclose(theta, (true[:-1].inv() * true[1:]).as_rotvec(), atol=1e-15)
    np.testing.assert_allclose(integrate_angles(q_nb[0], theta), q_nb, rtol=0.0, atol=1e-13)
    for error in errors:
        assert not np.any(error)
    # half the samples of twice the interval: the turns compose, so no coning error is hidden
    theta = np.array(theta)
    coarse, _ = measure(KEY, q_nb[::2], 2.0 * DT, MemsGyro())
    pairs = Rotation.from_rotvec(theta[::2]) * Rotation.from_rotvec(theta[1::2])
    np.testing.assert_allclose(coarse, pairs.as_rotvec(), atol=1e-15)
    assert np.abs(coarse - (theta[::2] + theta[1::2])).max() > 1e-5


def test_the_sign_of_a_quaternion_does_not_matter(q_nb):
    sign = np.where(np.arange(len(q_nb)) % 3 == 0, -1.0, 1.0)[:, None]
    np.testing.assert_array_equal(
        measure(KEY, q_nb, DT, CHEAP)[0], measure(KEY, sign * q_nb, DT, CHEAP)[0]
    )


def test_what_is_reported_is_the_turn_and_the_errors(q_nb):
    gyro = MemsGyro(
        np.array([1e-4, 2e-4, 3e-4]), np.array([1e-4, 0.0, 2e-4]), 50.0, 1e-3, [1e-3, -2e-3, 0.0]
    )
    theta, errors = measure(KEY, q_nb, DT, gyro)
    true = rotation(q_nb)
    turn = (true[:-1].inv() * true[1:]).as_rotvec()
    errors = jax.tree.map(np.asarray, errors)
    rate = errors.bias_rad_s + errors.markov_rad_s + errors.white_rad_s
    expected = turn * (1.0 + np.array([1e-3, -2e-3, 0.0])) + DT * rate
    np.testing.assert_allclose(theta, expected, rtol=0.0, atol=1e-15)
    np.testing.assert_array_equal(errors.scale_factor, [1e-3, -2e-3, 0.0])
    np.testing.assert_array_equal(np.abs(errors.bias_rad_s), [1e-4, 2e-4, 3e-4])
    assert not np.any(errors.markov_rad_s[:, 1])


@pytest.fixture(scope="module", name="many")
def of_many_runs():
    """Dead reckoning of a body at rest: 800 runs of 60 s."""
    keys = jax.vmap(lambda k: stream(6, k, Component.IMU))(jnp.arange(800))
    start = jnp.array([1.0, 0.0, 0.0, 0.0])

    @jax.jit
    @jax.vmap
    def one(key):
        theta, errors = delta_angles(key, STILL, DT, CHEAP)
        return theta, errors, integrate_angles(start, theta)

    theta, errors, q = one(keys)
    return np.asarray(theta), jax.tree.map(np.asarray, errors), rotation(q[:, -1]).as_rotvec()


def within(samples, variance, count):
    """Test for a mean square that fits its variance; count independent samples in it."""
    low, high = stats.chi2.ppf([1e-5, 1.0 - 1e-5], count) / count
    assert low < np.mean(samples**2) / variance < high


def test_white_noise_is_white_and_of_its_level(many):
    white = many[1].white_rad_s
    within(white, (0.5 * DEG) ** 2, white.size)
    assert stats.kstest(white[:20].ravel() / (0.5 * DEG), "norm").pvalue > 1e-3
    flat = white.reshape(-1, 3) / (0.5 * DEG)
    assert np.abs(np.corrcoef(flat.T)[~np.eye(3, dtype=bool)]).max() < 4.5 / len(flat) ** 0.5
    assert abs(np.mean(white[:, 1:] * white[:, :-1])) / (0.5 * DEG) ** 2 < 4.5 / white.size**0.5


def test_drift_is_a_steady_markov_process_of_its_correlation_time(many):
    drift, sigma = many[1].markov_rad_s, CHEAP.markov_sigma_rad_s
    for k in (0, 300, 599):
        within(drift[:, k], sigma**2, drift[:, k].size)
    # first differences are almost independent, so the correlation time is well determined
    step = drift[:, 1:] - np.exp(-DT / 300.0) * drift[:, :-1]
    within(step, sigma**2 * (1.0 - np.exp(-2.0 * DT / 300.0)), step.size)
    later = np.mean(drift[:, 0] * drift[:, 599]) / sigma**2
    np.testing.assert_allclose(later, np.exp(-59.9 / 300.0), atol=4.5 / drift[:, 0].size ** 0.5)


def test_the_sign_of_the_bias_is_drawn_unless_it_is_given(many):
    bias = many[1].bias_rad_s
    np.testing.assert_allclose(np.abs(bias), 5 * DEG / 3600.0, rtol=1e-14)
    signs = np.sign(bias)
    assert np.all(np.abs(signs.mean(0)) < 4.5 / len(signs) ** 0.5)
    assert np.abs(signs.T @ signs / len(signs) - np.eye(3)).max() < 4.5 / len(signs) ** 0.5
    given = CHEAP._replace(bias_rad_s=[1e-4, -2e-4, 0.0], sign_drawn=False)
    _, errors = measure(KEY, STILL, DT, given)
    np.testing.assert_array_equal(errors.bias_rad_s, [1e-4, -2e-4, 0.0])


def test_the_error_of_dead_reckoning_grows_as_its_parts_do(many):
    turn, t = many[2], 60.0
    walk = 0.5 * DEG * np.sqrt(DT)  # rad/sqrt(s)
    np.testing.assert_allclose(walk / DEG, 0.158, atol=5e-4)
    x = t / 300.0
    slow = 2.0 * (CHEAP.markov_sigma_rad_s * 300.0) ** 2 * (x - 1.0 + np.exp(-x))
    within(turn, walk**2 * t + slow + (CHEAP.bias_rad_s * t) ** 2, turn.size)


def test_drift_alone_is_the_integral_of_the_process():
    gyro = MemsGyro(markov_sigma_rad_s=1e-4, markov_time_s=20.0)
    keys = jax.vmap(lambda k: stream(7, k, Component.IMU))(jnp.arange(800))
    theta = jax.jit(jax.vmap(lambda key: delta_angles(key, STILL, DT, gyro)[0]))(keys)
    x = 60.0 / 20.0
    expected = 2.0 * (1e-4 * 20.0) ** 2 * (x - 1.0 + np.exp(-x))
    within(np.sum(np.asarray(theta), 1), expected, 2400)


def test_a_scale_factor_counts_with_the_spin(q_nb):
    theta, _ = measure(KEY, q_nb, DT, MemsGyro(scale_factor=1e-3))
    perfect, _ = measure(KEY, q_nb, DT, MemsGyro())
    np.testing.assert_allclose(theta, 1.001 * np.asarray(perfect), rtol=1e-14)
    # 1000 ppm of 60 deg/s for 60 s: 3.6 deg about the axis of spin
    end = rotation(q_nb[-1]).inv() * rotation(integrate_angles(q_nb[0], theta)[-1])
    assert 3.2 * DEG < end.magnitude() < 3.6 * DEG


def test_numbers_depend_neither_on_sizes_nor_on_length(q_nb):
    _, small = measure(KEY, q_nb, DT, CHEAP)
    _, twice = measure(KEY, q_nb, DT, CHEAP._replace(white_rad_s=1.0 * DEG, bias_rad_s=0.0))
    np.testing.assert_allclose(twice.white_rad_s, 2.0 * np.asarray(small.white_rad_s), rtol=1e-14)
    np.testing.assert_array_equal(twice.markov_rad_s, small.markov_rad_s)
    begun, _ = measure(KEY, q_nb[:101], DT, CHEAP)
    np.testing.assert_array_equal(begun, measure(KEY, q_nb, DT, CHEAP)[0][:100])


@pytest.mark.parametrize(
    ("q_nb", "dt", "change", "words"),
    [
        (STILL, DT, {"bias_rad_s": np.nan}, "bias_rad_s must be"),
        (STILL, DT, {"bias_rad_s": np.zeros(2)}, "bias_rad_s must be a number or of shape"),
        (STILL, DT, {"markov_sigma_rad_s": -1.0}, "markov_sigma_rad_s must be"),
        (STILL, DT, {"markov_time_s": 0.0}, "tau_s must be"),
        (STILL, DT, {"white_rad_s": np.inf}, "white_rad_s must be"),
        (STILL, DT, {"scale_factor": -1.0}, "scale_factor must be"),
        (STILL[:1], DT, {}, "q_nb must have shape"),
        (STILL[:, :3], DT, {}, "q_nb must have shape"),
        (STILL[0], DT, {}, "q_nb must have shape"),
        (np.zeros((3, 4)), DT, {}, "q_nb must"),
        (np.full((3, 4), np.nan), DT, {}, "q_nb must"),
        (STILL, 0.0, {}, "dt_s must be"),
        (STILL, -0.1, {}, "dt_s must be"),
        (STILL, np.nan, {}, "dt_s must be"),
    ],
)
def test_errors_that_no_gyro_has_are_refused(q_nb, dt, change, words):
    with pytest.raises(ValueError, match=words):
        delta_angles(KEY, q_nb, dt, MemsGyro()._replace(**change))
