"""The doctor on an IMU alone: each fault put into a healthy table is found, named and mended."""

import dataclasses

import numpy as np
import pytest
from made_logs import found, rows_of, the

from robins.dataset import ImuTable
from robins.logs import examine
from robins.logs.quiet import signal_of


@pytest.fixture(scope="module")
def imu(drive):
    return drive.imu


def changed(imu, **columns):
    return dataclasses.replace(imu, **columns)


def turned(imu, C):
    """Both triads in other axes."""
    return changed(imu, gyro=imu.gyro @ np.array(C).T, accel=imu.accel @ np.array(C).T)


def test_a_healthy_table_is_silent(imu):
    assert examine(imu) == []


# ------------------------------------------------------------------------------------- units


@pytest.mark.parametrize(
    ("factor", "mend"),
    [
        (1 / 9.80665, "g: multiply by 9.80665"),
        (1e3 / 9.80665, "milli-g: multiply by 0.00980665"),
        (1 / 0.3048, "ft/s^2: multiply by 0.3048"),
        (1e3, "mm/s^2: divide by 1000"),
    ],
)
def test_acceleration_in_another_unit(imu, factor, mend):
    f = the(changed(imu, accel=factor * imu.accel), "gravity_unit")
    assert (f.severity, f.where) == ("error", "line 2")
    assert f.value == pytest.approx(9.8 * factor, rel=0.01)
    assert "where gravity is 9.8" in f.sentence
    assert mend in f.sentence


def test_acceleration_in_no_known_unit(imu):
    f = the(changed(imu, accel=3.5 * imu.accel), "gravity_unknown")
    assert f.severity == "error"
    assert "no usual unit" in f.sentence


def test_acceleration_without_gravity(imu):
    f = the(changed(imu, accel=imu.accel + np.array([0.0, 0.0, 9.75])), "gravity_missing")
    assert f.severity == "error"
    assert "'linear accelerations'" in f.sentence


def test_a_cheap_accelerometer_is_noted_not_refused(imu):
    f = the(changed(imu, accel=imu.accel - np.array([0.0, 0.0, 0.15])), "gravity_bias")
    assert f.severity == "note"
    assert "off by +0.15 m/s^2 (+15 mg)" in f.sentence


@pytest.mark.parametrize(("unit", "factor"), [("m/s^2", 1.0), ("g", 1 / 9.80665)])
def test_rates_given_as_increments(imu, unit, factor):
    spoilt = changed(imu, kind="increment", accel=factor * imu.accel)
    f = the(spoilt, "rates_as_increments")
    assert f"The rows are rates in {unit}, not increments over 10 ms: multiply" in f.sentence
    assert found(spoilt, "error") == ["rates_as_increments"]


@pytest.mark.parametrize(("unit", "factor"), [("m/s", 0.01), ("g s", 0.01 / 9.80665)])
def test_increments_given_as_rates(imu, unit, factor):
    spoilt = changed(imu, gyro=0.01 * imu.gyro, accel=factor * imu.accel)
    f = the(spoilt, "increments_as_rates")
    assert f"The rows are increments over 10 ms in {unit}, not rates: divide" in f.sentence
    assert found(spoilt, "error") == ["increments_as_rates"]


def test_increments_are_as_healthy_as_rates(imu):
    assert (
        examine(changed(imu, kind="increment", gyro=0.01 * imu.gyro, accel=0.01 * imu.accel)) == []
    )


@pytest.mark.parametrize(
    ("scale", "unit"), [(60 * 180 / np.pi, "deg/s"), (180 / np.pi * 3600, "deg/h")]
)
def test_gyros_in_degrees_that_turn_faster_than_any_gyro(imu, scale, unit):
    f = the(changed(imu, gyro=scale * imu.gyro), "gyro_unit")
    assert f.severity == "error"
    assert f"The columns are probably in {unit}: multiply by pi/180" in f.sentence


def test_gyros_in_degrees_at_rest_by_their_bias(imu):
    rest = rows_of(imu, slice(0, 1100))
    f = the(changed(rest, gyro=rest.gyro * 180 / np.pi), "gyro_unit")
    assert f.sentence.startswith("drive_imu.csv line 2: at rest the gyros show 0.2")


@pytest.mark.parametrize(
    ("factor", "severity", "unit"),
    [(180 / np.pi, "warning", "deg/s"), (180 / np.pi * 3600, "error", "deg/h")],
)
def test_the_earth_rate_of_a_good_gyro_at_rest_tells_its_unit(factor, severity, unit):
    rng = np.random.default_rng(4)
    n = 12_000
    earth = 7.292115e-5 * np.array([np.cos(0.8), 0.0, -np.sin(0.8)])
    gyro = earth + 2e-6 * rng.standard_normal((n, 3))
    accel = np.array([0.0, 0.0, -9.81]) + 1e-3 * rng.standard_normal((n, 3))
    imu = ImuTable(np.arange(n) * 10_000_000, gyro, accel, "rate", source="drive_imu.csv")
    assert examine(imu) == []
    f = the(changed(imu, gyro=factor * gyro), "gyro_unit")
    assert f.severity == severity
    assert f"just the Earth's 15.04 deg/h in {unit}" in f.sentence


# -------------------------------------------------------------------------------------- axes


@pytest.mark.parametrize("C", [np.diag([1, -1, -1]), np.diag([1, 1, -1])], ids=["FLU", "mirrored"])
def test_z_up_in_place_of_down(imu, C):
    f = the(turned(imu, C), "z_axis_reversed")
    assert f.severity == "error"
    assert "gravity shows as +9.8 m/s^2 on accel_z" in f.sentence


def test_right_forward_up_is_healthy_if_it_says_so(imu):
    rfu = turned(imu, [[0, 1, 0], [1, 0, 0], [0, 0, -1]])
    assert examine(changed(rfu, body="RFU")) == []
    assert found(rfu) == ["z_axis_reversed"]
    assert found(changed(imu, body="RFU")) == ["z_axis_reversed"]


def test_a_sensor_on_its_side(imu):
    f = the(turned(imu, [[0, 0, -1], [0, 1, 0], [1, 0, 0]]), "not_level")
    assert (f.severity, f.value) == ("warning", pytest.approx(1.0, abs=0.01))


# ----------------------------------------------------------------------------------- columns


@pytest.mark.parametrize("value", [0.0, 0.37])
def test_a_dead_axis(imu, value):
    gyro = imu.gyro.copy()
    gyro[:, 1] = value
    f = the(changed(imu, gyro=gyro), "axis_stuck")
    assert (f.severity, f.value) == ("error", value)
    assert f"gyro_y is {value:g} in every sample" in f.sentence


def test_an_axis_that_hung_for_a_while(imu):
    accel = imu.accel.copy()
    accel[5000:5300, 0] = accel[5000, 0]
    f = the(changed(imu, accel=accel), "axis_stuck_for_a_while")
    assert (f.severity, f.where) == ("warning", "line 5002")
    assert "for 300 samples (3.0 s)" in f.sentence


def test_an_axis_that_stops_at_full_scale(imu):
    gyro = imu.gyro.copy()
    gyro[:, 2] = np.clip(40 * gyro[:, 2], -np.deg2rad(250), np.deg2rad(250))
    faults = [f for f in examine(changed(imu, gyro=gyro)) if f.code == "saturated"]
    assert {round(f.value, 3) for f in faults} == {4.363, -4.363}
    assert all("a usual full scale (4.363 rad/s)" in f.sentence for f in faults)


def test_one_knock_beyond_the_range(imu):
    accel = imu.accel.copy()
    accel[3000:3005, 2] = 4 * 9.80665
    f = the(changed(imu, accel=accel), "saturated")
    assert (f.severity, f.where) == ("warning", "line 3002")
    assert "in 5 samples, 5 in a row" in f.sentence


def test_missing_numbers(imu):
    gyro = imu.gyro.copy()
    gyro[[10, 20], 2] = np.nan, np.inf
    f = the(changed(imu, gyro=gyro), "not_finite")
    assert (f.severity, f.where, f.value) == ("warning", "line 12", 2)


def test_a_missing_column(imu):
    gyro = imu.gyro.copy()
    gyro[:, 2] = np.nan
    spoilt = changed(imu, gyro=gyro)
    assert the(spoilt, "column_missing").severity == "error"
    assert found(spoilt, "error") == ["column_missing", "no_samples"]


def test_too_few_bits(imu):
    assert found(changed(imu, accel=np.round(imu.accel)), "warning").count("coarse") == 3


def test_an_increment_after_lost_ones_is_the_rate_of_its_own_interval(imu):
    sums = changed(imu, gyro=imu.gyro * 0.01, accel=imu.accel * 0.01, kind="increment")
    keep = np.delete(np.arange(len(imu)), [500, 900, 901, 902])
    signal = signal_of(rows_of(sums, keep))
    np.testing.assert_allclose(signal.accel, imu.accel[keep], atol=1e-9)
    np.testing.assert_allclose(signal.gyro, imu.gyro[keep], atol=1e-9)
