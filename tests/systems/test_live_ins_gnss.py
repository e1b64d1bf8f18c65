"""A live navigation is that of the causal replay, however late the fixes come."""

from dataclasses import replace
from functools import partial

import jax
import numpy as np
import pytest
from short_drive import DRIVE

from robins import scenario
from robins.filters import Code
from robins.logs import clean, load_dataset
from robins.logs.ordering import rows_where
from robins.results import ResultError
from robins.systems import replaying
from robins.systems.ins_gnss import SYSTEM, Drive, InsGnssReplay, LiveInsGnss, drive_dataset, model
from robins.systems.ins_gnss.log import contender, prepare, steps_of
from robins.systems.ins_gnss.path import InsGnssPath, row_of
from robins.systems.ins_gnss.recording import in_body_axes, on_one_clock
from robins.systems.ins_gnss.rest import usual_of
from robins.systems.ins_gnss.robust import navigation
from robins.systems.streaming import Flag, LiveError

RATE_HZ, FIX_HZ = 50.0, 2.0
HEADED = InsGnssReplay.model_validate({"start": {"known_heading": 1.2}})


def as_rates(dataset):
    """The log with rates in the place of increments, as a unit of a phone gives them."""
    imu, dt = dataset.imu, 1e-9 * float(dataset.imu.time_ns[1] - dataset.imu.time_ns[0])
    table = type(imu)(imu.time_ns, imu.gyro / dt, imu.accel / dt, "rate")
    return type(dataset)(dataset.name, table, dataset.gnss)


pytestmark = pytest.mark.usefixtures("unchecked")  # thousands of samples, one by one


@pytest.fixture(scope="module")
def log():
    return as_rates(drive_dataset(scenario.parse(Drive, DRIVE), seed=4))


def pieces_of(dataset, parameters):
    """The log on one clock, and its pieces as a replay takes them."""
    log = on_one_clock(in_body_axes(dataset, parameters.imu.orientation), parameters)
    pieces, _ = replaying.prepare_pieces(
        log.time_s,
        log.increments.dt,
        parameters.update.longest_gap,
        partial(prepare, log, parameters),
    )
    return log, pieces


def epochs_of_replay(dataset, parameters, name):
    """Stamps [ns] and vectors (as `vector`) at the epochs of a causal replay."""
    log, pieces = pieces_of(dataset, parameters)
    of = partial(contender, parameters, float(np.median(np.diff(log.gnss_s))))
    answer = replaying.run_filters(pieces, (name,), of)[name]
    x = navigation(answer.mean)
    place = x.position
    rows = [x.q_nb.wxyz, x.v_n, np.stack([place.lat, place.lon, place.alt], axis=1)]
    rows += [np.asarray(answer.sigma)[:, :9], *(p[:, None] for p in answer.wrong.values())]
    vectors = np.concatenate(list(map(np.asarray, rows)), axis=1)
    seconds = replaying.epochs_of(pieces)
    return np.round(seconds * 1e9).astype(np.int64) + int(dataset.imu.time_ns[0]), vectors


def vector(n):
    """The numbers of an answer."""
    place = n.lat_rad, n.lon_rad, n.alt_m
    return np.concatenate([n.q_nb, n.v_n, place, n.sigma, list(n.wrong.values())])


def events(dataset, late_s, skipped=()):
    """Events in the order in which they come in: (time, is a fix, row)."""
    fixes = [k for k in range(len(dataset.gnss)) if k not in skipped]
    comes = [(int(t), 0, k) for k, t in enumerate(dataset.imu.time_ns)]
    comes += [(int(dataset.gnss.time_ns[k] + 1e9 * late_s[k]), 1, k) for k in fixes]
    return sorted(comes)


def push(live, dataset, event):
    """One sample or fix."""
    _, fix, k = event
    imu, g = dataset.imu, dataset.gnss
    if not fix:
        return live.push_imu(int(imu.time_ns[k]), imu.gyro[k], imu.accel[k])
    time_ns, place, *others = row_of_fix(g, k)
    return live.push_fix(time_ns, *place, *others)


def row_of_fix(g, k):
    """A fix as `push_fix` takes it, but for its place in one piece."""
    place = float(g.lat_rad[k]), float(g.lon_rad[k]), float(g.alt_m[k])
    velocity = (None, None) if g.v_n is None else (g.v_n[k], g.sigma_v[k])
    return (
        int(g.time_ns[k]),
        place,
        g.sigma_m[k],
        *velocity,
        0 if g.quality is None else int(g.quality[k]),
    )


def played(live, dataset, all_events):
    """Answers to all, and what the filter said last of each epoch, by stamp."""
    at, step = {}, live._step

    def heard(*of):
        step(*of)
        at[live.epoch.time_ns] = vector(live.epoch)

    live._step = heard
    answers = [push(live, dataset, event) for event in all_events]
    live._step = step
    return answers, at


def compare(at, stamps, vectors, shortest):
    """Every epoch of the live filter is that of the replay; the last ones may be missing."""
    found = [(at[int(t)], row) for t, row in zip(stamps, vectors, strict=True) if int(t) in at]
    assert len(found) >= shortest
    live, of = (np.array(side) for side in zip(*found, strict=True))
    scale = np.concatenate([np.ones(7), [6.4e6, 6.4e6, 1.0], np.ones(live.shape[1] - 10)])
    np.testing.assert_allclose((live - of) * scale, 0.0, atol=2e-9)


@pytest.fixture(scope="module")
def made():
    return LiveInsGnss(InsGnssReplay(), RATE_HZ, FIX_HZ, "ekf")


@pytest.fixture
def live(made, tmp_path):
    made.save(tmp_path / "fresh.live")
    return LiveInsGnss.load(tmp_path / "fresh.live")


def test_a_file_of_another_filter_is_refused(live, log, tmp_path):
    """As one that an earlier version wrote, whose state had fewer components."""
    for event in events(log, np.zeros(len(log.gnss)))[:900]:
        push(live, log, event)
    assert live.epoch is not None
    live._states = [s._replace(belief=None) for s in live._states]
    live.save(tmp_path / "old.live")
    with pytest.raises(ResultError, match=r"components.*use the robins that wrote it"):
        LiveInsGnss.load(tmp_path / "old.live")


def lateness(order, count):
    """Delays [s] of the fixes; out of order each comes after the next one."""
    early, late = {"at once": (0.0, 0.0), "late": (0.17, 0.17), "out of order": (0.1, 0.72)}[order]
    return np.where(np.arange(count) % 2 == 0, late, early)


@pytest.mark.parametrize("order", ["at once", "late", "out of order"])
def test_epochs_are_those_of_the_replay(live, log, order):
    answers, at = played(live, log, events(log, lateness(order, len(log.gnss))))
    stamps, vectors = epochs_of_replay(log, InsGnssReplay(), "ekf")
    compare(at, stamps, vectors, len(stamps) - 3)
    started = [not a.flags & Flag.STARTING for a in answers]
    assert started == sorted(started)
    assert np.mean(started) > 0.6
    assert (live.counts["steps_again"] > 20) == (order != "at once")
    assert live.start.startswith("levelled at rest")
    assert live.doubts() == []


def test_sigmas_that_are_too_small_are_doubted_as_in_a_replay(live, log):
    """A late fix, for which steps are repeated, counts once among the innovations judged."""
    sure = replace(log, gnss=replace(log.gnss, sigma_m=0.2 * log.gnss.sigma_m))
    found = []
    for late_s in ("at once", "out of order"):
        live.start_over()
        played(live, sure, events(sure, lateness(late_s, len(log.gnss))))
        found.append(live.doubts())
    refused = f"measurements of '{model.POSITION}' were refused"
    assert refused in found[0][0]
    assert live.counts["steps_again"] > 20
    assert found[1] == found[0]
    assert refused in SYSTEM.replay(sure, InsGnssReplay(), ("ekf",)).warnings[0]


@pytest.mark.parametrize(
    ("parameters", "begin_s"),
    [(None, 0.0), (InsGnssReplay(), 0.0), (HEADED, 0.0), (HEADED, 6.0)],
    ids=["velocities", "course of positions", "heading given", "heading given, in motion"],
)
def test_steps_have_the_bits_of_those_of_a_replay(live, log, parameters, begin_s, monkeypatch):
    """Samples one by one, and each fix up to 0.9 s late: the last word on each epoch."""
    last = {}
    if parameters is not None:
        begin_ns = log.imu.time_ns[0] + round(begin_s * 1e9)
        imu = rows_where(log.imu, log.imu.time_ns >= begin_ns)
        gnss = rows_where(log.gnss, log.gnss.time_ns >= begin_ns)
        log = replace(log, imu=imu, gnss=replace(gnss, v_n=None, sigma_v=None))
        live = (
            live
            if parameters == InsGnssReplay()
            else LiveInsGnss(parameters, RATE_HZ, FIX_HZ, "ekf")
        )
    parameters = parameters or InsGnssReplay()

    def noted(piece, used, begin_s, epochs, *others):
        steps = steps_of(piece, used, begin_s, epochs, *others)
        for k, second in enumerate(epochs):
            last[round(1e9 * second)] = jax.tree_util.tree_map(
                lambda a, k=k: np.asarray(a)[k], steps
            )
        return steps

    monkeypatch.setattr("robins.systems.ins_gnss.path.steps_of", noted)
    for event in events(log, np.random.default_rng(0).uniform(0.0, 0.9, len(log.gnss))):
        push(live, log, event)
    _, (piece,) = pieces_of(log, parameters)
    assert live.start == piece.start.sentence
    whole, found = (piece.world.u, piece.world.y, piece.world.aux), 0
    for k, second in enumerate(piece.epoch_s):
        if (steps := last.get(round(1e9 * second))) is not None:
            of = jax.tree_util.tree_map(lambda a, k=k: np.asarray(a)[k], whole)
            # a live object leaves room for velocities that have not come
            mine = [
                steps[0],
                *({k: a[k] for k in b} for a, b in zip(steps[1:3], whole[1:], strict=False)),
            ]
            jax.tree_util.tree_map(np.testing.assert_array_equal, tuple(mine), of)
            found += 1
    assert found > 0.9 * len(piece.epoch_s)


def chunked(dataset, parameters, size):
    """Start and steps of a path whose samples come in chunks, each with the fixes up to its end."""
    usual = usual_of(on_one_clock(dataset, parameters))
    path, begun, made, imu = InsGnssPath(parameters, usual, 1.0), None, [], dataset.imu
    arrived = 0
    for at in range(0, len(imu), size):
        rows = slice(at, at + size)
        path.push(imu.time_ns[rows], np.hstack([imu.gyro[rows], imu.accel[rows]]))
        while arrived < len(dataset.gnss) and dataset.gnss.time_ns[arrived] <= path.imu.time_ns[-1]:
            time_ns, *fix = row_of_fix(dataset.gnss, arrived)
            path.push_fix(row_of(path.seconds(time_ns), *fix))
            arrived += 1
        if begun is None and (begun := path.start()):
            epoch = begun[0], begun[0]
        if begun and (epochs := path.due(*epoch)):
            ends = np.array([edge_s for edge_s, _ in epochs])
            made.append((ends, *path.steps(epoch[0], ends)[:3]))
            epoch = epochs[-1]
            path.forget(epoch[0])
    return begun, jax.tree_util.tree_map(lambda *rows: np.concatenate(rows), *made)


@pytest.mark.parametrize("velocities", [True, False])
@pytest.mark.parametrize("parameters", [InsGnssReplay(), HEADED], ids=["course", "heading given"])
def test_chunks_of_any_size_give_the_bits_of_a_replay(log, velocities, parameters):
    """Samples are missing, so is a fix, another has no height, one is far off; fixes jitter."""
    late_ns = np.random.default_rng(1).integers(0, 90_000_000, len(log.gnss))
    lat = log.gnss.lat_rad + np.radians(1.0) * (np.arange(len(log.gnss)) == 20)
    alt = np.where(np.arange(len(log.gnss)) == 24, np.nan, log.gnss.alt_m)
    gnss = replace(log.gnss, time_ns=log.gnss.time_ns + late_ns, lat_rad=lat, alt_m=alt)
    if not velocities:
        gnss = replace(gnss, v_n=None, sigma_v=None)
    there = ~np.isin(np.arange(len(log.imu)), [*range(580, 590), 700])
    gnss = rows_where(gnss, np.arange(len(gnss)) != 17)
    log = replace(log, imu=rows_where(log.imu, there), gnss=gnss)
    _, (piece,) = pieces_of(log, parameters)
    world = piece.world
    for size in (1, 7, 1000, len(log.imu)):
        (begin_s, start, belief), found = chunked(log, parameters, size)
        assert (begin_s, start.sentence) == (piece.begin_s, piece.start.sentence)
        count = len(found[0])
        assert count > len(piece.epoch_s) - 5
        of = jax.tree_util.tree_map(
            lambda a, n=count: np.asarray(a)[:n], (piece.epoch_s, world.u, world.y, world.aux)
        )
        for one, other in zip(found, of, strict=True):
            one = {k: one[k] for k in other} if isinstance(other, dict) else one
            jax.tree_util.tree_map(np.testing.assert_array_equal, one, other)
        jax.tree_util.tree_map(np.testing.assert_array_equal, belief, world.start)


def test_an_answer_is_the_state_carried_on_over_the_samples_since(live, log):
    """Answer of a replay that ends with a fix in this sample, but for that fix."""
    all_events = events(log, np.zeros(len(log.gnss)))
    end = next(i for i, e in enumerate(all_events) if e[0] > log.imu.time_ns[0] + 11.3e9)
    answers, _ = played(live, log, all_events[:end])
    last = answers[-1]
    cut = type(log)(
        log.name,
        rows_where(log.imu, log.imu.time_ns <= last.time_ns),
        rows_where(log.gnss, log.gnss.time_ns <= last.time_ns),
    )
    # a fix without a number makes an epoch of the replay here
    g, blank = cut.gnss, np.full(3, np.nan)
    nothing = type(g)(
        np.append(g.time_ns, last.time_ns),
        *(np.append(a, np.nan) for a in (g.lat_rad, g.lon_rad, g.alt_m)),
        np.vstack([g.sigma_m, np.ones(3)]), np.vstack([g.v_n, blank]),
        np.vstack([g.sigma_v, np.ones(3)]),
    )  # fmt: skip
    stamps, vectors = epochs_of_replay(
        type(log)(log.name, cut.imu, nothing), InsGnssReplay(), "ekf"
    )
    assert stamps[-1] == last.time_ns
    # the mean to rounding; the sigma but for what a rest of a sample more tells
    np.testing.assert_allclose(vector(last)[:10], vectors[-1, :10], atol=1e-9)
    np.testing.assert_allclose(last.sigma, vectors[-1, 10:], rtol=1e-3)


def test_restored_in_between_it_goes_on_to_the_bit(live, log, tmp_path):
    late_s = np.full(len(log.gnss), 0.23)
    whole = events(log, late_s)
    answers, _ = played(live, log, whole)
    again, path, begun = (
        LiveInsGnss(InsGnssReplay(), RATE_HZ, FIX_HZ, "ekf"),
        tmp_path / "v.live",
        0,
    )
    for end in (100, 420, 501, 760):
        played(again, log, whole[begun:end])
        again.save(path)
        again, begun = LiveInsGnss.load(path), end
    rest, _ = played(again, log, whole[begun:])
    for one, other in zip(rest, answers[begun:], strict=True):
        np.testing.assert_array_equal(vector(one), vector(other))
        assert (one.flags, one.wrong) == (other.flags, other.wrong)
        np.testing.assert_equal(one.seen, other.seen)
    assert again.counts == live.counts
    assert again.start == live.start


def test_an_outage_is_bridged_as_the_replay_does(live, log):
    skipped = set(range(14, 22))
    given = type(log)(log.name, log.imu, rows_where(
        log.gnss, ~np.isin(np.arange(len(log.gnss)), list(skipped))))  # fmt: skip
    _, at = played(live, log, events(log, np.full(len(log.gnss), 0.1), skipped))
    stamps, vectors = epochs_of_replay(given, InsGnssReplay(), "ekf")
    compare(at, stamps, vectors, len(stamps) - 3)


def test_bad_fixes_and_samples_are_refused_and_counted(live, log):
    whole = events(log, np.full(len(log.gnss), 0.1))
    played(live, log, whole[:600])
    t, k = int(live._path.imu.time_ns[-1]), next(e[2] for e in whole[600:] if e[1])
    g = log.gnss
    place, sigma = (float(g.lat_rad[k]), float(g.lon_rad[k]), float(g.alt_m[k])), g.sigma_m[k]
    before = live.epoch
    nan = float("nan")
    for stamp, where, reason in (
        (t, (nan, nan, nan), "nan"),
        (t - 5_000_000_000, place, "too_old"),
        (t + 60_000_000_000, place, "ahead"),
    ):
        assert live.push_fix(stamp, *where, sigma).flags == Flag.REFUSED
        assert live.counts[f"gnss_{reason}"] >= 1
    told = push(live, log, (0, 1, k - 1))  # it was there before
    assert told.flags == Flag.REFUSED
    assert live.counts["gnss_duplicate"] == 1
    for wrong, word in (
        (lambda: live.push_fix(t, 46.0, 9.0, 300.0, sigma), "are no radians"),
        (lambda: live.push_fix(t, *place, 1.0), "sigma_m: must be 3 real numbers"),
        (lambda: live.push_fix(t, *place, sigma, np.zeros(3)), "a velocity needs sigmas"),
        (lambda: live.push_fix(0.5, *place, sigma), "whole number of nanoseconds"),
        (lambda: live.push_imu(t + 1, np.zeros(2), np.zeros(3)), "gyro: must be 3 real numbers"),
    ):
        with pytest.raises(LiveError, match=word):
            wrong()
    assert live.push_imu(t - 1, np.zeros(3), np.zeros(3)).flags == Flag.REFUSED
    assert live.epoch is before
    answers, _ = played(live, log, whole[600:])
    assert answers[-1].flags == Flag(0)


@pytest.mark.parametrize("late_s", [0.0, 0.7])
def test_a_fix_that_is_far_off_is_flagged_and_counted_once(live, log, late_s):
    """It is 111 km off; where it comes late the filter takes the steps since then again."""
    far, count = 20, len(log.gnss)
    lat = log.gnss.lat_rad + np.radians(1.0) * (np.arange(count) == far)
    log = replace(log, gnss=replace(log.gnss, lat_rad=lat))
    late, flagged = np.full(count, 0.1), {}
    late[far] += late_s
    for event in events(log, late):
        answer = push(live, log, event)
        if event[1:] == (1, far):
            assert Flag.OUTLIER in answer.flags
        for epoch in live.passed:
            flagged[epoch.time_ns] = Flag.OUTLIER in epoch.flags
            if flagged[epoch.time_ns] and epoch.time_ns == int(log.gnss.time_ns[far]):
                assert epoch.seen["gnss_position"].code == Code.REFUSED
    assert flagged[int(log.gnss.time_ns[far])]
    assert live.counts["outliers_gnss_position"] == sum(flagged.values()) <= 3


def test_a_fix_of_the_future_waits(live, log):
    _, at = played(live, log, events(log, np.full(len(log.gnss), -0.4)))
    stamps, vectors = epochs_of_replay(log, InsGnssReplay(), "ekf")
    compare(at, stamps, vectors, len(stamps) - 3)
    assert live.counts["steps_again"] == 0


def test_samples_that_a_log_is_cleaned_of_are_refused_as_they_come(live, log):
    """Swapped, doubled, without a number, absurd, or lost; and fixes that swap places."""
    rows = np.arange(len(log.imu))
    rows[[600, 601]] = rows[[601, 600]]
    rows = np.delete(rows, slice(690, 696))
    rows = np.insert(rows, 720, rows[719])
    gyro = log.imu.gyro[rows].copy()
    gyro[650, 1], gyro[670, 2] = np.nan, 2e5
    imu = replace(log.imu, time_ns=log.imu.time_ns[rows], gyro=gyro, accel=log.imu.accel[rows])
    raw, late_s = replace(log, imu=imu), np.where(np.arange(len(log.gnss)) % 3 == 0, 0.72, 0.1)
    comes = [(int(np.max(imu.time_ns[: k + 1])), 0, k) for k in range(len(imu))]
    comes += [event for event in events(raw, late_s) if event[1]]
    _, at = played(live, raw, sorted(comes))
    cleaned = clean(raw)
    names = ("imu_nan", "imu_absurd", "imu_backward", "imu_duplicate")
    assert [live.counts[name] for name in names] == [1, 1, 1, 1]
    assert [cleaned.counts[name] for name in names] == [1, 1, 1, 1]
    compare(at, *epochs_of_replay(cleaned, InsGnssReplay(), "ekf"), 30)


def test_a_long_gap_is_a_new_start(live, log):
    whole = events(log, np.full(len(log.gnss), 0.1))
    gone = log.imu.time_ns[0] + np.array([9.0, 11.5]) * 1e9
    heard = [e for e in whole if e[1] or not gone[0] < log.imu.time_ns[e[2]] < gone[1]]
    answers, _ = played(live, log, heard)
    assert live.counts["imu_gaps_declared"] == 1
    after = [a for a in answers if a.time_ns > gone[1] + 2e8]
    assert after[0].flags == Flag.STARTING
    assert after[-1].flags == Flag(0)


@pytest.mark.parametrize("name", ["ekf", "robust"])
def test_the_walk_has_the_epochs_of_its_replay(data_dir, name):
    paths = [data_dir / f"gnssimu_walk_{part}.xz" for part in ("imu.csv", "gnss.pos")]
    if not all(path.exists() for path in paths):
        pytest.skip("the walk is not in the folder of real logs")
    parameters = scenario.load(InsGnssReplay, SYSTEM.replay_default.parent / "walk.toml")
    parameters = parameters.model_copy(update={"outages": None})
    log = clean(load_dataset(paths))
    end = log.imu.time_ns[0] + 25_000_000_000
    log = type(log)(log.name, rows_where(log.imu, log.imu.time_ns < end),
                    rows_where(log.gnss, log.gnss.time_ns < end))  # fmt: skip
    of = on_one_clock(log, parameters)
    rates = (1.0 / float(np.median(a)) for a in (of.increments.dt, np.diff(of.gnss_s)))
    live = LiveInsGnss(parameters, *rates, name)
    _, at = played(live, log, events(log, np.full(len(log.gnss), 0.08)))
    stamps, vectors = epochs_of_replay(log, parameters, name)
    compare(at, stamps, vectors, len(stamps) - 3)


@pytest.mark.parametrize("velocities", [True, False])
def test_nothing_is_compiled_once_it_has_started(live, log, velocities):
    if not velocities:
        log = replace(log, gnss=replace(log.gnss, v_n=None, sigma_v=None))
        live = LiveInsGnss(HEADED, RATE_HZ, FIX_HZ, "ekf")
    whole, compiled = events(log, np.full(len(log.gnss), 0.1)), []

    def heard(event, seconds, **told):
        if event == "/jax/core/compile/backend_compile_duration":
            compiled.append(told["fun_name"])

    begun = 420
    jax.clear_caches()  # else what another test compiled would not be seen
    answers, _ = played(live, log, whole[:begun])
    assert not answers[-1].flags & Flag.STARTING
    jax.monitoring.register_event_duration_secs_listener(heard)
    try:
        played(live, log, whole[begun:])
        assert compiled == []
        jax.jit(lambda x: x + 3.5)(1.0)
        assert len(compiled) == 1  # it would have been heard
    finally:
        jax.monitoring.unregister_event_duration_listener(heard)
