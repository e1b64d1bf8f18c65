"""The star sensor: its errors as drawn, and as SciPy reads them back from attitudes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation

from robins.sim.random import Component, stream
from robins.sim.star_sensor import read_star, star_errors

COUNT, FRAME = 2400, 0.5
KEY = stream(9, 1, Component.STAR_SENSOR)
SIGMA = np.array([1e-4, 1e-4, 4e-4])
errors = jax.jit(star_errors, static_argnums=3)
turned = jax.jit(jax.vmap(read_star, (0, 0, None)))


def test_white_noise_has_its_sigma_about_each_axis():
    noise = np.asarray(errors(KEY, SIGMA, FRAME, COUNT))
    assert np.abs(np.corrcoef(noise.T)[~np.eye(3, dtype=bool)]).max() < 4.0 / COUNT**0.5
    for series, sigma in zip(noise.T, SIGMA, strict=True):
        assert stats.kstest(series / sigma, "norm").pvalue > 1e-3
        assert abs(np.corrcoef(series[1:], series[:-1])[0, 1]) < 4.0 / COUNT**0.5


def test_the_low_frequency_error_is_a_sine_of_its_size_and_period():
    size, period = np.array([3e-5, 5e-5, 0.0]), 600.0
    quiet = np.asarray(errors(KEY, SIGMA, FRAME, COUNT))
    slow = np.asarray(errors(KEY, SIGMA, FRAME, COUNT, size, period)) - quiet
    # 1200 s are two periods: all of the sine is in one line of the discrete spectrum.
    lines = np.fft.rfft(slow, axis=0) / (COUNT / 2)
    np.testing.assert_allclose(np.abs(lines[2]), size, rtol=1e-9, atol=1e-15)
    assert np.abs(np.delete(lines, 2, axis=0)).max() < 1e-15
    assert abs(np.diff(np.angle(lines[2, :2]))[0]) > 0.01
    many = jax.jit(jax.vmap(lambda k: star_errors(k, 0.0, 1.0, 1, 1.0, 600.0)[0]))
    start = np.asarray(many(jax.random.split(KEY, 500))).ravel()
    assert stats.kstest(np.arcsin(start), stats.uniform(-np.pi / 2, np.pi).cdf).pvalue > 1e-3


def test_the_same_numbers_are_drawn_whatever_the_sizes_and_the_count():
    noise = errors(KEY, SIGMA, FRAME, COUNT)
    np.testing.assert_allclose(errors(KEY, 3.0 * SIGMA, FRAME, COUNT), 3.0 * noise, rtol=1e-12)
    np.testing.assert_allclose(star_errors(KEY, SIGMA, FRAME, 7), noise[:7], rtol=1e-14)


@pytest.mark.parametrize("mounted", [False, True])
def test_the_error_is_a_turn_about_the_axes_of_the_sensor(mounted):
    mount = Rotation.from_euler("ZYX", [0.4, -1.1, 2.0] if mounted else np.zeros(3))
    true = Rotation.random(COUNT, rng=np.random.default_rng(8))
    error = errors(KEY, SIGMA, FRAME, COUNT)
    q_bs = mount.as_quat(scalar_first=True) if mounted else None
    measured = turned(jnp.asarray(true.as_quat(scalar_first=True)), error, q_bs)
    body = (true.inv() * Rotation.from_quat(measured, scalar_first=True)).as_rotvec()
    np.testing.assert_allclose(mount.inv().apply(body), error, atol=1e-15)
    np.testing.assert_allclose(np.linalg.norm(measured, axis=1), 1.0, rtol=1e-15)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"sigma_rad": -1.0}, "sigma_rad must be a finite number from 0"),
        ({"sigma_rad": [1.0, 2.0]}, "sigma_rad must be a number or of shape"),
        ({"count": 0}, "count is 0"),
        ({"frame_s": 0.0}, "frame_s must be a finite number above 0"),
        ({"low_frequency_period_s": 0.0}, "low_frequency_period_s must be a finite number above 0"),
    ],
)
def test_what_cannot_be_drawn_is_refused(wrong, message):
    given = {"sigma_rad": SIGMA, "frame_s": FRAME, "count": 5} | wrong
    with pytest.raises(ValueError, match=message):
        star_errors(KEY, **given)


def test_a_mounting_of_another_shape_is_refused():
    with pytest.raises(ValueError, match="q_bs must have shape"):
        read_star(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.zeros(3), np.eye(3))
