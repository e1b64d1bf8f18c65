"""A simulated pair written as two files and read back is the same pair."""

import dataclasses
from dataclasses import replace

import jax
import numpy as np
import pytest
from simulated_pair import pair_dataset, recorded

from robins import logs, scenario
from robins.ins.mechanise import Nav, nav_at
from robins.manifold import local
from robins.rotation import Rotation
from robins.systems.transfer_alignment.product.log import on_one_clock, pieces_of
from robins.systems.transfer_alignment.product.parameters import PairReplay
from robins.systems.transfer_alignment.product.world import lay_out, simulate_pair

TEXT = """
lever_arm = ["2 m", "-1 m", "0.5 m"]
[manoeuvre]
kind = "aircraft"
latitude = "32 deg"
longitude = "110 deg"
height = "1000 m"
speed = "100 m/s"
pitch = "2 deg"
legs = [
  { bank = "0 deg", seconds = "3 s" },
  { bank = "30 deg", seconds = "6 s" },
  { bank = "-30 deg", seconds = "6 s" },
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
position_noise = "1 m"
[mounting]
nominal = ["1 deg", "-2 deg", "90 deg"]
sigma = "0.3 deg"
[flexure]
sigma = "2 arcmin"
time = "2 s"
[start]
attitude = "0.5 deg"
"""


def parameters(*settings):
    return scenario.parse(PairReplay, TEXT, settings)


PAIR = parameters()


@pytest.fixture(scope="module")
def simulated():
    """Runs of the pair by their number."""
    course = lay_out(PAIR)
    return jax.jit(lambda k: simulate_pair(PAIR, course, 5, k))


@pytest.fixture(scope="module")
def run(simulated):
    return simulated(0)


@pytest.fixture(scope="module")
def log(run, tmp_path_factory):
    """The pair as it is read from two files."""
    folder = tmp_path_factory.mktemp("pair")
    dataset = recorded(run, "made")
    logs.write_log(folder / "master.csv", dataset.master)
    logs.write_log(folder / "slave.csv", dataset.imu)
    return logs.load_pair(folder / "master.csv", folder / "slave.csv")


def only_piece(dataset, pair=PAIR):
    pieces, problems = pieces_of(*on_one_clock(logs.clean(dataset)), pair)
    assert not problems
    (piece,) = pieces
    return piece


def rows_used(piece, dataset):
    """Row (E,) of the master's record at each epoch, -1 where there is none."""
    at = (dataset.master.time_ns - dataset.imu.time_ns[0]) * 1e-9
    rows = np.argmin(np.abs(at - piece.epoch_s[:, None]), axis=1)
    return np.where(np.abs(at[rows] - piece.epoch_s) < 1e-9, rows, -1)


def test_what_is_read_back_is_what_was_simulated(run, log):
    piece = only_piece(log)
    # the first record, at the end of the first epoch, is where the slave starts from
    assert piece.begin_s == pytest.approx(0.1)
    np.testing.assert_array_equal(rows_used(piece, log), np.arange(1, 150))
    for name in ("theta", "dv", "dt"):
        got, wanted = getattr(piece.world.increments, name), getattr(run.increments, name)
        width = wanted.shape[1]
        np.testing.assert_allclose(got[:, :width], np.asarray(wanted)[1:], rtol=0, atol=1e-12)
        assert not np.any(got[:, width:])
    np.testing.assert_array_equal(piece.world.master.v_n, np.asarray(run.master.v_n)[1:])
    np.testing.assert_array_equal(piece.world.master_omega_b, np.asarray(run.master_omega_b)[1:])
    off = jax.vmap(Rotation.local)(piece.world.master.q_nb, Rotation(run.master.q_nb.wxyz[1:]))
    assert np.max(np.abs(off)) < 1e-14
    assert np.max(np.abs(piece.world.master.position.lat - run.master.position.lat[1:])) < 1e-15


def test_a_log_of_a_run_is_that_run_of_the_campaign(run, simulated):
    again = pair_dataset(PAIR, seed=5)
    np.testing.assert_array_equal(again.master.v_n, run.master.v_n)
    np.testing.assert_array_equal(again.truth.q_nb, run.truth.ins.q_nb.wxyz)
    assert not np.allclose(again.master.v_n, simulated(1).master.v_n, atol=1e-3)


QUIET = (
    *('master.attitude_noise="0 deg"', 'master.velocity_noise="0 m/s"'),
    *('master.position_noise="0 m"', 'mounting.sigma="0 deg"', 'flexure.sigma="0 deg"'),
)


@pytest.mark.parametrize("delay", ["0 s", "0.14 s"])
def test_the_slave_starts_where_the_record_was_true(delay):
    pair = parameters(*QUIET, f'master.delay="{delay}"')
    dataset = pair_dataset(pair, 1)
    silent = replace(dataset, master=replace(dataset.master, omega_ib_b=None))
    piece, without_rates = only_piece(dataset, pair), only_piece(silent, pair)
    # the gyros are off by 5 deg/h and noise, and mean over a sample to either side of the record
    told, found = (p.world.master_omega_b[:-1] for p in (piece, without_rates))
    assert np.sqrt(np.mean(told**2)) > 0.03
    assert np.sqrt(np.mean((found - told) ** 2)) < 5e-4
    assert np.max(np.abs(local(piece.world.start, without_rates.world.start))) < 2e-4
    k = int(np.flatnonzero(np.isfinite(dataset.master.v_n[:, 0]))[0])
    assert piece.begin_s == pytest.approx(dataset.master.time_ns[k] * 1e-9 - pair.master.delay)
    # before 3 s the flight is straight, so the true slave there lies on a line between epochs
    epoch_s = dataset.truth.time_ns * 1e-9
    early, late = (nav_at(dataset.truth, j) for j in (0, 1))
    back = (piece.begin_s - epoch_s[0]) / (epoch_s[1] - epoch_s[0])
    true = Nav(early.q_nb, *jax.tree.map(lambda a, b: a + back * (b - a), early[1:], late[1:]))
    off = np.asarray(local(piece.world.start, true))
    assert np.max(np.abs(off[:3])) < 2e-5  # the frame turns with the Earth meanwhile
    assert np.max(np.abs(off[3:6])) < 2e-3
    assert np.max(np.abs(off[6:])) < 1e-3


def test_outages_of_the_master_leave_steps_without_a_record(log):
    keep = (log.master.time_ns < 5e9) | (log.master.time_ns > 7e9)
    rows = np.flatnonzero(keep)
    master = log.master
    fields = ("time_ns", "lat_rad", "lon_rad", "alt_m", "v_n", "q_nb", "omega_ib_b", "rows")
    short = replace(master, **{f: getattr(master, f)[rows] for f in fields})
    piece = only_piece(replace(log, master=short))
    silent = (piece.epoch_s > 5.0) & (piece.epoch_s < 7.0)
    assert np.max(np.diff(piece.epoch_s)) <= 0.25 + 1e-9
    assert np.isnan(piece.world.master.v_n[silent]).all()
    assert np.isfinite(piece.world.master_omega_b).all()
    used = rows_used(piece, replace(log, master=short))
    assert np.all(used[silent] == -1)
    np.testing.assert_array_equal(used[used >= 0], np.arange(1, len(rows)))


def test_missing_components_stay_missing_and_the_start_waits(log):
    v_n = log.master.v_n.copy()
    v_n[:4, 1] = np.nan
    v_n[9, 2] = np.nan
    piece = only_piece(replace(log, master=replace(log.master, v_n=v_n)))
    assert piece.begin_s == pytest.approx(0.5)
    here = int(np.flatnonzero(rows_used(piece, log) == 9)[0])
    np.testing.assert_array_equal(np.isnan(piece.world.master.v_n[here]), [False, False, True])
    assert np.isfinite(piece.world.master.q_nb.wxyz[here]).all()


def without_samples(dataset, begin_s, end_s):
    t = dataset.imu.time_ns * 1e-9
    keep = (t <= begin_s) | (t >= end_s)
    imu = dataset.imu
    kept = {f: getattr(imu, f)[keep] for f in ("time_ns", "gyro", "accel", "rows")}
    return replace(dataset, imu=replace(imu, **kept))


def test_a_short_gap_is_bridged_with_noise_and_a_long_one_divides_the_log(log):
    piece = only_piece(without_samples(log, 8.0, 8.2))
    assert set(np.asarray(piece.world.noise_scale)) == {1.0, 30.0}
    struck = (piece.epoch_s > 8.0) & (piece.epoch_s < 8.21)
    np.testing.assert_array_equal(piece.world.noise_scale > 1.0, struck)
    # lift goes on through the gap, 0.2 s of more than 9.8 m/s^2
    bridged, true = (
        float(p.world.increments.dv[struck, :, 2].sum()) for p in (piece, only_piece(log))
    )
    assert bridged == pytest.approx(true, abs=0.02)
    assert true < -1.9
    pieces, _ = pieces_of(*on_one_clock(logs.clean(without_samples(log, 8.0, 9.0))), PAIR)
    assert [len(pieces), pieces[0].epoch_s[-1]] == [2, pytest.approx(8.0)]
    assert pieces[1].begin_s == pytest.approx(9.0)
    assert np.all(pieces[1].world.noise_scale == 1.0)


def test_a_pair_that_cannot_be_aligned_says_why(log):
    def refused(words, **changes):
        with pytest.raises(ValueError, match=words):
            pieces_of(*on_one_clock(logs.clean(replace(log, **changes))), PAIR)

    refused("this log has none", master=None)
    late = replace(log.master, time_ns=log.master.time_ns + 10**12)
    refused("the slave spans 0 to 15.0 s, the master 1000.1 to 1015.0 s", master=late)
    blind = replace(log.master, q_nb=np.full_like(log.master.q_nb, np.nan))
    refused("no record of the master with position, velocity and attitude", master=blind)
    polar = replace(log.master, lat_rad=np.full_like(log.master.lat_rad, np.deg2rad(89.95)))
    refused("not defined there", master=polar)
    alone = {f.name: getattr(log.master, f.name) for f in dataclasses.fields(log.master)}
    alone = {k: v[:1] if isinstance(v, np.ndarray) else v for k, v in alone.items()}
    refused("no record after the first whole one", master=replace(log.master, **alone))
