"""The doctor on sensors that share a motion, and its manners."""

import dataclasses
import re

import made_logs
import numpy as np
import pytest
from made_logs import found, rows_of, with_gnss, with_imu
from made_pair import make_pair
from made_spoilt import late

from robins.dataset import Dataset, GnssTable, ImuTable
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


# ------------------------------------------------------------- a master and its slave


def errors(data):
    return [f for f in examine(data) if f.severity != "note"]


@pytest.mark.parametrize("kind", ["rate", "increment"])
def test_a_healthy_pair_is_silent(kind):
    for seed in range(3):
        pair = make_pair(seed, kind)
        assert errors(pair) == []
        assert errors(late(0.1, 0.1)(pair)) == []


@pytest.mark.parametrize("delay_s", [0.03, 0.08, 0.2, -0.05])
@pytest.mark.parametrize("stated_s", [0.0, 0.04])
def test_a_delay_is_measured_by_the_gyros(delay_s, stated_s):
    (told,) = errors(late(delay_s + stated_s, stated_s)())
    assert (told.severity, told.code, told.file) == ("error", "master_late", "master.csv")
    assert told.value == pytest.approx(delay_s, abs=0.004)
    total = told.value + stated_s
    mend = f'master.delay = "{total:.3f} s"' if total >= 0.0 else f"Add {-total:.3f} s to their"
    assert mend in told.sentence


# ------------------------------------------------------- an IMU that was turned about by hand


@pytest.mark.parametrize("trial", [1, 7, 15, 24, 28])
def test_real_recordings_by_hand(data_dir, trial):
    """BROAD, with its z up turned down: no error as it is, the fault found where one is put in."""
    (path,) = data_dir.glob(f"broad_{trial:02d}_*.npz")
    with np.load(path) as file:
        rate_hz = float(file["sampling_rate"])
        gyro, accel = (file[k].astype(float) * [1, -1, -1] for k in ("imu_gyr", "imu_acc"))
    time_ns = (np.arange(len(gyro)) * 1e9 / rate_hz).astype(np.int64)
    imu = ImuTable(time_ns, gyro, accel, "rate", source="drive_imu.csv")
    assert found(imu, "error") == []
    assert found(dataclasses.replace(imu, gyro=-gyro), "error") == ["left_handed"]


# ---------------------------------------------------------------------------------- manners


def test_errors_come_first_and_those_of_readers_are_brought_along(drive):
    cut = Finding("warning", "ends_early", "f", "line 9", "", "f ends early at line 9: it was cut.")
    data = dataclasses.replace(drive, imu=rows_of(drive.imu, slice(0, 1100)), findings=[cut])
    g, fifth = data.gnss, np.arange(len(data.gnss)) == 5
    lat, lon = (np.where(fifth, 0.0, x) for x in (g.lat_rad, g.lon_rad))
    codes = found(with_gnss(data, lat_rad=lat, lon_rad=lon))
    assert codes == ["no_fix_as_zero", "ends_early", "little_overlap"]


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


@pytest.mark.parametrize("noise_m", [0.05, 4.0])
def test_a_straight_drive_of_rough_positions_is_sound(noise_m):
    """Positions alone, whose sigmas nobody states: their noise is no motion."""
    rng = np.random.default_rng(1)
    t = np.arange(0.0, 60.0, 0.02)
    force = np.where(t < 10.0, 0.0, np.where(t < 40.0, 0.5, -0.4))
    way = np.cumsum(np.cumsum(force)) * 0.02**2
    accel = np.stack([force, 0.0 * t, 0.0 * t - 9.81], -1) + 0.03 * rng.standard_normal((len(t), 3))
    gyro = np.deg2rad(0.1) * rng.standard_normal((len(t), 3))
    imu = ImuTable(np.round(t * 1e9).astype(np.int64), gyro, accel, "rate", source="imu.csv")
    off = noise_m * np.array([1.0, 1.0, 2.0]) * rng.standard_normal((60, 3))
    north, east = (way[::50] * part for part in (0.87, 0.5))
    place = (0.84 + (north + off[:, 0]) / 6.37e6, 0.19 + (east + off[:, 1]) / 6.39e6 / 0.667)
    fixes = GnssTable(
        imu.time_ns[::50], *place, 500.0 + off[:, 2], np.full((60, 3), np.nan), source="fixes.csv"
    )
    assert [f for f in examine(Dataset("straight", imu, fixes)) if f.severity != "note"] == []


def circle(t):
    """Motion of 12 s at rest, 10 s of taking up 6 m/s, then laps of a circle of 20 m."""
    s = np.clip((t - 12.0) / 10.0, 0.0, 1.0)
    way = 6.0 * (10.0 * (s**3 - 0.5 * s**4) + np.maximum(t - 22.0, 0.0))
    return 6.0 * s**2 * (3.0 - 2.0 * s), 0.0 * t, 0.0 * t, 0.4 + way / 20.0


def test_a_circle_at_constant_speed_is_no_rest(monkeypatch):
    """Rate and specific force are steady as at rest, and each lap is like the last."""
    monkeypatch.setattr(made_logs, "motion", circle)
    assert errors(made_logs.make_drive()) == []


def test_a_bias_on_a_circle_is_no_direction_of_travel(monkeypatch):
    """A bias ahead and the pull of the circle, which are one steady force."""
    monkeypatch.setattr(made_logs, "motion", lambda t: circle(t + 60.0))
    drive = made_logs.make_drive()
    assert errors(with_imu(drive, accel=drive.imu.accel + np.array([0.5, 0, 0]))) == []


def test_a_step_in_an_outage_is_no_drift(drive):
    """A clock set by half a second while there was no fix may have drifted as well."""
    t = (drive.gnss.time_ns - drive.gnss.time_ns[0]) * 1e-9
    gnss = rows_of(drive.gnss, (t < 27.0) | (t > 50.0))
    after = gnss.time_ns > gnss.time_ns[0] + 40_000_000_000
    gnss = dataclasses.replace(gnss, time_ns=gnss.time_ns + 500_000_000 * after)
    (f,) = errors(dataclasses.replace(drive, gnss=gnss))
    assert f.code == "motion_disagrees"
    assert f.value == pytest.approx(-0.5, abs=0.1)
    assert re.search("a drift of -[89].* ms in a second explain it about equally", f.sentence)


def test_axes_that_were_hardly_turned_keep_their_names():
    """Turned about x alone, with gyro x reversed: nothing tells y from z."""
    rng = np.random.default_rng(2)
    t = np.arange(0.0, 60.0, 0.02)
    rate = np.deg2rad(4.0) * (((t >= 10.0) & (t < 20.0)) * 1.0 - ((t >= 25.0) & (t < 35.0)))
    roll = np.cumsum(rate) * 0.02
    accel = -9.81 * np.stack([0.0 * t, np.sin(roll), np.cos(roll)], -1)
    gyro = np.stack([-rate, 0.0 * t, 0.0 * t], -1) + np.deg2rad(0.1) * rng.standard_normal(
        (len(t), 3)
    )
    noisy = accel + 0.03 * rng.standard_normal(accel.shape)
    imu = ImuTable(np.round(t * 1e9).astype(np.int64), gyro, noisy, "rate", source="imu.csv")
    (f,) = errors(imu)
    assert "fit as (-gyro_x, gyro_y, gyro_z)" in f.sentence
    assert f.sentence.endswith("It turned too little about the other axes to test them.")
