"""Findings of the doctor on a unit and its receiver, on logs where both are known."""

from dataclasses import replace

import numpy as np
import pytest

from robins import scenario
from robins.logs import load_dataset, write_log
from robins.logs import unit_file as written_by
from robins.logs.mounting import Mounting
from robins.logs.unit_file import UnitProperties, find_unit, toml_of
from robins.systems.ins_gnss import Drive, InsGnssReplay, drive_dataset
from robins.systems.ins_gnss.correlated_errors import with_correlated_share
from robins.systems.ins_gnss.recording import on_one_clock
from robins.workbench.doctor import unit_file

TURNS = "".join(
    f'[[legs]]\ndo = "turn"\nangle = "{angle} deg"\nrate = "15 deg/s"\n'
    f'[[legs]]\ndo = "accelerate"\nseconds = "5 s"\nspeed = "{speed} m/s"\n'
    for angle, speed in ((70, 14), (-90, 8), (60, 13), (-120, 9), (80, 15), (45, 10))
)
DRIVE = f"""
imu_rate = "50 Hz"
[place]
latitude = "46 deg"
longitude = "9 deg"
height = "300 m"
heading = "20 deg"
[imu]
gyro_noise = "0.006 deg/s/sqrt(Hz)"
accel_noise = "200 ug/sqrt(Hz)"
gyro_bias = "0.1 deg/s"
accel_bias = "5 mg"
gyro_bias_walk = "0.0005 deg/s/sqrt(s)"
accel_bias_walk = "5 ug/sqrt(s)"
[gnss]
rate = "4 Hz"
sigma = "0.02 m"
velocity_sigma = "0.03 m/s"
[[legs]]
do = "stop"
seconds = "20 s"
[[legs]]
do = "accelerate"
seconds = "6 s"
speed = "10 m/s"
{TURNS}
"""
EPOCH_S = 0.25


@pytest.fixture(scope="module")
def log():
    return drive_dataset(scenario.parse(Drive, DRIVE), seed=2)


def _means(log):
    """The fixes with velocities that are means since the last one."""
    t, at = log.truth.time_ns * 1e-9, log.gnss.time_ns * 1e-9
    ways = np.cumsum(log.truth.v_n, axis=0) * 0.02
    way = [np.stack([np.interp(at - a, t, x) for x in ways.T], -1) for a in (0.0, EPOCH_S)]
    noise = 0.03 * np.random.default_rng(1).normal(size=log.gnss.v_n.shape)
    return replace(log.gnss, v_n=(way[0] - way[1]) / EPOCH_S + noise)


@pytest.mark.parametrize("means", [False, True])
@pytest.mark.parametrize("late_s", [0.0, 0.2])
def test_an_offset_of_the_clock_and_a_window_of_the_velocities_are_told_apart(log, late_s, means):
    gnss = _means(log) if means else log.gnss
    found = find_unit(log.imu, replace(gnss, time_ns=gnss.time_ns + round(late_s * 1e9)))
    assert (found.latency_s or 0.0) == pytest.approx(late_s, abs=0.04)
    assert found.velocity_window_s == (EPOCH_S if means else None)


def test_what_does_not_lower_the_unexplained_share_is_not_written(log, monkeypatch):
    """A wrong age of the velocities, and a right one."""
    means = replace(log.gnss, v_n=_means(log).v_n)
    for gnss, age_s, window_s in ((log.gnss, 0.125, None), (means, 0.125, EPOCH_S)):
        monkeypatch.setattr(written_by, "velocity_delay", lambda track, age_s=age_s: age_s)
        monkeypatch.setattr(written_by, "small_offset", lambda verdict: None)
        found = find_unit(log.imu, gnss)
        assert (found.velocity_window_s, found.left is None) == (window_s, window_s is None)
    assert found.left[1] < found.left[0]


ANGLES = [(0.0, 0.0, 0.0), (180.0, 0.0, -90.0), (10.0, -20.0, 35.0), (0.0, -12.0, 0.0)]


@pytest.mark.parametrize("angles", ANGLES)
def test_the_mounting_is_that_of_a_turned_unit(log, angles):
    C_bs = Mounting(*angles).dcm_bs()
    imu = replace(log.imu, gyro=log.imu.gyro @ C_bs, accel=log.imu.accel @ C_bs)
    found = find_unit(imu, log.gnss)
    there = Mounting(*found.orientation_deg).dcm_bs()
    apart = np.degrees(np.arccos(np.clip((np.trace(there @ C_bs.T) - 1.0) / 2.0, -1.0, 1.0)))
    right = not np.any(np.array(angles) % 90.0)
    assert apart < (1e-3 if right else 4.0)
    assert (found.rounded_deg is not None) == right
    # 20 s of rest: half a dozen means or more, each of a second
    np.testing.assert_allclose(np.degrees(found.gyro_noise), 0.006, rtol=0.6)
    np.testing.assert_allclose(found.accel_noise, 200e-6 * 9.80665, rtol=0.6)


def test_seconds_in_which_a_vehicle_sets_off_are_no_noise(log):
    """Two of twenty seconds of rest turn by 0.5 deg/s, which is 80 sigma of their means."""
    gyro = log.imu.gyro.copy()
    gyro[800:900] += np.radians(0.5)
    found = find_unit(replace(log.imu, gyro=gyro), log.gnss)
    np.testing.assert_allclose(np.degrees(found.gyro_noise), 0.006, rtol=0.6)


def test_slopes_and_trim_are_no_mounting(log):
    """A unit that leans by 6 deg: the file states so, and that it was taken to be level."""
    C_bs = Mounting(4.0, -4.5, 0.0).dcm_bs()
    found = find_unit(
        replace(log.imu, gyro=log.imu.gyro @ C_bs, accel=log.imu.accel @ C_bs), log.gnss
    )
    assert found.orientation_deg == (0.0, 0.0, 0.0)
    assert found.rounded_deg == pytest.approx(6.0, abs=2.0)
    assert f"# found {found.rounded_deg:.1f} deg from these, as slopes" in toml_of(found, "drive")


def test_what_is_written_is_a_whole_configuration():
    found = UnitProperties(
        (180.0, 0.0, -90.0), 0.15, 0.25, (1e-4, 2e-4, 3e-4), None, (0.5, 0.02), 0.8
    )
    parameters = scenario.parse(InsGnssReplay, toml_of(found, "drive"))
    assert np.degrees(parameters.imu.orientation) == pytest.approx((180.0, 0.0, -90.0))
    assert parameters.imu.gyro_noise == pytest.approx((1e-4, 2e-4, 3e-4), rel=5e-3)
    assert parameters.imu.accel_noise == InsGnssReplay().imu.accel_noise
    assert parameters.gnss.lasting_share == 0.8
    assert parameters.gnss.latency == pytest.approx(0.15)
    assert parameters.gnss.velocity_window == pytest.approx(0.25)
    noisy = toml_of(found, "drive", {"gyro_noise": (2.5e-4,) * 3})  # one axis is above it
    assert "\ngyro_noise = [" in noisy
    assert "\n# gyro_noise = [" in toml_of(found, "drive", {"gyro_noise": (3.5e-4,) * 3})
    nothing = scenario.parse(InsGnssReplay, toml_of(UnitProperties(), "drive"))
    assert nothing == InsGnssReplay()


def test_the_share_of_errors_that_last_is_that_of_the_replay(log, tmp_path):
    """Positions that scatter by a tenth of their stated sigma; a unit of 0.02 m scatters by it."""
    paths = [tmp_path / "imu.csv", tmp_path / "fixes.txt"]
    write_log(paths[0], log.imu, "named-imu")
    for factor in (1.0, 10.0):
        gnss = replace(log.gnss, sigma_m=factor * log.gnss.sigma_m)
        write_log(paths[1], gnss, "kfgins-gnss")
        written = scenario.parse(InsGnssReplay, unit_file(paths))
        assert written.imu.gyro_noise == InsGnssReplay().imu.gyro_noise  # less at rest
        assert "# gyro_noise = [" in unit_file(paths)
        read = load_dataset(paths)
        found, notes = with_correlated_share(InsGnssReplay(), on_one_clock(read, InsGnssReplay()))
        assert (written.gnss.lasting_share is None) == (notes == []) == (factor == 1.0)
        if factor > 1.0:
            assert written.gnss.lasting_share == pytest.approx(found.gnss.lasting_share, abs=1e-3)
            assert written.gnss.lasting_share == pytest.approx(0.99, abs=5e-3)
