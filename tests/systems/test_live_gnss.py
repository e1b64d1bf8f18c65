"""Tight GNSS live: the bits of a replay for any chunks, columns, refusals, and what is kept."""

import inspect
import math
import pickle
from collections import OrderedDict
from functools import partial

import gnss_logs
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from robins.filters import Belief, Code, doubts, kalman
from robins.logs import load_ranges
from robins.program.names import by_name
from robins.results import ResultError, ignore_progress
from robins.systems import replaying
from robins.systems.gnss import GnssReplay, LiveGnss, gnss_model
from robins.systems.gnss.filters import SMOOTHERS, contender
from robins.systems.gnss.live import answer_of
from robins.systems.gnss.log import arrange, channels_of, names_of
from robins.systems.gnss.model import (
    LENGTH,
    RANGES,
    GnssModelKind,
    GnssState,
    LocalFrame,
    MotionStep,
)
from robins.systems.gnss.path import GnssPath
from robins.systems.marg import LiveMarg
from robins.systems.streaming import Flag, LiveError

BERLIN = LocalFrame.at(np.array([3.785e6, 9.02e5, 5.037e6]))
RNG = np.random.default_rng(20261130)
PARAMETERS = GnssReplay.model_validate({"wheels": {"aligned_after": 40.0}})
ODOMETRY, EPOCH = "odometry", "epoch"
pytestmark = pytest.mark.usefixtures("unchecked")  # some hundred records, one by one


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    path = tmp_path_factory.mktemp("city") / "in.txt"
    path.write_text(gnss_logs.as_text(*gnss_logs.drive())[0])
    return load_ranges([path])


@pytest.fixture(scope="module")
def channels(log):
    return channels_of(log.ranges, np.ones(len(log.ranges), dtype=bool))


@pytest.fixture(scope="module")
def made(channels):
    return LiveGnss(PARAMETERS, channels)


@pytest.fixture
def live(made):
    made.start_over()
    return made


def epochs_of(log):
    """Time, names and rows of the pseudoranges of each epoch."""
    r, names = log.ranges, names_of(log.ranges)
    rows = np.column_stack([r.range_m, r.sigma_m, r.satellite_e, r.elevation_rad, r.cn0_dbhz])
    for at in np.split(np.arange(len(names)), np.flatnonzero(np.diff(r.time_ns)) + 1):
        yield int(r.time_ns[at[0]]), [names[k] for k in at], rows[at]


def records(log, late_s=0.0):
    """Records in the order of their arrival, epochs late by so much (scalar, or by epoch)."""
    o, epochs = log.odometry, list(epochs_of(log))
    rows = np.column_stack([o.speed_mps, o.yaw_rate, o.sigma_speed, o.sigma_yaw])
    out = [(int(t), ODOMETRY, (int(t), *row)) for t, row in zip(o.time_ns, rows, strict=True)]
    for late, epoch in zip(np.broadcast_to(late_s, len(epochs)), epochs, strict=True):
        out.append((epoch[0] + round(1e9 * late), EPOCH, epoch))
    return [record[1:] for record in sorted(out, key=lambda record: record[:2])]


def push(live, kind, given):
    if kind == ODOMETRY:
        return live.push_odometry(given[0], *map(float, given[1:]))
    time_ns, names, rows = given
    return live.push_ranges(
        time_ns, names, rows[:, 0], rows[:, 1], rows[:, 2:5], rows[:, 5], rows[:, 6]
    )


def played(live, all_):
    """Last answer, and those at the epochs."""
    answer, passed = None, []
    for record in all_:
        answer = push(live, *record)
        passed += live.passed
    return answer, passed


@pytest.mark.parametrize("size", [1, 7, 1000])
def test_chunks_of_any_size_give_the_bits_of_a_replay(log, channels, size):
    wanted, whole = arrange(log, PARAMETERS)
    path, steps = GnssPath(PARAMETERS, channels), []
    for k, (kind, given) in enumerate(records(log)):
        if kind == ODOMETRY:
            path.push_odometry(np.array([given[0]]), np.array([given[1:]]))
        else:
            path.push_ranges(*given)
        if k % size == size - 1:
            steps += path.steps()
    steps += path.steps()
    found = jax.tree_util.tree_map(lambda *x: np.stack(x), *[world for _, world in steps])
    assert (path.satellites, path.way_m) == (whole.satellites, whole.way_m)
    assert path.begin_ns == steps[0][0]
    for a, b in (
        ((np.array([t for t, _ in steps]) - path.begin_ns) * 1e-9, wanted.epoch_s),
        (path.fix, wanted.world.fix),
        *zip(found.u, wanted.world.u, strict=True),
        *((found.y[name], wanted.world.y[name]) for name in (RANGES, LENGTH)),
        *zip(found.sky, wanted.world.sky, strict=True),
    ):
        np.testing.assert_array_equal(a, b)


@pytest.fixture(scope="module")
def replayed(log):
    """Epochs, Earth-fixed places and their sigmas of the causal replay."""
    of, path = arrange(log, PARAMETERS)
    make = partial(contender, PARAMETERS, path.place, path.member)
    answers = replaying.run_filters([of], ("delays",), make, SMOOTHERS, ignore_progress)
    mean, sigma = answers["delays"].mean, np.asarray(answers["delays"].sigma)
    o, C = np.asarray(path.place.origin_e), np.asarray(path.place.C_en)
    places = np.stack([o + C @ p for p in np.asarray(mean.position)])
    time_ns = path.begin_ns + np.round(1e9 * of.epoch_s).astype(np.int64)
    doubted = doubts(answers["delays"].tally, assumed=(LENGTH,))
    return time_ns, places, sigma[:, :3], np.asarray(mean.direction), doubted


@pytest.mark.parametrize("late_s", [0.0, 0.17], ids=["at once", "late"])
def test_answers_at_epochs_have_the_bits_of_a_replay(live, log, replayed, late_s):
    answer, passed = played(live, records(log, late_s))
    assert not live.counts
    time_ns, places, sigma, direction, doubted = replayed
    assert live.doubts() == doubted
    assert [one.time_ns for one in passed] == time_ns.tolist()
    np.testing.assert_array_equal([one.r_e for one in passed], places)
    np.testing.assert_array_equal([one.sigma_m for one in passed], sigma)
    heading = np.array([one.heading_rad for one in passed])
    known = np.isfinite(heading)
    assert known.any()
    o = log.odometry
    stands = time_ns <= o.time_ns[np.argmax(o.speed_mps != 0.0)]
    assert stands.sum() > 5
    assert not known[stands].any()  # nothing tells the heading of a vehicle that stands
    np.testing.assert_array_equal(
        heading[known], [math.atan2(c[1], c[0]) for c in direction[known]]
    )
    assert answer.time_ns == log.odometry.time_ns[-1]
    # what follows is the last state, carried on: 10 ms at most
    assert np.linalg.norm(answer.r_e - places[-1]) < 0.2


def test_epochs_out_of_order_are_refused_or_waited_for(live, log, channels, replayed):
    count = len(replayed[0])
    late_s = np.where(np.arange(count) % 2 == 0, 0.6, 0.0)  # each comes after the next one
    answer, passed = played(live, records(log, late_s))
    assert live.counts["ranges_too_old"] > 0.3 * count
    assert np.all(np.isfinite(answer.r_e))
    patient = LiveGnss(PARAMETERS, channels, wait_s=0.7)
    _, passed = played(patient, records(log, late_s))
    assert not patient.counts
    np.testing.assert_array_equal([one.r_e for one in passed], replayed[1][: len(passed)])
    assert count - len(passed) <= 2  # they still wait


def test_saved_in_between_it_goes_on_to_the_bit(live, log, replayed, tmp_path):
    all_ = records(log, 0.05)
    half = len(all_) // 2
    _, first = played(live, all_[:half])
    live.save(tmp_path / "car.live")
    loaded = LiveGnss.load(tmp_path / "car.live")
    copied = pickle.loads(pickle.dumps(live))
    for other in (loaded, copied, live):
        assert other.epoch.time_ns == first[-1].time_ns
        _, rest = played(other, all_[half:])
        found = np.stack([one.r_e for one in (*first, *rest)])
        np.testing.assert_array_equal(found, replayed[1])
    with pytest.raises(ResultError, match="LiveMarg"):
        LiveMarg.load(tmp_path / "car.live")


@pytest.mark.parametrize("channels", [{"G": 5, "R": 5}, {"G": 4}, {"E": 3, "G": 12}])
def test_no_program_is_made_once_it_is_there(log, channels, monkeypatch):
    known = OrderedDict()
    monkeypatch.setattr("robins.program.memory._known", known)
    live, made = LiveGnss(PARAMETERS, channels), list(known)
    assert len(made) == 2  # a step, and a look ahead
    _, passed = played(live, records(log))
    assert len(passed) > 50
    assert list(known) == made


def test_a_satellite_takes_the_column_that_was_not_used_for_longest(log):
    _, names, rows = next(e for e in epochs_of(log) if len(e[1]) >= 6)
    letters = sorted({name[0] for name in names})
    assert letters[0] == "G"
    path = GnssPath(PARAMETERS, dict.fromkeys(letters, 3))
    path.push_odometry(np.array([0, 10**12]), np.array([[0.0, 0.0, 0.1, 0.01]] * 2))
    of_g = [k for k, name in enumerate(names) if name[0] == "G"]
    a, b, c, d = of_g[:4]
    others = [k for k, name in enumerate(names) if name[0] != "G"][:2]
    for k, chosen in enumerate(([a, b, c], [a, c], [a, d], [a, b, c, d])):
        at = [*chosen, *others]
        path.push_ranges(k * 10**9, [names[i] for i in at], rows[at])
    steps = [world for _, world in path.steps()]
    # b was not seen for longest when d came, c has its column still
    assert path.satellites[:3] == [names[a], names[d], names[c]]
    assert steps[2].u.fresh.tolist() == [0.0, 1.0, 0.0, 0.0, 0.0, 0.0]
    assert steps[2].y[RANGES][1] == rows[d, 0]
    assert steps[1].u.fresh.sum() == steps[3].u.fresh.sum() == 0.0
    # those that are received keep their columns, so of four in three columns b has none
    assert np.isfinite(steps[3].y[RANGES][:3]).all()
    assert path.dropped == 1


@pytest.mark.parametrize("delays", [True, False])
def test_its_programs_have_a_name_in_the_cache(delays):
    built = gnss_model(PARAMETERS, GnssModelKind(delays=delays), BERLIN, np.zeros((4, 0)))
    structure = jax.tree_util.tree_structure(built)
    assert by_name(structure)
    assert jax.tree_util.tree_structure(pickle.loads(pickle.dumps(built))) == structure


def test_a_new_satellite_forgets_the_delay_of_its_column():
    """The covariance of the delay, after a step, is that of the law, free of all others."""
    member = np.zeros((4, 0))
    built = gnss_model(PARAMETERS, GnssModelKind(delays=True), BERLIN, member)
    n = 12
    S = np.linalg.cholesky(np.cov(RNG.standard_normal((n, 40))) + np.eye(n))
    x = GnssState(np.zeros(3), np.array([1.0, 0.0]), 0.0, np.zeros(2), np.zeros(0), np.arange(4.0))
    start = Belief(jax.tree_util.tree_map(jnp.asarray, x), jnp.asarray(S))
    u = MotionStep(
        0.2, 5.0, 0.1, 0.05, 0.002, jnp.full(4, 9.0), jnp.full(4, 7.0), jnp.array([0, 0, 1.0, 0])
    )
    filter_ = kalman()
    state, _ = filter_.predict(filter_.init(start, built.dims), built.motion, u)
    factor = np.asarray(state.belief.factor)
    P = factor @ factor.T
    k = n - 4 + 2
    assert state.belief.mean.delay[2] == pytest.approx(9.0)
    assert P[k, k] == pytest.approx(49.0)
    np.testing.assert_allclose(np.delete(P[k], k), 0.0, atol=1e-9)
    assert abs(P[k + 1, k - 1]) > 1e-3  # the others keep what they share


@pytest.mark.parametrize("c", [(0.0, 0.0), (0.0, -1.3e-20), (1e-9, 0.0)])
def test_a_direction_without_a_length_is_no_heading(c):
    x = np.array([0.0] * 3 + [1.0] * 3 + [*c, 0.5, 0.0, 0.0, 0.5])
    assert np.isnan(answer_of(0, BERLIN, x, Flag(0)).heading_rad)
    x[6:8] = 0.0, 1.0
    x[8:12] = 0.01, 0.0, 0.0, 0.04
    answer = answer_of(0, BERLIN, x, Flag(0))
    assert answer.heading_rad == pytest.approx(np.pi / 2)
    assert answer.sigma_heading_rad == pytest.approx(0.1)


def test_in_reverse_it_goes_back():
    """A speed below zero moves against the direction, and forgets delays all the same."""
    built = gnss_model(PARAMETERS, GnssModelKind(delays=True), BERLIN, np.zeros((4, 0)))
    still = np.zeros(3), np.array([1.0, 0.0]), 0.0, np.zeros(2), np.zeros(0), np.full(4, 30.0)
    x = GnssState(*map(jnp.asarray, still))
    ahead = MotionStep(1.0, 2.0, 0.0, 0.05, 0.002, jnp.zeros(4), jnp.ones(4))
    back = ahead._replace(speed=-2.0)
    assert built.motion.step(x, back).position[0] == pytest.approx(-2.0)
    np.testing.assert_array_equal(
        built.motion.step(x, back).delay, built.motion.step(x, ahead).delay
    )
    assert built.motion.step(x, back).delay[0] < 29.0
    np.testing.assert_array_equal(
        built.motion.noise_factor(x, back), built.motion.noise_factor(x, ahead)
    )


def test_through_an_outage_it_follows_the_odometry(channels, log):
    """30 s straight on, a quarter turn, 30 s: a mean over all of it would go across."""
    _, names, rows = next(e for e in epochs_of(log) if len(e[1]) >= 6)
    step_ns, turn = 100_000_000, np.pi / 2 / 3.0
    paths = [GnssPath(PARAMETERS, channels, 0.0, patience) for patience in (1.0, math.inf)]
    found = [[], []]
    for k in range(661):
        speed, rate = 10.0, turn if 301 <= k <= 330 else 0.0
        for path, out in zip(paths, found, strict=True):
            path.push_odometry(np.array([k * step_ns]), np.array([[speed, rate, 0.05, 0.002]]))
            if k in (1, 650):
                path.push_ranges(k * step_ns, names, rows)
            out += path.steps()
    live, replayed = found
    assert len(live) == len(replayed) > 60
    for (t, one), (at, other) in zip(live, replayed, strict=True):
        assert t == at
        jax.tree_util.tree_map(np.testing.assert_array_equal, one, other)
    x = GnssState(*map(jnp.asarray, (np.zeros(3), np.array([1.0, 0.0]), 0.0, np.zeros(2))),
                  jnp.zeros(0), jnp.zeros(0))  # fmt: skip
    motion = gnss_model(PARAMETERS, GnssModelKind(), BERLIN, np.zeros((4, 0))).motion
    for _, world in live:
        x = motion.step(x, jax.tree_util.tree_map(jnp.asarray, world.u))
    radius = 10.0 / turn
    straight = np.array([30.0, 31.9]) * 10.0 + radius
    np.testing.assert_allclose(x.position[:2], straight, atol=3.0)
    assert paths[0].way_m == pytest.approx(649.0, abs=0.5)


def test_an_epoch_that_the_filter_cannot_use_is_doubtful(live, log):
    _, names, rows = next(e for e in epochs_of(log) if len(e[1]) >= 6)
    absurd = rows.copy()
    absurd[:, 0] = 1e300
    places = []
    for k, of in enumerate((rows, rows, absurd, rows)):
        push(live, EPOCH, (k * 10**9, names, of))
        places.append(live.push_odometry(k * 10**9, 0.0, 0.0, 0.1, 0.01).r_e)
    assert np.linalg.norm(places[-1] - places[1]) < 50.0
    time_ns, found = live._last_step
    found = found.copy()
    found[12] = float(Code.NOT_FINITE)
    live._last_step = time_ns, found
    assert live._epoch().flags == Flag.DOUBTFUL


def test_without_odometry_the_oldest_epochs_go(live, log):
    _, names, rows = next(e for e in epochs_of(log) if len(e[1]) >= 6)
    for k in range(620):
        push(live, EPOCH, (k * 10**8, names, rows))
    assert live.counts["ranges_without_odometry"] == 20
    assert live._path.waiting_ns[0] == 20 * 10**8


def test_what_was_lost_is_counted_over_a_new_beginning(live, log):
    _, names, rows = next(e for e in epochs_of(log) if len(e[1]) >= 6)
    wrong = rows / 1e3
    push(live, EPOCH, (0, names, wrong))
    live.push_odometry(0, 0.0, 0.0, 0.1, 0.01)
    for k in range(10):
        live.push_odometry(10**17 + k * 10**8, 0.0, 0.0, 0.1, 0.01)
    push(live, EPOCH, (10**17 + 9 * 10**8, names, wrong))
    assert live.counts["ranges_without_fix"] == 2


def test_hours_without_an_epoch_take_no_memory(live):
    for k in range(3000):
        live.push_odometry(k * 100_000_000, 5.0, 0.0, 0.05, 0.002)
    assert len(live._path._odometry) < 30


@pytest.mark.parametrize("fault", ["kilometres", "one place", "too few columns"])
def test_without_a_first_fix_it_does_not_start(live, log, channels, fault):
    _, names, rows = next(e for e in epochs_of(log) if len(e[1]) >= 6)
    wrong = rows.copy()
    if fault == "kilometres":
        wrong[:, :5] /= 1e3
    elif fault == "one place":
        wrong[:, 2:5] = wrong[0, 2:5]
    else:
        live = LiveGnss(PARAMETERS, {"G": 3, "R": 1})
        only = [k for k, name in enumerate(names) if name[0] == "G"]
        names, wrong = [names[k] for k in only], wrong[only]
    for k in range(2):
        push(live, EPOCH, (k * 10**9, names, wrong))
        answer = live.push_odometry(k * 10**9, 0.0, 0.0, 0.1, 0.01)
        assert answer.flags == Flag.STARTING
    assert live.counts["ranges_without_fix"] == (0 if fault == "too few columns" else 2)
    if fault != "too few columns":
        push(live, EPOCH, (2 * 10**9, names, rows))
        answer = live.push_odometry(2 * 10**9, 0.0, 0.0, 0.1, 0.01)
        assert answer.flags == Flag(0)
        assert np.all(np.isfinite(answer.r_e))


def test_a_clock_that_was_set_begins_anew(live, log):
    _, names, rows = next(e for e in epochs_of(log) if len(e[1]) >= 6)
    push(live, EPOCH, (0, names, rows))
    live.push_odometry(0, 0.0, 0.0, 0.1, 0.01)
    far = 10**17
    assert live.push_odometry(far, 0.0, 0.0, 0.1, 0.01).flags & Flag.REFUSED
    assert live.push_odometry(10**8, 0.0, 0.0, 0.1, 0.01).flags == Flag(0)
    for k in range(10):
        answer = live.push_odometry(far + k * 10**8, 0.0, 0.0, 0.1, 0.01)
    assert live.counts["begun_anew"] == 1
    assert answer.flags == Flag.STARTING
    push(live, EPOCH, (far + 9 * 10**8, names, rows))
    assert live.push_odometry(far + 10**9, 0.0, 0.0, 0.1, 0.01).flags == Flag(0)


def test_bad_records_are_refused_and_counted(live, log):
    all_ = records(log)
    half = len(all_) // 2
    before, _ = played(live, all_[:half])
    t, names, rows = next(given for kind, given in all_[half:] if kind == EPOCH)
    newest = before.time_ns
    for given, why in (
        ((newest, 1.0, 0.0, 0.1, 0.01), "odometry_duplicate"),
        ((newest - 5, 1.0, 0.0, 0.1, 0.01), "odometry_backward"),
        ((newest + 5, np.nan, 0.0, 0.1, 0.01), "odometry_nan"),
        ((newest + 5, 400.0, 0.0, 0.1, 0.01), "odometry_absurd"),
        ((newest + 5, 1.0, 0.0, 0.0, 0.01), "odometry_absurd"),
    ):
        count = live.counts[why]
        answer = live.push_odometry(*given)
        assert answer.flags & Flag.REFUSED
        assert live.counts[why] == count + 1
        np.testing.assert_array_equal(answer.r_e, before.r_e)
    bad = rows.copy()
    bad[0, 0], bad[1, 1] = np.nan, -1.0
    strange = ["X1", *names[1:]]
    push(live, EPOCH, (t, names, bad))
    assert live.counts["range_bad"] == 2
    assert push(live, EPOCH, (t, names, rows)).flags & Flag.REFUSED
    assert live.counts["ranges_duplicate"] == 1
    push(live, EPOCH, (t + 1, strange, rows))
    assert live.counts["range_of_another_system"] == 1
    assert push(live, EPOCH, (live.epoch.time_ns, names, rows)).flags & Flag.REFUSED
    assert live.counts["ranges_too_old"] == 1
    with pytest.raises(LiveError, match="whole number"):
        live.push_odometry(True, 1.0, 0.0, 0.1, 0.01)
    with pytest.raises(LiveError, match="by its name, once"):
        push(live, EPOCH, (t + 2, [names[0]] * len(names), rows))
    columns = *rows.T[:2], rows[:, 2:5], *rows.T[5:]
    as_users_call = partial(inspect.unwrap(LiveGnss.push_ranges), live)  # without checks of types
    with pytest.raises(LiveError, match="by its name, once"):
        as_users_call(t + 2, [["G"], *names[1:]], *columns)
    for strange in ("G05",):
        with pytest.raises(LiveError, match="names such as"):
            live.push_ranges(t + 2, strange, *columns)
    with pytest.raises(LiveError, match="satellite_e"):
        live.push_ranges(t + 2, names, *rows[:, :2].T, rows[:, 2:5].T, *rows[:, 5:].T)
    with pytest.raises(LiveError, match="is no time"):
        live.push_odometry(2**63, 1.0, 0.0, 0.1, 0.01)
    assert push(live, EPOCH, (t + 2, [], rows[:0])).flags & Flag.REFUSED
    assert live.counts["ranges_empty"] == 1
    with pytest.raises(LiveError, match="range_m"):
        push(live, EPOCH, (t + 2, names[:3], rows))
    _, rest = played(live, all_[half:])
    assert np.all(np.isfinite(rest[-1].r_e))


def test_before_four_satellites_there_is_no_number(live, log):
    answer = live.push_odometry(0, 0.0, 0.0, 0.1, 0.01)
    assert answer.flags == Flag.STARTING
    assert np.isnan(answer.r_e).all()
    _, names, rows = next(epochs_of(log))
    push(live, EPOCH, (0, names[:3], rows[:3]))
    assert live.push_odometry(10**9, 0.0, 0.0, 0.1, 0.01).flags == Flag.STARTING
    push(live, EPOCH, (2 * 10**9, names, rows))
    assert live.push_odometry(3 * 10**9, 0.0, 0.0, 0.1, 0.01).flags == Flag(0)


@pytest.mark.parametrize(
    ("given", "match"),
    [
        ({"channels": {"G": 3}}, "4 or more"),
        ({"channels": {"GPS": 8}}, "letter"),
        ({"channels": {"G": 8, "R": 0}}, "positive"),
        ({"filter": "delays+rts"}, "whole log"),
        ({"filter": "none"}, "filter"),
        ({"wait_s": -1.0}, "0 to 10 s"),
        ({"longest_delay_s": math.inf}, "0 to 10 s"),
    ],
)
def test_what_it_cannot_be_made_with_is_refused(given, match):
    with pytest.raises(ValueError, match=match):
        LiveGnss(PARAMETERS, **given)
