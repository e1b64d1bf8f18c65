"""References against differences of their attitudes, and the axes they are to have."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from robins.earth.wgs84 import GM
from robins.sim.attitude_reference import (
    PEAK_ACCELERATION,
    PEAK_RATE,
    Reference,
    handover_reference,
    inertial,
    nadir,
    slews,
)
from robins.sim.orbit import OrbitStates, circular_orbit

DEG = np.pi / 180.0
COUNT = 12000
LONG = 0.5 * np.arange(COUNT)  # more than one turn of the orbit
DT = 0.05
TIME = DT * np.arange(COUNT)
STILL = np.array([0.5, -0.5, 0.5, 0.5])


@pytest.fixture(scope="module")
def orbit():
    return circular_orbit(500e3, 97.4 * DEG, 0.8, 0.3, LONG)


def numbers(reference):
    return Reference(*(np.array(x) for x in reference))


def check_rates(reference, dt, near_rate, near_alpha):
    """Rates and accelerations of a reference by central differences."""
    q, omega, alpha = numbers(reference)
    turn = Rotation.from_quat(q, scalar_first=True)
    # From the middle of three, half the way on less half the way back, both in its axes.
    ahead = (turn[1:-1].inv() * turn[2:]).as_rotvec()
    behind = (turn[1:-1].inv() * turn[:-2]).as_rotvec()
    np.testing.assert_allclose((ahead - behind) / (2 * dt), omega[1:-1], rtol=0.0, atol=near_rate)
    change = (omega[2:] - omega[:-2]) / (2 * dt)
    np.testing.assert_allclose(change, alpha[1:-1], rtol=0.0, atol=near_alpha)
    np.testing.assert_allclose(np.linalg.norm(q, axis=1), 1.0, rtol=0.0, atol=1e-15)
    assert np.min(np.sum(q[1:] * q[:-1], axis=1)) > 0.99  # no jumps of sign


def test_nadir_is_forward_against_the_normal_and_down(orbit):
    reference = numbers(nadir(orbit))
    r, v = np.array(orbit.r_i_m), np.array(orbit.v_i_m_s)
    C = Rotation.from_quat(reference.q_ib, scalar_first=True).as_matrix()
    forward, down = v / np.linalg.norm(v[0]), -r / np.linalg.norm(r[0])
    normal = np.cross(r, v)
    right = -normal / np.linalg.norm(normal[0])
    np.testing.assert_allclose(C, np.stack([forward, right, down], -1), rtol=0.0, atol=1e-14)
    rate = 2.0 * np.pi / 5676.98  # one turn in 94.6 minutes, the way of a wheel that rolls on
    np.testing.assert_allclose(reference.omega_b, np.tile([0.0, -rate, 0.0], (COUNT, 1)), atol=1e-9)
    np.testing.assert_allclose(reference.alpha_b, 0.0, atol=1e-18)
    check_rates(reference, 0.5, 1e-12, 1e-18)


def test_nadir_of_an_ellipse_speeds_up_where_it_is_low():
    # Kepler's ellipse by its eccentric anomaly, at times that follow from it.
    a, e = 9e6, 0.2
    n = np.sqrt(GM / a**3)
    anomaly = np.linspace(0.3, 3.0, 20001)
    x, y = a * (np.cos(anomaly) - e), a * np.sqrt(1 - e * e) * np.sin(anomaly)
    time = (anomaly - e * np.sin(anomaly)) / n
    speed = n / (1.0 - e * np.cos(anomaly))
    vx, vy = -a * np.sin(anomaly) * speed, a * np.sqrt(1 - e * e) * np.cos(anomaly) * speed
    place, velocity = np.stack([x, y, 0 * x], -1), np.stack([vx, vy, 0 * x], -1)
    reference = numbers(
        nadir(OrbitStates(jnp.asarray(time), jnp.asarray(place), jnp.asarray(velocity)))
    )
    C = Rotation.from_quat(reference.q_ib, scalar_first=True).as_matrix()
    turned = np.unwrap(np.arctan2(-C[:, 1, 2], -C[:, 0, 2]))
    omega, alpha = reference.omega_b[:, 1], reference.alpha_b[:, 1]
    np.testing.assert_allclose(np.gradient(turned, time)[1:-1], -omega[1:-1], rtol=1e-6)
    slope, near = np.gradient(omega, time), 1e-5 * np.max(reference.alpha_b)
    np.testing.assert_allclose(slope[1:-1], alpha[1:-1], rtol=0.0, atol=near)


def test_inertial_stays():
    reference = numbers(inertial(STILL, TIME[:3]))
    np.testing.assert_array_equal(reference.q_ib, np.tile(STILL, (3, 1)))
    assert not np.any(reference.omega_b)
    assert not np.any(reference.alpha_b)


AMPLITUDE, PERIOD = np.array([60.0, 45.0, 80.0]) * DEG, np.array([200.0, 310.0, 170.0])
PHASE = np.array([0.3, 1.0, -2.0])


def test_slews_have_the_rates_of_their_attitudes():
    base = nadir(circular_orbit(500e3, 97.4 * DEG, 0.8, 0.3, TIME))
    reference = slews(base, AMPLITUDE, PERIOD, TIME, PHASE)
    assert np.max(np.abs(reference.omega_b)) > 0.05
    # What is left of central differences goes with the square of 0.05 s.
    check_rates(reference, DT, 2e-7, 2e-8)


def test_slews_turn_about_x_then_y_then_z():
    reference = numbers(slews(inertial(STILL, TIME), AMPLITUDE, PERIOD, TIME, PHASE))
    angles = AMPLITUDE * np.sin(2.0 * np.pi * TIME[:, None] / PERIOD + PHASE)
    asked = Rotation.from_quat(STILL, scalar_first=True) * Rotation.from_euler("XYZ", angles)
    got = Rotation.from_quat(reference.q_ib, scalar_first=True)
    np.testing.assert_allclose((got.inv() * asked).magnitude(), 0.0, atol=1e-13)


def test_slews_that_fade_in_start_at_rest_and_end_as_the_others():
    base, at_full = inertial(STILL, TIME), int(100.0 / DT)
    reference = numbers(slews(base, AMPLITUDE, PERIOD, TIME, PHASE, fade_in_s=100.0))
    # The third derivative jumps where the fading ends, by 60 amplitude/100^3 s^3.
    check_rates(reference, DT, 2e-7, 2e-6)
    np.testing.assert_allclose(reference.q_ib[0], STILL, rtol=1e-15)
    assert not np.any(reference.omega_b[0])
    assert not np.any(reference.alpha_b[0])
    full = numbers(slews(base, AMPLITUDE, PERIOD, TIME, PHASE))
    for mine, other in zip(reference, full, strict=True):
        assert np.max(np.abs(mine[at_full // 2] - other[at_full // 2])) > 1e-4
        np.testing.assert_allclose(mine[at_full:], other[at_full:], rtol=0.0, atol=1e-15)
    # From the first epoch on, whatever its time
    later = slews(base, AMPLITUDE, PERIOD, TIME + 1000.0, PHASE, fade_in_s=100.0)
    np.testing.assert_allclose(later.q_ib, reference.q_ib, rtol=0.0, atol=1e-13)


TURN, LENGTH = np.array([0.3, -0.5, 0.2]), 40.0  # rad, s


def way(base, rate, turn=TURN):
    return numbers(handover_reference(base, turn, np.asarray(rate, float), LENGTH, TIME))


def test_the_way_between_two_attitudes_turns_about_one_axis_from_rest_to_rest():
    base = inertial(STILL, TIME)
    found = way(base, np.zeros(3))
    check_rates(found, DT, 1e-6, 3e-5)
    there = Rotation.from_quat(STILL, scalar_first=True)
    left = (there.inv() * Rotation.from_quat(found.q_ib, scalar_first=True)).as_rotvec()
    np.testing.assert_allclose(left[0], TURN, atol=1e-14)
    axis, angle = TURN / np.linalg.norm(TURN), np.linalg.norm(TURN)
    np.testing.assert_allclose(left, np.outer(left @ axis, axis), atol=1e-14)
    assert np.all(np.diff(left @ axis) <= 1e-15)
    over = TIME >= LENGTH
    np.testing.assert_allclose(left[over], 0.0, atol=1e-15)
    for k, peak in ((1, PEAK_RATE / LENGTH), (2, PEAK_ACCELERATION / LENGTH**2)):
        size = np.linalg.norm(found[k], axis=1)
        np.testing.assert_allclose(np.max(size), peak * angle, rtol=1e-5)
        np.testing.assert_allclose(size[[0, -1]], 0.0, atol=1e-15)


def test_a_reference_that_moves_is_left_and_come_to_without_a_jump_of_its_rate(orbit):
    """From one that turns at 1 deg/s, a sixth of a turn away, to nadir."""
    base = nadir(circular_orbit(500e3, 97.4 * DEG, 0.8, 0.3, TIME))
    omega = np.array([1.0, -0.4, 0.2]) * DEG  # of the one that is left, in its axes
    to, turn = numbers(base), Rotation.from_rotvec(TURN)
    found = way(base, omega - turn.inv().apply(to.omega_b[0]))
    check_rates(found, DT, 1e-6, 3e-5)
    np.testing.assert_allclose(found.omega_b[0], omega, atol=1e-15)
    then = Rotation.from_quat(to.q_ib[0], scalar_first=True) * turn
    apart = then.inv() * Rotation.from_quat(found.q_ib[0], scalar_first=True)
    np.testing.assert_allclose(apart.as_rotvec(), 0.0, atol=1e-14)
    over = TIME >= LENGTH
    for x, wanted in zip(found, to, strict=True):
        np.testing.assert_allclose(x[over], wanted[over], atol=1e-14)
    # The rate that dies away brings no more acceleration than is reckoned with.
    dies = way(inertial(STILL, TIME), omega, np.zeros(3))
    most = 4.0 * np.linalg.norm(omega) / LENGTH
    assert 0.98 * most < np.max(np.linalg.norm(dies.alpha_b, axis=1)) < most


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"amplitude_rad": [1.0, 2.0]}, "amplitude_rad must be a number or of shape"),
        ({"amplitude_rad": np.nan}, "amplitude_rad must be"),
        ({"period_s": 0.0}, "period_s must be"),
        ({"phase_rad": np.inf}, "phase_rad must be"),
        ({"fade_in_s": -1.0}, "fade_in_s must be"),
        ({"time_s": TIME[:4]}, r"time_s must have shape \(3,\)"),
        ({"time_s": np.full(3, np.nan)}, "time_s must be"),
    ],
)
def test_what_is_no_slew_is_refused(change, words):
    given = {"amplitude_rad": 0.1, "period_s": 60.0, "time_s": TIME[:3]} | change
    with pytest.raises(ValueError, match=words):
        slews(inertial(STILL, TIME[:3]), **given)


def test_what_is_no_attitude_is_refused():
    for q, words in ((np.ones(4), "unit quaternion"), (np.ones(3), "q_ib must have shape")):
        with pytest.raises(ValueError, match=words):
            inertial(q, TIME[:3])
