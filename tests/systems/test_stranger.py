"""A log that nobody tuned the filter for: what it says, and what is not taken for granted."""

import itertools
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from short_drive import DRIVE

from robins import logs, manifold, scenario
from robins.dataset import OdometryTable
from robins.ins.rest import standstill
from robins.logs.mounting import Mounting, turned
from robins.systems.ins_gnss import SYSTEM, Drive, InsGnssReplay, drive_dataset, replay
from robins.systems.ins_gnss.log import prepare
from robins.systems.ins_gnss.model import ins_gnss_model
from robins.systems.ins_gnss.recording import TYRES, in_body_axes, on_one_clock
from robins.systems.ins_gnss.rest import Evidence, UsualIntervals, at_rest, confirmed, usual_of
from robins.systems.ins_gnss.robust import (
    AS_TOLD,
    HYPOTHESES,
    STRAYED,
    WILD_M,
    FixHypothesis,
    augmented_belief,
    fresh,
    hypothesis_model,
    mode_changes,
    robust,
    smoothed_probabilities,
)
from robins.systems.suspects import spans

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

OUTAGE = """
[outages]
length = "12 s"
first = "16 s"
gap = "60 s"
last = "1 s"
"""


@pytest.fixture(scope="module")
def log():
    return drive_dataset(scenario.parse(Drive, SMOOTH), seed=1)


# ------------------------------------------------------------------------------------ standstill

TIME = np.arange(0.0, 40.0, 0.1)
QUIET = np.ones(len(TIME), bool)
USUAL = UsualIntervals(0.1, 0.5)
FIXES = np.arange(0.0, 40.0, 0.5)
# moves from 10 to 20 s, and from 30 s on
MOVES = ((FIXES >= 10.0) & (FIXES < 20.0)) | (FIXES >= 30.0)


def told(fixes=FIXES, moves=MOVES):
    """Fixes that are certain of each instant."""
    return Evidence(fixes, moves, np.where(moves, fixes, np.nan), np.where(moves, np.nan, fixes))


def asked(unrest, fixes=FIXES, moves=MOVES):
    return confirmed(QUIET, unrest, TIME, [told(fixes, moves)], 1.5, USUAL)


def test_fixes_say_whether_what_looks_still_is():
    found = asked(np.ones(len(TIME)))
    moving = ((TIME >= 10.0) & (TIME < 20.0)) | (TIME >= 30.0)
    np.testing.assert_array_equal(found, ~moving)
    assert not np.any(asked(0.0 * TIME, FIXES[:0], MOVES[:0]))
    assert not np.any(confirmed(~QUIET, 0.0 * TIME, TIME, [told()], 1.5, USUAL))


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
            [told(FIXES[heard][fixes], MOVES[heard][fixes])],
            1.5,
            USUAL,
        )
        np.testing.assert_array_equal(part, whole[until])


@pytest.mark.parametrize(
    ("velocities", "sigma", "share"),
    [(True, "0.02 m", 0.5), (False, "0.02 m", 0.5), (False, "0.2 m", 0.1), (False, "3 m", 0.0)],
)
def test_a_smooth_road_is_not_taken_for_rest(velocities, sigma, share):
    """A path within its noise proves no rest: the share that is found is less, none is wrong."""
    log = drive_dataset(scenario.parse(Drive, SMOOTH, (f"gnss.sigma={sigma}",)), seed=1)
    given = log if velocities else replace(log, gnss=replace(log.gnss, v_n=None, sigma_v=None))
    whole, aids = on_one_clock(given, InsGnssReplay()), InsGnssReplay().aids
    found, _ = at_rest(whole, aids, usual_of(whole))
    speed = np.interp(whole.time_s, log.truth.time_ns * 1e-9, np.linalg.norm(log.truth.v_n, axis=1))
    by_spread, *_ = standstill(whole.increments, *aids.quiet)
    assert np.sum(by_spread & (speed > 5.0)) > 300, "the spread alone takes it for rest"
    assert not np.any(found & (speed > 0.5))
    assert np.mean(found[speed == 0.0]) >= share


def _with_wheels(log, until_s=np.inf):
    """The log with speeds of the wheels at 10 Hz, and fixes until a time only."""
    t = log.truth.time_ns[::5]
    speed = np.linalg.norm(log.truth.v_n, axis=1)[::5]
    none = np.full(len(t), np.nan)
    wheels = OdometryTable(t, speed, none, np.full(len(t), 0.05), none)
    early = log.gnss.time_ns * 1e-9 < until_s
    columns = ("time_ns", "lat_rad", "lon_rad", "alt_m", "sigma_m", "v_n", "sigma_v")
    gnss = replace(log.gnss, **{name: getattr(log.gnss, name)[early] for name in columns})
    return replace(log, gnss=gnss, odometry=wheels)


def test_wheels_tell_rest_from_a_smooth_road_where_no_fix_comes(log):
    given, aids = _with_wheels(log, until_s=14.0), InsGnssReplay().aids
    whole = on_one_clock(given, InsGnssReplay())
    found, _ = at_rest(whole, aids, usual_of(whole))
    alone, _ = at_rest(whole._replace(wheels=None), aids, usual_of(whole))
    speed = np.interp(whole.time_s, log.truth.time_ns * 1e-9, np.linalg.norm(log.truth.v_n, axis=1))
    stands = (speed == 0.0) & (whole.time_s > 14.0)
    assert not np.any(found & (speed > 0.5))
    assert np.mean(found[stands]) > 0.7
    assert not np.any(alone[stands]), "without wheels it is no calmer than on the road"


def test_a_speed_of_the_wheels_holds_the_way_where_no_fix_comes(log):
    heard = on_one_clock(_with_wheels(log), InsGnssReplay()).wheels
    np.testing.assert_allclose(heard.sigma, np.hypot(0.05, TYRES * heard.speed), rtol=1e-12)
    outage = scenario.parse(InsGnssReplay, OUTAGE)
    given = logs.clean(_with_wheels(log))
    errors = [
        replay(one, outage, ("ekf",)).metrics["ekf"]["outage_horizontal_max_m"]
        for one in (replace(given, odometry=None), given)
    ]
    assert errors[1] < 0.5 * errors[0]


# ------------------------------------------------------------------------------------- the filter


@pytest.mark.parametrize("step_s", [0.1, 0.25, 1.0])
def test_changes_are_probabilities_and_positions_are_off_for_the_patience_in_the_mean(step_s):
    p = mode_changes(step_s, 10.0)
    np.testing.assert_allclose(p.sum(axis=1), 1.0, rtol=1e-12)
    assert np.all(p >= 0.0)
    off = np.flatnonzero((HYPOTHESES.read > 0.0) & (HYPOTHESES.new < WILD_M))
    inside = p[np.ix_(off, off)]
    steps = np.linalg.solve(np.eye(len(off)) - inside, np.ones(len(off)))
    np.testing.assert_allclose(steps * step_s, 10.0, rtol=0.06)
    # seldom: the share of time in which they are off, where nothing is measured
    left = np.linalg.matrix_power(p, 100_000)[0]
    np.testing.assert_allclose(left[off].sum(), 10.0 / 110.0, rtol=0.12)


def test_the_linear_motion_of_each_hypothesis_is_the_slope_of_its_step(log):
    parameters = InsGnssReplay()
    own = ins_gnss_model(parameters.imu, parameters.gnss, parameters.aids)
    whole = on_one_clock(log, parameters)
    piece = prepare(whole, parameters, slice(0, len(whole.time_s)))
    u = jax.tree_util.tree_map(lambda a: jnp.asarray(a)[3], piece.world.u)
    start = augmented_belief(piece.world.start, True)
    x = start.mean._replace(offset=jnp.array([3.0, -2.0, 1.0]))
    n = manifold.dim(x)

    @jax.jit  # the motions have the same structure
    def both(motion):
        stepped, (new, Phi, noise) = motion.step(x, u), motion.linear(x, u)
        moved = jax.vmap(lambda e: motion.step(manifold.retract(x, 0.1 * e), u))(jnp.eye(n)[-4:])
        wide = jax.vmap(lambda one: manifold.local(stepped, one) / 0.1)(moved)
        return manifold.local(stepped, new), Phi, noise, wide

    for row in zip(*HYPOTHESES, strict=True):
        off, Phi, noise, wide = both(hypothesis_model(own, FixHypothesis(*row)).motion)
        assert np.all(np.abs(off) < 1e-9)
        np.testing.assert_allclose(np.asarray(Phi)[:, -4:], np.asarray(wide).T, atol=1e-5)
        assert noise.shape[0] == n


def test_a_bank_and_a_model_made_again_have_the_same_structure():
    parameters = InsGnssReplay()

    def made(fault_s):
        own = ins_gnss_model(parameters.imu, parameters.gnss, parameters.aids)
        bank = robust(own, 0.25, fault_s)
        return [
            jax.tree_util.tree_flatten(x)
            for x in (bank, hypothesis_model(own, AS_TOLD), fresh(own))
        ]

    each = list(zip(made(10.0), made(30.0), strict=True))
    for one, other in each:
        assert one[1] == other[1]
        assert {np.asarray(leaf).dtype for leaf in one[0]} == {np.dtype(float)}
    bank, other = each[0]
    differ = [a for a, b in zip(bank[0], other[0], strict=True) if np.any(a != b)]
    assert [np.shape(a) for a in differ] == [(10, 10)]  # the changes


def test_a_wild_position_leaves_the_estimate_where_it_was():
    """One fix of a receiver of metres, at another end of the Earth."""
    log = drive_dataset(scenario.parse(Drive, DRIVE), seed=4)

    def place(of):
        track = replay(of, InsGnssReplay(), ("robust",)).solution
        return np.stack([track[f"{x}_rad"].values[0] for x in ("lat", "lon")], axis=1)

    usual = place(log)
    for off_m in (1e4, 5e6):
        lat = log.gnss.lat_rad.copy()
        lat[20] -= off_m / 6.4e6
        away = 6.4e6 * np.abs(place(replace(log, gnss=replace(log.gnss, lat_rad=lat))) - usual)
        assert 0.0 < np.max(away) < 0.2


def test_hindsight_is_that_of_all_sequences_of_modes():
    rng = np.random.default_rng(5)
    change = mode_changes(2.0, 5.0)
    likely = rng.uniform(0.01, 1.0, (4, len(change)))
    start = np.full(len(change), 1.0 / len(change))
    filtered, now = [], start
    for row in likely:
        now = (now @ change) * row
        now = now / now.sum()
        filtered.append(now)
    total = np.zeros_like(likely)
    first = start @ change
    for path in itertools.product(range(len(change)), repeat=4):
        p = first[path[0]] * likely[0, path[0]]
        for k in range(1, 4):
            p *= change[path[k - 1], path[k]] * likely[k, path[k]]
        total[np.arange(4), path] += p
    total /= total.sum(axis=1, keepdims=True)
    found = smoothed_probabilities(np.array(filtered), change)
    np.testing.assert_allclose(found.off, total[:, HYPOTHESES.read > 0].sum(axis=1), rtol=1e-9)
    np.testing.assert_allclose(found.scale, np.exp(total @ np.log(HYPOTHESES.scale)), rtol=1e-9)
    np.testing.assert_allclose(found.diverged, total[:, STRAYED], rtol=1e-9)


def test_spans_are_first_and_last_times():
    time_s = np.arange(8.0)
    which = np.array([1, 1, 0, 0, 1, 0, 1, 1], bool)
    assert spans(time_s, which) == [(0.0, 1.0), (4.0, 4.0), (6.0, 7.0)]
    assert spans(time_s, ~which | which) == [(0.0, 7.0)]
    assert spans(time_s, which & ~which) == []


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
    outcome = replay(logs.clean(told), InsGnssReplay(), (name,))
    if name == "robust":
        assert outcome.metrics[name]["refused_gnss_position"] == 0
    assert any("means over the 0.25 s since the last fix" in note for note in outcome.notes)
    (deceived,) = [told for told in outcome.warnings if "positions were off" in told]
    assert "20.2" in deceived
    assert "24.0 s" in deceived or "23.7" in deceived or "23.8" in deceived
    s = outcome.solution.sel(filter=name)
    here = (s.time.values > 14.0) & (s.time.values < 38.0)
    north = 6.37e6 * (s.lat_rad.values - np.interp(s.time.values, t, log.truth.lat_rad))
    assert np.sqrt(np.mean(north[here] ** 2)) < 0.1
    assert np.max(np.abs(north[here])) < 0.5


# ------------------------------------------------------------------------ the command and Python


def test_without_a_file_a_replay_is_that_of_the_packaged_one():
    assert InsGnssReplay() == scenario.load(InsGnssReplay, SYSTEM.replay_default)
    assert InsGnssReplay().filters[0] == SYSTEM.replay_filters[0] == "robust"


def test_a_mounting_alone_is_a_complete_file_and_turns_as_loading_with_it_does(log):
    text = '[imu]\norientation = ["180 deg", "0 deg", "-90 deg"]\n'
    parameters = scenario.parse(InsGnssReplay, text)
    assert parameters.gnss == InsGnssReplay().gnss
    mounting = Mounting(180.0, 0.0, -90.0)
    by_hand, here = turned(log, mounting), in_body_axes(log, parameters.imu.orientation)
    np.testing.assert_array_equal(here.imu.gyro, by_hand.imu.gyro)
    np.testing.assert_array_equal(here.imu.accel, by_hand.imu.accel)
    assert in_body_axes(by_hand, parameters.imu.orientation) is by_hand, "it is turned once"
    oblique = Mounting(10.0, -20.0, 30.0)
    there = in_body_axes(log, tuple(np.deg2rad([10.0, -20.0, 30.0])))
    np.testing.assert_allclose(there.imu.accel, turned(log, oblique).imu.accel, atol=1e-14)
