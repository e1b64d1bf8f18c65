"""Replay of a simulated log, whose truth is known, clean and with every kind of bad sample."""

import re
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from robins import logs, scenario
from robins.dataset import Dataset
from robins.earth import Geodetic, earth_rate_n
from robins.ins.blocks import gained_in_window
from robins.ins.frames import turned
from robins.ins.state import InsState
from robins.program import BuildError
from robins.rotation import Rotation as Attitude
from robins.systems import ins_gnss
from robins.systems.ins_gnss import SYSTEM, Drive, InsGnssReplay, drive_dataset
from robins.systems.ins_gnss import replay as replay_log
from robins.systems.ins_gnss.model import Mount, read_position
from robins.systems.ins_gnss.recording import axes_of, in_body_axes, on_one_clock
from robins.workbench import replay as replay_files

DRIVE = """
system = "ins-gnss"
imu_rate = "50 Hz"
[place]
latitude = "48 deg"
longitude = "11.5 deg"
height = "520 m"
heading = "30 deg"
[imu]
gyro_noise = "0.15 deg/sqrt(h)"
accel_noise = "0.06 m/s/sqrt(h)"
gyro_bias = "20 deg/h"
accel_bias = "2 mg"
gyro_bias_walk = "4 deg/h/sqrt(h)"
accel_bias_walk = "0.05 mg/sqrt(h)"
[gnss]
sigma = ["0.5 m", "0.5 m", "1 m"]
velocity_sigma = "0.05 m/s"
lever_arm = ["0.5 m", "-0.2 m", "-1 m"]
[update]
longest_block = "0.5 s"
[[legs]]
do = "stop"
seconds = "5 s"
[[legs]]
do = "accelerate"
seconds = "6 s"
speed = "12 m/s"
[[legs]]
do = "turn"
angle = "90 deg"
rate = "12 deg/s"
[[legs]]
do = "straight"
seconds = "8 s"
[[legs]]
do = "turn"
angle = "-140 deg"
rate = "15 deg/s"
[[legs]]
do = "straight"
seconds = "15 s"
"""
CONFIGURATION = (
    DRIVE[DRIVE.index("[imu]") : DRIVE.index("[gnss]")]
    + """
[gnss]
lever_arm = ["0.5 m", "-0.2 m", "-1 m"]
[start]
tilt = "0.5 deg"
heading = "3 deg"
course_speed = "4 m/s"
[aids]
zero_velocity = false
"""
)
FIX_RATE_S = 1.0
BOTH = ("ekf", "ekf+rts")  # as most replays: what was compiled for one serves the others


@pytest.fixture(scope="module")
def drive():
    return scenario.parse(Drive, DRIVE)


@pytest.fixture(scope="module")
def log(drive):
    return drive_dataset(drive, seed=3)


def configuration(*settings):
    return scenario.parse(InsGnssReplay, CONFIGURATION, settings)


@pytest.fixture(scope="module")
def clean_outcome(log):
    return replay_log(logs.clean(log), configuration(), BOTH)


def _error(outcome, log, name):
    """Antenna position errors north and east against the truth [m]."""
    s = outcome.solution.sel(filter=name)
    time_ns = np.round(s.time.values * 1e9).astype(np.int64)
    at = np.searchsorted(log.truth.time_ns, time_ns - 5_000_000)
    keep = np.abs(log.truth.time_ns[at] - time_ns) < 1000
    lat, lon = log.truth.lat_rad[at][keep], log.truth.lon_rad[at][keep]
    north = (s.lat_rad.values[keep] - lat) * 6.37e6
    east = (s.lon_rad.values[keep] - lon) * 6.37e6 * np.cos(lat)
    return np.hypot(north, east)


def test_the_filter_is_far_better_than_the_fixes_and_the_smoother_better_still(clean_outcome, log):
    metrics = clean_outcome.metrics
    # the antenna is half a metre from the truth's point; the fixes scatter by 0.7 m across
    assert np.sqrt(np.mean(_error(clean_outcome, log, "ekf") ** 2)) < 0.54 + 0.35
    assert metrics["ekf"]["nis_gnss_position_band"][0] < metrics["ekf"]["nis_gnss_position"]
    assert metrics["ekf"]["nis_gnss_position"] < metrics["ekf"]["nis_gnss_position_band"][1]
    sigma = clean_outcome.solution["sigma_attitude"]
    heading = sigma.sel(filter="ekf", axis_attitude="down").values
    smoothed = sigma.sel(filter="ekf+rts", axis_attitude="down").values
    assert heading[-1] < 0.5 * heading[0]
    assert np.all(smoothed <= heading * (1 + 1e-9))


def test_without_an_interpreter_jax_computes_the_same_and_it_is_said(
    clean_outcome, log, monkeypatch
):
    def none():
        raise BuildError("there is no C++ compiler")

    monkeypatch.setattr("robins.program.scanned.interpreter_of_one", none)
    by_jax = replay_log(logs.clean(log), configuration(), ("ekf",))
    assert by_jax.notes == [
        *clean_outcome.notes,
        "ekf: computed by JAX, which compiles first, as there is no C++ compiler",
    ]
    for name, array in by_jax.solution.data_vars.items():
        want = clean_outcome.solution.sel(filter=["ekf"])[name].values
        scale = np.nanmax(np.abs(want), initial=1e-300)
        np.testing.assert_allclose(array.values, want, rtol=0, atol=1e-11 * scale, err_msg=name)


def test_the_attitude_is_told_as_angles_and_as_a_quaternion(clean_outcome, log):
    solution = clean_outcome.solution
    assert solution.attrs["origin_ns"] == log.imu.time_ns[0]
    assert solution["q_nb"].attrs["frame"] == "FRD to NED"
    for name in ("ekf", "ekf+rts"):
        q = Rotation.from_quat(solution["q_nb"].sel(filter=name).values, scalar_first=True)
        angles = solution["estimate_euler"].sel(filter=name).values[:, ::-1]
        assert (q.inv() * Rotation.from_euler("ZYX", angles)).magnitude().max() < 1e-9


def test_a_lever_arm_told_with_the_log_is_that_of_the_configuration(log, clean_outcome):
    told = replace(logs.clean(log), lever_arm_b_m=(0.5, -0.2, -1.0))
    for settings in ((), ('gnss.lever_arm="0 m"',)):
        outcome = replay_log(told, configuration(*settings), BOTH)
        here = outcome.solution.lat_rad.sel(filter="ekf").values
        np.testing.assert_array_equal(here, clean_outcome.solution.lat_rad.sel(filter="ekf").values)
    other = replace(told, lever_arm_b_m=(0.5, 0.2, -1.0))
    with pytest.raises(
        ValueError, match=r"loaded with a lever arm of .* gnss.lever_arm is .*; give"
    ):
        replay_log(other, configuration(), BOTH)


def test_a_replay_that_contradicts_its_sigmas_ends_with_the_likely_causes(log, clean_outcome):
    assert clean_outcome.warnings == []
    sure = replace(log, gnss=replace(log.gnss, sigma_m=0.05 * log.gnss.sigma_m))
    outcome = replay_log(logs.clean(sure), configuration(), BOTH)
    refused = outcome.metrics["ekf"]["refused_gnss_position"]
    assert refused > len(log.gnss) / 3
    told = rf"ekf: {refused} of \d+ measurements of 'gnss_position' were refused"
    assert any(re.match(told, warning) for warning in outcome.warnings), outcome.warnings
    assert outcome.warnings[-1].startswith("Likely causes: the lever arm or the latency")


def test_every_fix_falls_on_an_epoch_of_its_own_time(log):
    parameters = configuration()
    whole = on_one_clock(log, parameters)
    assert np.max(whole.increments.dt) < parameters.update.longest_gap
    assert np.all(np.diff(whole.gnss_s) == pytest.approx(FIX_RATE_S, abs=1e-9))


def rows_of(imu, rows):
    return replace(imu, **{f: getattr(imu, f)[rows] for f in ("time_ns", "gyro", "accel")})


@pytest.mark.parametrize("where", [0.0, 0.31, 0.77, 1.0])
@pytest.mark.parametrize(
    ("reason", "spoil"),
    [
        ("imu_nan", lambda t, k: t.gyro.__setitem__((k, 1), np.nan)),
        ("imu_inf", lambda t, k: t.accel.__setitem__((k, 2), -np.inf)),
        ("imu_absurd", lambda t, k: t.accel.__setitem__((k, 0), 1e308)),
    ],
)
def test_a_bad_sample_is_as_if_it_were_absent(log, where, reason, spoil):
    k = round(where * (len(log.imu) - 1))
    imu = replace(log.imu, gyro=log.imu.gyro.copy(), accel=log.imu.accel.copy())
    spoil(imu, k)
    absent = rows_of(log.imu, np.arange(len(imu)) != k)
    cleaned = logs.clean(replace(log, imu=imu))
    assert cleaned.counts[reason] == 1
    for field in ("time_ns", "gyro", "accel"):
        np.testing.assert_array_equal(getattr(cleaned.imu, field), getattr(absent, field))


def test_an_inserted_duplicate_and_a_step_back_change_nothing(log, clean_outcome):
    k = 700
    rows = np.insert(np.arange(len(log.imu)), k, [k - 1, k - 40])
    cleaned = logs.clean(replace(log, imu=rows_of(log.imu, rows)))
    assert cleaned.counts["imu_duplicate"] == 1
    assert cleaned.counts["imu_backward"] == 1
    outcome = replay_log(cleaned, configuration(), BOTH)
    assert outcome.counts["imu_backward"] == 1
    for name, array in clean_outcome.solution.data_vars.items():
        np.testing.assert_array_equal(outcome.solution[name].values, array.values, err_msg=name)


def test_an_outlying_fix_is_refused_and_said(log, clean_outcome):
    lat = log.gnss.lat_rad.copy()
    lat[30] += 1e-3  # six kilometres
    spoilt = replace(log, gnss=replace(log.gnss, lat_rad=lat))
    outcome = replay_log(logs.clean(spoilt), configuration(), BOTH)
    assert outcome.metrics["ekf"]["refused_gnss_position"] == 1
    clean = clean_outcome.metrics["ekf"]
    assert clean["refused_gnss_position"] == 0
    # a lone fix left out changes the end of the path by much less than its own sigma
    here = outcome.solution["lat_rad"].values[0, -1]
    there = clean_outcome.solution["lat_rad"].values[0, -1]
    assert abs(here - there) * 6.37e6 < 0.1


def test_a_missing_component_leaves_the_others_in_use(log):
    alt = log.gnss.alt_m.copy()
    alt[30] = np.nan
    outcome = replay_log(
        logs.clean(replace(log, gnss=replace(log.gnss, alt_m=alt))), configuration(), BOTH
    )
    dof = outcome.solution["nis_dof_gnss_position"].values[0]
    assert np.sum(dof == 2) == 1
    assert np.all(np.isfinite(outcome.solution["lat_rad"].values))


def _without(log, begin_s, end_s):
    t = log.imu.time_ns * 1e-9
    return logs.clean(replace(log, imu=rows_of(log.imu, (t < begin_s) | (t > end_s))))


def test_a_short_gap_is_bridged_with_more_noise_and_a_long_one_declared(log):
    short = replay_log(_without(log, 20.0, 20.3), configuration(), BOTH)
    assert short.counts["imu_gaps_declared"] == 0
    assert short.counts["blocks_over_imu_gaps"] >= 1
    assert np.all(np.isfinite(short.solution["lat_rad"].values))
    begin_s, end_s = 29.0, 31.9  # in the middle: pieces of one length are compiled once
    long = replay_log(_without(log, begin_s, end_s), configuration(), ("ekf",))
    assert long.counts["imu_gaps_declared"] == 1
    lat = long.solution["lat_rad"].values[0]
    assert np.sum(np.isnan(lat)) == 1, "one epoch of NaN breaks the curve at the gap"
    starts = [note for note in long.notes if note.startswith("Start:")]
    assert len(starts) == 2, "each piece says how it was aligned"
    assert np.max(np.diff(long.solution.time.values)) > end_s - begin_s


def test_a_log_without_hope_says_why(log):
    with pytest.raises(ValueError, match="has none"):
        replay_log(replace(log, gnss=None), configuration())
    late = replace(log.gnss, time_ns=log.gnss.time_ns + 10**12)
    with pytest.raises(ValueError, match="same time scale"):
        replay_log(replace(log, gnss=late), configuration())
    with pytest.raises(ValueError, match="no filter 'ghost'"):
        replay_log(log, configuration(), ("ghost",))


def test_velocity_gained_in_a_window_is_that_of_a_plain_sum(log):
    increments = on_one_clock(log, configuration()).increments
    time = np.cumsum(increments.dt)
    end, window = time[800] - 0.3 * increments.dt[800], 0.25
    gained, age = gained_in_window(increments, time, np.array([end]), window)
    assert age[0] == pytest.approx(window / 2, rel=1e-9)
    # the same by fine steps: mean over the window of the velocity gained until its end
    # an increment is in the axes at its start; the force itself is in those of the moment
    at_once = increments.dv - 0.5 * np.cross(increments.theta, increments.dv)
    rate, force = increments.theta / increments.dt[:, None], at_once / increments.dt[:, None]
    fine = 1e-4
    s = np.arange(end - window, end, fine) + fine / 2
    row = np.searchsorted(time, s)
    turn, total = Rotation.identity(), np.zeros(3)
    for now, k in zip(s[::-1], row[::-1], strict=True):
        turn = turn * Rotation.from_rotvec(-rate[k] * fine)
        total += turn.apply(force[k]) * fine * (1 - (end - now) / window)
    np.testing.assert_allclose(gained[0], total, atol=2e-4)


def test_the_walk_meets_its_figures(data_dir):
    walk = Path(ins_gnss.__file__).parent / "scenarios" / "walk.toml"
    files = [data_dir / "gnssimu_walk_imu.csv.xz", data_dir / "gnssimu_walk_gnss.pos.xz", walk]
    found = replay_files(files).metrics
    ekf, smoothed = found["ekf"], found["ekf+rts"]
    assert ekf["aided_horizontal_rms_m"] <= 0.030
    assert ekf["aided_vertical_rms_m"] <= 0.018
    assert smoothed["outage_horizontal_rms_m"] <= 0.20
    assert ekf["outage_fixes"] == 120


def test_a_run_as_a_log_has_the_noise_of_the_campaign(drive, log):
    problem = SYSTEM.studies["drive"].problem(drive, ("ekf",), 3)
    case = jax.jit(problem.simulate)(0)
    here = np.isfinite(np.asarray(case.y["gnss_position"].lat))
    np.testing.assert_allclose(
        np.asarray(case.y["gnss_position"].lat)[here], log.gnss.lat_rad, rtol=0, atol=1e-15
    )
    assert isinstance(log, Dataset)


def test_the_axes_of_the_vehicle_have_the_same_bits_sample_by_sample(log):
    """A product of matrices rounds a row alone in another way than many."""
    whole = in_body_axes(log, (0.1, -0.2, 0.3)).imu
    C_bs = axes_of((0.1, -0.2, 0.3))
    for k in range(0, len(log.imu), 7):
        both = turned(C_bs, np.stack([log.imu.gyro[k], log.imu.accel[k]]))
        np.testing.assert_array_equal(both, [whole.gyro[k], whole.accel[k]])
    np.testing.assert_allclose(whole.gyro, log.imu.gyro @ C_bs.T, rtol=1e-13, atol=1e-16)


def test_a_late_fix_is_of_where_the_antenna_was():
    """Northwards at 10 m/s, not turning, the antenna a metre above the unit."""
    here = Geodetic(jnp.array(0.8), jnp.array(0.2), jnp.array(100.0))
    still, rate = jnp.zeros(3), earth_rate_n(here.lat)
    x = InsState(Attitude.identity(), jnp.array([10.0, 0.0, 0.0]), here, still, still)
    mount = Mount(jnp.array([0.0, 0.0, -1.0]), jnp.array(0.5), still)
    moved = here.local(read_position(mount, x, rate))  # north, east, down
    np.testing.assert_allclose(moved, [-5.0, 0.0, -1.0], atol=1e-5)
