"""Files and folders of other programs: read to the numbers that they hold, by other arithmetic."""

import contextlib
import gzip
import struct

import h5py
import made_wild as wild
import numpy as np
import pytest
import scipy.io
from made_nine_axis import HZ, tumble
from scipy.spatial.transform import Rotation

from robins.dataset import Dataset, ImuTable, Trajectory
from robins.logs import LogError, columns_from, examine, formats_of, load_dataset, open_log
from robins.logs.archives import arrays_in
from robins.logs.merging import interpolated

G = 9.80665


def opened(tmp_path, content, name="log"):
    path = tmp_path / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return open_log(path, None, [])


def turned(q, v):
    """A vector of the body along the axes to which a quaternion with its scalar first turns."""
    return Rotation.from_quat(q[..., [1, 2, 3, 0]]).apply(v)


# -------------------------------------------------------------------------------------- paths


def test_poses_without_a_header_turn_and_lie_as_they_should(tmp_path):
    """A yaw of 2 atan(0.8 / 0.6) about up: forward is (-0.28, 0.96, 0) of east, north, up."""
    (tmp_path / "times.txt").write_text(wild.KITTI_TIMES)
    plain = "".join(f"{5.0 + 0.1 * k:.2f} {k} 2 3 0 0 0.8 0.6\n" for k in range(20))
    ov_eval = "# timestamp(s) tx ty tz qx qy qz qw Pr11 Pr12 Pr13\n" + plain.replace(
        "\n", " 1 0 0\n"
    )
    orbslam = wild.ORBSLAM.replace("0.0 0.0 0.6 0.8", "0.0 0.0 0.8 0.6")
    openvins = wild.OPENVINS.replace("0.600000 0.800000", "0.800000 0.600000")
    for text in (plain, ov_eval, orbslam, openvins):
        path = opened(tmp_path, text)
        assert isinstance(path, Trajectory)
        np.testing.assert_allclose(turned(path.q_nb, [1, 0, 0])[0], [-0.28, 0.96, 0], atol=1e-6)
        assert path.lon_rad[-1] > path.lon_rad[0]
    # ten metres to the east at the equator of a = 6378137 m
    assert opened(tmp_path, plain).lon_rad[10] == pytest.approx(10.0 / 6378140.0, rel=1e-6)
    assert opened(tmp_path, openvins).v_n[0] == pytest.approx([0.1, 0.2, 0.3], abs=1e-6)
    drive = opened(tmp_path, wild.KITTI)  # 1 m right, 2 m up, 3 m ahead a line; camera level
    r = 6378137.0
    moved = drive.lon_rad[10] * r, drive.lat_rad[10] * 6335439.3, drive.alt_m[10]
    assert moved == pytest.approx((10.0, 30.0, 20.0), rel=1e-4)
    for axis, way in zip(np.eye(3), ([0, 1, 0], [1, 0, 0], [0, 0, -1]), strict=True):
        np.testing.assert_allclose(turned(drive.q_nb, axis)[0], way, atol=1e-7)
    (tmp_path / "times.txt").write_text(wild.KITTI_TIMES[:-13])
    with pytest.raises(LogError, match=r"has 20 poses, and .*times.txt 19 times"):
        opened(tmp_path, wild.KITTI)


def test_the_pose_of_a_motion_capture_needs_no_velocity(tmp_path):
    header = "#timestamp [ns], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], "
    text = header + "q_RS_y [], q_RS_z []\n1403636580838555648,4.6,-1.7,0.7,0.6,0,0,0.8\n"
    path = opened(tmp_path, text)
    assert np.isnan(path.v_n).all()
    np.testing.assert_allclose(turned(path.q_nb, [1, 0, 0])[0], [-0.28, 0.96, 0], atol=1e-5)


def test_solutions_of_receivers(tmp_path):
    found = opened(tmp_path, wild.INSPVA)
    assert found.time_ns.tolist() == [(315964800 + 1264 * 604800 + 144088) * 10**9 + 2284950]
    assert found.v_n.tolist() == [[354.846489850, 108.429407241, 10.837482850]]
    attitude = Rotation.from_euler("ZYX", [7.372686190, -3.476059035, 1.116219952], degrees=True)
    np.testing.assert_allclose(turned(found.q_nb, [1, 2, 3])[0], attitude.apply([1, 2, 3]))
    body = wild.INSPVA[1 : wild.INSPVA.index("*")].encode()
    crc = 0
    for byte in body:  # as the manual has it, bit by bit
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0xEDB88320 if crc & 1 else 0)
    assert wild.INSPVA.rstrip().endswith(f"*{crc:08x}")
    with pytest.raises(LogError, match="holds no whole INSPVA line"):
        opened(tmp_path, wild.INSPVA.replace("354.8", "355.8"))
    findings = []
    (tmp_path / "log").write_text(wild.INSPVA + wild.INSPVA.replace("108", "109"))
    assert len(open_log(tmp_path / "log", None, findings)) == 1
    assert [f.code for f in findings] == ["lines_left_out"]
    sbet = opened(tmp_path, wild.SBET)
    assert np.diff(sbet.time_ns).tolist() == [5_000_000] * 8
    assert (sbet.lat_rad[0], sbet.lon_rad[0], sbet.alt_m[0]) == (0.8, 0.2, 300.0)
    attitude = Rotation.from_euler("ZYX", [1.5 - 0.5, 0.2, 0.1])
    np.testing.assert_allclose(turned(sbet.q_nb, [1, 2, 3])[0], attitude.apply([1, 2, 3]))
    assert len(opened(tmp_path, wild.SBET[:-5])) == 8


def test_units_of_makers(tmp_path):
    mt, dot = opened(tmp_path, wild.XSENS_MT), opened(tmp_path, wild.XSENS_DOT)
    assert (np.diff(mt.time_ns)[0], mt.gyro[0, 2], mt.accel[0, 2]) == (10_000_000, 0.03, 9.8)
    assert np.diff(dot.time_ns)[0] == 16_667_000
    np.testing.assert_allclose(dot.gyro[0], [np.pi / 2, np.pi, -np.pi / 2])
    micro, vector = opened(tmp_path, wild.MICROSTRAIN), opened(tmp_path, wild.VECTORNAV)
    np.testing.assert_allclose(micro.imu.accel[0], [0.05 * G, 0.04 * G, -G])
    np.testing.assert_allclose(micro.mag.field_t[0], [-15e-6, -18e-6, 50e-6])
    assert np.diff(micro.imu.time_ns)[0] == 10_000_000
    np.testing.assert_allclose(vector.mag.field_t[0], [20e-6, 0, 45e-6])
    assert np.diff(vector.imu.time_ns)[0] == 2_500_000


# ----------------------------------------------------------------------------------- archives

ARRAYS = wild.named()


def archives(tmp_path):
    """The same samples as each program writes them: path, and what the name of a column is."""
    pa = pytest.importorskip("pyarrow", reason="the extra `parquet` is not installed")
    parquet = pytest.importorskip("pyarrow.parquet")
    struct_of = {"imu": ARRAYS, "note": "text", "cells": np.array([1, "a"], object)}
    scipy.io.savemat(tmp_path / "v5.mat", struct_of)
    scipy.io.savemat(tmp_path / "packed.mat", struct_of, do_compression=True)
    for name, columns in (("group.h5", 1), ("v73.mat", -1)):
        size = 512 if name == "v73.mat" else 0
        with h5py.File(tmp_path / name, "w", userblock_size=size) as file:
            for key, array in ARRAYS.items():  # MATLAB stores (1, n) for its column of n
                file[f"imu/{key}"] = array if columns == 1 else array[None]
            file["elsewhere"] = h5py.ExternalLink("other.h5", "/x")
    with open(tmp_path / "v73.mat", "r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64")
    np.savez_compressed(tmp_path / "a.npz", **{f"imu/{k}": v for k, v in ARRAYS.items()})
    parquet.write_table(
        pa.table({f"imu/{k}": v for k, v in ARRAYS.items()}), tmp_path / "a.parquet"
    )
    return [
        tmp_path / n for n in ("v5.mat", "packed.mat", "group.h5", "v73.mat", "a.npz", "a.parquet")
    ]


def test_an_archive_is_read_by_declared_names_and_used(tmp_path):
    units = {"time": "s", "gyro": "deg/s", "accel": "g"}
    columns = [("time", "time_s")]
    columns += [(f"{s}_{a}", f"{s}_{a}_{u}") for s, u in (("gyro", "deg_s"), ("accel", "g"))
                for a in "xyz"]  # fmt: skip
    lines = [f'{q} = {{ name = "imu/{n}", unit = "{units[q.split("_")[0]]}" }}' for q, n in columns]
    declared = tmp_path / "own.toml"
    declared.write_text("\n".join(["[columns]", *lines]))
    for path in archives(tmp_path):
        imu = load_dataset([path], formats=formats_of([path], [declared])).imu
        np.testing.assert_array_equal(imu.time_ns, np.arange(40) * 10_000_000)
        np.testing.assert_allclose(imu.gyro[:, 1], np.deg2rad(ARRAYS["gyro_y_deg_s"]), rtol=1e-15)
        np.testing.assert_allclose(imu.accel[:, 2], ARRAYS["accel_z_g"] * G, rtol=1e-15)
        with pytest.raises(LogError, match=r"no known format has arrays of these names: imu/"):
            open_log(path)


def test_matlab_is_read_as_scipy_reads_it(tmp_path):
    rng = np.random.default_rng(2)
    kinds = ("f8", "f4", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8")
    content = {k: (100 * rng.random((7, 3))).astype(k) for k in kinds}
    content |= {"flag": np.array([[True, False]]), "s": {"t": {"x": content["f8"]}, "c": 1j}}
    for packed in (False, True):
        scipy.io.savemat(tmp_path / "a.mat", content, do_compression=packed)
        found, wanted = arrays_in(tmp_path / "a.mat"), scipy.io.loadmat(tmp_path / "a.mat")
        assert set(found) == {*kinds, "flag", "s/t/x"}
        for k in (*kinds, "flag"):
            np.testing.assert_array_equal(found[k], wanted[k])
        np.testing.assert_array_equal(found["s/t/x"], wanted["s"][0, 0]["t"][0, 0]["x"])


def test_a_matrix_is_columns_and_a_plain_file_has_places(tmp_path):
    rows = np.arange(70.0).reshape(10, 7)
    lines = [f'{q} = {{ place = {k}, unit = "{u}" }}' for k, (q, u) in enumerate(
        [("time", "s"), *((f"gyro_{a}", "rad/s") for a in "xyz"),
         *((f"accel_{a}", "m/s^2") for a in "xyz")], start=1)]  # fmt: skip
    (tmp_path / "own.toml").write_text("\n".join(["[columns]", *lines]))
    np.save(tmp_path / "log.npy", rows)
    imu = open_log(tmp_path / "log.npy", columns_from(tmp_path / "own.toml"))
    np.testing.assert_array_equal(imu.gyro, rows[:, 1:4])
    for line, name in zip(lines, ("t", *(f"m/g[:,{k}]" for k in range(3)), *(
        f"m/a[:,{k}]" for k in range(3))), strict=True):  # fmt: skip
        text = (tmp_path / "own.toml").read_text()
        place = line.split(",")[0].split("{ ")[1]
        (tmp_path / "own.toml").write_text(text.replace(place + ",", f'name = "{name}",'))
    m = {"g": rows[:, 1:4].T, "a": rows[:, 4:]}
    scipy.io.savemat(tmp_path / "log.mat", {"t": rows[:, 0], "m": m})
    imu = open_log(tmp_path / "log.mat", columns_from(tmp_path / "own.toml"))
    np.testing.assert_array_equal(imu.accel, rows[:, 4:])
    scipy.io.savemat(tmp_path / "log.mat", {"t": rows[:9, 0], "m": m})
    with pytest.raises(LogError, match=r"the columns differ in length: t 9, m/g\[:,0\] 10"):
        open_log(tmp_path / "log.mat", columns_from(tmp_path / "own.toml"))


def test_arrays_named_as_the_columns_of_a_text_need_no_declaration(tmp_path):
    imu = opened(tmp_path, wild.bytes_of(np.savez, **ARRAYS))
    np.testing.assert_allclose(imu.gyro[:, 0], np.deg2rad(ARRAYS["gyro_x_deg_s"]), rtol=1e-15)


def test_broad_in_all_its_archives(tmp_path):
    arrays = tumble(2.0)
    scipy.io.savemat(tmp_path / "trial.mat", arrays)
    with h5py.File(tmp_path / "trial.hdf5", "w") as file:
        for name, array in arrays.items():
            file[name] = array
        file.attrs["sampling_rate"] = file["sampling_rate"][()]  # as in those published
        del file["sampling_rate"]
    np.savez(tmp_path / "trial.npz", **arrays)
    trials = [open_log(tmp_path / f"trial.{end}") for end in ("npz", "mat", "hdf5")]
    for trial in trials:
        assert isinstance(trial, Dataset)
        assert np.diff(trial.imu.time_ns)[0] == 1e9 / HZ
        for table, field in (
            ("imu", "gyro"),
            ("mag", "field_t"),
            ("attitude", "q_nb"),
            ("attitude", "moving"),
        ):
            one, other = (getattr(getattr(t, table), field) for t in (trial, trials[0]))
            np.testing.assert_array_equal(one, other)


# ------------------------------------------------------------------------------------ folders


def test_specific_forces_on_the_clock_of_the_gyros():
    now = np.arange(10) * 10_000_000 + 10**18
    then = np.array([20, 0, 70]) * 1_000_000 + 10**18  # in any order
    force = np.stack([then - 10.0**18] * 3, axis=-1)
    found = interpolated(now, then, force)
    assert np.isnan(found[8:]).all()
    np.testing.assert_allclose(found[:8, 0], (now - 10**18)[:8], atol=1.0)


def test_euroc_as_one_recording(tmp_path):
    imu = "#timestamp [ns]," + ",".join(
        f"{q}_RS_S_{a} [{u}]" for q, u in (("w", "rad s^-1"), ("a", "m s^-2")) for a in "xyz"
    )
    pose = "#timestamp [ns], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], "
    for sensor, text in (
        ("imu0", f"{imu}\n1403636579758555392,1,2,3,9.8,0,0\n"),
        (
            "state_groundtruth_estimate0",
            f"{pose}q_RS_y [], q_RS_z []\n1403636579758555392,0,0,5,1,0,0,0\n",
        ),
    ):
        (tmp_path / "MH_01" / "mav0" / sensor).mkdir(parents=True)
        (tmp_path / "MH_01" / "mav0" / sensor / "data.csv").write_text(text)
    for folder in (tmp_path / "MH_01", tmp_path / "MH_01" / "mav0"):
        data = load_dataset([folder])
        assert (data.imu.gyro[0].tolist(), len(data.truth)) == ([1, 2, 3], 1)


def test_kitti_raw_data(tmp_path):
    oxts = tmp_path / "drive" / "oxts"
    (oxts / "data").mkdir(parents=True)
    for k in range(3):
        (oxts / "data" / f"{k:010d}.txt").write_text(wild.OXTS)
    (oxts / "timestamps.txt").write_text(
        "".join(f"2011-09-26 13:02:25.{964389445 + 10**7 * k}\n" for k in range(3))
    )
    data = load_dataset([tmp_path / "drive"])
    assert np.diff(data.imu.time_ns).tolist() == [10**7] * 2
    assert data.imu.time_ns[0] == (1317042145 + 15) * 10**9 + 964389445  # 15 leap seconds in 2011
    numbers = np.array(wild.OXTS.split(), float)
    np.testing.assert_array_equal(data.imu.accel[0], numbers[11:14] * [1, -1, -1])
    np.testing.assert_array_equal(data.imu.gyro[0], numbers[17:20] * [1, -1, -1])
    # forward is along the velocity, and specific force is up, by the attitude
    forward, v = turned(data.truth.q_nb, [1, 0, 0])[0], data.truth.v_n[0]
    assert forward @ v / np.linalg.norm(v) > 0.999
    assert turned(data.truth.q_nb, data.imu.accel)[0, 2] == pytest.approx(-10.0, abs=0.1)
    assert data.gnss.sigma_m[0].tolist() == [0.49229361157748] * 3
    (oxts / "data" / "0000000002.txt").unlink()
    with pytest.raises(LogError, match=r"timestamps.txt has 3 stamps for 2 files in data"):
        open_log(tmp_path / "drive")


LOGGER = "time,seconds_elapsed,z,y,x\n"
PLACES = (
    "time,seconds_elapsed,bearingAccuracy,speedAccuracy,verticalAccuracy,horizontalAccuracy,speed,"
    "bearing,altitude,longitude,latitude\n1700000000000000000,0,10,0.5,3,15.1,2,90,40,-75.15,39.98\n"
    "1700000001000000000,1,-1,-1,3,15.1,-1,-1,40,-75.15,39.98\n"
)


def phone(folder, files):
    folder.mkdir(exist_ok=True)
    for name, text in files.items():
        (folder / f"{name}.csv").write_text(text)
    return load_dataset([folder])


def logger(*rows):
    return LOGGER + "".join(f"{1700000000 + k}000000000,{k},{r}\n" for k, r in enumerate(rows))


def test_sensor_logger_of_both_makes(tmp_path):
    files = {"Gyroscope": logger("3,2,1", "3,2,1"), "Location": PLACES}
    total = {"TotalAcceleration": logger("9.8,0.2,0.1", "9.8,0.2,0.1")}
    android = phone(
        tmp_path / "a", files | total | {"Magnetometer": logger("-40,20,1", "-40,20,1")}
    )
    meta = "version,platform,standardisation\n3,{},{}\n"
    apart = {
        "Accelerometer": logger("-0.5,-0.2,0", "-0.5,-0.2,0"),
        "Gravity": logger("-9.3,0,-0.1", "-9.3,0,-0.1"),
    }
    apple = phone(tmp_path / "i", files | apart | {"Metadata": meta.format("ios", "false")})
    for data in (android, apple):
        np.testing.assert_allclose(data.imu.accel[0], [0.1, 0.2, 9.8], atol=1e-12)
        assert (data.imu.gyro[0].tolist(), data.imu.body) == ([1, 2, 3], "RFU")
        assert data.imu.time_ns[0] == data.gnss.time_ns[0] == (1700000000 + 18) * 10**9
        assert data.gnss.v_n[0, 1] == pytest.approx(2.0)
        assert np.isnan(data.gnss.v_n[1]).all()
    np.testing.assert_allclose(android.mag.field_t[0], [1e-6, 20e-6, -40e-6])
    with pytest.raises(LogError, match=r"Gyroscope.csv line 1: no column fits y; there are time"):
        phone(tmp_path / "b", files | total | {"Gyroscope": logger("3,2,1").replace("y", "v")})
    with pytest.raises(LogError, match="so the sign is not known"):
        phone(tmp_path / "n", files | apart)


def test_phyphox_with_decimal_commas(tmp_path):
    def sheet(names, *rows):
        return "\n".join([";".join(f'"{n}"' for n in names), *rows]) + "\n"

    xyz = [f"{a} (rad/s)" for a in "XYZ"]
    forces = [f"Acceleration {a} (m/s^2)" for a in "xyz"]
    fixes = ["Time (s)", "Latitude (°)", "Longitude (°)", "Height (m)", "Velocity (m/s)",
             "Direction (°)", "Horizontal Accuracy (m)", "Vertical Accuracy (m)"]  # fmt: skip
    data = phone(tmp_path / "p", {
        "Gyroscope": sheet(["Time (s)", *xyz], "1,0E-2;0,1;0,2;0,3", "2,0E-2;0,1;0,2;0,3"),
        "Accelerometer": sheet(["Time (s)", *forces], "0,0E0;0;0;9", "3,0E-2;0;0;12"),
        "Location": sheet(fixes, "0,5;50,5;6,25;200;1,5;90;5;4"),
    })  # fmt: skip
    np.testing.assert_allclose(data.imu.accel[:, 2], [10.0, 11.0])
    assert data.imu.gyro[1].tolist() == [0.1, 0.2, 0.3]
    np.testing.assert_allclose(
        np.rad2deg([data.gnss.lat_rad[0], data.gnss.lon_rad[0]]), [50.5, 6.25]
    )
    assert data.gnss.v_n is None or data.gnss.v_n[0, 1] == pytest.approx(1.5)


def test_gnss_ins_sim(tmp_path):
    def sheet(names, *rows):
        return ",".join(names) + "\n" + "".join(",".join(map(str, r)) + "\n" for r in rows)

    def three(stem, unit):
        return [f"{stem}_{a} ({unit})" for a in "xyz"]

    place = ("lat (deg)", "lon (deg)", "alt (m)")
    gps = [f"gps_{n}" for n in (*place, "vN (m/s)", "vE (m/s)", "vD (m/s)")]
    lla = [f"ref_pos_{n}" for n in place]
    euler = [f"ref_{n} (deg)" for n in ("Yaw", "Pitch", "Roll")]
    data = phone(tmp_path / "s", {
        "time": sheet(["time (sec)"], [0.0], [0.01]),
        "gyro-0": sheet(three("gyro", "deg/s"), [180, 0, 0], [180, 0, 0]),
        "accel-0": sheet(three("accel", "m/s^2"), [0, 0, -9.8], [0, 0, -9.8]),
        "gps_time": sheet(["gps_time (sec)"], [0.0]),
        "gps-0": sheet(gps, [32, 120, 5, 1, 2, 3]),
        "ref_pos": sheet(lla, [32, 120, 5], [32, 120, 5]),
        "ref_vel": sheet(three("ref_vel", "m/s"), [1, 2, 3], [1, 2, 3]),
        "ref_att_euler": sheet(euler, [90, 0, 0], [90, 0, 0]),
    })  # fmt: skip
    assert data.imu.gyro[0, 0] == pytest.approx(np.pi)
    assert data.gnss.v_n[0].tolist() == data.truth.v_n[1].tolist() == [1, 2, 3]
    np.testing.assert_allclose(turned(data.truth.q_nb, [1, 0, 0])[0], [0, 1, 0], atol=1e-12)
    assert np.rad2deg(data.gnss.lat_rad[0]) == pytest.approx(32.0)


def test_a_folder_that_is_no_recording_says_what_it_holds(tmp_path):
    (tmp_path / "photo.jpg").write_text("")
    with pytest.raises(
        LogError,
        match=r"is a folder with photo.jpg; give files, or the folder of a",
    ):
        open_log(tmp_path)


# ------------------------------------------------------------------------------------- damage


def test_damaged_files_are_read_or_refused(tmp_path):
    """Bits, cuts and sizes changed in every kind of file: read or refused by a `LogError`."""
    rng = np.random.default_rng(11)
    files = [path.read_bytes() for path in archives(tmp_path)]
    files += [wild.SBET, wild.INSPVA.encode(), wild.KITTI.encode(), wild.XSENS_DOT.encode()]
    files += [wild.bytes_of(np.save, np.ones((9, 7))), gzip.compress(files[0])]
    path = tmp_path / "damaged"
    for content in files:
        for _ in range(8):
            data = bytearray(content)
            for at in rng.integers(0, len(data), 1 + rng.integers(4)):
                data[at] = rng.integers(256)
            if rng.random() < 0.3:
                data = data[: rng.integers(1, len(data))]
            if rng.random() < 0.3 and len(data) > 8:
                at = 4 * int(rng.integers(len(data) // 4))
                data[at : at + 4] = struct.pack("<I", 2**31 - 1)
            path.write_bytes(bytes(data))
            with contextlib.suppress(LogError):
                open_log(path, None, [])


def test_an_archive_is_examined_as_any_log(tmp_path):
    t = np.arange(200) / 100.0
    still = {f"gyro_{a}_rad_s": 1e-3 * np.sin(9 * t + k) for k, a in enumerate("xyz")}
    still |= {f"accel_{a}_m_s2": (a == "z") * -1.0 + 1e-3 * np.cos(7 * t) for a in "xyz"}
    imu = opened(tmp_path, wild.bytes_of(np.savez, time_s=t, **still))
    assert isinstance(imu, ImuTable)
    assert "gravity_unit" in [f.code for f in examine(imu)]
