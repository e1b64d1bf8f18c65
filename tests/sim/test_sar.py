"""The radar: errors in metres by pyproj's geodesics, outliers by the mixture they are."""

import jax
import jax.numpy as jnp
import numpy as np
import pyproj
import pytest
from scipy import stats

from robins.earth import Geodetic
from robins.sim.random import Component, stream
from robins.sim.sar import SarErrorModel, observe_sar

COUNT = 20_000
KEY = stream(6, 3, Component.SAR)
rng = np.random.default_rng(2)
LAT = rng.uniform(-1.2, 1.2, COUNT)
LON = np.where(np.arange(COUNT) < COUNT // 2, np.pi - 1e-7, rng.uniform(-np.pi, np.pi, COUNT))
ALT = np.full(COUNT, 20e3)
HEADING = rng.uniform(-np.pi, np.pi, COUNT)
TRUE = Geodetic(LAT, LON, ALT)
PRESENT = np.arange(COUNT) % 7 != 0
SIGMA_M, HEADING_SIGMA = np.array([20.0, 30.0]), 0.02

observe = jax.jit(observe_sar)


def model(**other):
    return SarErrorModel(sigma_m=SIGMA_M, heading_sigma_rad=HEADING_SIGMA)._replace(**other)


def seen(given, present=PRESENT):
    return jax.tree.map(np.asarray, observe(given, KEY, TRUE, HEADING, present))


def errors(fix, there=PRESENT):
    """North, east [m] at height and heading [rad]: by geodesics on the ellipsoid."""
    lat, lon = fix.position.lat[there], fix.position.lon[there]
    azimuth, _, distance = pyproj.Geod(ellps="WGS84").inv(
        LON[there], LAT[there], lon, lat, radians=True
    )
    # Metres at height, not on the ellipsoid: of each radius of curvature.
    e_sq = 0.00669437999014
    sin_sq = np.sin(LAT[there]) ** 2
    transverse = 6378137.0 / np.sqrt(1.0 - e_sq * sin_sq)
    meridian = transverse * (1.0 - e_sq) / (1.0 - e_sq * sin_sq)
    north = distance * np.cos(azimuth) * (1.0 + ALT[0] / meridian)
    east = distance * np.sin(azimuth) * (1.0 + ALT[0] / transverse)
    turned = np.mod(fix.heading_rad[there] - HEADING[there] + np.pi, 2.0 * np.pi) - np.pi
    return np.stack([north, east, turned], 1)


UNIT = np.append(SIGMA_M, HEADING_SIGMA)


def mixture(x, share, factor):
    return (1.0 - share) * stats.norm.cdf(x) + share * stats.norm.cdf(x / factor)


@pytest.mark.parametrize("share", [0.0, 0.1])
def test_errors_are_normal_and_of_a_share_larger(share):
    fix = seen(model(outlier_share=share))
    error = errors(fix) / UNIT
    for axis in range(3):
        x = error[:, axis]
        assert stats.kstest(x, lambda x: mixture(x, share, 5.0)).pvalue > 1e-3
    product = np.mean(error[:, :, None] * error[:, None, :], 0)[~np.eye(3, dtype=bool)]
    variance = 1.0 + share * 24.0
    # of the product of two axes that are struck together: share 625 and the rest 1
    spread = np.sqrt((1.0 - share + share * 625.0) / len(error))
    assert np.abs(product).max() < 4.5 * spread
    fourth = 3.0 * (1.0 - share + share * 625.0)
    off = np.mean(error**2, 0) - variance
    assert np.abs(off).max() < 4.5 * np.sqrt((fourth - variance**2) / len(error))


def test_a_sample_is_struck_in_all_its_components():
    calm, got = errors(seen(model())), errors(seen(model(outlier_share=0.1)))
    struck = np.abs(got[:, 2] / calm[:, 2]) > 3.0
    assert np.mean(struck) == pytest.approx(0.1, abs=4.0 * np.sqrt(0.09 / len(struck)))
    wanted = np.where(struck[:, None], 5.0, 1.0) * calm
    np.testing.assert_allclose(got[:, 2], wanted[:, 2], rtol=1e-9)
    # A geodesic leaves the parallel it sets out along, by s^2 tan(lat) / 2R.
    apart = np.sum(wanted[:, :2] ** 2, 1) * (1.0 + np.abs(np.tan(LAT[PRESENT]))) / 6.3e6
    assert np.all(np.abs(got - wanted)[:, :2] < apart[:, None] + 1e-5)


def test_an_offset_is_so_many_sigmas_long():
    there = np.ones(COUNT, bool)
    off = model(outlier_share=1.0, outlier_factor=0.0, outlier_offset=5.0)
    error = errors(seen(off, there), there) / UNIT
    np.testing.assert_allclose(np.hypot(error[:, 0], error[:, 1]), 5.0, rtol=1e-4)
    np.testing.assert_allclose(np.abs(error[:, 2]), 5.0, rtol=1e-9)
    angle = np.arctan2(error[:, 1], error[:, 0])
    assert stats.kstest(angle, stats.uniform(-np.pi, 2.0 * np.pi).cdf).pvalue > 1e-3
    assert abs(np.mean(np.sign(error[:, 2]))) < 4.0 / COUNT**0.5
    # on top of the noise, of a tenth of the samples
    some = errors(seen(model(outlier_share=0.1, outlier_factor=1.0, outlier_offset=5.0)))
    added = (some - errors(seen(model()))) / UNIT
    struck = np.abs(added[:, 2]) > 1.0
    np.testing.assert_allclose(np.hypot(*added[struck, :2].T), 5.0, rtol=1e-3)
    np.testing.assert_allclose(added[~struck], 0.0, atol=1e-9)


def test_missing_samples_and_heights_are_nan_and_angles_in_range():
    fix = seen(model())
    np.testing.assert_array_equal(np.isnan(fix.position.lat), ~PRESENT)
    np.testing.assert_array_equal(np.isnan(fix.position.lon), ~PRESENT)
    np.testing.assert_array_equal(np.isnan(fix.heading_rad), ~PRESENT)
    assert np.all(np.isnan(fix.position.alt))
    for angle in (fix.position.lon[PRESENT], fix.heading_rad[PRESENT]):
        assert np.all((angle >= -np.pi) & (angle < np.pi))
    west = np.sum(fix.position.lon[: COUNT // 2] < 0.0)
    assert 0.3 < west / np.sum(PRESENT[: COUNT // 2]) < 0.7


def test_what_is_missing_leaves_the_others_as_they_were():
    fix, whole = seen(model()), seen(model(), np.ones(COUNT, bool))
    np.testing.assert_array_equal(fix.position.lat[PRESENT], whole.position.lat[PRESENT])
    np.testing.assert_array_equal(fix.heading_rad[PRESENT], whole.heading_rad[PRESENT])
    short = observe_sar(
        model(), KEY, Geodetic(LAT[:9], LON[:9], ALT[:9]), HEADING[:9], np.ones(9, bool)
    )
    np.testing.assert_allclose(short.position.lat, whole.position.lat[:9], rtol=1e-15)
    exact = seen(SarErrorModel(0.0, 0.0), np.ones(COUNT, bool))
    np.testing.assert_array_equal(exact.position.lat, LAT)
    np.testing.assert_array_equal(exact.position.lon, LON)
    np.testing.assert_array_equal(exact.heading_rad, HEADING)


def test_defaults_are_the_published_ones():
    assert SarErrorModel().sigma_m == 25.0
    assert np.rad2deg(SarErrorModel().heading_sigma_rad) == pytest.approx(1.0)
    assert SarErrorModel().outlier_share == 0.0


def few(**other):
    given = {"model": SarErrorModel(), "position": Geodetic(LAT[:4], LON[:4], ALT[:4])}
    given |= {"heading_rad": HEADING[:4], "present": jnp.ones(4, bool), **other}
    return observe_sar(key=KEY, **given)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"model": SarErrorModel(sigma_m=-1.0)}, "sigma_m must be"),
        ({"model": SarErrorModel(sigma_m=[1.0] * 3)}, r"a number or of shape \(2,\)"),
        ({"model": SarErrorModel(heading_sigma_rad=np.inf)}, "heading_sigma_rad must be"),
        ({"model": SarErrorModel(outlier_share=1.5)}, "outlier_share must be .* from 0 to 1, got"),
        ({"model": SarErrorModel(outlier_factor=-5.0)}, "outlier_factor must be"),
        ({"model": SarErrorModel(outlier_offset=-5.0)}, "outlier_offset must be"),
        ({"heading_rad": HEADING[:3]}, r"heading_rad must have shape \(4,\), got \(3,\)"),
        ({"position": Geodetic(LAT[:4], LON[:4], 0.0)}, r"position.alt must have shape \(4,\)"),
    ],
)
def test_what_cannot_be_is_refused(wrong, message):
    with pytest.raises(ValueError, match=message):
        few(**wrong)
