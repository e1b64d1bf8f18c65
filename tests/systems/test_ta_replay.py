"""Alignment of recorded pairs whose truth is known: right within its own sigmas, and honest."""

import dataclasses
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from in_lanes import each
from interpreted import run as run_filter
from scipy import stats
from scipy.spatial.transform import Rotation as SciRotation
from simulated_pair import recorded

from robins import logs, scenario
from robins.manifold import local
from robins.results.solution import check
from robins.systems import replaying
from robins.systems.transfer_alignment.product.log import (
    contender,
    on_one_clock,
    orientation,
    pieces_of,
    remarks,
    replay,
    start_belief,
)
from robins.systems.transfer_alignment.product.model import ATTITUDE, VELOCITY
from robins.systems.transfer_alignment.product.parameters import PairReplay
from robins.systems.transfer_alignment.product.study import product_contender
from robins.systems.transfer_alignment.product.world import lay_out, simulate_pair
from robins.workbench import InputError, publish
from robins.workbench import align as align_pair

# Blocks as long as the master's interval: whatever is missing, one shape, so one compilation.
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
  { bank = "40 deg", seconds = "14 s" },
  { bank = "-40 deg", seconds = "18 s" },
  { bank = "0 deg", seconds = "5 s" },
]
[slave]
rate = "50 Hz"
gyro_noise = "0.05 deg/sqrt(h)"
accel_noise = "50 ug/sqrt(Hz)"
gyro_bias = "20 deg/h"
accel_bias = "1 mg"
[master]
rate = "5 Hz"
attitude_noise = "1 arcmin"
velocity_noise = "0.02 m/s"
position_noise = "1 m"
delay = "0.06 s"
[mounting]
nominal = ["1 deg", "-2 deg", "90 deg"]
sigma = "0.3 deg"
[flexure]
sigma = "3 arcmin"
time = "2 s"
[start]
attitude = "0.1 deg"
[believed]
mounting = "0.3 deg"
flexure = { sigma = "3 arcmin", time = "2 s" }
[recording]
longest_block = "0.2 s"
"""
PAIR = scenario.parse(PairReplay, TEXT)
SEVERAL = 8


def read_back(dataset, folder):
    logs.write_log(folder / "master.csv", dataset.master)
    logs.write_log(folder / "slave.csv", dataset.imu)
    return logs.load_pair(folder / "master.csv", folder / "slave.csv")


def simulated(count):
    course = lay_out(PAIR)
    several = each(lambda k: simulate_pair(PAIR, course, 3, k))(np.arange(count))
    return [jax.tree.map(lambda x, k=k: np.asarray(x[k]), several) for k in range(count)]


def written(runs, folder):
    """Each run as it is read from its two files, and cleaned."""
    return [logs.clean(read_back(recorded(run, "made"), folder)) for run in runs]


@pytest.fixture(scope="module")
def runs():
    return simulated(1)


@pytest.fixture(scope="module")
def pairs(runs, tmp_path_factory):
    return written(runs, tmp_path_factory.mktemp("pairs"))


@pytest.fixture(scope="module")
def answers(pairs):
    return [navigated([only_piece(pair)]) for pair in pairs]


@pytest.fixture(scope="module")
def clean(pairs):
    return replay(pairs[0], PAIR)


def navigated(pieces):
    names = ("product",)
    return replaying.run_filters(pieces, names, lambda name: contender(PAIR, name))["product"]


def belief_of(piece):
    """The beliefs at all epochs, of which an answer keeps less."""
    chosen = contender(PAIR, "product")
    case = chosen.case(piece.world)
    found = run_filter(chosen.filter, chosen.model, case.start, case.y, case.u, case.aux)
    return found.steps.posterior


def only_piece(pair):
    (piece,), problems = pieces_of(*on_one_clock(pair), PAIR)
    assert not problems
    return piece


def at(tree, epoch):
    return jax.tree.map(lambda x: x[epoch], tree)


# ------------------------------------------------------------------------- right within its sigmas


def test_errors_are_as_large_as_stated_over_several_pairs(tmp_path):
    """NEES by a dense solve, of the whole state, over all pairs, early and late."""
    runs = simulated(SEVERAL)
    beliefs = [belief_of(only_piece(pair)) for pair in written(runs, tmp_path)]
    for epoch in (1, 60, len(beliefs[0].factor) - 1):
        total, n = 0.0, 24
        for run, of_pair in zip(runs, beliefs, strict=True):
            belief = at(of_pair, epoch)
            e = np.asarray(local(belief.mean, jax.tree.map(jnp.asarray, at(run.truth, epoch))))
            S = np.asarray(belief.factor)
            total += e @ np.linalg.solve(S @ S.T, e)
        low, high = stats.chi2.ppf([0.0005, 0.9995], n * SEVERAL)
        assert low < total < high, epoch


def test_what_is_estimated_is_within_its_sigmas_and_they_have_shrunk(clean, runs):
    found, truth = clean.metrics["product"], at(runs[0].truth, -1)
    arcmin, deg_h, mg = np.deg2rad(1 / 60), np.deg2rad(1 / 3600), 9.80665e-3
    for name, unit, true, before in (
        ("mounting", arcmin, truth.mounting_rad, PAIR.mounting.sigma),
        ("gyro_bias", deg_h, truth.ins.gyro_bias, PAIR.slave.gyro_bias),
        ("accel_bias", mg, truth.ins.accel_bias, PAIR.slave.accel_bias),
    ):
        (estimate,) = (v for k, v in found.items() if k.startswith(name) and "sigma" not in k)
        (sigma,) = (v for k, v in found.items() if k.startswith(f"{name}_sigma"))
        assert np.all(np.abs(np.array(estimate) * unit - true) < 3.5 * np.array(sigma) * unit)
        assert np.all(np.array(sigma) * unit < 0.6 * np.array(before)), name
    for sensor in (ATTITUDE, VELOCITY):
        low, high = found[f"nis_{sensor}_band"]
        assert low < found[f"nis_{sensor}"] < high
        assert found[f"refused_{sensor}"] == 0


def test_innovations_that_contradict_the_sigmas_are_told_with_the_likely_causes(clean, pairs):
    assert clean.warnings == []
    sure = PAIR.master.model_copy(update={"velocity_noise": (2e-3, 2e-3, 2e-3)})
    told = replay(pairs[0], PAIR.model_copy(update={"master": sure})).warnings
    assert told[0].startswith("product: the innovations of 'master_velocity' are larger than")
    assert told[-1].startswith("Likely causes: a delay of the master that is not stated")


def test_the_start_is_correlated_as_its_making_is(pairs):
    piece = only_piece(pairs[0])
    plain = product_contender(PAIR, "product", PAIR.believed).case(piece.world).start
    P = np.asarray(start_belief(plain, PAIR).covariance)
    q = SciRotation.from_quat(np.asarray(piece.world.start.q_nb.wxyz), scalar_first=True)
    C_ns = q.as_matrix()
    C_nm = C_ns @ SciRotation.from_euler("ZYX", PAIR.mounting.nominal[::-1]).as_matrix().T
    P0 = np.asarray(plain.covariance)
    mounting, flexure = P0[15:18, 15:18], P0[18:21, 18:21]
    record = np.diag(np.square(PAIR.master.attitude_noise))
    want = P0[:3, :3] + C_ns @ mounting @ C_ns.T + C_nm @ flexure @ C_nm.T + record
    np.testing.assert_allclose(P[:3, :3], want, atol=1e-18)
    np.testing.assert_allclose(P[:3, 15:18], C_ns @ mounting, atol=1e-18)
    np.testing.assert_allclose(P[:3, 18:21], C_nm @ flexure, atol=1e-18)
    np.testing.assert_allclose(P[3:6, 3:6], np.diag(np.square(PAIR.master.velocity_noise)))
    np.testing.assert_allclose(P[9:, 9:], P0[9:, 9:], rtol=1e-12, atol=1e-20)


def test_the_solution_is_that_of_the_slave(clean, runs):
    solution, truth = clean.solution.sel(filter="product"), runs[0].truth.ins
    # from the second epoch on they are those of the simulation
    q = SciRotation.from_quat(truth.q_nb.wxyz, scalar_first=True)
    heading, pitch, roll = q.as_euler("ZYX").T
    off = solution["estimate_euler"].values - np.stack([roll, pitch, heading], -1)
    off = np.angle(np.exp(1j * off))
    assert np.rad2deg(np.sqrt(np.mean(off[60:] ** 2))) * 60 < 5.0
    wrong = solution["estimate_velocity"].values - truth.v_n
    assert np.sqrt(np.mean(wrong[1:] ** 2)) < 0.05
    assert set(clean.solution["reference_lat_rad"].dims) == {"master_time"}
    check(clean.solution)


# ------------------------------------------------------------------------------- faults of the log


def changed(dataset, rows=None, **arrays):
    """The pair with other arrays in its master, or with only some of its records."""
    master = replace(dataset.master, **{k: v.copy() for k, v in arrays.items()})
    if rows is not None:
        kept = {
            f.name: getattr(master, f.name)[rows]
            for f in dataclasses.fields(master)
            if isinstance(getattr(master, f.name), np.ndarray)
        }
        master = replace(master, **kept)
    return logs.clean(replace(dataset, master=master))


def spoil(dataset, kind, k=90):
    m = dataset.master
    if kind == "order":  # a duplicate and a step back
        return changed(dataset, rows=np.insert(np.arange(len(m)), k, [k - 1, k - 20]))
    v_n, q_nb = m.v_n.copy(), m.q_nb.copy()
    v_n[k] = float(kind)
    q_nb[k, : 1 if kind == "inf" else 4] = float(kind)
    return changed(dataset, v_n=v_n, q_nb=q_nb)


@pytest.mark.parametrize("kind", ["nan", "inf"])
def test_a_bad_record_is_as_good_as_none_and_counted(pairs, kind):
    spoilt = spoil(pairs[0], kind)
    assert spoilt.counts[f"master_{kind}"] == 1
    rows = np.delete(np.arange(len(pairs[0].master)), 90)
    absent = replay(changed(pairs[0], rows=rows), PAIR)
    found = replay(spoilt, PAIR)
    assert found.counts[f"master_{kind}"] == 1
    for name in ("estimate_mounting", "sigma_mounting", "estimate_gyro_bias"):
        got, want = (o.solution[name].values[0, -1] for o in (found, absent))
        np.testing.assert_allclose(got, want, rtol=1e-6, atol=1e-12)


def test_records_out_of_order_change_nothing(pairs, clean):
    spoilt = spoil(pairs[0], "order")
    assert (spoilt.counts["master_duplicate"], spoilt.counts["master_backward"]) == (1, 1)
    found = replay(spoilt, PAIR)
    for name, array in clean.solution.data_vars.items():
        np.testing.assert_array_equal(found.solution[name].values, array.values, err_msg=name)


def test_an_outlying_record_does_little_harm(pairs, clean):
    q_nb = pairs[0].master.q_nb.copy()
    turn = SciRotation.from_rotvec([0.0, 0.0, 0.1])  # 344 arcmin
    struck = turn * SciRotation.from_quat(q_nb[90], scalar_first=True)
    q_nb[90] = struck.as_quat(scalar_first=True)
    found = replay(changed(pairs[0], q_nb=q_nb), PAIR)
    off = found.solution["estimate_mounting"] - clean.solution["estimate_mounting"]
    assert np.max(np.abs(off.values[0, -1]) / clean.solution["sigma_mounting"].values[0, -1]) < 0.5


def test_an_outage_of_the_master_is_lived_through(pairs):
    t = pairs[0].master.time_ns * 1e-9
    outage = (t > 12.0) & (t < 17.0)
    outcome = replay(changed(pairs[0], rows=np.flatnonzero(~outage)), PAIR)
    time = outcome.solution.time.values
    sigma = outcome.solution["sigma_velocity"].values[0, :, 0]
    begin, end = np.searchsorted(time, [12.0, 16.9])
    assert sigma[end] > 2.0 * sigma[begin]
    assert np.all(np.isfinite(sigma))
    found = outcome.metrics["product"]
    low, high = found[f"nis_{ATTITUDE}_band"]
    assert low < found[f"nis_{ATTITUDE}"] < high


def test_a_long_gap_of_the_slave_is_declared_and_the_pieces_are_joined(pairs, answers, monkeypatch):
    imu, t = pairs[0].imu, pairs[0].imu.time_ns * 1e-9
    keep = (t < 19.61) | (t > 20.51)
    arrays = {f: getattr(imu, f)[keep] for f in ("time_ns", "gyro", "accel", "rows")}

    def instead(piece, contender, smoothed):  # of a compilation for each piece's shape
        answer = until(answers[0], len(piece.epoch_s))
        return answer, answer

    monkeypatch.setattr(replaying, "_piece_estimates", instead)
    outcome = replay(logs.clean(replace(pairs[0], imu=replace(imu, **arrays))), PAIR)
    assert outcome.counts["imu_gaps_declared"] == 1
    assert len([n for n in outcome.notes if n.startswith("Aligned from")]) == 2
    rows = outcome.solution["estimate_mounting"].values[0]
    assert np.sum(np.isnan(rows).all(axis=1)) == 1
    assert np.all(np.diff(outcome.solution.time.values) > 0)
    check(outcome.solution)


# ------------------------------------------------------------------------------ what it says of it


def test_what_the_motion_does_not_show_is_said(answers, clean):
    """A straight part, 3 s long: a mounting error and one of attitude are the same."""
    early = until(answers[0], 12)
    (said,) = [n for n in remarks("product", early) if "mounting" in n]
    assert "product: mounting" in said
    assert "down" in said
    assert "hardly observed" in said
    assert not [n for n in clean.notes if "hardly observed" in n]


def until(answer, epoch):
    kept = at((answer.mean, answer.sigma, answer.updates), slice(0, epoch))
    return answer._replace(mean=kept[0], sigma=kept[1], updates=kept[2])


def test_a_mounting_far_from_nominal_is_found_and_remarked(runs, pairs):
    """The nominal mounting stated 7 deg wrong: a whole rotation is estimated, not a small angle."""
    settings = ('mounting.nominal=["1 deg", "-2 deg", "97 deg"]', 'believed.mounting="5 deg"')
    wrong = scenario.parse(PairReplay, TEXT, settings)
    outcome = replay(pairs[0], wrong)
    (said,) = [n for n in outcome.notes if "from its nominal mounting" in n]
    assert "Models of first order do not hold beyond 5 deg" in said
    nominal = [SciRotation.from_euler("ZYX", p.mounting.nominal[::-1]) for p in (PAIR, wrong)]
    true = nominal[0] * SciRotation.from_rotvec(runs[0].truth.mounting_rad[-1].copy())
    solution = outcome.solution
    found = nominal[1] * SciRotation.from_rotvec(solution["estimate_mounting"].values[0, -1])
    sigma = np.linalg.norm(solution["sigma_mounting"].values[0, -1])
    assert (found.inv() * true).magnitude() < 3.0 * sigma


def test_the_doctor_sees_the_slave_along_the_axes_of_the_master(pairs):
    turn = logs.Mounting(*np.degrees(orientation(PAIR)))
    turned = replace(pairs[0], imu=turn.turn(pairs[0].imu))
    codes = {f.code for f in logs.examine(turned) if f.severity != "note"}
    assert not codes & {"gyro_axes", "gyro_unit", "turning_disagrees", "left_handed"}
    assert "gyro_axes" in {f.code for f in logs.examine(pairs[0])}
    (late,) = [f for f in logs.examine(turned) if f.code == "master_late"]
    assert late.severity == "error"
    assert late.value == pytest.approx(PAIR.master.delay, abs=0.003)


def test_the_doctor_has_nothing_to_say_of_healthy_pairs_with_their_delay_stated(pairs):
    turn = logs.Mounting(*np.degrees(orientation(PAIR)))
    for pair in pairs:
        turned = replace(pair, imu=turn.turn(pair.imu), master_delay_s=PAIR.master.delay)
        assert logs.examine(turned) == []
        heading, pitch, roll = (
            SciRotation.from_quat(pair.master.q_nb, scalar_first=True).as_euler("ZYX").T
        )
        ccw = SciRotation.from_euler("ZYX", np.stack([-heading, pitch, roll], -1))
        master = replace(pair.master, q_nb=ccw.as_quat(scalar_first=True))
        (told,) = logs.examine(replace(turned, master=master))
        assert told.code == "attitude_sign"
        assert "counted counterclockwise" in told.sentence


def test_a_filter_that_is_not_there_is_named(pairs):
    with pytest.raises(ValueError, match="no filter 'ghost'"):
        replay(pairs[0], PAIR, ("ghost",))


# ------------------------------------------------------------------------------------ the command


@pytest.fixture(scope="module")
def files(runs, tmp_path_factory):
    folder = tmp_path_factory.mktemp("files")
    dataset = recorded(runs[0], "made")
    read_back(dataset, folder)
    late = replace(dataset.imu, time_ns=dataset.imu.time_ns + 10**13)
    logs.write_log(folder / "late.csv", late)
    (folder / "mine.toml").write_text('system = "transfer-alignment"\nstudy = "product"\n' + TEXT)
    return folder


def test_the_attitude_of_the_slave_is_told_as_angles_and_as_a_quaternion(clean, pairs):
    assert clean.solution.attrs["origin_ns"] == pairs[0].imu.time_ns[0]
    q = SciRotation.from_quat(clean.solution["q_nb"].values[0], scalar_first=True)
    angles = clean.solution["estimate_euler"].values[0, :, ::-1]
    assert (q.inv() * SciRotation.from_euler("ZYX", angles)).magnitude().max() < 1e-9


@pytest.mark.usefixtures("sketched")
def test_two_files_become_a_result_with_figures_and_a_page(files, clean):
    heard, pair = [], (files / "master.csv", files / "slave.csv")
    mine, settings = str(files / "mine.toml"), ('title="Mine"',)
    outcome = align_pair(mine, *pair, settings=settings, findings=heard.extend)
    result = publish(outcome, files / "result")
    assert result.summary["scenario"] == "transfer-alignment/slave"
    found, want = result.summary["filters"]["product"], clean.metrics["product"]
    assert found["mounting_arcmin"] == pytest.approx(want["mounting_arcmin"])
    assert found["nis_master_attitude_band"] == pytest.approx(want["nis_master_attitude_band"])
    assert {"estimate_mounting", "estimate_gyro_bias", "innovation_master_attitude"} <= set(
        result.figures
    )
    assert "Mounting" in result.report.read_text("utf-8")
    assert [f.code for f in heard if f.severity == "error"] == []
    assert "Aligned from" in outcome.notes[0]


def refused(files, name=None, master="master.csv", slave="slave.csv", settings=()):
    named = str(name or files / "mine.toml")
    with pytest.raises((InputError, logs.LogError)) as caught:
        align_pair(named, files / master, files / slave, settings=settings)
    return str(caught.value)


def test_what_cannot_be_aligned_is_told_in_a_sentence(files):
    told = refused(files, "transfer-alignment/s0")
    assert "study 'attitude-matching'; what can is transfer-alignment, study 'product'" in told
    assert "drive cannot be given a recorded master" in refused(files, "ins-gnss/drive")
    assert "were master and slave exchanged" in refused(files, master="slave.csv")
    text = (files / "slave.csv").read_text()
    (files / "no_axis.csv").write_text(text.replace("dtheta_y_rad,", "yaw_rate,"))
    told = refused(files, slave="no_axis.csv")
    assert "lacks dtheta_y_rad or dtheta_y_deg; it has time_s, dtheta_x_rad" in told
    (files / "degrees.csv").write_text(text.replace("_rad", "_deg"))
    told = refused(files, slave="degrees.csv")
    assert "the gyros do not turn as the attitudes of master.csv do" in told
    assert "no common time" in refused(files, slave="late.csv")
    told = refused(files, settings=('master.delay="0 s"',))
    assert "older than their stamps, judged by the gyros of slave.csv" in told
    assert 'State that: master.delay = "0.06' in told
