"""Coarse alignment: exact on perfect sensors, its covariance by Monte Carlo, its refusals."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation as Reference
from scipy.stats import chi2

from robins.earth import OMEGA_E, earth_rate_n, gravity
from robins.ins.alignment import (
    UNKNOWN_HEADING_RAD,
    align,
    gyrocompass,
    heading_from_velocity,
    is_static,
    level,
    static_sigmas,
)
from robins.ins.imu_errors import ImuErrorModel, TriadErrors, grade
from robins.rotation import Rotation

LAT = np.deg2rad(48.0)
G = float(gravity(LAT, 0.0))
TURN = np.array([0.0, 0.0, 0.1])
DEG_H = np.pi / 180.0 / 3600.0


def attitudes(n, rng, largest_pitch=np.pi / 2):
    """Random C_nb (n, 3, 3) by another library, with roll, pitch, heading."""
    euler = rng.uniform([-np.pi, -largest_pitch, -np.pi], [np.pi, largest_pitch, np.pi], (n, 3))
    return Reference.from_euler("ZYX", euler[:, ::-1]).as_matrix(), euler


def at_rest(C_nb, lat=LAT):
    """Mean rates and specific force of perfect sensors."""
    omega_n = np.asarray(earth_rate_n(lat))
    f_n = np.array([0.0, 0.0, -float(gravity(lat, 0.0))])
    C_bn = np.swapaxes(C_nb, -1, -2)
    return C_bn @ omega_n, C_bn @ f_n


def phi(C_true, q_nb):
    """Error in C_true = exp(phi x) C_estimate, by another library."""
    C_bn = np.swapaxes(np.asarray(q_nb.as_dcm()), -1, -2)
    return Reference.from_matrix(C_true @ C_bn).as_rotvec()


def assert_covariance(errors, covariances):
    """Sample covariance against the stated ones, whitened: every entry and the mean square."""
    root = np.linalg.cholesky(covariances)
    white = np.linalg.solve(root, errors[..., None])[..., 0]
    n = len(white)
    sample = white.T @ white / n
    low, high = chi2.ppf([1e-4, 1.0 - 1e-4], n) / n
    assert np.all((np.diag(sample) > low) & (np.diag(sample) < high)), sample
    assert np.abs(sample[~np.eye(3, dtype=bool)]).max() < 4.5 / np.sqrt(n), sample
    low, high = chi2.ppf([1e-4, 1.0 - 1e-4], 3 * n) / n
    assert low < np.trace(sample) < high


RNG = np.random.default_rng(0)


def test_gyrocompassing_perfect_sensors_gives_the_attitude():
    C_nb, _ = attitudes(300, RNG)
    for lat in (LAT, -0.3, 0.0, 1.5):
        got = gyrocompass(*at_rest(C_nb, lat), lat, 0.0, 0.0)
        assert got.method == "gyrocompass"
        np.testing.assert_allclose(got.q_nb.as_dcm(), C_nb, atol=2e-12)


def test_levelling_perfect_sensors_gives_roll_and_pitch():
    C_nb, euler = attitudes(300, RNG, largest_pitch=1.5)
    got = level(at_rest(C_nb)[1], 0.0, euler[:, 2], 0.0)
    assert got.method == "level"
    np.testing.assert_allclose(got.q_nb.as_dcm(), C_nb, atol=2e-13)
    one = level(at_rest(C_nb[7])[1], 0.01)
    np.testing.assert_allclose(np.stack(one.q_nb.as_euler()), [*euler[7, :2], 0.0], atol=1e-12)
    unknown = UNKNOWN_HEADING_RAD**2 + (0.01 / G * np.tan(euler[7, 1])) ** 2
    np.testing.assert_allclose(one.covariance[2, 2], unknown)


SIGMA_OMEGA = DEG_H * np.array([0.05, 0.1, 0.2])
SIGMA_F = np.array([1e-3, 5e-3, 2e-2])


def test_the_covariance_of_gyrocompassing_is_that_of_its_errors():
    C_nb, _ = attitudes(4000, RNG)
    omega, f = at_rest(C_nb)
    omega = omega + SIGMA_OMEGA * RNG.normal(size=omega.shape)
    f = f + SIGMA_F * RNG.normal(size=f.shape)
    got = gyrocompass(omega, f, LAT, SIGMA_OMEGA, SIGMA_F)
    assert_covariance(phi(C_nb, got.q_nb), got.covariance)


def test_the_covariance_of_levelling_is_that_of_its_errors():
    C_nb, euler = attitudes(4000, RNG, largest_pitch=1.2)
    f = at_rest(C_nb)[1] + SIGMA_F * RNG.normal(size=(4000, 3))
    heading = euler[:, 2] + 0.02 * RNG.normal(size=4000)
    got = level(f, SIGMA_F, heading, 0.02)
    assert_covariance(phi(C_nb, got.q_nb), got.covariance)


@pytest.mark.parametrize("lat", [0.0, 0.7, -1.2])
def test_error_formulas_of_the_books(lat):
    C_nb = attitudes(1, RNG)[0][0]
    omega, f = at_rest(C_nb, lat)
    g, level_rate = float(gravity(lat, 0.0)), OMEGA_E * np.cos(lat)

    def error(d_omega_n=0.0, d_f_n=0.0):
        d_omega_b, d_f_b = (C_nb.T @ (x + np.zeros(3)) for x in (d_omega_n, d_f_n))
        got = gyrocompass(omega + d_omega_b, f + d_f_b, lat, 1e-6, 1e-2)
        return phi(C_nb, got.q_nb)

    north, east, down = 1e-6 * np.eye(3)
    # Titterton & Weston: tilt = accelerometer bias over g, heading = east gyro bias over the
    # horizontal Earth rate, and the tilt about north times tan L.
    np.testing.assert_allclose(error(d_f_n=north), [0.0, -1e-6 / g, 0.0], atol=1e-12)
    tilt = 1e-6 / g
    np.testing.assert_allclose(error(d_f_n=east), [tilt, 0.0, -tilt * np.tan(lat)], atol=1e-12)
    np.testing.assert_allclose(error(d_f_n=down), np.zeros(3), atol=1e-12)
    turned = [0.0, 0.0, 1e-6 * OMEGA_E / level_rate]
    np.testing.assert_allclose(error(d_omega_n=east * OMEGA_E), turned, atol=1e-11)
    for harmless in (north, down):
        np.testing.assert_allclose(error(d_omega_n=harmless * OMEGA_E), np.zeros(3), atol=1e-11)


def test_heading_sigma_of_a_good_gyro():
    omega, f = at_rest(np.eye(3))
    got = gyrocompass(omega, f, LAT, 0.01 * DEG_H, 0.0)
    expected = 0.01 * DEG_H / (OMEGA_E * np.cos(LAT))
    np.testing.assert_allclose(np.sqrt(got.covariance[2, 2]), expected, rtol=1e-12)
    np.testing.assert_allclose(got.covariance[:2, :2], 0.0, atol=1e-30)
    # The figure in the head of the module.
    at_45 = gyrocompass(*at_rest(np.eye(3), np.pi / 4), np.pi / 4, 0.01 * DEG_H, 0.0)
    assert round(np.rad2deg(np.sqrt(at_45.covariance[2, 2])) * 60.0, 1) == 3.2


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"f_b": [0.0, 0.1, 0.0]}, "free fall"),
        ({"f_b": [0.0, 0.0, -1.0]}, "are the values in g"),
        ({"f_b": [0.0, 0.0, -9.0]}, "the vehicle accelerates"),
        ({"f_b": [0.0, -9.8]}, "three components"),
        ({"omega_ib_b": [0.0, np.nan, 0.0]}, "omega_ib_b must be finite"),
        ({"lat_rad": np.deg2rad(89.9)}, r"latitude 89.9 deg .*gyros are good to 0\.1 deg/h"),
        ({"sigma_omega": 10 * DEG_H}, "heading sigma of 56.9 deg is too large"),
        ({"omega_ib_b": [0.0, 0.0, 1e-3]}, "the vehicle turns, or the bias"),
        ({"lat_rad": np.deg2rad(-48.0)}, "or the latitude is wrong"),
    ],
)
def test_gyrocompassing_refuses_what_it_cannot_do(change, message):
    omega, f = at_rest(np.eye(3))
    given = {"omega_ib_b": omega, "f_b": f, "lat_rad": LAT, "sigma_omega": 0.1 * DEG_H}
    with pytest.raises(ValueError, match=message):
        gyrocompass(**(given | change), sigma_f=0.01)


def test_levelling_refuses_what_it_cannot_do():
    with pytest.raises(ValueError, match="free fall"):
        level([1e-3, 0.0, 0.0], 0.01)
    with pytest.raises(ValueError, match="straight up or down"):
        level([G, 0.0, 0.0], 0.01)
    with pytest.raises(ValueError, match="f_b must be finite"):
        level([[0.0, 0.0, -G], [np.nan, 0.0, -G]], 0.01)


def record(n=2000, seed=1, sigma_omega=1e-3, sigma_f=0.02):
    rng = np.random.default_rng(seed)
    omega, f = at_rest(np.eye(3))
    return omega + sigma_omega * rng.normal(size=(n, 3)), f + sigma_f * rng.normal(size=(n, 3))


def test_a_record_at_rest_passes():
    omega, f = record()
    got = is_static(omega, f, g=G)
    assert got.static
    assert got.reasons == ()
    np.testing.assert_allclose(got.f_b, [0.0, 0.0, -G], atol=5 * 0.02 / np.sqrt(2000))
    np.testing.assert_allclose(got.sigma_omega, 1e-3, rtol=0.1)
    np.testing.assert_allclose(got.sigma_f, 0.02, rtol=0.1)


def test_motion_is_seen_and_named():
    omega, f = record()
    sway = 0.05 * np.sin(np.linspace(0.0, 20.0, len(omega)))
    for moved, word in (
        ((omega + sway[:, None] * [1, 0, 0], f), "the rates scatter by 0.03"),
        ((omega, f + 20 * sway[:, None] * [0, 1, 0]), "the specific force scatters by 0.7"),
        ((omega + TURN, f), "the mean rate is 0.0999 rad/s"),
        ((omega, f * 0.5), "the mean specific force is 4.9"),
        ((omega, f / 9.8), "are expected; are the values in g?"),
    ):
        got = is_static(*moved, g=G)
        assert not got.static
        assert len(got.reasons) == 1
        assert word in got.reasons[0]
    everything = is_static(omega + 100 * sway[:, None], f * 3.0 + 100 * sway[:, None], g=G)
    assert len(everything.reasons) == 4


def test_records_that_cannot_be_judged_are_refused():
    omega, f = record(30)
    with pytest.raises(ValueError, match="at least 10 samples"):
        is_static(omega[:9], f[:9])
    with pytest.raises(ValueError, match=r"\(30, 3\) and \(29, 3\)"):
        is_static(omega, f[1:])
    f[4, 1] = np.nan
    with pytest.raises(ValueError, match="f_b is not finite at row 4"):
        is_static(omega, f)


@pytest.mark.parametrize("heading", [-3.0, -1.0, 0.2, 3.14])
def test_heading_of_a_straight_drive(heading):
    rng = np.random.default_rng(3)
    sigma, runs, fixes = np.array([0.1, 0.3, 1.0]), 2000, 4
    speed = np.array([5.0, 8.0, 10.0, 12.0])
    ahead = np.array([np.cos(heading), np.sin(heading), 0.0])
    v = speed[:, None] * ahead + sigma * rng.normal(size=(runs, fixes, 3))
    got = np.array([heading_from_velocity(one, sigma) for one in v])
    error = (np.angle(np.exp(1j * (got[:, 0] - heading)))) / got[:, 1]
    low, high = chi2.ppf([1e-4, 1.0 - 1e-4], runs) / runs
    assert low < np.mean(error**2) < high
    assert abs(error.mean()) < 4.0 / np.sqrt(runs)


def test_heading_sigma_of_one_fix():
    heading, sigma = heading_from_velocity([0.0, 10.0, 1.0], [0.2, 5.0, 5.0])
    np.testing.assert_allclose([heading, sigma], [np.pi / 2, 0.02])
    slipping = heading_from_velocity([0.0, 10.0, 1.0], 0.2, sideslip_sigma_rad=0.05)[1]
    np.testing.assert_allclose(slipping, np.hypot(0.02, 0.05))
    missing = [[np.nan, 3.0, 0.0], [0.0, 10.0, np.nan]]
    np.testing.assert_allclose(heading_from_velocity(missing, 0.2), [np.pi / 2, 0.02])


@pytest.mark.parametrize(
    ("v_n", "sigma_v", "message"),
    [
        ([0.5, 0.5, 0.0], 0.1, r"moves at 0\.707 m/s; below 2 m/s"),
        ([[5.0, 0.0, 0.0], [np.nan] * 3, [1.0, 0.0, 0.0]], 0.1, "moves at 1 m/s"),
        ([[np.nan] * 3], 0.1, "no velocity"),
        ([[5.0, 0.0, 0.0], [0.0, 5.0, 0.0]], 0.1, "differ by 90 deg.*turns"),
        ([5.0, 0.0], 0.1, "v_n must have shape"),
        ([5.0, 0.0, 0.0], 0.0, "sigma_v must be positive"),
    ],
)
def test_velocities_that_tell_no_heading_are_refused(v_n, sigma_v, message):
    with pytest.raises(ValueError, match=message):
        heading_from_velocity(v_n, sigma_v)


def test_static_sigmas_hold_all_errors():
    model = ImuErrorModel(
        TriadErrors(
            bias_sigma=1e-6,
            misalignment_sigma=1e-3,
            scale_sigma=[0.1, 0.0, 0.0],
            g_sensitivity_sigma=1e-7,
        ),
        TriadErrors(white=0.02, misalignment_sigma=1e-3, scale_sigma=1e-2),
    )
    f, omega = np.array([1.0, 2.0, -9.0]), np.array([4e-5, 0.0, -5e-5])
    sigma_omega, sigma_f = static_sigmas(model, 100.0, f, omega)
    rng = np.random.default_rng(4)
    n, off = 20000, np.ones((3, 3)) - np.eye(3)

    def random(sigma, shape):
        return sigma * rng.normal(size=(n, *shape))

    bent = random(1e-3 * off, (3, 3)) @ omega + random(1e-7, (3, 3)) @ f
    d_omega = random(1e-6, (3,)) + random(np.array([0.1, 0.0, 0.0]), (3,)) * omega + bent
    d_f = random(0.002, (3,)) + random(1e-2, (3,)) * f + random(1e-3 * off, (3, 3)) @ f
    np.testing.assert_allclose(d_omega.std(0), sigma_omega, rtol=0.025)
    np.testing.assert_allclose(d_f.std(0), sigma_f, rtol=0.025)


def test_align_takes_the_compass_if_the_gyros_are_good_enough():
    omega, f = record(sigma_omega=1e-6, sigma_f=1e-3)
    fine = align(omega, f, 0.01, LAT, grade("navigation"))
    assert fine.method == "gyrocompass"
    sigmas = np.sqrt(np.diag(fine.covariance))
    assert np.all(np.abs(phi(np.eye(3), fine.q_nb)) < 4.0 * sigmas)
    np.testing.assert_allclose(sigmas[:2], 50e-6 * 9.80665 / G, rtol=0.2)
    coarse = align(omega, f, 0.01, LAT, grade("consumer MEMS"))
    assert coarse.method == "level"
    np.testing.assert_allclose(np.sqrt(coarse.covariance[2, 2]), UNKNOWN_HEADING_RAD, rtol=1e-3)
    with pytest.raises(ValueError, match=r"not at rest: the mean rate is 0\.0999"):
        align(omega + TURN, f, 0.01, LAT, grade("tactical"))
    with pytest.raises(ValueError, match="not at rest: the rates scatter"):
        align(omega, f, 0.01, LAT, grade("tactical"), largest_sigma_omega=1e-8)


def test_the_attitude_is_a_state_that_a_filter_can_start_from():
    got = level([0.0, 0.0, -G], 0.01)
    assert isinstance(got.q_nb, Rotation)
    moved = got.q_nb.retract(jnp.array([0.1, 0.0, 0.0]))
    np.testing.assert_allclose(got.q_nb.local(moved), [0.1, 0.0, 0.0], atol=1e-15)
