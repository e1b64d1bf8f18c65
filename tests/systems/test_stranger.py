"""A log that nobody tuned the filter for: what it says, and what is not taken for granted."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from robins import logs, scenario
from robins.filters import Belief, Model, Motion, Sensor, kalman, run, taylor
from robins.filters.rules import student_t
from robins.ins.rest import confirmed, standstill
from robins.logs.mounting import Mounting, turned
from robins.systems.ins_gnss import SYSTEM, Drive, Replay, drive_dataset, replay
from robins.systems.ins_gnss.model import POSITION
from robins.systems.ins_gnss.recording import in_body_axes, on_one_clock
from robins.systems.ins_gnss.robust import SCALES, changes, find_back, hypotheses
from robins.systems.ins_gnss.start import at_rest

SMOOTH = """
imu_rate = "50 Hz"
[place]
latitude = "46 deg"
longitude = "9 deg"
height = "300 m"
heading = "70 deg"
[imu]
gyro_noise = "0.004 deg/s/sqrt(Hz)"
accel_noise = "150 ug/sqrt(Hz)"
gyro_bias = "0.1 deg/s"
accel_bias = "5 mg"
gyro_bias_walk = "0.0005 deg/s/sqrt(s)"
accel_bias_walk = "5 ug/sqrt(s)"
[gnss]
rate = "4 Hz"
sigma = "0.02 m"
velocity_sigma = "0.05 m/s"
[[legs]]
do = "stop"
seconds = "4 s"
[[legs]]
do = "accelerate"
seconds = "6 s"
speed = "12 m/s"
[[legs]]
do = "straight"
seconds = "8 s"
[[legs]]
do = "turn"
angle = "70 deg"
rate = "14 deg/s"
[[legs]]
do = "straight"
seconds = "8 s"
[[legs]]
do = "accelerate"
seconds = "6 s"
speed = "0 m/s"
[[legs]]
do = "stop"
seconds = "4 s"
"""


@pytest.fixture(scope="module")
def log():
    return drive_dataset(scenario.parse(Drive, SMOOTH), seed=1)


# ------------------------------------------------------------------------------------ standstill

TIME = np.arange(0.0, 40.0, 0.1)
QUIET = np.ones(len(TIME), bool)
FIXES = np.arange(0.0, 40.0, 0.5)
# moves from 10 to 20 s, and from 30 s on
MOVES = ((FIXES >= 10.0) & (FIXES < 20.0)) | (FIXES >= 30.0)


def asked(unrest, fixes=FIXES, moves=MOVES):
    return confirmed(QUIET, unrest, TIME, fixes, moves, 1.5)


def test_fixes_say_whether_what_looks_still_is():
    found = asked(np.ones(len(TIME)))
    moving = ((TIME >= 10.0) & (TIME < 20.0)) | (TIME >= 30.0)
    np.testing.assert_array_equal(found, ~moving)
    assert not np.any(confirmed(QUIET, 0.0 * TIME, TIME, FIXES[:0], MOVES[:0], 1.5))
    assert not np.any(confirmed(~QUIET, 0.0 * TIME, TIME, FIXES, MOVES, 1.5))


@pytest.mark.parametrize(("calm", "still"), [(0.9, False), (0.6, False), (0.4, True)])
def test_without_fixes_only_what_is_calmer_than_any_motion_seen_is_still(calm, still):
    heard = FIXES < 25.0
    unrest = np.where(TIME > 26.5, calm, 1.0)
    found = asked(unrest, FIXES[heard], MOVES[heard])
    assert np.all(found[TIME > 26.6] == still)
    # where no motion was seen before, spread alone tells nothing
    early = FIXES < 5.0
    assert not np.any(asked(unrest, FIXES[early], MOVES[early])[TIME > 6.6])


def test_standstill_uses_nothing_of_the_future():
    rng = np.random.default_rng(3)
    unrest = rng.uniform(0.1, 1.0, len(TIME))
    heard = (FIXES < 14.0) | (FIXES > 33.0)
    whole = asked(unrest, FIXES[heard], MOVES[heard])
    for end_s in (5.0, 12.3, 21.7, 35.0):
        until, fixes = end_s > TIME, FIXES[heard] < end_s
        part = confirmed(
            QUIET[until],
            unrest[until],
            TIME[until],
            FIXES[heard][fixes],
            MOVES[heard][fixes],
            1.5,
        )
        np.testing.assert_array_equal(part, whole[until])


@pytest.mark.parametrize("velocities", [True, False])
def test_a_smooth_road_is_not_taken_for_rest(log, velocities):
    given = log if velocities else replace(log, gnss=replace(log.gnss, v_n=None, sigma_v=None))
    whole, aids = on_one_clock(given, Replay()), Replay().aids
    found, _ = at_rest(whole, aids)
    speed = np.interp(whole.time_s, log.truth.time_ns * 1e-9, np.linalg.norm(log.truth.v_n, axis=1))
    by_spread, _ = standstill(whole.increments, *aids.quiet)
    assert np.sum(by_spread & (speed > 5.0)) > 300, "the spread alone takes it for rest"
    assert not np.any(found & (speed > 0.5))
    assert np.mean(found[speed == 0.0]) > 0.5


# ------------------------------------------------------------------------------------- the filter

PATIENCE = 6
MODEL = Model(
    Motion(step=lambda x, u: x, noise=0.01 * jnp.ones(3)),
    (Sensor(lambda x, aux: x, 0.1 * jnp.ones(3), 3, POSITION),),
)


def _followed(offset):
    """Estimates (T, 3) of a point at the origin whose position is off by these (T, 3)."""
    noise = 0.1 * np.random.default_rng(4).normal(size=offset.shape)
    filter_ = kalman(taylor(), [find_back(PATIENCE), student_t(4.0)])
    found = run(
        filter_, MODEL, Belief.of(jnp.zeros(3), 0.01 * jnp.eye(3)), {POSITION: offset + noise}
    )
    return np.asarray(found.mean)


def test_positions_that_stay_away_are_followed_after_the_patience_and_not_before():
    offset = np.zeros((60, 3))
    offset[20:] = [30.0, -20.0, 5.0]
    found = _followed(offset)
    assert np.max(np.abs(found[: 20 + PATIENCE])) < 1.0
    assert np.max(np.abs((found - offset)[20 + PATIENCE + 1 :])) < 0.5


def test_a_receiver_that_is_deceived_for_a_while_is_not_followed():
    offset = np.zeros((60, 3))
    offset[20 : 20 + PATIENCE] = [30.0, -20.0, 5.0]
    offset[30:40] = np.array([25.0, 0.0, 0.0]) * (-1.0) ** np.arange(10)[:, None]
    assert np.max(np.abs(_followed(offset))) < 1.0


def test_changes_of_hypotheses_are_probabilities_and_velocities_stay_what_they_are():
    of = hypotheses(asked=True)
    p = changes(of)
    np.testing.assert_allclose(p.sum(axis=1), 1.0, rtol=1e-12)
    assert np.all(p >= 0.0)
    other = of.mean[:, None] != of.mean[None, :]
    assert np.all(p[other] == 0.0)
    assert len(of.mean) == 2 * len(SCALES)
    assert np.all(hypotheses(asked=False).mean == 1.0)


@pytest.mark.parametrize("name", ["robust", "robust+rts"], ids=["bank", "smoothed"])
def test_mean_velocities_and_a_deceived_receiver_cost_little(log, name):
    """Velocities are means since the last fix, and positions are off by 3 m for 4 s."""
    g = log.gnss
    t, at = log.truth.time_ns * 1e-9, g.time_ns * 1e-9
    path = np.stack([np.interp(at, t, x) for x in log.truth.v_n.T], axis=-1)
    way = np.stack(
        [np.interp(at, t, x) for x in np.cumsum(log.truth.v_n * 0.02, axis=0).T], axis=-1
    )
    mean = np.concatenate([path[:1], np.diff(way, axis=0) / 0.25])
    mean += 0.05 * np.random.default_rng(8).normal(size=mean.shape)
    wrong = (at > 20.0) & (at < 24.0)
    lat = g.lat_rad + np.where(wrong, 3.0 / 6.37e6, 0.0)
    told = replace(log, gnss=replace(g, lat_rad=lat, v_n=mean))
    outcome = replay(logs.clean(told), Replay(), (name,))
    if name == "robust":
        assert outcome.metrics[name]["refused_gnss_position"] == 0
    else:
        assert any("means over the 0.25 s since the last fix" in note for note in outcome.notes)
    s = outcome.solution.sel(filter=name)
    here = (s.time.values > 14.0) & (s.time.values < 38.0)
    north = 6.37e6 * (s.lat_rad.values - np.interp(s.time.values, t, log.truth.lat_rad))
    assert np.sqrt(np.mean(north[here] ** 2)) < 0.1
    assert np.max(np.abs(north[here])) < 0.5


# ------------------------------------------------------------------------ the command and Python


def test_without_a_file_a_replay_is_that_of_the_packaged_one():
    assert Replay() == scenario.load(Replay, SYSTEM.replay_default)
    assert Replay().filters[0] == SYSTEM.replay_filters[0] == "robust"


def test_a_mounting_alone_is_a_complete_file_and_turns_as_loading_with_it_does(log):
    text = '[imu]\norientation = ["180 deg", "0 deg", "-90 deg"]\n'
    parameters = scenario.parse(Replay, text)
    assert parameters.gnss == Replay().gnss
    mounting = Mounting(180.0, 0.0, -90.0)
    by_hand, here = turned(log, mounting), in_body_axes(log, parameters.imu.orientation)
    np.testing.assert_array_equal(here.imu.gyro, by_hand.imu.gyro)
    np.testing.assert_array_equal(here.imu.accel, by_hand.imu.accel)
    assert in_body_axes(by_hand, parameters.imu.orientation) is by_hand, "it is turned once"
    oblique = Mounting(10.0, -20.0, 30.0)
    there = in_body_axes(log, tuple(np.deg2rad([10.0, -20.0, 30.0])))
    np.testing.assert_allclose(there.imu.accel, turned(log, oblique).imu.accel, atol=1e-14)
