"""The magnetic field: published test values, a textbook sum in NumPy, pygeomag, laws of physics."""

import re
from datetime import UTC, date, datetime
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import factorial, lpmv

from robins.earth import magnetic
from robins.earth.wgs84 import dcm_en, ecef_from_geodetic, geodetic_from_ecef

NT = 1e-9
TABLE = Path(__file__).with_name("wmm_test_values.csv")
PUBLISHED = np.genfromtxt(TABLE, delimiter=",", skip_header=2)
RNG = np.random.default_rng(4)
COUNT = 64  # one shape, one compilation
LAT = RNG.uniform(-1.5, 1.5, COUNT)
LON = RNG.uniform(-np.pi, np.pi, COUNT)
ALT = RNG.uniform(-1e3, 850e3, COUNT)
YEAR = RNG.uniform(2025.0, 2030.0, COUNT)


@pytest.fixture(scope="module")
def model():
    return magnetic.wmm(2025)


@pytest.fixture(scope="module")
def slope(model):
    """Derivative of the field at (lat, lon, alt, year) along one direction of these."""
    at = lambda *place: magnetic.field_n(model, *place)  # noqa: E731
    return jax.jit(lambda place, way: jax.jvp(at, place, way))


def test_the_published_values_of_both_models():
    assert len(PUBLISHED) == 112
    places = np.radians(PUBLISHED[:, 3]), np.radians(PUBLISHED[:, 4]), PUBLISHED[:, 2] * 1e3
    for year in (2020, 2025):
        model, own = magnetic.wmm(year), PUBLISHED[:, 0] == year
        field = np.asarray(magnetic.field_n(model, *places, PUBLISHED[:, 1]))[own] / NT
        later = np.asarray(magnetic.field_n(model, *places, PUBLISHED[:, 1] + 1.0))[own] / NT
        # the tables are rounded to 0.1 nT, so half a digit is all that may be left
        np.testing.assert_allclose(field, PUBLISHED[own, 5:8], rtol=0.0, atol=0.0501)
        np.testing.assert_allclose(later - field, PUBLISHED[own, 8:11], rtol=0.0, atol=0.0501)


def textbook(model, lat, lon, alt, year):
    """Sum over degree and order with SciPy's Legendre functions, in geocentric axes; one place."""
    x, y, z = np.asarray(ecef_from_geodetic(lat, lon, alt))
    r, s = np.sqrt(x * x + y * y + z * z), np.hypot(x, y)
    u = z / r
    years = year - model.epoch
    south = east = up = 0.0
    for n in range(1, len(model.g)):
        for m in range(n + 1):
            scale = np.sqrt((2.0 if m else 1.0) * factorial(n - m) / factorial(n + m)) * (-1) ** m
            p = scale * lpmv(m, n, u)
            # (1 - u^2) dP/du = (n + m) P_(n-1) - n u P_n, times -(1 - u^2)^(-1/2)
            below = scale * lpmv(m, n - 1, u)
            dp = -((n + m) * below - n * u * p) / (s / r)  # by colatitude
            g = model.g[n, m] + years * model.g_rate[n, m]
            h = model.h[n, m] + years * model.h_rate[n, m]
            f = (magnetic.RADIUS_M / r) ** (n + 2)
            wave = g * np.cos(m * lon) + h * np.sin(m * lon)
            up += f * (n + 1) * wave * p
            south -= f * wave * dp
            east += f * m * (g * np.sin(m * lon) - h * np.cos(m * lon)) * p / (s / r)
    turn = lat - np.arcsin(u)  # geodetic minus geocentric latitude
    north = -south * np.cos(turn) - up * np.sin(turn)
    return np.array([north, east, south * np.sin(turn) - up * np.cos(turn)])


def test_a_textbook_sum_in_geocentric_axes_agrees(model):
    got = magnetic.field_n(model, LAT, LON, ALT, YEAR)
    for k in range(COUNT):
        expected = textbook(model, LAT[k], LON[k], ALT[k], YEAR[k])
        np.testing.assert_allclose(got[k], expected, rtol=0.0, atol=1e-6 * NT)


def test_pygeomag_agrees(model):
    geomag = pytest.importorskip("pygeomag", reason="the cross-check needs pygeomag")
    got = np.asarray(magnetic.field_n(model, LAT, LON, ALT, YEAR)) / NT
    peer = geomag.GeoMag(base_year=2025)
    for k in range(COUNT):
        there = peer.calculate(np.degrees(LAT[k]), np.degrees(LON[k]), ALT[k] / 1e3, YEAR[k])
        np.testing.assert_allclose(got[k], [there.x, there.y, there.z], rtol=0.0, atol=1e-3)


def test_the_field_has_neither_sources_nor_curl(model):
    """Central differences in Earth-fixed axes: divergence and rotation vanish outside the core."""
    step = 1e3
    centre = np.asarray(ecef_from_geodetic(LAT[:8], LON[:8], ALT[:8]))
    ways = step * np.concatenate([np.eye(3), -np.eye(3)])
    around = (centre[:, None] + ways).reshape(-1, 3)
    lat, lon, alt = geodetic_from_ecef(around)
    b_n = np.asarray(magnetic.field_n(model, lat, lon, alt, 2026.0))
    b_e = np.einsum("kij,kj->ki", np.asarray(dcm_en(lat, lon)), b_n).reshape(8, 2, 3, 3)
    gradient = (b_e[:, 0] - b_e[:, 1]) / (2.0 * step)  # (place, by, of)
    size = np.abs(gradient).max()
    assert np.abs(np.trace(gradient, axis1=1, axis2=2)).max() < 1e-6 * size
    assert np.abs(gradient - gradient.transpose(0, 2, 1)).max() < 1e-6 * size


@pytest.mark.parametrize("pole", [1.0, -1.0])
def test_the_poles_are_places_like_others(model, slope, pole):
    lat = pole * (np.pi / 2.0 - np.array([0.0, 1e-12, 1e-9, 1e-6]))
    lon = np.linspace(-np.pi, np.pi, 16)
    b_n = np.asarray(magnetic.field_n(model, lat[:, None], lon[None], 0.0, 2026.0))
    turned = np.einsum("lpij,lpj->lpi", np.asarray(dcm_en(lat[:, None], lon[None])), b_n)
    # at the pole one vector whatever the longitude, and the limit of its neighbourhood
    np.testing.assert_allclose(turned[0], np.broadcast_to(turned[0, 0], (16, 3)), atol=1e-9 * NT)
    np.testing.assert_allclose(turned[1], turned[0], rtol=0.0, atol=1e-6 * NT)
    np.testing.assert_allclose(turned[3], turned[0], rtol=0.0, atol=0.2 * NT)
    # at the pole itself a turn of the longitude turns the axes, nothing else
    place = tuple(jnp.asarray(v) for v in (pole * np.pi / 2.0, 0.3, 0.0, 2026.0))
    b, by_lon = slope(place, tuple(jnp.asarray(v) for v in (0.0, 1.0, 0.0, 0.0)))
    turn = np.cross([0.0, 0.0, pole], np.asarray(b))
    np.testing.assert_allclose(by_lon, turn, rtol=0.0, atol=1e-6 * NT)


def test_the_derivatives_are_those_of_the_field(model, slope):
    place = np.array([1.1, -0.6, 2e4, 2027.3])
    ways = np.diag([1e-5, 1e-5, 50.0, 0.5])
    ends = (np.asarray(magnetic.field_n(model, *(place + s * ways).T)) for s in (1, -1))
    expected = (next(ends) - next(ends)) / 2.0
    for way, change in zip(ways, expected, strict=True):
        _, got = slope(tuple(jnp.asarray(place)), tuple(jnp.asarray(way)))
        np.testing.assert_allclose(got, change, rtol=1e-6, atol=1e-6 * np.abs(change).max())


def test_the_elements_of_a_field():
    rows = PUBLISHED[PUBLISHED[:, 0] == 2025]
    got = magnetic.elements(rows[0, 5:8] * NT)
    # first row of the published table: D 1.28, I 83.21 deg, H 6523.2, F 55178.5 nT
    angles = np.degrees([got.declination_rad, got.inclination_rad])
    np.testing.assert_allclose(angles, [1.28, 83.21], atol=5e-3)
    sizes = np.array([got.horizontal_t, got.total_t]) / NT
    np.testing.assert_allclose(sizes, [6523.2, 55178.5], atol=0.1)


def test_batches_broadcast_and_vmap_does_the_same(model):
    grid = magnetic.field_n(model, LAT[:8, None], LON[None, :8], 0.0, 2025.0)
    assert grid.shape == (8, 8, 3)
    alone = jax.vmap(lambda a, b: magnetic.field_n(model, a, b, 0.0, 2025.0))(LAT[:8], LON[:8])
    np.testing.assert_allclose(alone, np.asarray(grid)[np.arange(8), np.arange(8)], rtol=1e-13)


def test_along_a_path_straight_lines_between_knots_err_as_promised(model):
    """A low orbit over the neighbourhood of a pole, 7.7 km/s, with a gap, to every digit."""
    time = np.arange(0.0, 300.0, 0.1)
    time = time[(time < 100.0) | (time > 200.0)]
    along, tilt = 7.7e3 / 6.78e6 * time + 1.4, 1.56
    lat = np.arcsin(np.sin(along) * np.sin(tilt))
    lon = np.arctan2(np.sin(along) * np.cos(tilt), np.cos(along))
    path = lat, lon, np.full_like(time, 4e5), 2026.5
    whole = magnetic.field_along(model, *path)
    for knot_s, least, most in ((1.0, 0.02, 0.2), (10.0, 2.0, 15.0)):
        joined = magnetic.field_along(model, *path, time, knot_s)
        assert least < np.linalg.norm(joined - whole, axis=1).max() / NT < most
    at_every = magnetic.field_along(model, *path, time, 0.01)
    np.testing.assert_allclose(at_every, whole, rtol=0.0, atol=1e-6 * NT)


BAD = {
    "alt_m[1] = 900000": {"alt_m": [0.0, 9e5]},
    "alt_m = -2000": {"alt_m": -2e3},
    "decimal_year = 2024.9 is not from 2025 to 2030": {"decimal_year": 2024.9},
    "lat_rad = 45": {"lat_rad": 45.0},
    "lon_rad = nan": {"lon_rad": np.nan},
    "time_s must hold": {"lat_rad": [0.0, 0.1], "time_s": [1.0, 1.0]},
    "knot_s must be": {"lat_rad": [0.0, 0.1], "time_s": [0.0, 1.0], "knot_s": 0.0},
}


@pytest.mark.parametrize("says", BAD)
def test_what_a_model_does_not_cover_is_refused(model, says):
    given = {"lat_rad": 0.0, "lon_rad": 0.0, "alt_m": 0.0, "decimal_year": 2026.0} | BAD[says]
    with pytest.raises(ValueError, match=re.escape(says)):
        magnetic.field_along(model, **given)


def test_the_model_of_a_date():
    assert magnetic.wmm_for(2024.99).name == "WMM-2020"
    assert magnetic.wmm_for(2025.0).name == "WMM-2025"
    for year in (2019.9, 2030.1, np.nan):
        with pytest.raises(magnetic.MagneticModelError, match="hold from 2020 to 2030"):
            magnetic.wmm_for(year)
    with pytest.raises(magnetic.MagneticModelError, match="there is no WMM of 2021"):
        magnetic.wmm(2021)


def test_decimal_years():
    assert magnetic.decimal_year(date(2026, 1, 1)) == 2026.0
    assert magnetic.decimal_year(datetime(2024, 7, 2, tzinfo=UTC)) == 2024.5  # a leap year
    moment = np.datetime64("2025-04-01T06:00:00")
    expected = 2025.0 + 90.25 / 365.0
    assert magnetic.decimal_year(moment) == pytest.approx(expected, abs=1e-12)
    unix_ns = int(moment.astype("datetime64[ns]").astype(np.int64))
    assert magnetic.decimal_year(unix_ns) == pytest.approx(expected, abs=1e-12)


HEAD = "2025.0 TINY 1/1/2025\n"
BROKEN = {
    "line 1: a coefficient file begins": "WMM 2025\n",
    "line 2: expected degree, order": HEAD + "1 0 1.0 x 0 0\n",
    "line 3: expected degree, order": HEAD + "1 0 1.0 0 0 0\n1 2 1.0 0 0 0\n",
    "[(1, 1)] are missing": HEAD + "1 0 1.0 0 0 0\n",
    "are missing; the file is not whole": HEAD,
}


@pytest.mark.parametrize("says", BROKEN)
def test_a_file_that_is_not_whole_is_refused(tmp_path, says):
    path = tmp_path / "bad.cof"
    path.write_text(BROKEN[says])
    with pytest.raises(magnetic.MagneticModelError, match=re.escape(says)):
        magnetic.read_cof(path)


def test_a_dipole_read_from_a_file_is_a_dipole(tmp_path):
    path = tmp_path / "dipole.cof"
    path.write_text(HEAD + "1 0 -30000 0 0 0\n1 1 0 0 0 0\n9999\n")
    model = magnetic.read_cof(path)
    r_e = np.asarray(ecef_from_geodetic(LAT, LON, ALT))
    r = np.linalg.norm(r_e, axis=1, keepdims=True)
    axis = np.array([0.0, 0.0, -30000 * NT])
    along = (r_e @ axis)[:, None] / r
    b_e = (magnetic.RADIUS_M / r) ** 3 * (3.0 * along * r_e / r - axis)
    expected = np.einsum("kij,ki->kj", np.asarray(dcm_en(LAT, LON)), b_e)
    got = magnetic.field_along(model, LAT, LON, ALT, 2025.0)
    np.testing.assert_allclose(got, expected, rtol=0.0, atol=1e-6 * NT)
