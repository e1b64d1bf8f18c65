"""Motions: derivatives that belong to the path, and paths that do as they were told."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation as SciRotation

from robins.earth import OMEGA_E, Geodetic, dcm_en, ecef_from_geodetic, gravity_n
from robins.rotation import to_euler
from robins.sim import commands as do
from robins.sim.commands import from_commands
from robins.sim.trajectory import MotionProfile, from_waypoints, sine_velocity

START = Geodetic.from_degrees(55.0, 37.0, 150.0)
SPIN = np.array([0.0, 0.0, OMEGA_E])


@pytest.fixture(scope="module")
def drive() -> MotionProfile:
    manoeuvres = [
        do.stand(5.0),
        do.accelerate(15.0, 8.0),
        do.turn(np.pi / 2.0, 0.3),
        do.climb(20.0, 15.0),
        do.weave(0.2, 5.0, 15.0),
        do.porpoise(2.0, 6.0, 12.0),
        do.turn(-np.pi, 0.4, ease_s=2.0),
        do.straight(4.0),
        do.stop(6.0),
        do.stand(5.0),
    ]
    return from_commands(START, manoeuvres, heading_rad=1.0, vehicle="aircraft")


@pytest.fixture(scope="module")
def waypoints() -> MotionProfile:
    """Westward over the 180 deg meridian."""
    t = np.arange(12) * 10.0
    lat = np.deg2rad(-17.0) + 1e-4 * np.sin(0.05 * t)
    lon = np.deg2rad(-179.99) - 5e-6 * t
    return from_waypoints(t, lat, (lon + np.pi) % (2 * np.pi) - np.pi, 300.0 + 0.2 * t)


@pytest.fixture(scope="module")
def sine() -> MotionProfile:
    return sine_velocity(START, duration_s=120.0)


@pytest.fixture(params=["drive", "waypoints", "sine"])
def motion(request) -> MotionProfile:
    return request.getfixturevalue(request.param)


def earth_fixed(motion, t):
    k = motion.at(t)
    r = np.asarray(ecef_from_geodetic(k.lat, k.lon, k.alt))
    C_en = np.asarray(dcm_en(k.lat, k.lon))
    C_nb = SciRotation.from_quat(k.q_nb, scalar_first=True).as_matrix()
    return k, r, C_en, C_en @ C_nb


def test_rates_are_those_of_the_path_in_the_earth_frame(motion):
    """Velocity, specific force and rate by differences in ECEF, of fourth order."""
    h = 0.005
    middle = np.linspace(0.1, motion.duration_s - 0.1, 200)
    shifts = np.arange(-2, 3)
    samples = [earth_fixed(motion, middle + s * h) for s in shifts]

    def slope(values):
        return np.einsum("s,s...->...", [1, -8, 0, 8, -1], values) / (12.0 * h)

    k, _, C_en, C_eb = samples[2]
    velocity = np.einsum("nij,nj->ni", C_en, k.v_n)
    # the position is rounded to 1e-9 m
    np.testing.assert_allclose(slope([r for _, r, _, _ in samples]), velocity, atol=5e-7)
    acceleration = slope([np.einsum("nij,nj->ni", C, k.v_n) for k, _, C, _ in samples])

    omega_ib, f_b = k.rates()
    g_e = np.einsum("nij,nj->ni", C_en, np.asarray(gravity_n(k.lat, k.alt)))
    # gravity holds the centrifugal part already
    f_e = acceleration + 2.0 * np.cross(SPIN, velocity) - g_e
    np.testing.assert_allclose(np.einsum("nij,nj->ni", C_eb, f_b), f_e, atol=2e-6)

    turn = [SciRotation.from_matrix(np.swapaxes(C_eb, 1, 2) @ s[3]).as_rotvec() for s in samples]
    omega_ie = np.einsum("nji,j->ni", C_eb, SPIN)
    np.testing.assert_allclose(omega_ib, slope(turn) + omega_ie, atol=2e-6)


def test_derivative_of_the_velocity_components(motion):
    h, t = 0.01, np.linspace(0.1, motion.duration_s - 0.1, 200)
    v = [motion.at(t + s * h).v_n for s in (-2, -1, 1, 2)]
    slope = (v[0] - 8.0 * v[1] + 8.0 * v[2] - v[3]) / (12.0 * h)
    np.testing.assert_allclose(motion.at(t).a_n, slope, atol=2e-5)


def test_what_an_imu_feels_runs_without_steps(motion):
    """The largest change between samples halves with the sampling interval."""
    jumps = []
    for n in (20_000, 40_000):
        t = np.linspace(0.0, motion.duration_s, n + 1)
        jumps.append([np.abs(np.diff(a, axis=0)).max() for a in motion.at(t).rates()])
    np.testing.assert_allclose(np.array(jumps[0]) / jumps[1], 2.0, rtol=0.05)


def test_commands_are_carried_out(drive):
    total = 5 + 8 + (np.pi / 2 / 0.3 + 1) + 15 + 15 + 12 + (np.pi / 0.4 + 2) + 4 + 6 + 5
    assert drive.duration_s == pytest.approx(total, rel=1e-12)
    still = drive.at(np.linspace(0.0, 5.0, 50))
    assert np.abs(still.v_n).max() < 1e-6
    end = drive.at(np.array([drive.duration_s]))
    assert np.abs(end.v_n).max() < 1e-6
    assert end.alt[0] - 150.0 == pytest.approx(20.0, abs=1e-6)
    _, _, heading = (np.rad2deg(np.asarray(a)) for a in to_euler(jnp.asarray(end.q_nb)))
    assert heading[0] == pytest.approx(np.rad2deg(1.0) + 90.0 - 180.0, abs=1e-4)
    # half-way through the first turn, past the ease, the heading runs at the rate asked for
    k = drive.at(np.array([13.0 + 0.5 * (np.pi / 2 / 0.3 + 1)]))
    (north, east, _), (a_north, a_east, _) = k.v_n[0], k.a_n[0]
    assert np.hypot(north, east) == pytest.approx(15.0, abs=1e-6)
    assert (north * a_east - east * a_north) / 15.0**2 == pytest.approx(0.3, abs=1e-4)


def test_an_aircraft_banks_into_its_turns_and_a_car_does_not(drive):
    t = np.linspace(0.0, drive.duration_s, 4001)
    k = drive.at(t)
    _, f_b = k.rates()
    assert np.abs(f_b[:, 1]).max() < 1e-3  # no force to the side
    roll = np.asarray(to_euler(jnp.asarray(k.q_nb))[0])
    right = roll[(t > 15.0) & (t < 18.0)]
    # tan(bank) = v omega / g
    np.testing.assert_allclose(right, np.arctan(15.0 * 0.3 / 9.81), atol=2e-3)
    car = from_commands(START, [do.turn(1.0, 0.3)], speed_mps=10.0)
    q = car.at(np.linspace(0.0, car.duration_s, 100)).q_nb
    assert np.abs(np.asarray(to_euler(jnp.asarray(q))[0])).max() < 1e-9


def test_waypoints_are_met_across_the_date_line(waypoints):
    t = np.arange(12) * 10.0
    table = waypoints.trajectory(np.round(t * 1e9).astype(np.int64))
    lat = np.deg2rad(-17.0) + 1e-4 * np.sin(0.05 * t)
    np.testing.assert_allclose(table.lat_rad, lat, rtol=1e-12)
    moved = (table.lon_rad - np.deg2rad(-179.99) + 5e-6 * t + np.pi) % (2 * np.pi) - np.pi
    np.testing.assert_allclose(moved, 0.0, atol=1e-12)
    assert table.lon_rad.max() > 3.0
    assert table.lon_rad.min() < -3.0
    np.testing.assert_allclose(table.alt_m, 300.0 + 0.2 * t, rtol=1e-12)
    np.testing.assert_allclose(table.v_n[:, 2], -0.2, atol=1e-9)
    # forward axis along the velocity
    forward = SciRotation.from_quat(table.q_nb, scalar_first=True).apply([1.0, 0.0, 0.0])
    course = table.v_n / np.linalg.norm(table.v_n, axis=1, keepdims=True)
    np.testing.assert_allclose(forward, course, atol=1e-6)


def test_attitude_at_waypoints_may_be_given():
    t = np.arange(20.0)
    given = SciRotation.from_euler("ZYX", np.stack([0.3 * t, 0.1 * t, 0.2 * t], -1))
    q = -given.as_quat(scalar_first=True)
    motion = from_waypoints(t, 0.9 + 1e-6 * t, 0.5 + 0.0 * t, 0.0 * t, q_nb=q)
    turned = SciRotation.from_quat(motion.at(t).q_nb, scalar_first=True)
    assert (turned.inv() * given).magnitude().max() < 1e-12


def test_sine_motion_is_that_of_pyins():
    from pyins import sim as pyins_sim  # with Numba

    seconds = 60.0
    theirs, _ = pyins_sim.generate_sine_velocity_motion(
        0.01, seconds + 0.005, [55.0, 37.0, 150.0], [10.0, 10.0, 10.0], 60.0, 30.0
    )
    motion = sine_velocity(START, duration_s=seconds)
    k = motion.at(theirs.index.to_numpy())
    np.testing.assert_allclose(k.v_n, theirs[["VN", "VE", "VD"]], atol=1e-8)
    # radians to metres; pyins joins its velocities by cubic splines and stops iterating at 1 cm
    np.testing.assert_allclose(k.lat, np.deg2rad(theirs.lat), atol=1e-2 / 6.4e6)
    np.testing.assert_allclose(k.lon, np.deg2rad(theirs.lon), atol=1e-2 / 6.4e6)
    np.testing.assert_allclose(k.alt, theirs.alt, atol=1e-5)
    # theirs raises the nose where the velocity points down
    angles = np.deg2rad(theirs[["heading", "pitch", "roll"]].to_numpy()) * [1.0, -1.0, 1.0]
    turned = SciRotation.from_quat(k.q_nb, scalar_first=True)
    assert (turned.inv() * SciRotation.from_euler("ZYX", angles)).magnitude().max() < 1e-7


def test_sampling_times():
    motion = sine_velocity(START, duration_s=30.0)
    times = motion.times_ns(3.0)
    assert times.dtype == np.int64
    assert len(times) == 91
    some = [0, 333333333, 666666667, 10**9, 30 * 10**9]
    np.testing.assert_array_equal(times[[0, 1, 2, 3, -1]], some)


GOOD = {"time_s": np.arange(8.0), "lat_rad": 0.9 + 1e-6 * np.arange(8)}
GOOD |= {"lon_rad": np.full(8, 0.5), "alt_m": np.zeros(8)}
BAD_WAYPOINTS = {
    "time_s: 8 waypoints, at least 4 at increasing": {"time_s": np.arange(8.0)[::-1]},
    r"lat_rad: 8 finite numbers.*\(7,\)": {"lat_rad": np.full(7, 0.9)},
    r"alt_m: 8 finite numbers": {"alt_m": np.full(8, np.nan)},
    "latitude 89.9.*local level": {"lat_rad": np.full(8, np.deg2rad(89.95))},
    r"stands still at .*pass q_nb": {"lat_rad": np.full(8, 0.9)},
    r"q_nb has shape \(8, 3\)": {"q_nb": np.zeros((8, 3))},
}


@pytest.mark.parametrize("message", BAD_WAYPOINTS)
def test_bad_waypoints_are_refused(message):
    with pytest.raises(ValueError, match=message):
        from_waypoints(**{**GOOD, **BAD_WAYPOINTS[message]})


BAD_COMMANDS = {
    "the list is empty": [],
    "command 1, .*duration and period must be positive": [do.straight(1.0), do.straight(0.0)],
    "a ground speed is not negative": [do.accelerate(-1.0, 5.0)],
    "the height changes at .*accelerate first": [do.climb(5.0, 10.0)],
}


@pytest.mark.parametrize("message", BAD_COMMANDS)
def test_bad_commands_are_refused(message):
    with pytest.raises(ValueError, match=message):
        from_commands(START, BAD_COMMANDS[message])


def test_a_turn_needs_a_rate():
    with pytest.raises(ValueError, match="both must be positive"):
        do.turn(1.0, -0.1)
