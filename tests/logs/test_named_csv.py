"""CSV with units in its header, and pairs of such files: a master INS and the IMU beside it."""

import copy
import dataclasses

import numpy as np
import pytest
from scipy.integrate import cumulative_trapezoid
from scipy.spatial.transform import Rotation

from robins.dataset import Dataset, ImuTable, Trajectory
from robins.ins.frames import to_ned_frd
from robins.logs import LogError, LogWarning, clean, examine, load_pair, open_log, write_log
from robins.logs.registry import recognise

RNG = np.random.default_rng(8)
HEADER = (
    "time_s,lat_deg,lon_deg,height_m,v_north_m_s,v_east_m_s,v_down_m_s,roll_deg,pitch_deg,"
    "heading_deg"
)
ROW = "{t},48.1,11.5,520,100,-5,0.5,-10,2,{heading}\n"


def quaternion(angles):
    return Rotation.from_euler("ZYX", angles[:, ::-1]).as_quat()[:, [3, 0, 1, 2]]


def a_flight(seconds=40.0, rate=10.0):
    """A path that weaves to both sides, its attitudes and turn rates, NED/FRD."""
    t = np.arange(round(seconds * rate)) / rate
    heading = 0.8 * np.sin(2 * np.pi * t / 20)
    v_n = np.stack([60 * np.cos(heading), 60 * np.sin(heading), 0 * t], -1)
    moved = cumulative_trapezoid(v_n, dx=1.0 / rate, axis=0, initial=0.0)
    angles = np.stack([0.5 * np.cos(2 * np.pi * t / 20), 0.03 + 0 * t, heading], -1)
    return Trajectory(
        (t * 1e9).astype(np.int64),
        0.84 + moved[:, 0] / 6.39e6,
        0.2 + moved[:, 1] / (6.39e6 * np.cos(0.84)),
        1000 + 0 * t,
        v_n,
        quaternion(angles),
        omega_ib_b=RNG.normal(size=(len(t), 3)),
    )


def gyros_of(path, rate=100.0):
    """Rates of a body that turns as the path does, constant between its rows."""
    q = Rotation.from_quat(path.q_nb[:, [1, 2, 3, 0]])
    step = np.diff(path.time_ns) * 1e-9
    omega = (q[:-1].inv() * q[1:]).as_rotvec() / step[:, None]
    t = np.arange(0.0, path.time_ns[-1] * 1e-9, 1.0 / rate)
    k = np.searchsorted(path.time_ns[1:] * 1e-9, t)
    pushed = np.diff(path.v_n, axis=0) / step[:, None]
    accel = q[:-1][k].inv().apply(pushed[k] - [0.0, 0.0, 9.81])
    noise = 1e-3 * RNG.normal(size=(2, len(t), 3))
    gyro, accel = omega[k] + 0.1 * noise[0], accel + noise[1]
    return ImuTable((t * 1e9).astype(np.int64), gyro, accel, "rate", source="slave.csv")


FLIGHT = a_flight()
IMU = gyros_of(FLIGHT)


def same_attitude(a, b):
    return np.all(np.abs(np.abs(np.sum(a * b, axis=-1)) - 1.0) < 1e-14)


# ----------------------------------------------------------------------------- writing and reading


def test_a_file_by_hand_means_what_its_header_says(tmp_path):
    path = tmp_path / "m.csv"
    path.write_text(
        "# what the box put out\n# frames: NED, FRD\n"
        "time_ms,heading_rad,pitch_rad,roll_deg,temperature,v_down_m_s,v_east_m_s,v_north_m_s,"
        "height_m,lon_rad,lat_deg\n"
        "1500,1.5707963267948966,0,0,35.1,3,2,1,,0.2,45\n"
        "1600,nan,0,0,35.1,3,2,,700,0.2,45\n"
    )
    table = open_log(path)
    assert table.time_ns.tolist() == [1_500_000_000, 1_600_000_000]
    np.testing.assert_allclose(table.lat_rad, np.pi / 4)
    np.testing.assert_array_equal(table.v_n, [[1, 2, 3], [np.nan, 2, 3]])
    np.testing.assert_array_equal(table.alt_m, [np.nan, 700])
    north_b = Rotation.from_quat(table.q_nb[0, [1, 2, 3, 0]]).apply([1.0, 0, 0])
    np.testing.assert_allclose(north_b, [0, 1, 0], atol=1e-15)  # forward is east
    assert np.isnan(table.q_nb[1]).all()
    assert table.rows.tolist() == [4, 5]


def test_euler_angles_are_of_the_vehicle_in_both_pairs_of_frames(tmp_path):
    for frames in ("NED FRD", "ENU RFU"):
        (tmp_path / frames).write_text(
            f"# frames: {frames}\n{HEADER}\n" + ROW.format(t=1, heading=30)
        )
    ned, enu = (to_ned_frd(open_log(tmp_path / f)) for f in ("NED FRD", "ENU RFU"))
    np.testing.assert_array_equal(ned.v_n, enu.v_n)
    assert same_attitude(ned.q_nb, enu.q_nb)


# --------------------------------------------------------------------------------------- refusals


def refusal(tmp_path, text):
    path = tmp_path / "log.csv"
    path.write_text(text)
    with pytest.raises(LogError) as caught:
        open_log(path)
    return str(caught.value)


def test_frames_that_nobody_knows(tmp_path):
    told = refusal(tmp_path, f"# frames: NED RFU\n{HEADER}\n" + ROW.format(t=0, heading=1))
    assert "line 1: frames = 'NED RFU': is neither NED FRD nor ENU RFU" in told


@pytest.mark.parametrize(
    ("column", "value", "words"),
    [
        ("heading_deg", 5729.6, "heading_deg = 5729.6: beyond +-400 deg"),
        ("lat_deg", 2755.9, "lat_deg = 2755.9: beyond +-90 deg"),
        ("pitch_deg", 91.0, "pitch_deg = 91.0: beyond +-90 deg"),
    ],
)
def test_angles_in_another_unit(tmp_path, column, value, words):
    k = HEADER.split(",").index(column)
    row = ROW.format(t="{t}", heading=30).split(",")
    row[k] = f"{value}\n" if column == "heading_deg" else str(value)
    told = refusal(tmp_path, HEADER + "\n" + "".join(",".join(row).format(t=t) for t in range(5)))
    assert f"line 2: {words}" in told
    assert "another unit, or another column" in told


def test_degrees_under_a_name_of_radians(tmp_path):
    text = HEADER.replace("heading_deg", "heading_rad")
    told = refusal(tmp_path, text + "\n" + "".join(ROW.format(t=t, heading=200) for t in range(3)))
    assert "heading_rad = 200.0: beyond +-6.981 rad" in told
    assert "degrees under a name that says radians" in told


def test_one_impossible_angle_is_missing_and_said(tmp_path):
    path = tmp_path / "m.csv"
    rows = [ROW.format(t=t, heading=1e4 if t == 2 else 30) for t in range(5)]
    path.write_text(HEADER + "\n" + "".join(rows))
    with pytest.warns(LogWarning, match="line 4: heading_deg is 10000, beyond .-400 deg"):
        table = open_log(path)
    assert np.isnan(table.q_nb).any(axis=1).tolist() == [False, False, True, False, False]


def test_quaternions_that_are_none(tmp_path):
    header = HEADER.split(",roll")[0] + ",q_w,q_x,q_y,q_z\n"
    row = "{t},48,11,0,1,2,3,{w},0,0.6,0\n"
    told = refusal(tmp_path, header + "".join(row.format(t=t, w=2) for t in range(3)))
    assert "is not of unit length, as in 3 of 3 rows" in told
    path = tmp_path / "m.csv"
    path.write_text(header + "".join(row.format(t=t, w=7 if t == 1 else 0.8) for t in range(4)))
    with pytest.warns(LogWarning, match="the quaternion q_w .. q_z has length"):
        table = open_log(path)
    assert np.isnan(table.q_nb).all(axis=1).tolist() == [False, True, False, False]
    np.testing.assert_allclose(table.q_nb[0], [0.8, 0, 0.6, 0], rtol=1e-15)


def test_a_file_of_both_kinds_is_read_for_what_is_wanted(tmp_path):
    path = tmp_path / "both.csv"
    more = "gyro_x_rad_s,gyro_y_rad_s,gyro_z_rad_s,accel_x_m_s2,accel_y_m_s2,accel_z_m_s2"
    rows = [ROW.format(t=t, heading=3).strip() + ",1,2,3,4,5,6\n" for t in range(3)]
    path.write_text(f"{HEADER},{more}\n" + "".join(rows))
    with pytest.raises(LogError, match="several formats fit"):
        recognise(path)
    pair = load_pair(path, path)
    assert pair.imu.gyro[0].tolist() == [1, 2, 3]
    assert pair.master.v_n[0].tolist() == [100, -5, 0.5]


def test_exchanged_files_are_told(tmp_path):
    write_log(tmp_path / "m.csv", FLIGHT)
    write_log(tmp_path / "s.csv", IMU)
    pair = load_pair(tmp_path / "m.csv", tmp_path / "s.csv")
    assert (pair.name, len(pair.master), len(pair.imu)) == ("s", len(FLIGHT), len(IMU))
    with pytest.raises(LogError, match="were master and slave exchanged"):
        load_pair(tmp_path / "s.csv", tmp_path / "m.csv")


# ------------------------------------------------------------------------------ doctor and clean


def a_pair(**changes):
    return dataclasses.replace(Dataset("pair", IMU, master=FLIGHT), **changes)


def codes(dataset):
    return [f.code for f in examine(dataset)]


def test_a_sound_pair_has_no_findings():
    assert codes(a_pair()) == []


def test_a_turn_is_not_taken_for_rest():
    """A steady turn at 60 deg of bank feels two g, always along z."""
    t = np.arange(600) / 10.0
    rate, speed = 9.81 * np.tan(np.deg2rad(60)) / 100, 100.0
    heading = np.unwrap(rate * t)
    v_n = speed * np.stack([np.cos(heading), np.sin(heading), 0 * t], -1)
    moved = speed / rate * np.stack([np.sin(heading), -np.cos(heading)], -1)
    path = dataclasses.replace(
        FLIGHT,
        time_ns=(t * 1e9).astype(np.int64),
        lat_rad=0.84 + moved[:, 0] / 6.39e6,
        lon_rad=0.2 + moved[:, 1] / (6.39e6 * np.cos(0.84)),
        alt_m=1000 + 0 * t,
        v_n=v_n,
        q_nb=quaternion(np.stack([np.deg2rad(60) + 0 * t, 0 * t, heading], -1)),
        omega_ib_b=None,
    )
    imu = gyros_of(path)
    assert "gravity_unknown" in codes(imu)
    assert not [f for f in examine(Dataset("turn", imu, master=path)) if f.severity == "error"]


@pytest.mark.parametrize("late_ns", [120_000_000, -80_000_000])
def test_a_delay_of_the_master_is_measured(late_ns):
    late = dataclasses.replace(FLIGHT, time_ns=FLIGHT.time_ns + late_ns)
    # the made rates hold over the sample that ends at their time, which increments say exactly
    turned, pushed = 0.01 * IMU.gyro, 0.01 * IMU.accel
    imu = dataclasses.replace(IMU, gyro=turned, accel=pushed, kind="increment")
    (found,) = [f for f in examine(a_pair(master=late, imu=imu)) if f.code == "master_late"]
    assert found.value == pytest.approx(late_ns * 1e-9, abs=0.001)
    assert found.severity == "error"


def test_clean_keeps_what_is_there_and_counts_what_is_not():
    bad = copy.deepcopy(FLIGHT)
    bad.lat_rad[3], bad.v_n[4, 1], bad.q_nb[5, 2], bad.v_n[6, 0] = 2.0, np.inf, np.nan, 1e9
    bad.time_ns[8] = bad.time_ns[7]
    cleaned = clean(a_pair(master=bad))
    counts = {k: n for k, n in cleaned.counts.items() if k.startswith("master") and n}
    assert counts == {"master_nan": 1, "master_inf": 1, "master_absurd": 2, "master_duplicate": 1}
    master = cleaned.master
    assert len(master) == len(FLIGHT) - 1
    assert np.isnan(master.lat_rad[3])
    assert np.isfinite(master.lon_rad[3])
    np.testing.assert_array_equal(np.isnan(master.v_n[4]), [False, True, False])
    assert np.isnan(master.q_nb[5]).all()
    untouched = np.delete(np.arange(len(FLIGHT)), [3, 4, 5, 6, 8])
    np.testing.assert_array_equal(master.v_n[untouched - (untouched > 8)], FLIGHT.v_n[untouched])
    said = [f for f in examine(a_pair(master=bad)) if f.code == "master_missing"]
    assert len(said) == 2  # velocity and attitude; an absurd latitude is seen by clean
