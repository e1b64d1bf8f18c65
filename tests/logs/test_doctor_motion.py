"""The doctor on IMU and GNSS together, and its manners."""

import dataclasses

import numpy as np
import pytest
from made_logs import found, rows_of, the, with_gnss, with_imu

from robins.dataset import Dataset
from robins.logs import Finding, LogError, Mounting, examine, load_dataset


def test_a_healthy_log_is_silent(drive):
    assert examine(drive) == []
    assert examine([drive.imu, drive.gnss]) == []


def test_the_walk_has_no_error_and_its_flaws_are_told(walk_files):
    data = load_dataset(walk_files, mounting=Mounting(180.0, 0.0, -90.0))
    findings = {f.code: f for f in examine(data)}
    assert {f.severity for f in findings.values()} == {"warning", "note"}
    # Checked by hand: velocities are half an epoch late, float fixes state the sigma of fixed ones,
    # 7 decimals of a degree are 11 mm, 12 mg of accelerometer bias, steps of 6 to 9 ms.
    assert set(findings) == {
        *("velocity_late", "float_sigma"),
        *("position_resolution", "gravity_bias", "time_jitter"),
    }
    assert findings["velocity_late"].value == pytest.approx(0.125, abs=0.02)
    assert findings["gravity_bias"].value == pytest.approx(9.914, abs=0.005)


def test_the_walk_without_its_mounting(walk_files):
    data = load_dataset(walk_files)
    findings = {f.code: f for f in examine(data) if f.severity != "note"}
    assert findings["z_axis_reversed"].severity == "error"
    assert findings["forward_axis"].value == pytest.approx(-90.0, abs=15.0)


@pytest.mark.parametrize(
    ("factor", "words"),
    [
        (180 / np.pi, "probably deg/s: multiply by pi/180"),
        (180 / np.pi * 3600, "probably deg/h: multiply by pi/180/3600"),
        (np.pi / 180, "probably rad/s converted to radians once more"),
        (0.01, "probably increments where rates are expected: divide by 0.01 s"),
    ],
)
def test_the_unit_of_the_gyros_by_the_turns(drive, factor, words):
    spoilt = with_imu(drive, gyro=factor * drive.imu.gyro)
    assert found(spoilt) == ["gyro_unit"]
    f = the(spoilt, "gyro_unit")
    assert f.severity == "error"
    assert "turns by the gyros fit those of the GNSS velocity" in f.sentence
    assert words in f.sentence


@pytest.mark.parametrize(
    "M", [np.array([[0, 1, 0], [1, 0, 0], [0, 0, 1]]), np.diag([1, -1, 1])], ids=["x y", "-y"]
)
def test_left_handed_triads(drive, M):
    spoilt = with_imu(drive, gyro=drive.imu.gyro @ M, accel=drive.imu.accel @ M)
    assert the(spoilt, "left_handed").severity == "error"


@pytest.mark.parametrize(
    ("columns", "signs", "words"),
    [
        ([0, 1, 2], [-1, 1, 1], "(-gyro_x, gyro_y, gyro_z)"),
        ([0, 1, 2], [1, 1, -1], "(gyro_x, gyro_y, -gyro_z)"),
        ([1, 0, 2], [1, 1, 1], "(gyro_y, gyro_x, gyro_z)"),
        ([1, 2, 0], [1, 1, 1], "(gyro_z, gyro_x, gyro_y)"),
    ],
)
def test_gyro_axes_that_are_not_those_of_the_accelerometers(drive, columns, signs, words):
    f = the(with_imu(drive, gyro=drive.imu.gyro[:, columns] * signs), "gyro_axes")
    assert f.severity == "error"
    assert f"take them as {words}" in f.sentence


def test_gyros_of_the_opposite_sense(drive):
    f = the(with_imu(drive, gyro=-drive.imu.gyro), "gyro_reversed")
    assert str(f) == f"error: {f.sentence}"


def test_accelerometer_axes_that_are_not_those_of_the_gyros(drive):
    f = the(with_imu(drive, accel=drive.imu.accel * [1, -1, 1]), "accel_axes")
    assert "take them as (accel_x, -accel_y, accel_z)" in f.sentence


def test_gravity_in_place_of_specific_force(drive):
    codes = found(with_imu(drive, accel=-drive.imu.accel), "error")
    assert codes == ["z_axis_reversed", "accel_reversed"]


@pytest.mark.parametrize("angle", [90, 180, -50])
def test_a_sensor_turned_about_the_vertical(drive, angle):
    c, s = np.cos(np.deg2rad(angle)), np.sin(np.deg2rad(angle))
    turn = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    spoilt = with_imu(drive, gyro=drive.imu.gyro @ turn, accel=drive.imu.accel @ turn)
    assert found(spoilt) == ["forward_axis"]
    assert abs((the(spoilt, "forward_axis").value - angle + 180) % 360 - 180) < 3.0


def test_without_gnss_velocities_positions_serve(drive):
    by_place = with_gnss(drive, v_n=None, sigma_v=None)
    assert examine(by_place) == []
    assert found(with_imu(by_place, gyro=-drive.imu.gyro)) == ["gyro_reversed"]


def test_large_biases_are_no_wrong_axes(drive):
    """A cheap sensor that was never at rest: 0.6 deg/s and 20 mg."""
    imu, gnss = rows_of(drive.imu, slice(1800, None)), rows_of(drive.gnss, slice(90, None))
    biased = dataclasses.replace(
        imu,
        gyro=imu.gyro + np.array([0.01, -0.01, 0.01]),
        accel=imu.accel + np.array([0.2, 0.1, 0]),
    )
    assert set(found(Dataset("moving", biased, gnss))) <= {"gravity_bias"}


@pytest.mark.parametrize("seconds", [0.3, -2.5, 8.0])
def test_a_time_offset_is_measured(drive, seconds):
    f = the(with_imu(drive, time_ns=drive.imu.time_ns + round(seconds * 1e9)), "time_offset")
    assert f.severity in ("warning", "error")
    assert f.value == pytest.approx(seconds, abs=0.06)


def test_leap_seconds_between_the_files(drive):
    late = examine(with_imu(drive, time_ns=drive.imu.time_ns + 18 * 10**9))
    assert (late[0].severity, late[0].code) == ("error", "leap_seconds")
    assert "only if +18.0" in late[0].sentence
    assert "That is the leap seconds between UTC and GPS time" in late[0].sentence


def test_files_of_two_recordings(drive):
    other = dataclasses.replace(drive.imu, gyro=drive.imu.gyro[::-1], accel=drive.imu.accel[::-1])
    assert "motion_disagrees" in found(dataclasses.replace(drive, imu=other), "warning")


def test_too_little_motion_is_said(drive):
    rest = rows_of(drive.imu, slice(0, 1100))
    assert found(dataclasses.replace(drive, imu=rest), "note") == ["motion_not_checked"]


# ---------------------------------------------------------------------------------- manners


def test_errors_come_first_and_those_of_readers_are_brought_along(drive):
    cut = Finding("warning", "ends_early", "f", "line 9", "", "f ends early at line 9: it was cut.")
    data = dataclasses.replace(
        drive, imu=rows_of(drive.imu, slice(0, 1100)), meta={"findings": [cut]}
    )
    sigma = data.gnss.sigma_m * 0.0
    codes = found(with_gnss(data, sigma_m=sigma))
    assert codes == ["sigma_not_positive", "ends_early", "little_overlap", "motion_not_checked"]


def test_the_doctor_survives_what_it_is_given(drive):
    """Nothing but bad numbers gives findings, never an exception or a warning of NumPy."""
    rng = np.random.default_rng(1)
    for n in (0, 1, 2, 9, 12, 300):
        for fill in (np.nan, np.inf, 0.0, 1e308, -1e308, 5e-324):
            imu = dataclasses.replace(
                rows_of(drive.imu, slice(0, n)),
                gyro=np.full((n, 3), fill),
                time_ns=rng.integers(-(2**62), 2**62, n),
            )
            gnss = dataclasses.replace(
                rows_of(drive.gnss, slice(0, n)),
                lat_rad=np.full(n, fill),
                v_n=np.full((n, 3), fill),
                sigma_m=np.full((n, 3), fill),
            )
            assert "error" in {f.severity for f in examine(Dataset("bad", imu, gnss))}


def test_any_one_column_of_nonsense_is_survived(drive):
    short = Dataset("x", rows_of(drive.imu, slice(0, 4500)), rows_of(drive.gnss, slice(0, 225)))
    for fill in (np.nan, 1e308):
        for name in ("gyro", "accel"):
            assert examine(with_imu(short, **{name: np.full((4500, 3), fill)}))
        for name in ("lat_rad", "lon_rad", "alt_m"):
            assert examine(with_gnss(short, **{name: np.full(225, fill)}))
        for name in ("sigma_m", "v_n", "sigma_v"):
            assert examine(with_gnss(short, **{name: np.full((225, 3), fill)}))


def test_tables_that_are_none_are_refused(drive):
    with pytest.raises(LogError, match="has shape"):
        examine(with_imu(drive, gyro=drive.imu.gyro[:5]))
