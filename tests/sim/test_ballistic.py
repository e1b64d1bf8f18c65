"""Free flight against an integration of its equation of motion, closed forms and PROJ."""

import jax
import jax.numpy as jnp
import numpy as np
import pyproj
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from robins.sim.ballistic import ballistic

GM = 3.986004418e14
SPIN = 7.292115e-5
DEG = np.pi / 180.0

# lat, lon, alt, speed, elevation, azimuth; the first is the sounding rocket of the specification
ROCKET = (40 * DEG, 10 * DEG, 0.0, 3050.0, 60 * DEG, 20 * DEG)
LAUNCHES = {
    "rocket": (ROCKET, 600.0),
    "straight up": ((-33 * DEG, 151 * DEG, 500.0, 2000.0, 90 * DEG, 0.0), 400.0),
    "across the date line": ((10 * DEG, 179 * DEG, 0.0, 3050.0, 50 * DEG, 85 * DEG), 500.0),
    "far": ((62 * DEG, -20 * DEG, 120e3, 7400.0, 8 * DEG, -100 * DEG), 900.0),
    "nearly for ever": ((5 * DEG, 40 * DEG, 0.0, 11000.0, 70 * DEG, 10 * DEG), 80000.0),
}


@jax.jit
def fly(launch, time):
    return ballistic(*launch, time)


def east_north_up(lat, lon):
    """Rows: unit vectors in Earth-fixed axes."""
    up = np.array([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])
    east = np.array([-np.sin(lon), np.cos(lon), 0.0])
    return np.stack([east, np.cross(up, east), up])


def north_east_down(lat, lon):
    """Columns: unit vectors in Earth-fixed axes."""
    east, north, up = east_north_up(lat, lon)
    return np.stack([north, east, -up], 1)


def start_of(launch):
    lat, lon, alt, speed, elevation, azimuth = launch
    to_ecef = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
    r = np.array(to_ecef.transform(lon / DEG, lat / DEG, alt))
    east, north, up = east_north_up(lat, lon)
    level = np.sin(azimuth) * east + np.cos(azimuth) * north
    return r, speed * (np.cos(elevation) * level + np.sin(elevation) * up)


@pytest.fixture(scope="module", params=LAUNCHES, name="flight")
def of_launch(request):
    launch, end = LAUNCHES[request.param]
    return launch, fly(launch, np.linspace(0.0, end, 201))


def test_it_is_the_solution_of_the_equation_of_motion(flight):
    launch, path = flight
    r, v = start_of(launch)
    solved = solve_ivp(
        lambda _, y: np.concatenate([y[3:], -GM * y[:3] / np.linalg.norm(y[:3]) ** 3]),
        (0.0, float(path.time_s[-1])),
        np.concatenate([r, v]),
        "DOP853",
        np.asarray(path.time_s),
        rtol=3e-14,
        atol=1e-9,
    )
    # The integration itself is good to 1e-12 of the distance flown.
    way = float(np.linalg.norm(solved.y[:3, -1]) + np.linalg.norm(r))
    np.testing.assert_allclose(path.r_i_m, solved.y[:3].T, rtol=0.0, atol=1e-11 * way)
    np.testing.assert_allclose(path.v_i_m_s, solved.y[3:].T, rtol=0.0, atol=1e-8)


def test_energy_and_angular_momentum_are_kept(flight):
    launch, path = flight
    r, v = start_of(launch)
    radius = np.linalg.norm(path.r_i_m, axis=1)
    axis = 1.0 / (2.0 / np.linalg.norm(r) - v @ v / GM)
    vis_viva = GM * (2.0 / radius - 1.0 / axis)
    np.testing.assert_allclose(np.sum(path.v_i_m_s**2, 1), vis_viva, rtol=1e-12, atol=1e-6)
    momentum = np.cross(path.r_i_m, path.v_i_m_s)
    size = float(np.linalg.norm(r) * np.linalg.norm(v))
    np.testing.assert_allclose(momentum, np.tile(np.cross(r, v), (201, 1)), atol=2e-13 * size)


def test_the_top_of_the_flight_is_where_the_orbit_has_its_apogee():
    r, v = start_of(ROCKET)
    radius = np.linalg.norm(r)
    a = 1.0 / (2.0 / radius - v @ v / GM)
    e = np.linalg.norm(np.cross(v, np.cross(r, v)) / GM - r / radius)
    # Kepler's equation from the perigee: the apogee half a period after it.
    anomaly = np.arccos((1.0 - radius / a) / e)
    rest = np.sqrt(a**3 / GM) * (np.pi - (anomaly - e * np.sin(anomaly)))
    path = ballistic(*ROCKET, [0.0, rest, 2.0 * rest])
    np.testing.assert_allclose(np.linalg.norm(path.r_i_m[1]), a * (1.0 + e), rtol=1e-14)
    assert abs(path.r_i_m[1] @ path.v_i_m_s[1]) < 1e-3 * radius
    np.testing.assert_allclose(np.linalg.norm(path.r_i_m[2]), radius, rtol=1e-13)
    assert 390e3 < path.alt_m[1] < 392e3
    with pytest.raises(ValueError, match=r"after 602\.77\d* s"):
        ballistic(*ROCKET, [0.0, 2.0 * rest + 1e-3])


def test_latitude_longitude_and_height_are_those_of_proj(flight):
    _, path = flight
    turn = Rotation.from_rotvec(np.outer(np.asarray(path.time_s), [0.0, 0.0, SPIN]))
    r_e = turn.inv().apply(np.array(path.r_i_m))
    # The way to Earth-fixed axes is exact in PROJ, the way back is not.
    to_ecef = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
    place = np.rad2deg(path.lon_rad), np.rad2deg(path.lat_rad), np.asarray(path.alt_m)
    far = float(np.abs(r_e).max())
    np.testing.assert_allclose(np.stack(to_ecef.transform(*place), 1), r_e, atol=2e-15 * far)


def test_local_axes_are_seen_from_the_launch(flight):
    (lat, lon, *_), path = flight
    to_launch = Rotation.from_quat(np.asarray(path.q_local), scalar_first=True).as_matrix()
    np.testing.assert_allclose(to_launch[0], np.eye(3), atol=1e-15)
    for k in (1, 77, 200):
        turn = Rotation.from_euler("z", SPIN * float(path.time_s[k])).as_matrix()
        here = turn @ north_east_down(float(path.lat_rad[k]), float(path.lon_rad[k]))
        np.testing.assert_allclose(to_launch[k], north_east_down(lat, lon).T @ here, atol=1e-14)


def test_derivatives_are_finite_and_right_from_the_first_instant():
    time = np.array([0.0, 1e-3, 100.0, 590.0])

    @jax.jit
    def place(launch):
        path = fly(launch, time)
        return jnp.concatenate([path.r_i_m, path.q_local], 1)

    launch = jnp.array(ROCKET)
    jacobian = np.asarray(jax.jit(jax.jacfwd(place))(launch))
    for j, h in enumerate([1e-4, 1e-4, 10.0, 0.1, 1e-4, 1e-4]):
        ahead, behind = (np.asarray(place(launch.at[j].add(s * h))) for s in (1.0, -1.0))
        slope = (ahead - behind) / (2.0 * h)
        scale = np.abs(slope).max(0) + 1e-6
        np.testing.assert_allclose(jacobian[..., j] / scale, slope / scale, atol=1e-5)


def test_launches_map():
    time = np.array([0.0, 200.0])
    launches = np.array([ROCKET, LAUNCHES["across the date line"][0]])
    many = jax.vmap(fly, (0, None))(launches, time)
    for k, launch in enumerate(launches):
        one = fly(launch, time)
        np.testing.assert_allclose(many.r_i_m[k], one.r_i_m, rtol=1e-14)
        np.testing.assert_allclose(many.q_local[k], one.q_local, atol=1e-14)


@pytest.mark.parametrize(
    ("place", "value", "words"),
    [
        (0, 40.0, "lat_rad must be"),
        (1, np.nan, "lon_rad must be"),
        (2, -np.inf, "alt_m must be"),
        (3, 0.0, "speed_m_s must be"),
        (3, 11300.0, "does not come back"),
        (4, 0.0, "elevation_rad must be"),
        (4, 1.6, "elevation_rad must be"),
        (5, np.inf, "azimuth_rad must be"),
        (6, [0.0, -0.1], "time_s must be"),
        (6, [0.0, np.nan], "time_s must be"),
        (6, 3.0, "time_s must have shape"),
        (6, [], "time_s must have shape"),
        (6, [0.0, 900.0], "back at the radius of its launch"),
    ],
)
def test_what_cannot_fly_is_refused(place, value, words):
    given: list = [*ROCKET, [0.0, 1.0]]
    given[place] = value
    with pytest.raises(ValueError, match=words):
        ballistic(*given)
