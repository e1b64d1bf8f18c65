"""Live transfer alignment: the steps of a replay for any chunks, late records, refusals, files."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from scipy import stats
from simulated_pair import pair_dataset

from robins import scenario
from robins.filters import Code
from robins.ins.increments import IncrementStream, usual_interval
from robins.systems import replaying
from robins.systems.streaming import Flag, LiveError
from robins.systems.transfer_alignment import LiveAlignment
from robins.systems.transfer_alignment.product import model as pm
from robins.systems.transfer_alignment.product.log import contender, on_one_clock, pieces_of
from robins.systems.transfer_alignment.product.parameters import PairReplay
from robins.systems.transfer_alignment.product.path import PairPath

TEXT = """
lever_arm = ["2 m", "-1 m", "0.5 m"]
filters = ["product"]
[manoeuvre]
kind = "aircraft"
latitude = "32 deg"
longitude = "110 deg"
height = "1000 m"
speed = "100 m/s"
legs = [
  { bank = "0 deg", seconds = "3 s" },
  { bank = "30 deg", seconds = "3 s" },
  { bank = "-30 deg", seconds = "4 s" },
]
[slave]
rate = "50 Hz"
gyro_noise = "0.05 deg/sqrt(h)"
accel_noise = "50 ug/sqrt(Hz)"
gyro_bias = "5 deg/h"
accel_bias = "1 mg"
[master]
attitude_noise = "1 arcmin"
velocity_noise = "0.05 m/s"
delay = "0.03 s"
[mounting]
nominal = ["1 deg", "-2 deg", "90 deg"]
sigma = "0.3 deg"
[start]
attitude = "0.5 deg"
"""
PAIR = scenario.parse(PairReplay, TEXT)
RATE_HZ, LATE_NS = 50.0, 60_000_000
pytestmark = pytest.mark.usefixtures("unchecked")  # some hundred samples, one by one


@pytest.fixture(scope="module")
def log():
    """Rates and specific forces in place of increments; the turn rate of half of the records."""
    dataset = pair_dataset(PAIR, seed=3)
    imu, master = dataset.imu, dataset.master
    middle_ns = imu.time_ns - round(0.5e9 / RATE_HZ)  # where the mean of an interval is the rate
    table = type(imu)(middle_ns, imu.gyro * RATE_HZ, imu.accel * RATE_HZ, "rate")
    rate, v_n = master.omega_ib_b.copy(), master.v_n.copy()
    rate[::2], v_n[40, 1] = np.nan, np.nan
    return replace(dataset, imu=table, master=replace(master, omega_ib_b=rate, v_n=v_n))


@pytest.fixture(scope="module")
def piece(log):
    (found,), _ = pieces_of(*on_one_clock(log), PAIR)
    return found


@pytest.fixture(scope="module")
def made():
    return LiveAlignment(PAIR, RATE_HZ)


@pytest.fixture
def live(made):
    made.start_over()
    return made


def events(log, late_ns=LATE_NS, skipped=()):
    """Arrivals in order: time [ns], zero for a sample and one for a record, and its row."""
    late = np.broadcast_to(late_ns, len(log.master))
    out = [(int(t), 0, k) for k, t in enumerate(log.imu.time_ns)]
    out += [
        (int(t) + int(late[k]), 1, k) for k, t in enumerate(log.master.time_ns) if k not in skipped
    ]
    return sorted(out)


def push(live, log, event):
    _, is_record, k = event
    if not is_record:
        return live.push_imu(int(log.imu.time_ns[k]), log.imu.gyro[k], log.imu.accel[k])
    m = log.master
    place = m.lat_rad[k], m.lon_rad[k], m.alt_m[k]
    return live.push_record(int(m.time_ns[k]), *place, m.v_n[k], m.q_nb[k], m.omega_ib_b[k])


def played(live, log, all_events):
    """The last answer, and those at the epochs."""
    answer, passed = None, []
    for event in all_events:
        answer = push(live, log, event)
        passed += live.passed
    return answer, passed


@pytest.mark.parametrize("size", [1, 7, 1000])
def test_chunks_of_any_size_give_the_bits_of_a_replay(log, piece, size):
    increments, records = on_one_clock(log)
    path, found = PairPath(PAIR, usual_interval(increments[:, 1])), []
    at, imu = None, log.imu
    for begin in range(0, len(imu), size):
        rows = slice(begin, begin + size)
        samples = np.concatenate([imu.gyro[rows], imu.accel[rows]], axis=1)
        path.push(path.imu.push(imu.time_ns[rows], samples))
        here = records[:, 0] <= (imu.time_ns[rows][-1] - imu.time_ns[0]) * 1e-9
        path.push_records(records[here])
        records = records[~here]
        if at is None:
            if (begun := path.start()) is None:
                continue
            at = begun[0], begun[0]
            jax.tree.map(np.testing.assert_array_equal, begun[1], piece.world.start)
        if due := path.due(*at):
            found.append((due, path.steps(at[0], np.array([t for t, _ in due]))))
            at = due[-1]
            path.forget(at[0] - 0.2)
    epochs = np.concatenate([[t for t, _ in due] for due, _ in found])
    assert len(epochs) > len(piece.epoch_s) - 3
    np.testing.assert_array_equal(epochs, piece.epoch_s[: len(epochs)])
    block, master, lag = jax.tree.map(lambda *x: np.concatenate(x), *[s for _, s in found])
    w = piece.world
    of = jax.tree.map(
        lambda a: np.asarray(a)[: len(epochs)], (w.increments, w.noise_scale, w.master, w.lag)
    )
    jax.tree.map(np.testing.assert_array_equal, (*block, master, lag), of)


def test_the_lag_is_that_of_a_simulated_pair(piece):
    of = pm.lag_of(piece.world.increments, PAIR.master.delay, piece.world.master_omega_b)
    assert np.max(np.abs(of.theta)) > 1e-3
    for name in ("dt", "theta", "dv", "omega_m"):  # the first record is from before the start
        one, other = getattr(piece.world.lag, name)[1:], getattr(of, name)[1:]
        np.testing.assert_allclose(one, other, atol=1e-13)


def replayed(piece, name="product"):
    """Velocities and sigmas (E, 21) at the epochs of a replay."""
    answer = replaying.run_filters([piece], (name,), lambda n: contender(PAIR, n))[name]
    return np.concatenate([answer.mean.ins.v_n, np.asarray(answer.sigma)[:, :18]], axis=1)


def test_epochs_are_those_of_the_replay_though_records_come_late(live, log, piece):
    last, passed = played(live, log, events(log))
    found = np.array([np.concatenate([one.v_n, one.sigma]) for one in passed])
    assert len(found) > len(piece.epoch_s) - 3
    stamps = np.round(piece.epoch_s[: len(found)] * 1e9) + log.imu.time_ns[0]
    assert [a.time_ns for a in passed] == stamps.tolist()
    want = replayed(piece)[: len(found)]
    np.testing.assert_allclose(found, want, rtol=1e-9, atol=1e-12)
    assert not live.counts
    assert last.flags == Flag(0)
    assert {one.code for one in last.seen.values()} == {Code.DONE}
    truth, k = log.truth, -1
    assert np.linalg.norm(last.v_n - truth.v_n[k]) < 0.2
    assert abs(last.alt_m - truth.alt_m[k]) < 5.0


def test_a_record_that_comes_after_its_time_is_used_with_the_motion_since(live, log, piece):
    """Records of 2 s come half a second late: as if their delay had been that."""
    late = np.where(np.arange(len(log.master)) // 20 == 2, 500_000_000, LATE_NS)
    last, _ = played(live, log, events(log, late))
    assert live.counts["records_late"] > 10
    want = replayed(piece)[-1]
    off = np.abs(np.concatenate([last.v_n, last.sigma]) - want)
    assert np.all(off[:3] < 3.0 * last.sigma[3:6])
    np.testing.assert_allclose(last.sigma, want[3:], rtol=0.05)
    assert not live.doubts()
    live.start_over()
    thrown, _ = played(live, log, events(log, np.where(late > LATE_NS, 5_000_000_000, late)))
    assert live.counts["master_too_old"] == 20
    assert np.all(thrown.sigma[:3] > last.sigma[:3])


def test_an_outage_of_the_master_is_bridged(live, log):
    _, passed = played(live, log, events(log, skipped=range(50, 70)))
    gone = [a for a in passed if 5_200_000_000 < a.time_ns < 6_900_000_000]
    assert len(gone) >= 6
    assert {one.code for a in gone for one in a.seen.values()} == {Code.MISSING}
    assert np.all(gone[-1].sigma[3:6] > gone[0].sigma[3:6])


def test_a_long_gap_in_the_samples_aligns_again(live, log):
    kept = [e for e in events(log) if e[1] or not 4e9 < log.imu.time_ns[e[2]] < 6e9]
    last, _ = played(live, log, kept)
    assert live.counts["imu_gaps_declared"] == 1
    assert last.flags == Flag(0)


def test_restored_in_between_it_goes_on_to_the_bit(live, log, tmp_path):
    whole = events(log)
    played(live, log, whole[:250])
    live.save(tmp_path / "pod.live")
    again = LiveAlignment.load(tmp_path / "pod.live")
    for event in whole[250:320]:
        one, other = push(live, log, event), push(again, log, event)
        np.testing.assert_array_equal(one.sigma, other.sigma)
        np.testing.assert_array_equal(one.mounting_rad, other.mounting_rad)
        assert (one.flags, one.seen) == (other.flags, other.seen)


def test_bad_records_and_samples_are_refused(live, log):
    whole = events(log)
    assert push(live, log, whole[0]).flags == Flag.STARTING
    played(live, log, whole[1:300])
    m, k = log.master, 45
    t, place, v, q = int(m.time_ns[k]), (0.55, 1.9, 1000.0), m.v_n[k], m.q_nb[k]
    none, last = np.full(3, np.nan), max(e[2] for e in whole[:300] if e[1])
    for given, reason in (
        ((t, *none, none, np.full(4, np.nan)), "nan"),
        ((t - 4_000_000_000, *place, v, q), "too_old"),
        ((t + 60_000_000_000, *place, v, q), "ahead"),
        ((int(m.time_ns[last]), *place, v, q), "duplicate"),
    ):
        assert live.push_record(*given).flags & Flag.REFUSED, reason
        assert live.counts[f"master_{reason}"] == 1
    for given, words in (
        ((t, 32.0, 110.0, 1000.0, v, q), "are no radians"),
        ((t, np.radians(89.95), 1.9, 1000.0, v, q), "not defined at a pole"),
        ((t, *place, v, 2.0 * q), "has the norm 2, not one"),
        ((t, *place, v[:2], q), "v_n: must be 3 real numbers"),
        ((t, *place, v, q, 1.0), "omega_ib_b: must be 3 real numbers"),
    ):
        with pytest.raises(LiveError, match=words):
            live.push_record(*given)
    far = replace(log, master=replace(m, v_n=m.v_n + 100.0))
    _, passed = played(live, far, whole[300:])
    # Huber's rule leaves them the weight at which their NIS is the quantile of 99.9 %
    largest = max(one.seen[pm.VELOCITY].nis for one in passed)
    assert largest == pytest.approx(stats.chi2.ppf(0.999, 3), rel=1e-6)
    assert any("master_velocity" in sentence for sentence in live.doubts())


def test_degrees_per_second_are_refused(log):
    live = LiveAlignment(PAIR, RATE_HZ)
    spin = replace(log.imu, gyro=log.imu.gyro + 200.0)
    with pytest.raises(LiveError, match="no rate in rad/s"):
        played(live, replace(log, imu=spin), events(log))


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"rate_hz": 0.0}, "rate_hz must be positive"),
        ({"rate_hz": 2.0}, "longest_gap, 0.5 s, must be 1.5 sampling intervals"),
        ({"longest_delay_s": -1.0}, "longest_delay_s must be positive"),
        ({"filter": "no"}, "no"),
    ],
)
def test_bad_arguments_are_refused(changed, words):
    with pytest.raises(ValueError, match=words):
        LiveAlignment(PAIR, **({"rate_hz": RATE_HZ} | changed))


def test_a_stream_of_increments_is_that_of_the_whole_table(log):
    stream, imu, found = IncrementStream(0.02), log.imu, []
    samples = np.concatenate([imu.gyro, imu.accel], axis=1)
    for size in (1, 1, 5, 100):
        begin = len(stream.time_ns) and int(np.searchsorted(imu.time_ns, stream.time_ns[-1])) + 1
        rows = slice(begin, begin + size)
        found.append(stream.push(imu.time_ns[rows], samples[rows]))
    want, _ = on_one_clock(log)
    rows = np.concatenate(found)
    np.testing.assert_array_equal(rows, want[: len(rows)])
    assert len(rows) == 105
