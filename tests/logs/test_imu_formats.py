import dataclasses
import datetime
import io

import numpy as np
import pandas as pd
import pytest
from made_pair import attitudes

from robins.dataset import ImuTable, Trajectory
from robins.logs import LogError, Origin, open_log, write_log

RNG = np.random.default_rng(5)
TIME_NS = 1_700_000_000_123_456_789 + np.arange(40) * 5_000_001
RATES = ImuTable(TIME_NS, RNG.normal(size=(40, 3)), 9.8 + RNG.normal(size=(40, 3)), "rate")
STEPS = ImuTable(TIME_NS, 5e-3 * RATES.gyro, 5e-3 * RATES.accel, "increment")


def path_over_hills(n=50):
    s = np.arange(n) / 10.0
    angles = np.stack([0.1 * np.sin(s), 0.05 * np.cos(s), -3.0 + 0.3 * s], axis=-1)
    lat, lon = np.deg2rad(47.0) + 1e-6 * s, np.deg2rad(8.0) + 2e-6 * s
    v_n = np.stack([6.0 + 0 * s, 9.0 + s, 0.1 * s], axis=-1)
    time_ns = TIME_NS[0] + (s * 1e9).astype(np.int64)
    return Trajectory(time_ns, lat, lon, 400 - s, v_n, attitudes(*angles.T)), angles


# ---------------------------------------------------------------------------------- GNSS_IMU


def test_gnss_imu_in_si(tmp_path):
    path = tmp_path / "imu.csv"
    path.write_text("1756402240.9610007,1,0,-0.5,0.1,0.2,0.3,0,0,0,0\n" * 2)
    imu = open_log(path)
    assert imu.time_ns.tolist() == [1756402240961000700] * 2
    assert imu.accel[0].tolist() == [9.80665, 0.0, -4.903325]
    assert imu.gyro[0].tolist() == [0.1, 0.2, 0.3]
    assert (imu.kind, imu.source, imu.rows.tolist()) == ("rate", str(path), [1, 2])


# ---------------------------------------------------------------------------------- KF-GINS


EPOCH = datetime.datetime(1980, 1, 6)


def second_of_week(time_ns):
    """Week and its second by the calendar; stamps count from 1970 without leap seconds."""
    when = datetime.datetime(1970, 1, 1) + datetime.timedelta(microseconds=int(time_ns) // 1000)
    week, rest = divmod(when - EPOCH, datetime.timedelta(days=7))
    return week, rest.total_seconds()


def across_a_week(time_ns):
    """The same intervals, the end of week 2381 in their middle."""
    sunday = (datetime.datetime(2025, 8, 31) - datetime.datetime(1970, 1, 1)).days * 86400 * 10**9
    return time_ns - time_ns[len(time_ns) // 2] + sunday + 7


@pytest.mark.parametrize("moved", [lambda t: t, across_a_week])
def test_kfgins_nav_there_and_back(tmp_path, moved):
    truth, angles = path_over_hills()
    truth = dataclasses.replace(truth, time_ns=moved(truth.time_ns))
    path = tmp_path / "truth.nav"
    write_log(path, truth, "kfgins-nav")
    rows = np.array([line.split() for line in path.read_text().splitlines()], float)
    for row, time_ns in zip(rows, truth.time_ns, strict=True):
        assert tuple(row[:2]) == pytest.approx(second_of_week(time_ns), abs=2e-6)
    assert rows[0, 2:4] == pytest.approx([47.0, 8.0])
    expected = np.rad2deg(angles[0])
    assert rows[0, 8:] == pytest.approx([expected[0], expected[1], expected[2] + 360.0])
    back = open_log(path)
    np.testing.assert_array_equal(back.v_n, truth.v_n)
    np.testing.assert_array_equal(np.diff(back.time_ns), np.diff(truth.time_ns))
    assert back.time_ns[0] / 1e9 == pytest.approx(rows[0, 1], abs=1e-6)
    assert np.all(np.abs(np.abs(np.sum(back.q_nb * truth.q_nb, axis=-1)) - 1.0) < 1e-12)


def test_kfgins_without_weeks_goes_on_beyond_the_end_of_one(tmp_path):
    path = tmp_path / "imu.txt"
    table = dataclasses.replace(STEPS, time_ns=across_a_week(STEPS.time_ns))
    write_log(path, table, "kfgins-imu")
    week, first = second_of_week(table.time_ns[0])
    rows = np.loadtxt(path)
    assert rows[0, 0] == pytest.approx(first, abs=2e-6)
    assert rows[0, 0] < 604800.0 < rows[-1, 0]
    back = open_log(path)
    beginning = (EPOCH - datetime.datetime(1970, 1, 1)).days * 86400 + week * 604800
    np.testing.assert_array_equal(back.time_ns + beginning * 10**9, table.time_ns)
    write_log(path, table, "kfgins-imu", week=week - 1)
    np.testing.assert_array_equal(open_log(path).time_ns, back.time_ns + 604_800 * 10**9)


def test_kfgins_stamps_of_no_week_are_kept(tmp_path):
    """Stamps since power-up stay what they are; seconds that begin anew go on."""
    truth, _ = path_over_hills()
    powered = dataclasses.replace(truth, time_ns=truth.time_ns - truth.time_ns[0])
    path = tmp_path / "truth.nav"
    write_log(path, powered, "kfgins-nav", week=2300)
    assert path.read_text().startswith("2300 0.000 ")
    np.testing.assert_array_equal(open_log(path).time_ns, powered.time_ns)
    late = dataclasses.replace(STEPS, time_ns=STEPS.time_ns - STEPS.time_ns[0])
    write_log(path, late, "kfgins-imu")
    np.testing.assert_array_equal(open_log(path).time_ns, late.time_ns)
    # a recorder that counts seconds of the week begins anew at its end
    lines = [line.split(" ", 1) for line in path.read_text().splitlines()]
    seconds = [(604799.8 + 0.01 * k) % 604800 for k in range(len(lines))]
    rows = zip(seconds, lines, strict=True)
    path.write_text("".join(f"{s:.2f} {rest}\n" for s, (_, rest) in rows))
    np.testing.assert_array_equal(np.diff(open_log(path).time_ns), 10_000_000)


# ------------------------------------------------------------------------------------ pyins


def test_pyins_reads_what_we_write(tmp_path):
    from pyins import strapdown  # with Numba

    path = tmp_path / "imu.csv"
    write_log(path, RATES, "pyins-imu")
    frame = pd.read_csv(path, index_col="time")
    increments = strapdown.compute_increments_from_imu(frame, "rate")
    # One sample interval: the mean of its two rates, but for coning of second order in dt.
    mean = 0.5 * (RATES.gyro[1:] + RATES.gyro[:-1]) * 5.000001e-3
    theta = increments[["theta_x", "theta_y", "theta_z"]].to_numpy()
    np.testing.assert_allclose(theta, mean, atol=1e-4)


def test_we_read_what_pyins_makes(tmp_path):
    from pyins import sim, transform  # with Numba

    trajectory, imu = sim.generate_sine_velocity_motion(
        0.1, 3.0, [50.0, 60.0, 100.0], [1.0, -1.0, 0.5]
    )
    for name, frame in (("trajectory", trajectory), ("imu", imu)):
        frame.to_csv(tmp_path / f"{name}.csv")
    table = open_log(tmp_path / "imu.csv")
    assert table.kind == "rate"
    np.testing.assert_array_equal(np.hstack([table.gyro, table.accel]), imu.to_numpy())
    np.testing.assert_array_equal(table.time_ns, np.round(imu.index.to_numpy() * 1e9))
    path = open_log(tmp_path / "trajectory.csv")
    np.testing.assert_allclose(np.rad2deg(path.lat_rad), trajectory.lat, rtol=1e-15)
    np.testing.assert_array_equal(path.v_n, trajectory[["VN", "VE", "VD"]])
    C = transform.mat_from_rph(trajectory[["roll", "pitch", "heading"]])
    v_b = np.array([1.0, 2.0, 3.0])
    w, u = path.q_nb[:, :1], path.q_nb[:, 1:]
    rotated = v_b + 2 * np.cross(u, np.cross(u, v_b) + w * v_b)
    np.testing.assert_allclose(rotated, C @ v_b, atol=1e-12)


def test_pyins_columns_in_any_order_with_a_nameless_index(tmp_path):
    names = ("accel_z", "gyro_y", "temperature", "gyro_x", "accel_x", "accel_y", "gyro_z")
    frame = pd.DataFrame({n: [float(k), k + 0.5] for k, n in enumerate(names)})
    frame.to_csv(tmp_path / "imu.csv")
    table = open_log(tmp_path / "imu.csv")
    assert table.gyro[0].tolist() == [3.0, 1.0, 6.0]
    assert table.accel[1].tolist() == [4.5, 5.5, 0.5]


# ------------------------------------------------------------------------------------ EuRoC


def test_euroc_imu_is_written_as_its_tools_write_it(tmp_path):
    path = tmp_path / "data.csv"
    write_log(path, RATES, "euroc-imu")
    assert path.read_text().startswith(
        "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
        "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]\n1700000000123456789,"
    )


TRUTH = (
    "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], "
    "q_RS_z [], v_RS_R_x [m s^-1], v_RS_R_y [m s^-1], v_RS_R_z [m s^-1], b_w_RS_S_x [rad s^-1]\n"
)


def test_euroc_truth_at_an_origin(tmp_path):
    path = tmp_path / "data.csv"
    path.write_text(
        TRUTH
        + "1403636579758555392,0,0,0,0.6,0.8,0,0,1,2,3,9\n"
        + "1403636579763555584,30,40,-5,1,0,0,0,1,2,3,9\n"
    )
    findings = []
    at_sea = open_log(path, findings=findings)
    assert [(f.severity, f.code) for f in findings] == [("note", "no_place")]
    assert at_sea.lat_rad[0] == pytest.approx(0.0, abs=1e-15)
    truth = open_log(path, origin=Origin(47.0, 8.0, 430.0))
    assert truth.time_ns.tolist() == [1403636579758555392, 1403636579763555584]
    assert (truth.nav, truth.q_nb[0].tolist()) == ("ENU", pytest.approx([0.6, 0.8, 0, 0]))
    # 30 m east and 40 m north by the usual degrees per metre at 47 deg.
    assert np.rad2deg(truth.lat_rad[1]) - 47.0 == pytest.approx(40.0 / 111_173.0, rel=1e-4)
    assert np.rad2deg(truth.lon_rad[1]) - 8.0 == pytest.approx(30.0 / 76_056.0, rel=1e-3)
    assert truth.alt_m[1] == pytest.approx(425.0, abs=1e-3)  # the Earth falls off by 0.2 mm
    assert truth.v_n[1] == pytest.approx([1.0, 2.0, 3.0], abs=3e-5)  # other axes 50 m away


def test_a_quaternion_in_another_order_is_refused(tmp_path):
    path = tmp_path / "data.csv"
    path.write_text(TRUTH + "1,0,0,0,0.6,0.7,0,0,1,2,3,9\n")
    message = r"line 2: length of q_RS_w .* = 0.92.*: is not of unit length, as in 1 of 1"
    with pytest.raises(LogError, match=message):
        open_log(path)


# -------------------------------------------------------------------------------------- TUM


def test_tum_is_local_metres_with_the_scalar_last(tmp_path):
    from pyins import transform

    truth, angles = path_over_hills()
    path = tmp_path / "truth.tum"
    write_log(path, truth, "tum")
    text = path.read_text()
    lat, lon = np.rad2deg([truth.lat_rad[0], truth.lon_rad[0]]).tolist()
    assert text.startswith(
        f"# timestamp tx ty tz qx qy qz qw\n# origin: {lat!r} deg, {lon!r} deg, 400.0 m\n"
    )
    table = np.loadtxt(io.StringIO(text))
    np.testing.assert_allclose(table[:, 0], truth.time_ns * 1e-9, atol=3e-7)
    lat, lon = np.rad2deg([truth.lat_rad, truth.lon_rad])
    metres = transform.lla_to_ned(np.column_stack([lat, lon, truth.alt_m]))
    np.testing.assert_allclose(table[:, 1:4], metres[:, [1, 0, 2]] * [1, 1, -1], atol=1e-6)
    x, y, z, w = table[:, 4:].T
    forward = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], -1)
    _, pitch, heading = angles.T
    level = np.stack([np.sin(heading), np.cos(heading)]) * np.cos(pitch)
    expected = np.stack([*level, np.sin(pitch)], -1)
    np.testing.assert_allclose(forward, expected, atol=2e-5)  # local axes turn by 1e-5 on the way


def test_an_origin_that_is_given_wins_over_that_of_the_file(tmp_path):
    truth, _ = path_over_hills()
    path = tmp_path / "truth.csv"
    write_log(path, truth, "euroc-truth", origin=Origin(46.9, 8.1, 350.0))
    moved = open_log(path, origin=Origin(46.9, 9.1, 350.0))
    np.testing.assert_allclose(moved.lon_rad - truth.lon_rad, np.deg2rad(1.0), atol=1e-13)
    np.testing.assert_allclose(moved.v_n, truth.v_n[:, [1, 0, 2]] * [1, 1, -1], atol=1e-12)
    with pytest.raises(LogError, match="has no local metres to put at an origin"):
        open_log(path, "euroc-imu", origin=Origin(0.0, 0.0, 0.0))
    empty = Trajectory(*(a[:0] for a in dataclasses.astuple(truth)[:6]))
    with pytest.raises(LogError, match="has no points"):
        write_log(tmp_path / "x.tum", empty, "tum")
