"""CSV with units in its header, and pairs of such files: a master INS and the IMU beside it."""

import copy
import dataclasses

import numpy as np
import pytest
from made_logs import found
from made_pair import attitudes
from made_spoilt import pair
from scipy.spatial.transform import Rotation

from robins.dataset import Dataset, ImuTable, Trajectory
from robins.ins.frames import to_ned_frd
from robins.logs import LogError, LogWarning, clean, load_pair, open_log, write_log
from robins.logs.registry import recognise

HEADER = (
    "time_s,lat_deg,lon_deg,height_m,v_north_m_s,v_east_m_s,v_down_m_s,roll_deg,pitch_deg,"
    "heading_deg"
)
ROW = "{t},48.1,11.5,520,100,-5,0.5,-10,2,{heading}\n"


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


QUATERNIONS = HEADER.split(",roll")[0] + ",q_w,q_x,q_y,q_z\n"
TURNED = "{t},48,11,0,1,2,3,{w},0,0.6,0\n"


def test_frames_that_nobody_knows(tmp_path):
    told = refusal(tmp_path, f"# frames: NED RFU\n{HEADER}\n" + ROW.format(t=0, heading=1))
    assert "line 1: frames = 'NED RFU': is neither NED FRD nor ENU RFU" in told


@pytest.mark.parametrize(
    ("column", "value", "words", "cause"),
    [
        ("heading_deg", 5729.6, "beyond +-400 deg", "another unit, or another column"),
        ("lat_deg", 2755.9, "beyond +-90 deg", "another unit, or another column"),
        ("pitch_deg", 91.0, "beyond +-90 deg", "another unit, or another column"),
        ("heading_rad", 200.0, "beyond +-6.981 rad", "degrees under a name that says radians"),
    ],
)
def test_angles_in_another_unit(tmp_path, column, value, words, cause):
    header = HEADER.replace(column.replace("rad", "deg"), column)
    row = ROW.format(t="{t}", heading=30).strip().split(",")
    row[header.split(",").index(column)] = str(value)
    told = refusal(
        tmp_path, "\n".join([header, *(",".join(row).format(t=t) for t in range(5)), ""])
    )
    assert f"line 2: {column} = {value}: {words}" in told
    assert cause in told


def test_single_rows_that_cannot_be_are_missing(tmp_path):
    """Single rows that cannot be; `test_findings` checks their findings."""
    path = tmp_path / "m.csv"
    rows = [ROW.format(t=t, heading=1e4 if t == 2 else 30) for t in range(5)]
    path.write_text(HEADER + "\n" + "".join(rows))
    with pytest.warns(LogWarning, match="line 4: heading_deg is 10000, beyond .-400 deg"):
        table = open_log(path)
    assert np.isnan(table.q_nb).any(axis=1).tolist() == [False, False, True, False, False]
    path.write_text(QUATERNIONS + "".join(TURNED.format(t=t, w=[0.8, 7][t == 1]) for t in range(4)))
    table = open_log(path, findings=[])
    assert np.isnan(table.q_nb).all(axis=1).tolist() == [False, True, False, False]
    np.testing.assert_allclose(table.q_nb[0], [0.8, 0, 0.6, 0], rtol=1e-15)
    told = refusal(tmp_path, QUATERNIONS + "".join(TURNED.format(t=t, w=2) for t in range(3)))
    assert "is not of unit length, as in 3 of 3 rows" in told


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
    write_log(tmp_path / "m.csv", pair().master)
    write_log(tmp_path / "s.csv", pair().imu)
    read = load_pair(tmp_path / "m.csv", tmp_path / "s.csv")
    assert (read.name, len(read.master), len(read.imu)) == ("s", 800, 8001)
    with pytest.raises(LogError, match="were master and slave exchanged"):
        load_pair(tmp_path / "s.csv", tmp_path / "m.csv")


# ------------------------------------------------------------------------------ doctor and clean


def test_a_turn_is_not_taken_for_rest():
    """A steady turn at 60 deg of bank feels two g, always along z."""
    bank, speed, t = np.deg2rad(60), 100.0, np.arange(600) / 10.0
    rate = 9.81 * np.tan(bank) / speed
    heading = rate * t
    moved = speed / rate * np.stack([np.sin(heading), -np.cos(heading)], -1)
    path = Trajectory(
        (t * 1e9).astype(np.int64),
        0.84 + moved[:, 0] / 6.39e6,
        0.2 + moved[:, 1] / (6.39e6 * np.cos(0.84)),
        1000 + 0 * t,
        speed * np.stack([np.cos(heading), np.sin(heading), 0 * t], -1),
        attitudes(bank + 0 * t, 0 * t, heading),
    )
    fine_ns = np.arange(0, path.time_ns[-1], 10_000_000)
    noise = 1e-3 * np.random.default_rng(8).normal(size=(2, len(fine_ns), 3))
    gyro = np.array([0.0, rate * np.sin(bank), rate * np.cos(bank)]) + 0.1 * noise[0]
    accel = np.array([0.0, 0.0, -9.81 / np.cos(bank)]) + noise[1]
    imu = ImuTable(fine_ns, gyro, accel, "rate", source="slave.csv")
    assert "gravity_unknown" in found(imu)
    assert found(Dataset("turn", imu, master=path), "error") == []


def test_clean_keeps_what_is_there_and_counts_what_is_not():
    good = pair().master
    bad = copy.deepcopy(good)
    bad.lat_rad[3], bad.v_n[4, 1], bad.q_nb[5, 2], bad.v_n[6, 0] = 2.0, np.inf, np.nan, 1e9
    bad.time_ns[8] = bad.time_ns[7]
    cleaned = clean(dataclasses.replace(pair(), master=bad))
    counts = {k: n for k, n in cleaned.counts.items() if k.startswith("master") and n}
    assert counts == {"master_nan": 1, "master_inf": 1, "master_absurd": 2, "master_duplicate": 1}
    master = cleaned.master
    assert len(master) == len(good) - 1
    assert np.isnan(master.lat_rad[3])
    assert np.isfinite(master.lon_rad[3])
    np.testing.assert_array_equal(np.isnan(master.v_n[4]), [False, True, False])
    assert np.isnan(master.q_nb[5]).all()
    untouched = np.delete(np.arange(len(good)), [3, 4, 5, 6, 8])
    np.testing.assert_array_equal(master.v_n[untouched - (untouched > 8)], good.v_n[untouched])
    # velocity and attitude; an absurd latitude is seen by clean
    assert found(dataclasses.replace(pair(), master=bad)).count("master_missing") == 2
