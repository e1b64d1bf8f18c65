"""The doctor on IMU and GNSS together, and its manners."""

import dataclasses

import numpy as np
import pytest
from made_logs import found, rows_of, with_gnss, with_imu

from robins.dataset import Dataset
from robins.logs import Finding, LogError, Mounting, examine, load_dataset


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


# ---------------------------------------------------------------------------------- manners


def test_errors_come_first_and_those_of_readers_are_brought_along(drive):
    cut = Finding("warning", "ends_early", "f", "line 9", "", "f ends early at line 9: it was cut.")
    data = dataclasses.replace(drive, imu=rows_of(drive.imu, slice(0, 1100)), findings=[cut])
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
