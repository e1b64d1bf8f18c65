"""A live orientation is that of the causal replay, kept in a file, not upset by bad samples."""

from copy import copy
from dataclasses import replace

import jax
import numpy as np
import pytest
from marg_logs import hand, log_of, with_field, with_imu
from scipy.spatial.transform import Rotation

from robins.logs.broad import read_broad
from robins.logs.ordering import rows_where
from robins.systems.marg import LiveMarg, MargReplay, replay
from robins.systems.marg.saturation import GyroRange, levels
from robins.systems.streaming import Flag, LiveError, TimestampGate, refuse_units

PARAMETERS = MargReplay()
RATE_HZ = 100.0
STARTING, BEHIND, REST = Flag.STARTING, Flag.BEHIND, Flag.REST


def made_log(seconds=24.0, seed=0):
    """A hand that lies still for 8 s, then moves; a gap, samples without numbers, a bent field."""
    q, p = hand(24.0, seed)
    log = log_of(q, p, gyro_noise=2e-3, accel_noise=0.02, field_noise=5e-7, seed=seed,
                 gyro_bias=np.radians([0.8, -0.5, 0.6]))  # fmt: skip
    gyro, field = log.imu.gyro.copy(), log.mag.field_t.copy()
    gyro[[700, 1200, 1201]] = np.nan
    field[1400:1500] += [4e-5, 0.0, 0.0]
    field[500:520] = np.nan
    keep = np.ones(len(gyro), bool)
    keep[1600:1640] = False
    keep[1700] = False
    imu = replace(log.imu, time_ns=log.imu.time_ns[keep], gyro=gyro[keep],
                  accel=log.imu.accel[keep])  # fmt: skip
    return part_of(replace(with_field(log, field), imu=imu), 0.0, seconds)


def part_of(log, begin_s, end_s):
    """The log between two times."""
    return replace(
        log,
        imu=rows_where(log.imu, between(log.imu.time_ns, begin_s, end_s)),
        mag=rows_where(log.mag, between(log.mag.time_ns, begin_s, end_s)),
        attitude=None,
    )


def between(time_ns, begin_s, end_s):
    """Which stamps lie there."""
    return (time_ns >= time_ns[0] + begin_s * 1e9) & (time_ns <= time_ns[0] + end_s * 1e9)


def played(live, log, samples=slice(None)):
    """Answers to the samples of a log."""
    read = dict(zip(log.mag.time_ns.tolist(), log.mag.field_t, strict=True))
    rows = zip(log.imu.time_ns.tolist(), log.imu.gyro, log.imu.accel, strict=True)
    return [live.push(t, w, f, read.get(t)) for t, w, f in list(rows)[samples]]


def columns(answers):
    """Attitudes, sigmas and flags of answers."""
    return (
        np.array([a.q_nb for a in answers]),
        np.array([a.sigma_rad for a in answers]),
        np.array([int(a.flags) for a in answers]),
    )


def apart(q, of):
    """Angles between attitudes [rad]."""
    return (Rotation.from_quat(q, scalar_first=True).inv()
            * Rotation.from_quat(of, scalar_first=True)).magnitude()  # fmt: skip


@pytest.fixture(scope="module")
def fresh():
    """A saved object that has heard nothing: loading it is cheaper than to make one."""
    return LiveMarg(PARAMETERS, RATE_HZ)


@pytest.fixture
def live(fresh, tmp_path):
    fresh.save(tmp_path / "fresh.live")
    return LiveMarg.load(tmp_path / "fresh.live")


def compare(log, live, least_us):
    """All answers after the start are those of the replay; returned with its outcome."""
    outcome = replay(log, live.parameters, ("marg",))
    answers = played(live, log)
    q, sigma, flags = columns(answers)
    whole = np.all(np.isfinite(log.imu.gyro), axis=1)
    q, sigma, flags = q[whole], sigma[whole], flags[whole]
    of = outcome.solution["q_nb"].values[0]
    heard = (flags & STARTING) == 0
    assert np.all(np.isnan(q[~heard]))
    assert np.sum(~heard) == least_us
    same = heard & ((flags & BEHIND) == 0)
    assert np.max(apart(q[same], of[same])) < 1e-9
    ends = np.searchsorted(outcome.solution["sample_time"].values, outcome.solution["time"].values)
    at = np.flatnonzero(same[ends[:-1]])  # the last block of a log need not be whole
    stated = outcome.solution["sigma_attitude"].values[0]
    np.testing.assert_allclose(sigma[ends[at]], stated[at], rtol=1e-9)
    still = outcome.solution["rest"].values
    np.testing.assert_array_equal((flags[ends[at]] & REST) > 0, still[at] > 0)
    refused = outcome.solution["magnetic_disturbance"].values[0]
    assert np.all(flags[ends[at]][refused[at] > 0] & Flag.DISTURBED)
    doubted = [f"marg: {one}." for one in live.doubts()]
    assert doubted == [one for one in outcome.warnings if one in doubted or "innovations of" in one]
    return outcome, answers


def test_answers_are_those_of_the_causal_replay_and_restored_ones_too(live, tmp_path):
    log = made_log()
    outcome, answers = compare(log, live, 157)
    for name in ("imu_gaps", "field_implausible", "blocks_in_free_fall", "steps_not_taken"):
        assert live.counts[name] == outcome.counts[name], name
    assert live.counts["imu_nan"] == outcome.counts["imu_missing"] == 3
    assert live.counts["field_missing"] == 20
    # kept in a file before the start, in it, at rest and in motion
    again = LiveMarg(PARAMETERS, RATE_HZ)
    path, begun = tmp_path / "unit.live", 0
    for end in (60, 153, 400, 1203, 1733):
        played(again, log, slice(begun, end))
        again.save(path)
        again, begun = LiveMarg.load(path), end
    rest = played(again, log, slice(begun, None))
    for one, other in zip(rest, answers[begun:], strict=True):
        assert one.flags == other.flags
        np.testing.assert_array_equal(one.q_nb, other.q_nb)
        np.testing.assert_array_equal(one.sigma_rad, other.sigma_rad)
    assert again.counts == live.counts


def test_nothing_is_compiled_for_a_sample(live):
    log, compiled = made_log(14.0), []

    def heard(event, seconds, **told):
        if event == "/jax/core/compile/backend_compile_duration":
            compiled.append(told["fun_name"])

    jax.clear_caches()  # else what another test compiled would not be seen
    played(live, log, slice(0, 300))  # what first_look asks of JAX once is compiled here
    jax.monitoring.register_event_duration_secs_listener(heard)
    try:
        played(live, log, slice(300, None))
        assert compiled == []
        jax.jit(lambda x: x + 2.5)(1.0)
        assert len(compiled) == 1  # it would have been heard
    finally:
        jax.monitoring.unregister_event_duration_listener(heard)


def test_a_start_in_motion_waits_for_three_seconds(live):
    compare(part_of(made_log(20.0, 3), 12.5, 20.0), live, 325)


@pytest.mark.parametrize("told", [True, False])
def test_peaks_beyond_the_range_wait_for_their_flank(told):
    """A stated range: every answer is the replay's, but those that wait for a flank."""
    log = made_log(20.0, 2)
    gyro = log.imu.gyro.copy()
    peak = np.exp(-(((np.arange(len(gyro))[:, None] - [900, 1005, 1104, 1317, 1500]) / 5.0) ** 2))
    gyro[:, 1] = np.clip(gyro[:, 1] + 9.0 * peak.sum(axis=1), -4.0, 4.0)
    log = with_imu(log, gyro=gyro)
    gyro = PARAMETERS.gyro.model_copy(update={"range": 4.0} if told else {})
    live = LiveMarg(PARAMETERS.model_copy(update={"gyro": gyro}), RATE_HZ)
    if told:
        outcome, answers = compare(log, live, 157)
        assert live.counts["imu_bridged"] == outcome.counts["imu_bridged"] > 20
    else:
        outcome, answers = replay(log, PARAMETERS, ("marg",)), played(live, log)
        assert 10 < live.counts["imu_bridged"] < outcome.counts["imu_bridged"]
    flags = columns(answers)[2]
    behind = (flags & BEHIND) > 0
    assert 0 < np.sum(behind) < 5 * 33
    assert np.sum((flags & Flag.SATURATED) > 0) >= (40 if told else 25)


def test_levels_found_sample_by_sample_are_those_of_all_samples_so_far():
    rng = np.random.default_rng(5)
    smooth = np.cumsum(rng.standard_normal((400, 3)), axis=0)
    rate = np.clip(
        smooth + 12.0 * np.sin(np.arange(400) / 7.0)[:, None], [-9.0, -12.0, -50.0], 11.0
    )
    seen = GyroRange()
    found = 0
    for k, row in enumerate(rate):
        seen.read(row)
        if k >= 3:
            np.testing.assert_array_equal(seen.levels, levels(rate[: k + 1]))
            found += np.sum(np.isfinite(seen.levels))
    assert found > 200


# ------------------------------------------------------------------------------------ bad samples


def test_a_sample_of_another_kind_is_refused_and_the_next_one_taken(live):
    still, force, field = np.zeros(3), np.array([0.0, 0.0, -9.81]), np.array([2e-5, 0.0, 4e-5])
    for given, word in (
        ((0.5, still, force), "whole number of nanoseconds"),
        ((True, still, force), "whole number of nanoseconds"),
        ((0, np.zeros(4), force), "gyro: must be 3 real numbers"),
        ((0, still, "down"), "accel: must be 3 real numbers"),
        ((0, still, [0.0, 0.0, None]), "accel: must be 3 real numbers"),
        ((0, still * 1j, force), "gyro: must be 3 real numbers"),
        ((0, still, force, np.zeros(2)), "field: must be 3 real numbers"),
    ):
        with pytest.raises(LiveError, match=word):
            live.push(*given)
    for k in range(300):
        found = live.push(k * 10_000_000, still.astype(np.float32), force.tolist(), field)
    assert found.flags == REST
    assert not any(live.counts.values())


@pytest.mark.parametrize(
    ("rate", "force", "word"),
    [
        ([0.4, 0.0, 0.1], [0.0, 0.0, -9.8], "gyro: reads 0.4 across gravity"),
        ([0.0, 0.0, 90.0], [0.0, 0.0, -9.8], "gyro: reads up to 90"),
        ([0.0, 0.0, 0.0], [0.0, 0.0, -1000.0], "accel: .* gravity in milli-g"),
        ([0.0, 0.0, 4.0], [0.0, 0.0, -9.8], None),  # a turn about the vertical
    ],
)
def test_units_are_judged_as_the_doctor_does(rate, force, word):
    rows = np.tile(rate, (50, 1)), np.tile(force, (50, 1))
    if word is None:
        refuse_units(*rows)
        return
    with pytest.raises(LiveError, match=word):
        refuse_units(*rows)


def test_a_field_in_another_unit_is_refused_and_a_stray_one_counted(live):
    still, force = np.zeros(3), np.array([0.0, 0.0, -9.81])
    told = []
    for k in range(40):
        field = [20.0, 0.0, 43.0] if 5 < k < 16 else [2e-5, 0.0, 4.3e-5 + 0.1 * (k == 3)]
        try:
            live.push(k * 10_000_000, still, force, np.array(field))
        except LiveError as error:
            told.append(str(error))
    assert live.counts["field_implausible"] == 11
    assert len(told) == 1
    assert "field: reads 47.42, which is no field in tesla, but one in uT" in told[0]


@pytest.mark.parametrize(
    ("gyro", "accel", "word"), [(1.0, 1 / 9.81, "in g, not in m/s"), (120.0, 1.0, "in deg/s")]
)
def test_samples_in_other_units_are_told_by_their_size(live, gyro, accel, word):
    rate, force = np.array([0.0, 0.0, 1.0]) * gyro, np.array([0.0, 0.0, -9.81]) * accel
    told = []
    for k in range(1000):
        try:
            live.push(k * 10_000_000, rate * np.sin(k / 9.0), force)
        except LiveError as error:
            told.append(str(error))
    assert 1 <= len(told) <= 8  # once a start is looked for, not at every sample
    assert word in told[0]
    for k in range(1000, 1700):  # right ones are taken, once the others are forgotten
        try:
            found = live.push(k * 10_000_000, 0.0 * rate, force / accel)
        except LiveError as error:
            told.append(str(error))
    assert found.flags == REST
    assert len(told) <= 9


def test_bad_samples_are_counted_and_leave_the_answers_as_if_they_were_not_there(live, tmp_path):
    log = made_log(8.0)
    live.save(tmp_path / "a")
    clean = LiveMarg.load(tmp_path / "a")
    want = {a.time_ns: a for a in played(clean, log)}
    hour, still = 3_600_000_000_000, np.zeros(3)
    spoilt = {
        610: (0, np.full(3, np.nan)),
        620: (0, np.full(3, np.inf)),
        630: (0, np.full(3, 1e9)),
        640: (-10_000_000, still),  # the stamp of the sample before
        650: (-1_000_000_000, still),
        660: (hour, still),
        670: (-hour, still),
    }
    for k, (t, w, f) in enumerate(zip(log.imu.time_ns.tolist(), log.imu.gyro, log.imu.accel,
                                      strict=True)):  # fmt: skip
        if k in spoilt:
            shift, rate = spoilt[k]
            found = live.push(t + shift, rate, f)
            assert found.flags & Flag.REFUSED
            assert np.all(np.isfinite(found.q_nb))
        found = live.push(t, w, f, log.mag.field_t[k])
        np.testing.assert_array_equal(found.q_nb, want[t].q_nb)
    for reason in ("nan", "inf", "absurd", "duplicate", "ahead"):
        assert live.counts[f"imu_{reason}"] == 1 + clean.counts[f"imu_{reason}"], reason
    assert live.counts["imu_backward"] == 2


def test_a_copy_does_not_hear_the_samples_of_its_original(live):
    log = made_log(6.0)
    played(live, log, slice(0, 250))
    other = copy(live)
    of_copy = played(other, log, slice(250, 300))
    counts, of_original = dict(other.counts), played(live, log, slice(250, 300))
    for one, another in zip(columns(of_copy), columns(of_original), strict=True):
        np.testing.assert_array_equal(one, another)
    assert dict(other.counts) == counts == dict(live.counts)


def test_a_clock_that_was_set_is_a_new_start(live):
    log = made_log(6.0)
    played(live, log)
    later = with_imu(log, time_ns=log.imu.time_ns - 3_600_000_000_000)
    flags = columns(played(live, later))[2]
    assert live.counts["begun_anew"] == 1
    assert np.all(flags[:9] & Flag.REFUSED)
    assert np.all(flags[10:160] & STARTING)
    assert flags[-1] == REST


def test_which_stamps_come_in():
    door, fine = TimestampGate(1.0, 3), np.zeros(6)
    ask = lambda seconds: door.check(round(seconds * 1e9), fine)  # noqa: E731
    assert [ask(t) for t in (5.0, 5.1, 5.1, 5.0, 9.0, 5.2, 9.1)] == [
        "", "", "duplicate", "backward", "ahead", "", "ahead",
    ]  # fmt: skip
    # what is refused goes on elsewhere: not the clock of before
    assert [ask(t) for t in (9.2, 9.3, 9.4)] == ["ahead", "anew", ""]


# --------------------------------------------------------------------------------- recorded logs


def test_a_recorded_trial_has_the_answers_of_its_replay(data_dir):
    paths = list(data_dir.glob("broad_07_*.npz"))
    if not paths:
        pytest.skip("this trial is not in the folder of real logs")
    log = part_of(read_broad(paths[0], []), 0.0, 25.0)
    rate_hz = 1e9 / float(np.median(np.diff(log.imu.time_ns)))
    of = replay(log, PARAMETERS, ("marg",)).solution["q_nb"].values[0]
    q, _, flags = columns(played(LiveMarg(PARAMETERS, rate_hz), log))
    heard = (flags & STARTING) == 0
    assert np.mean(heard) > 0.9
    assert np.max(apart(q[heard], of[heard])) < 1e-9


def test_a_state_with_other_attributes_is_refused(live):
    """Attributes that it lacks would stay as they are at the begin."""
    made, (cls, parameters, state) = live.__reduce__()
    del state["parts"]["_path"]["_side"]
    with pytest.raises(ValueError, match="SamplePath differs in _side"):
        made(cls, parameters, state)
