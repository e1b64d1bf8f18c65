"""A circular orbit against Kepler's laws, and the dipole against its potential and the WMM."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pyproj import Transformer
from scipy.spatial.transform import Rotation

from robins.earth.magnetic import RADIUS_M, MagneticModelError, decimal_year, field_n, wmm
from robins.earth.wgs84 import A_M, GM, OMEGA_E
from robins.sim.orbit import circular_orbit, dipole_field_i, field_along_orbit

DEG = np.pi / 180.0
TIME = np.arange(0.0, 6000.0, 2.0)
ALT, INCL, RAAN, ARG = 500e3, 97.4 * DEG, 0.8, 0.3


@pytest.fixture(scope="module")
def orbit():
    return circular_orbit(ALT, INCL, RAAN, ARG, TIME)


def test_it_falls_round_the_earth(orbit):
    r, v = np.asarray(orbit.r_i_m), np.asarray(orbit.v_i_m_s)
    np.testing.assert_array_equal(orbit.time_s, TIME)
    np.testing.assert_allclose(np.linalg.norm(r, axis=1), A_M + ALT, rtol=1e-15)
    h = TIME[1] - TIME[0]
    np.testing.assert_allclose((r[2:] - r[:-2]) / (2 * h), v[1:-1], rtol=0.0, atol=7600 * 1e-6)
    falls = -GM * r / np.linalg.norm(r, axis=1)[:, None] ** 3
    np.testing.assert_allclose((v[2:] - v[:-2]) / (2 * h), falls[1:-1], rtol=0.0, atol=8.5 * 1e-6)


def test_its_elements_are_those_asked_for(orbit):
    r, v = np.asarray(orbit.r_i_m), np.asarray(orbit.v_i_m_s)
    normal = np.cross(r[0], v[0])
    normal /= np.linalg.norm(normal)
    np.testing.assert_allclose(np.arccos(normal[2]), INCL, rtol=1e-14)
    node = np.cross([0.0, 0.0, 1.0], normal)
    np.testing.assert_allclose(np.arctan2(node[1], node[0]), RAAN, rtol=1e-14)
    along = np.arctan2(r[0] @ np.cross(normal, node), r[0] @ node)
    np.testing.assert_allclose(along, ARG, rtol=1e-14)
    # a day of it: 94.6 minutes a turn
    period = 2.0 * np.pi * np.sqrt((A_M + ALT) ** 3 / GM)
    later = circular_orbit(ALT, INCL, RAAN, ARG, np.array([0.0, period]))
    np.testing.assert_allclose(later.r_i_m[1], later.r_i_m[0], rtol=0.0, atol=1e-5)
    np.testing.assert_allclose(period / 60.0, 94.6, atol=0.05)


def spread(count):
    """Places all over the sphere of the orbit, in Earth-fixed axes."""
    towards = np.random.default_rng(7).normal(size=(count, 3))
    return (A_M + ALT) * towards / np.linalg.norm(towards, axis=1)[:, None]


def test_the_dipole_is_minus_the_gradient_of_its_potential():
    r = spread(20)

    def potential(r):
        g11, h11, g10 = -1410.3e-9, 4545.5e-9, -29350.0e-9
        distance = np.linalg.norm(r, axis=-1)
        lat, lon = np.arcsin(r[..., 2] / distance), np.arctan2(r[..., 1], r[..., 0])
        west_east = g11 * np.cos(lon) + h11 * np.sin(lon)
        return RADIUS_M**3 / distance**2 * (g10 * np.sin(lat) + west_east * np.cos(lat))

    h = 100.0 * np.eye(3)
    slope = np.stack([potential(r + h[k]) - potential(r - h[k]) for k in range(3)], -1) / 200.0
    np.testing.assert_allclose(dipole_field_i(jnp.asarray(r), 0.0), -slope, rtol=0.0, atol=1e-13)


def test_the_dipole_turns_with_the_earth():
    r, angle = spread(5), 0.9
    turn = Rotation.from_euler("z", angle).as_matrix()
    turned = dipole_field_i(jnp.asarray(r @ turn.T), angle)
    still = np.asarray(dipole_field_i(jnp.asarray(r), 0.0))
    np.testing.assert_allclose(turned, still @ turn.T, rtol=0.0, atol=1e-19)
    # one angle for each place too
    each = dipole_field_i(jnp.asarray(r), np.linspace(0.0, 1.0, 5))
    np.testing.assert_allclose(each[0], still[0], rtol=1e-15)


def along_ned(lat, lon):
    """The axes north, east, down in Earth-fixed ones, (K, 3 axes, 3)."""
    s, c, sl, cl, o = np.sin(lat), np.cos(lat), np.sin(lon), np.cos(lon), np.zeros(len(lat))
    axes = [[-s * cl, -s * sl, c], [-sl, cl, o], [-c * cl, -c * sl, -s]]
    return np.stack(axes).transpose(2, 0, 1)


EARTH_ANGLE, YEAR = 1.2, decimal_year(np.datetime64("2026-03-01"))
SOME = slice(3, None, 250)  # places of the orbit that are looked at


@pytest.fixture(scope="module")
def full_field(orbit):
    """The WMM, Earth-fixed axes, at 4000 places all over and at some of the orbit; one program.

    Geodetic coordinates by pyproj.
    """
    angle = EARTH_ANGLE + OMEGA_E * TIME[SOME]
    turn = Rotation.from_rotvec(angle[:, None] * [0.0, 0.0, 1.0])
    r_e = np.concatenate([spread(4000), turn.inv().apply(np.array(orbit.r_i_m[SOME]))])
    lat, lon, alt = Transformer.from_crs(4978, 4979).transform(*r_e.T)
    lat, lon = lat * DEG, lon * DEG
    b_n = np.asarray(field_n(wmm(2025), lat, lon, alt, YEAR))
    return r_e, np.einsum("kia,ki->ka", along_ned(lat, lon), b_n)


def test_the_dipole_is_near_the_world_magnetic_model(full_field):
    """A study of 200 places found 11.1 deg rms, 34.5 at most, sizes by factors of 0.71 to 1.73."""
    r, full = (x[:4000] for x in full_field)
    near = np.asarray(dipole_field_i(jnp.asarray(r), 0.0))
    sizes = np.linalg.norm(near, axis=1), np.linalg.norm(full, axis=1)
    apart = np.arccos(np.sum(near * full, axis=1) / (sizes[0] * sizes[1])) / DEG
    assert 10.5 < np.sqrt(np.mean(apart**2)) < 12.0
    assert 30.0 < np.max(apart) < 45.0
    ratio = sizes[0] / sizes[1]
    assert 0.6 < np.min(ratio) < 0.75
    assert 1.6 < np.max(ratio) < 1.85


def test_the_field_along_an_orbit_is_that_of_its_places(orbit, full_field):
    dipole = field_along_orbit(orbit, earth_angle_rad=EARTH_ANGLE)
    k = 1000
    there = dipole_field_i(orbit.r_i_m[k], EARTH_ANGLE + OMEGA_E * TIME[k])
    np.testing.assert_allclose(dipole[k], there, rtol=1e-14)
    full = np.asarray(field_along_orbit(orbit, "wmm", EARTH_ANGLE, YEAR, knot_s=10.0))
    angle = EARTH_ANGLE + OMEGA_E * TIME[SOME]
    asked = Rotation.from_rotvec(angle[:, None] * [0.0, 0.0, 1.0]).apply(full_field[1][4000:])
    np.testing.assert_allclose(full[SOME], asked, rtol=0.0, atol=15e-9)
    # The two models tell of the same field, in the same axes.
    cosine = np.sum(full * dipole, axis=1)
    cosine /= np.linalg.norm(full, axis=1) * np.linalg.norm(dipole, axis=1)
    assert np.degrees(np.arccos(np.min(cosine))) < 40.0


def test_derivatives_are_finite():
    @jax.jit
    def size(alt):
        orbit = circular_orbit(alt, 0.5, 0.1, 0.2, np.array([0.0, 100.0]))
        return jnp.sum(field_along_orbit(orbit)[1] ** 2)

    slope = (size(ALT + 100.0) - size(ALT - 100.0)) / 200.0
    np.testing.assert_allclose(jax.grad(size)(ALT), slope, rtol=1e-6)


@pytest.mark.parametrize(
    ("place", "value", "words"),
    [
        (0, 500.0, "alt_m .*is it in km"),
        (0, np.nan, "alt_m"),
        (1, 97.4, "incl_rad .is it in degrees"),
        (1, -0.1, "incl_rad"),
        (2, np.inf, "raan_rad must be"),
        (3, np.nan, "arg_lat_rad must be"),
        (4, 0.0, r"time_s must have shape \(E,\)"),
        (4, np.array([0.0, np.nan]), "time_s must be"),
    ],
)
def test_what_is_no_orbit_is_refused(place, value, words):
    given = [ALT, INCL, RAAN, ARG, TIME]
    given[place] = value
    with pytest.raises(ValueError, match=words):
        circular_orbit(*given)


def test_another_model_and_another_date_are_refused(orbit):
    with pytest.raises(ValueError, match="'dipole' and 'wmm', not 'igrf'"):
        field_along_orbit(orbit, "igrf")
    with pytest.raises(MagneticModelError, match="2031"):
        field_along_orbit(orbit, "wmm", decimal_year=2031.0)
    with pytest.raises(MagneticModelError, match="alt_m"):
        field_along_orbit(circular_orbit(900e3, INCL, RAAN, ARG, TIME), "wmm")
