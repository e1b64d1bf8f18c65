"""The star camera: which stars it shows and where, and the attitude it leads to, by other means."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation

from robins.earth.stars import synthetic
from robins.sim.random import Component, stream
from robins.sim.star_sensor import (
    ARCSEC,
    StarCamera,
    expose,
    index_for,
    measure_attitude,
    photograph,
    turned,
    visible_stars,
)

POINTINGS, HALF = 200, np.radians(10.0)
MOUNT = Rotation.from_euler("ZYX", [0.4, -1.1, 2.0])
CAMERA = StarCamera(
    magnitude_limit=5.5, q_bs=MOUNT.as_quat(scalar_first=True), most_stars=20, false_stars=3
)
SKY = synthetic(5.5)
INDEX = jax.tree.map(jnp.asarray, index_for(CAMERA, SKY))
TRUE = Rotation.random(POINTINGS, rng=np.random.default_rng(6))
Q_IB = jnp.asarray(TRUE.as_quat(scalar_first=True))
KEYS = jax.vmap(lambda k: stream(2, k, Component.STAR_SENSOR))(jnp.arange(POINTINGS))
NO_TURN = jnp.zeros(3)

shown = jax.jit(jax.vmap(photograph, (0, None, 0, None, None)))
known = jax.jit(jax.vmap(measure_attitude, (0, None, 0, None, None)))
tracked = jax.jit(jax.vmap(measure_attitude, (0, None, 0, None, None, 0, None)))


def picture(camera=CAMERA, turn=NO_TURN):
    return jax.tree.map(np.asarray, shown(KEYS, INDEX, Q_IB, camera, turn))


def in_sensor(image):
    """Directions in sensor axes, (POINTINGS, M, 3)."""
    return image.vectors_b @ MOUNT.as_matrix()


def stars_in_sensor(image):
    """True places of the stars of an image."""
    inertial = SKY.unit_i[image.star]
    return np.stack([(TRUE[k] * MOUNT).inv().apply(inertial[k]) for k in range(POINTINGS)])


@pytest.fixture(scope="module")
def image():
    return picture()


def test_the_brightest_stars_in_the_field_are_shown_where_they_are():
    counts = []
    quiet = picture(dataclasses.replace(CAMERA, sigma_rad=1e-12))
    for k in range(POINTINGS):
        unit = (TRUE[k] * MOUNT).inv().apply(SKY.unit_i)
        field = np.flatnonzero(unit[:, 2] > np.cos(HALF))  # brightest first
        counts.append(len(field))
        wanted = field[: CAMERA.most_stars]
        star = quiet.star[k]
        np.testing.assert_array_equal(star[star >= 0], wanted)
        np.testing.assert_array_equal(quiet.magnitude[k][star >= 0], SKY.magnitude[wanted])
        assert np.sum(~np.isnan(quiet.magnitude[k])) == len(wanted) + 3
    assert min(counts) < CAMERA.most_stars < max(counts)
    there = quiet.star >= 0
    np.testing.assert_allclose(in_sensor(quiet)[there], stars_in_sensor(quiet)[there], atol=1e-11)
    none = np.isnan(quiet.magnitude)
    assert np.all(np.isnan(quiet.vectors_b[none]))
    assert np.all(quiet.star[none] == -1)


def test_each_star_has_an_error_that_grows_with_its_magnitude():
    image = picture(dataclasses.replace(CAMERA, sigma_growth=0.3, magnitude_sigma=0.2))
    there = image.star >= 0
    magnitude = SKY.magnitude[image.star[there]]
    sigma = 20.0 * ARCSEC * np.maximum(1.0, 10.0 ** (0.3 * (magnitude - 4.0)))
    np.testing.assert_allclose(image.sigma_rad[there], sigma, rtol=1e-12)
    assert sigma.max() > 2.0 * sigma.min()
    true, seen = stars_in_sensor(image)[there], in_sensor(image)[there]
    np.testing.assert_allclose(np.linalg.norm(seen, axis=1), 1.0, rtol=1e-14)
    error = (seen - true) / sigma[:, None]
    first = np.cross(true, np.eye(3)[0])
    first = first / np.linalg.norm(first, axis=1, keepdims=True)
    angles = np.stack([np.sum(error * e, 1) for e in (first, np.cross(true, first))])
    for angle in (*angles, (image.magnitude[there] - magnitude) / 0.2):
        assert stats.kstest(angle, "norm").pvalue > 1e-3
    assert abs(np.corrcoef(angles)[0, 1]) < 4.0 / len(magnitude) ** 0.5
    # Reported brightest first, as far as the camera can tell.
    assert not np.any(np.diff(image.magnitude, axis=1) < 0.0)


def test_stars_are_missed_and_false_ones_shown(image):
    missing = picture(dataclasses.replace(CAMERA, missed=0.3))
    before, after = ((x.star >= 0).sum() for x in (image, missing))
    assert stats.binomtest(int(before - after), int(before), 0.3).pvalue > 1e-3
    for k in range(POINTINGS):
        assert set(missing.star[k]) <= set(image.star[k]) | {-1}
    false = (image.star == -1) & ~np.isnan(image.magnitude)
    assert np.all(false.sum(1) == 3)
    unit = in_sensor(image)[false]
    assert stats.kstest(unit[:, 2], stats.uniform(np.cos(HALF), 1 - np.cos(HALF)).cdf).pvalue > 1e-3
    azimuth = np.arctan2(unit[:, 1], unit[:, 0])
    assert stats.kstest(azimuth, stats.uniform(-np.pi, 2 * np.pi).cdf).pvalue > 1e-3
    # As bright as stars are: each magnitude has 10^0.4888 times as many as the one before.
    fainter = CAMERA.magnitude_limit - image.magnitude[false]
    assert stats.kstest(fainter, stats.expon(0.0, 1 / (0.4888 * np.log(10.0))).cdf).pvalue > 1e-3


def test_an_error_of_all_stars_is_one_of_the_attitude(image):
    turn = np.array([3e-3, -2e-3, 5e-3])
    turned = picture(turn=jnp.asarray(turn))
    told = TRUE * MOUNT * Rotation.from_rotvec(turn) * MOUNT.inv()
    told = jnp.asarray(told.as_quat(scalar_first=True))
    wanted = jax.tree.map(np.asarray, shown(KEYS, INDEX, told, CAMERA, NO_TURN))
    np.testing.assert_array_equal(turned.star, wanted.star)
    np.testing.assert_allclose(turned.vectors_b, wanted.vectors_b, atol=1e-14)
    assert np.any(turned.star != image.star)


def test_a_camera_that_is_turned_before_a_sky_sees_what_it_sees_there():
    """Shown stars reach beyond the field, so stars come in at its edge, and others go."""
    turn = jnp.array([3e-3, -2e-3, 5e-3])

    q_is = jnp.asarray((TRUE * MOUNT).as_quat(scalar_first=True))

    def seen(margin_rad):
        def one(key, q_is):
            shown = visible_stars(INDEX, q_is, CAMERA, 60, margin_rad)
            return expose(key, turned(shown, CAMERA, turn), CAMERA)

        return jax.tree.map(np.asarray, jax.jit(jax.vmap(one))(KEYS, q_is))

    wanted, beyond = picture(turn=turn), seen(np.radians(0.4))
    np.testing.assert_array_equal(beyond.star, wanted.star)
    np.testing.assert_allclose(beyond.vectors_b, wanted.vectors_b, atol=1e-14)
    np.testing.assert_allclose(beyond.magnitude, wanted.magnitude, atol=1e-14)
    assert np.any(seen(0.0).star != wanted.star)


def test_the_same_numbers_are_drawn_whatever_the_sizes(image):
    coarse = picture(dataclasses.replace(CAMERA, sigma_rad=2.0 * CAMERA.sigma_rad))
    there = image.star >= 0
    np.testing.assert_array_equal(coarse.star, image.star)
    true = stars_in_sensor(image)[there]
    once, twice = (in_sensor(x)[there] - true for x in (image, coarse))
    np.testing.assert_allclose(twice, 2.0 * once, atol=4.0 * (6.0 * CAMERA.sigma_rad) ** 2)


def whitened(q, covariance):
    error = (Rotation.from_quat(q, scalar_first=True).inv() * TRUE).as_rotvec()
    return np.einsum("kji,kj->ki", np.linalg.cholesky(np.linalg.inv(covariance)), error)


@pytest.fixture(scope="module")
def measured():
    return [np.asarray(x) for x in known(KEYS, INDEX, Q_IB, CAMERA, NO_TURN)]


def test_the_attitude_is_as_good_as_its_covariance_says(measured, image):
    q, covariance, count = measured
    np.testing.assert_array_equal(count, (image.star >= 0).sum(1))
    white, near = whitened(q, covariance), 4.0 * (2.0 / POINTINGS) ** 0.5
    np.testing.assert_allclose(white.T @ white / POINTINGS, np.eye(3), atol=near)
    # The boresight, sensor z, is the axis about which it knows least, wherever it points.
    worst = np.linalg.eigh(covariance)[1][:, :, -1]
    assert np.abs(worst @ MOUNT.apply([0.0, 0.0, 1.0])).mean() > 0.99


def test_tracked_stars_are_the_right_ones_or_none(measured):
    off = Rotation.from_rotvec(np.random.default_rng(3).normal(size=(POINTINGS, 3)) * 40 * ARCSEC)
    prior = jnp.asarray((TRUE * off).as_quat(scalar_first=True))
    q, covariance, count = tracked(KEYS, INDEX, Q_IB, CAMERA, NO_TURN, prior, 300.0 * ARCSEC)
    assert np.all(count <= measured[2] + 1)  # a false star beside a place without one, at most
    assert np.mean(np.asarray(count)) > 0.97 * np.mean(measured[2])
    assert np.abs(whitened(q, covariance)).max() < 5.0  # and one wrong star is off by more than ten
    # A prior that is far off finds hardly a star, and next to never two that agree by chance.
    lost = prior[jnp.roll(jnp.arange(POINTINGS), 1)]
    assert np.mean(tracked(KEYS, INDEX, Q_IB, CAMERA, NO_TURN, lost, 300.0 * ARCSEC)[2]) < 0.5


def test_with_too_few_stars_there_is_no_attitude():
    dim = dataclasses.replace(CAMERA, magnitude_limit=3.5)
    q, covariance, count = (np.asarray(x) for x in known(KEYS, INDEX, Q_IB, dim, NO_TURN))
    assert set(count) >= {0, 1, 2}
    refused = np.isnan(q).all(1)
    assert np.all(refused[count < 2])
    assert not np.any(refused[count > 3])
    np.testing.assert_array_equal(np.isnan(covariance).all((1, 2)), refused)
    assert np.all(np.isfinite(q[~refused]))


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"field_rad": 0.0}, "field_rad must be a finite number above 0"),
        ({"field_rad": 2.0}, "field_rad must be a finite number above 0 to 1.55"),
        ({"sigma_rad": 0.0}, "sigma_rad must be a finite number above 0"),
        ({"missed": 1.5}, "missed must be a finite number from 0 to 1"),
        ({"q_bs": (1.0, 1.0, 0.0, 0.0)}, "q_bs must be a unit quaternion"),
        ({"q_bs": np.eye(3)}, r"q_bs must have shape \(4,\)"),
        ({"most_stars": 0}, "most_stars is 0"),
        ({"false_stars": -1}, "false_stars must be a finite number from 0"),
        ({"magnitude_limit": -5.0}, "no star of the catalogue is brighter"),
    ],
)
def test_what_is_no_camera_is_refused(wrong, message):
    with pytest.raises(ValueError, match=message):
        index_for(dataclasses.replace(CAMERA, **wrong), SKY)
