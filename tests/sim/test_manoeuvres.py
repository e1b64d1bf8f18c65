"""Manoeuvres: what was commanded is flown, sailed and driven, and the attitude belongs to it."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.spatial.transform import Rotation as SciRotation

from robins.earth import OMEGA_E, Geodetic, gravity
from robins.sim import commands as do
from robins.sim.commands import from_commands
from robins.sim.manoeuvres import MODERATE_SEA, BankedTurn, SeaMotion, Wave, fly, roughen, sail

DEG = np.pi / 180.0
START = Geodetic(32.0 * DEG, 118.0 * DEG, 3000.0)
G = float(np.asarray(gravity(START.lat, START.alt)))
SPEED, PITCH, ROLL_S = 100.0, 2.0 * DEG, 2.0
S_TURN = [
    BankedTurn(0.0, 10.0),
    BankedTurn(30.0 * DEG, 31.0),
    BankedTurn(-30.0 * DEG, 30.0),
    BankedTurn(0.0, 49.0),
]


@pytest.fixture(scope="module")
def s_turn():
    return fly(START, S_TURN, SPEED, pitch_rad=PITCH, roll_s=ROLL_S)


@pytest.fixture(scope="module")
def hard_turn():
    """3 g to the side: spec 1.2 of transfer alignment, by attitude matching."""
    return fly(START, [BankedTurn(np.arctan(3.0), 12.0), BankedTurn(0.0, 8.0)], 240.0, roll_s=1.0)


@pytest.fixture(scope="module")
def ship():
    return sail(START, 60.0, speed_mps=6.0, heading_rad=2.0)


@pytest.fixture(scope="module")
def road():
    legs = [do.accelerate(15.0, 8.0), do.straight(4.0), do.accelerate(8.0, 5.0), do.straight(3.0)]
    return from_commands(START, legs, heading_rad=0.7)


@pytest.fixture(scope="module")
def rough(road):
    return roughen(road, [Wave(0.5 * DEG, 1.3, 0.4)], [Wave(0.3 * DEG, 0.9), Wave(0.1 * DEG, 2.1)])


@pytest.fixture(params=["s_turn", "hard_turn", "ship", "rough"])
def motion(request):
    return request.getfixturevalue(request.param)


def euler(k):
    return SciRotation.from_quat(k.q_nb, scalar_first=True).as_euler("ZYX")[:, ::-1].T


def test_rates_belong_to_the_attitude_and_velocity_to_the_height(motion):
    h = 2e-4
    t = np.linspace(0.1, motion.duration_s - 0.1, 401)
    early, k, late = motion.at(t - h), motion.at(t), motion.at(t + h)
    early_q, late_q = (SciRotation.from_quat(x.q_nb, scalar_first=True) for x in (early, late))
    rate = (early_q.inv() * late_q).as_rotvec() / (2.0 * h)
    # differences of second order leave h^2/6 of the third derivative, 1e3 m/s^4 in the hard turn
    np.testing.assert_allclose(rate, k.omega_nb_b, rtol=0, atol=2e-6)
    np.testing.assert_allclose((early.alt - late.alt) / (2.0 * h), k.v_n[:, 2], rtol=0, atol=1e-7)
    np.testing.assert_allclose((late.v_n - early.v_n) / (2.0 * h), k.a_n, rtol=0, atol=2e-5)


@pytest.mark.parametrize(("name", "speed"), [("s_turn", SPEED), ("hard_turn", 240.0)])
def test_a_coordinated_turn_feels_no_force_to_the_side(name, speed, request):
    motion = request.getfixturevalue(name)
    t = np.linspace(0.0, motion.duration_s, 3001)
    k = motion.at(t)
    _, f_b = k.rates()
    # the knots are met, and between them the splines miss a little where the roll begins and ends
    assert np.abs(f_b[:, 1]).max() < 2e-4
    np.testing.assert_allclose(np.linalg.norm(k.v_n, axis=1), speed, rtol=0, atol=1e-5)
    np.testing.assert_allclose(k.alt, START.alt, rtol=0, atol=1e-6)


def test_bank_in_the_turn_is_that_of_the_closed_form(s_turn):
    """Level turn over a rotating Earth: side acceleration over what is felt down, with pitch."""
    t = np.array([5.0, 20.0, 30.0, 40.9, 50.0, 60.0, 70.9, 100.0])
    k = s_turn.at(t)
    roll, pitch, _ = euler(k)
    commanded = np.array([0.0, 30.0, 30.0, 30.0, -30.0, -30.0, -30.0, 0.0]) * DEG
    np.testing.assert_allclose(roll, commanded, rtol=0, atol=0.15 * DEG)
    np.testing.assert_allclose(pitch, PITCH, rtol=0, atol=1e-8)

    a, e_sq = 6378137.0, 0.00669437999014
    w_sq = 1.0 - e_sq * np.sin(k.lat) ** 2
    R_N, R_M = a / np.sqrt(w_sq) + k.alt, a * (1.0 - e_sq) / w_sq**1.5 + k.alt
    v_N, v_E = k.v_n[:, 0], k.v_n[:, 1]
    about_down = 2.0 * OMEGA_E * np.sin(k.lat) + v_E * np.tan(k.lat) / R_N
    lift = 2.0 * OMEGA_E * np.cos(k.lat) * v_E + v_N**2 / R_M + v_E**2 / R_N
    # the Earth pushes a northern aircraft to the right, so its wings push to the left
    to_right = G * np.tan(commanded) - about_down * SPEED
    g = np.asarray(gravity(k.lat, k.alt))
    expected = to_right / ((g - lift) * np.cos(PITCH))
    np.testing.assert_allclose(np.tan(roll), expected, rtol=0, atol=2e-5)


def test_heading_turns_by_the_integral_of_the_turn_rate(s_turn, hard_turn):
    def eased(u):
        s = min(max(u, 0.0), 1.0)
        return 10.0 * s**3 - 15.0 * s**4 + 6.0 * s**5

    def turned(banks, begin, end, roll_s, speed):
        total = 0.0
        for (t, bank), before in zip(banks, [0.0, *(b for _, b in banks[:-1])], strict=True):
            t_end = next((x for x, _ in banks if x > t), end)

            def rate(x, t=t, bank=bank, before=before):
                return np.tan(before + (bank - before) * eased((x - t) / roll_s)) * G / speed

            points = [p for p in (t + roll_s,) if p < t_end]
            total += quad(rate, max(t, begin), t_end, points=points, epsabs=1e-12)[0]
        return total

    def change(motion):
        return np.diff(euler(motion.at(np.array([0.0, motion.duration_s])))[2])[0]

    hard = [(0.0, np.arctan(3.0)), (12.0, 0.0)]
    assert change(hard_turn) == pytest.approx(turned(hard, 0.0, 20.0, 1.0, 240.0), abs=1e-7)
    steady = np.diff(np.unwrap(euler(hard_turn.at(np.array([1.0, 12.0])))[2]))[0]
    assert steady == pytest.approx(11.0 * 3.0 * G / 240.0, abs=1e-7)

    s = [(0.0, 0.0), (10.0, 30.0 * DEG), (41.0, -30.0 * DEG), (71.0, 0.0)]
    assert change(s_turn) == pytest.approx(turned(s, 0.0, 120.0, ROLL_S, SPEED), abs=1e-7)


def test_a_ship_sways_as_told(ship):
    t = np.linspace(0.3, 59.7, 777)
    k = ship.at(t)
    roll, pitch, heading = euler(k)

    def wave(waves):
        return sum(w.amplitude * np.sin(2.0 * np.pi / w.period_s * t + w.phase_rad) for w in waves)

    np.testing.assert_allclose(roll, wave(MODERATE_SEA.roll), rtol=0, atol=1e-7)
    np.testing.assert_allclose(pitch, wave(MODERATE_SEA.pitch), rtol=0, atol=1e-7)
    np.testing.assert_allclose(heading, 2.0 + wave(MODERATE_SEA.yaw), rtol=0, atol=1e-7)
    np.testing.assert_allclose(k.alt, START.alt + wave(MODERATE_SEA.heave), rtol=0, atol=1e-6)
    course = np.tile([6.0 * np.cos(2.0), 6.0 * np.sin(2.0)], (len(t), 1))
    np.testing.assert_allclose(k.v_n[:, :2], course, rtol=0, atol=1e-6)


def test_amplitudes_of_a_single_swell():
    swell = SeaMotion(roll=[Wave(10.0 * DEG, 9.0)], heave=[Wave(1.5, 8.0, np.pi / 2)])
    k = sail(START, 72.0, sea=swell).at(np.linspace(0.0, 72.0, 7201))
    roll, pitch, _ = euler(k)
    assert roll.max() == pytest.approx(10.0 * DEG, rel=1e-5)
    assert np.ptp(k.alt) == pytest.approx(3.0, rel=1e-5)
    assert np.abs(k.v_n[:, 2]).max() == pytest.approx(1.5 * 2.0 * np.pi / 8.0, rel=1e-5)
    np.testing.assert_allclose(pitch, 0.0, atol=1e-12)
    # f = a - g: heaviest in the trough, where the heave turns upwards again
    _, f_b = k.rates()
    total = np.linalg.norm(f_b, axis=1) - G
    assert k.alt[total.argmax()] == pytest.approx(START.alt - 1.5, abs=1e-2)


def test_a_rough_road_shakes_the_body_and_leaves_the_path(road, rough):
    t = np.linspace(0.1, road.duration_s - 0.1, 333)
    smooth, shaken = road.at(t), rough.at(t)
    for name in ("lat", "lon"):
        np.testing.assert_allclose(getattr(shaken, name), getattr(smooth, name), rtol=0, atol=1e-12)
    np.testing.assert_allclose(shaken.v_n, smooth.v_n, rtol=0, atol=1e-5)
    roll, pitch, heading = euler(shaken)
    x = 2.0 * np.pi * t
    np.testing.assert_allclose(roll, 0.5 * DEG * np.sin(x / 1.3 + 0.4), rtol=0, atol=1e-6)
    waves = 0.3 * DEG * np.sin(x / 0.9) + 0.1 * DEG * np.sin(x / 2.1)
    np.testing.assert_allclose(pitch, waves, rtol=0, atol=1e-6)
    np.testing.assert_allclose(heading, 0.7, rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: fly(START, [], 100.0), "the list is empty"),
        (lambda: fly(START, [BankedTurn(0.1, 1.0)], 100.0), r"bank 0 lasts 1 s, less than the 2 s"),
        (lambda: fly(START, [BankedTurn(1.5, 9.0)], 100.0), r"bank 0 is 85\.9.* less than 85 deg"),
        (lambda: fly(START, [BankedTurn(np.nan, 9.0)], 100.0), "bank 0 is nan deg"),
        (lambda: fly(START, [BankedTurn(0.1, 9.0)], 0.0), "speed_mps is 0.0; it must be positive"),
        (lambda: fly(START, [BankedTurn(0.1, 9.0)], 9.0, roll_s=-1.0), "roll_s is -1.0"),
        (lambda: sail(START, 0.0), "duration_s is 0.0"),
        (lambda: sail(START, 9.0, speed_mps=-1.0), "a ground speed is not negative"),
        (
            lambda: sail(START, 9.0, sea=SeaMotion(yaw=[Wave(0.1, 0.0)])),
            "the period must be positive",
        ),
        (
            lambda: fly(Geodetic(1.57, 0.0, 0.0), [BankedTurn(0.0, 9.0)], 9.0),
            "north turns ever faster",
        ),
    ],
)
def test_what_cannot_be_moved_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
