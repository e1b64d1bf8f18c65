"""The WGS-84 Earth against pyproj, extended precision, and the laws its fields obey."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pyproj
import pytest

from robins.earth import Geodetic, wgs84

# One unit in the last place of an Earth-fixed coordinate is 0.93e-9 m. Sines, products and a
# square root cost a few of these: so the error is below 1e-9 m root mean square, and its worst case
# is held to four units. PROJ has as many of its own.
RMS_M = 1e-9
WORST_M = 4 * np.spacing(wgs84.A_M)
ORACLES = {"exact": WORST_M, "proj": 2 * WORST_M}

# Rounding is judged in the code that users run, which the other tests do without.
AS_USERS = {"xla_backend_optimization_level": 3, "xla_cpu_use_fusion_emitters": True}
compiled = partial(jax.jit, compiler_options=AS_USERS)
to_ecef = compiled(wgs84.ecef_from_geodetic)
to_geodetic = compiled(wgs84.geodetic_from_ecef)
gravity_n = jax.jit(wgs84.gravity_n)
proj = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)


def places():
    """Grid with poles, equator and both ends of the longitudes, and random places: rad, rad, m."""
    grid = np.meshgrid(
        np.deg2rad([-90, -89.9999, -75, -45, -30, -1e-7, 0, 15, 60, 89.9, 89.9999999, 90]),
        np.deg2rad(np.arange(-180.0, 181.0, 30.0)),
        [-500.0, 0.0, 1e3, 3e4, 5e5],
    )
    rng = np.random.default_rng(0)
    n = 20_000
    lat, lon = np.arcsin(rng.uniform(-1, 1, n)), rng.uniform(-np.pi, np.pi, n)
    random = (lat, lon, rng.uniform(-500, 5e5, n))
    return [np.concatenate([g.ravel(), r]) for g, r in zip(grid, random, strict=True)]


LAT, LON, ALT = places()


def exact_ecef(lat, lon, alt):
    """The same in extended precision, 1e-13 m."""
    lat, lon, alt = (np.asarray(a, np.longdouble) for a in (lat, lon, alt))
    f = 1 / np.longdouble("298.257223563")
    e2 = f * (2 - f)
    radius = np.longdouble(6378137) / np.sqrt(1 - e2 * np.sin(lat) ** 2)
    across = (radius + alt) * np.cos(lat)
    up = ((1 - e2) * radius + alt) * np.sin(lat)
    return np.stack([across * np.cos(lon), across * np.sin(lon), up], -1)


def assert_at(r, lat, lon, alt):
    """Earth-fixed coordinates are those of PROJ and of extended precision."""
    for name, expected in (
        ("proj", np.stack(proj.transform(lon, lat, alt, radians=True), -1)),
        ("exact", exact_ecef(lat, lon, alt)),
    ):
        error = np.abs(r - expected).astype(float)
        assert np.sqrt(np.mean(np.square(error))) < RMS_M, name
        assert error.max() <= ORACLES[name], name


def test_ecef_is_that_of_proj_and_of_extended_precision():
    assert_at(np.asarray(to_ecef(LAT, LON, ALT)), LAT, LON, ALT)


def test_geodetic_coordinates_lead_back_to_the_place():
    # Through PROJ's forward conversion and through extended precision. PROJ's own inverse is one
    # step of Bowring, 3 mm off at 500 km, so it is no measure here.
    r = np.asarray(to_ecef(LAT, LON, ALT))
    lat, lon, alt = (np.asarray(a) for a in to_geodetic(r))
    assert_at(r, lat, lon, alt)
    np.testing.assert_allclose(alt, ALT, atol=WORST_M, rtol=0)
    # Latitude is known to the rounding of r and of itself, which is coarser above 1 rad.
    np.testing.assert_allclose(lat, LAT, atol=WORST_M / wgs84.A_M, rtol=0)


def test_poles_and_axes_come_out_whole():
    b, a = wgs84.B_M, wgs84.A_M
    r = np.array([[0, 0, b + 10], [0, 0, -b - 10], [a + 10, 0, 0], [0, a, 0], [-a, 0, 0]])
    lat, lon, alt = to_geodetic(r)
    np.testing.assert_array_equal(lat, [np.pi / 2, -np.pi / 2, 0, 0, 0])
    np.testing.assert_array_equal(lon, [0, 0, 0, np.pi / 2, np.pi])
    np.testing.assert_allclose(alt, [10, 10, 10, 0, 0], atol=WORST_M, rtol=0)


def test_two_steps_suffice_from_deep_below_to_high_orbits():
    for alt in (-1e6, 2e6, 2e7, 3.6e7):
        r = exact_ecef(LAT, LON, np.full_like(LAT, alt)).astype(float)
        lat, lon, height = (np.asarray(a) for a in to_geodetic(r))
        error = np.abs(exact_ecef(lat, lon, height) - r).astype(float)
        assert error.max() <= 4 * np.spacing(wgs84.A_M + max(alt, 0.0)), alt


@pytest.mark.parametrize(
    "r_e", [np.zeros(3), np.array([[7e6, 0.0, 0.0], [6378.0, 0.0, 0.0]]), np.array([0.0, 0.0, 5e6])]
)
def test_a_place_deep_in_the_earth_has_no_geodetic_coordinates(r_e):
    with pytest.raises(ValueError, match="m from the centre of the Earth"):
        wgs84.geodetic_from_ecef(r_e)
    with pytest.raises(ValueError, match="give metres, 5"):
        Geodetic.from_ecef(jnp.asarray(r_e))


def test_gradient_of_geodetic_coordinates_is_the_inverse_of_the_other():
    p = np.array([0.7, -2.0, 250.0])
    forward = jax.jit(jax.jacfwd(lambda p: wgs84.ecef_from_geodetic(*p)))(p)
    back = jax.jit(jax.jacrev(lambda r: jnp.stack(wgs84.geodetic_from_ecef(r))))
    product = np.asarray(back(to_ecef(*p)) @ forward)
    scale = np.array([6.4e6, 6.4e6, 1.0])  # compare metres with metres
    np.testing.assert_allclose(product * scale[:, None] / scale, np.eye(3), atol=1e-12)
    near_axis = back(jnp.array([1.0, 0.0, 6.4e6]))
    assert np.all(np.isfinite(near_axis))


def test_directions_of_the_local_frame_are_those_of_growing_coordinates():
    lat, lon, alt = np.array([-1.2, 0.0, 0.8]), np.array([3.0, -1.0, 0.1]), np.full(3, 100.0)
    point = jax.vmap(jax.jacfwd(lambda p: wgs84.ecef_from_geodetic(p[0], p[1], p[2])))
    slope = np.asarray(jax.jit(point)(np.stack([lat, lon, alt], -1)))
    C_en = np.asarray(wgs84.dcm_en(lat, lon))
    meridian, transverse = wgs84.curvature_radii(lat)
    radii = np.stack([meridian + 100.0, (transverse + 100.0) * np.cos(lat)], -1)
    np.testing.assert_allclose(slope[..., :2], C_en[..., :2] * radii[:, None], atol=1e-8)
    np.testing.assert_allclose(slope[..., 2], -C_en[..., 2], atol=1e-15)


def test_curvature_radii_at_the_equator_and_the_poles():
    a, b = wgs84.A_M, wgs84.B_M
    meridian, transverse = wgs84.curvature_radii(np.array([0.0, np.pi / 2, -np.pi / 2]))
    np.testing.assert_allclose(meridian, [b * b / a, a * a / b, a * a / b], rtol=4e-16)
    np.testing.assert_allclose(transverse, [a, a * a / b, a * a / b], rtol=4e-16)


# ------------------------------------------------------------------------------------------ gravity


def potential(p, z):
    """Normal potential at distance p from the axis, z from the equator (Heiskanen & Moritz 2-62).

    Works on complex numbers, whose imaginary part then carries the derivative.
    """
    focal_sq = wgs84.A_M**2 - wgs84.B_M**2
    focal = np.sqrt(focal_sq)
    rest = p * p + z * z - focal_sq
    u = np.sqrt(0.5 * rest * (1 + np.sqrt(1 + 4 * focal_sq * z * z / rest**2)))

    def q(u):
        return 0.5 * ((1 + 3 * u * u / focal_sq) * np.arctan(focal / u) - 3 * u / focal)

    spin_sq = wgs84.OMEGA_E**2
    flattened = 0.5 * spin_sq * wgs84.A_M**2 * q(u) / q(wgs84.B_M) * (z * z / u**2 - 1 / 3)
    return wgs84.GM / focal * np.arctan(focal / u) + flattened + 0.5 * spin_sq * p * p


@pytest.mark.parametrize("alt", [-500.0, 0.0, 1e4, 3e4, 1e5, 5e5, 2e7])
def test_gravity_is_the_slope_of_the_normal_potential(alt):
    lat = np.deg2rad(np.linspace(-90, 90, 73))
    r = np.asarray(to_ecef(lat, np.zeros(73), np.full(73, alt)))
    p, z = r[:, 0].astype(complex), r[:, 2].astype(complex)
    tiny = 1e-20  # no difference is taken, so no digits are lost
    outward = potential(p + 1j * tiny, z).imag / tiny
    northward = potential(p, z + 1j * tiny).imag / tiny
    north = northward * np.cos(lat) - outward * np.sin(lat)
    down = -northward * np.sin(lat) - outward * np.cos(lat)
    expected = np.stack([north, np.zeros(73), down], -1)
    by_numpy = wgs84.gravity_n(lat, np.full(73, alt))
    assert type(by_numpy) is np.ndarray
    for found in (gravity_n(lat, np.full(73, alt)), by_numpy):
        np.testing.assert_allclose(found, expected, atol=1e-11, rtol=0)
    size = np.linalg.norm(expected, axis=-1)
    np.testing.assert_allclose(wgs84.gravity(lat, alt), size, atol=1e-11, rtol=0)


def test_gravity_on_the_ellipsoid_is_the_formula_of_somigliana():
    lat = np.deg2rad(np.linspace(-90, 90, 37))
    s2 = np.sin(lat) ** 2
    # NIMA TR8350.2, table 3.4: as published, to the last digit.
    gamma_e, k, e2 = 9.7803253359, 0.00193185265241, 0.00669437999014
    expected = gamma_e * (1 + k * s2) / np.sqrt(1 - e2 * s2)
    np.testing.assert_allclose(wgs84.gravity(lat, 0.0), expected, atol=1e-10, rtol=0)
    assert round(float(wgs84.gravity(0.0, 0.0)), 10) == 9.7803253359
    # published 9.8321849378, cut off
    assert round(float(wgs84.gravity(np.pi / 2, 0.0)), 10) == 9.8321849379
    np.testing.assert_allclose(wgs84.gravity(np.pi / 4, 0.0), 9.8061977694, atol=5e-11, rtol=0)


def test_gravity_near_the_ground_is_the_series_in_height():
    # Heiskanen & Moritz 2-124, second order; its rest is 4 (h/a)^3 and f^2 h/a.
    lat, alt = np.deg2rad([0.0, 30.0, 45.0, 90.0]), 1e4
    m = wgs84.OMEGA_E**2 * wgs84.A_M**2 * wgs84.B_M / wgs84.GM
    slope = 1 + wgs84.F + m - 2 * wgs84.F * np.sin(lat) ** 2
    series = 1 - 2 * slope * alt / wgs84.A_M + 3 * (alt / wgs84.A_M) ** 2
    expected = np.asarray(wgs84.gravity(lat, 0.0)) * series
    np.testing.assert_allclose(wgs84.gravity(lat, alt), expected, atol=1e-6, rtol=0)


def test_field_of_gravity_has_no_curl_and_the_divergence_of_the_rotation():
    def field(r_e):
        lat, lon, alt = wgs84.geodetic_from_ecef(r_e)
        return wgs84.dcm_en(lat, lon) @ wgs84.gravity_n(lat, alt)

    lat = np.deg2rad([-70.0, 5.0, 45.0, 80.0])
    r = to_ecef(lat, np.array([0.3, -2.0, 3.0, 1.0]), np.array([-500.0, 0.0, 3e4, 5e5]))
    slope = np.asarray(jax.jit(jax.vmap(jax.jacfwd(field)))(r))
    np.testing.assert_allclose(slope, np.swapaxes(slope, -1, -2), atol=1e-20)
    # Outside the masses only the centrifugal part has a divergence.
    divergence = np.trace(slope, axis1=-2, axis2=-1)
    np.testing.assert_allclose(divergence, 2 * wgs84.OMEGA_E**2, rtol=1e-10)


def test_plumb_line_is_curved_northward_by_the_known_rate():
    north = np.asarray(gravity_n(np.pi / 4, 1e3))[0] / 1e3
    # d(gamma)/d(lat) over the radius: difference of gravity between pole and equator, 5.2e-2.
    equator, pole = (float(wgs84.gravity(lat, 0.0)) for lat in (0.0, np.pi / 2))
    expected = -(pole - equator) / 6.37e6
    np.testing.assert_allclose(north, expected, rtol=0.01)


# -------------------------------------------------------------------------------------------- rates


def test_earth_rate_is_the_axis_seen_in_the_local_frame():
    lat, lon = np.array([-1.5, 0.0, 0.7]), np.array([1.0, 2.0, -3.0])
    axis = np.array([0.0, 0.0, 7.292115e-5])
    expected = np.einsum("nij,i->nj", wgs84.dcm_en(lat, lon), axis)
    np.testing.assert_allclose(wgs84.earth_rate_n(lat), expected, atol=1e-20)


@pytest.mark.parametrize("lat", [-1.4, 0.0, 0.6])
def test_transport_rate_turns_the_local_frame(lat):
    v_n, alt = np.array([120.0, -80.0, 5.0]), 2000.0
    meridian, transverse = (float(r) + alt for r in wgs84.curvature_radii(lat))

    def frame(t):
        d_lat, d_lon = v_n[0] / meridian * t, v_n[1] / (transverse * np.cos(lat)) * t
        return np.asarray(wgs84.dcm_en(lat + d_lat, 0.3 + d_lon))

    rate = frame(0.0).T @ (frame(1.0) - frame(-1.0)) / 2.0  # C_ne dC_en/dt = omega_en_n x
    omega = np.asarray(wgs84.transport_rate_n(lat, alt, v_n))
    x, y, z = omega
    np.testing.assert_allclose(rate, [[0, -z, y], [z, 0, -x], [-y, x, 0]], atol=2e-13)
    assert np.linalg.norm(omega) > 1e-5


def test_everything_broadcasts_over_leading_axes():
    lat = np.linspace(-1, 1, 6).reshape(2, 3)
    assert wgs84.ecef_from_geodetic(lat, 0.5, 10).shape == (2, 3, 3)
    assert wgs84.dcm_en(lat, 0.5).shape == (2, 3, 3, 3)
    assert wgs84.gravity(lat, 0).shape == (2, 3)
    assert wgs84.gravity_n(0.3, lat).shape == (2, 3, 3)
    assert wgs84.earth_rate_n(lat).shape == (2, 3, 3)
    one_speed = wgs84.transport_rate_n(lat, np.zeros(()), np.array([10.0, 20.0, 0.0]))
    many = wgs84.transport_rate_n(lat, np.zeros((2, 3)), np.full((2, 3, 3), [10.0, 20.0, 0.0]))
    np.testing.assert_array_equal(one_speed, many)
