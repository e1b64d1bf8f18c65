import lzma
from pathlib import Path

import numpy as np
import pytest
from made_nine_axis import broad_bytes
from made_ulog import flight

from robins.dataset import Dataset, GnssTable, ImuTable, Trajectory
from robins.logs import FORMATS, LogError, Mounting, load_dataset, open_log
from robins.logs.registry import recognise

GNSS_IMU = "".join(f"17564022{k}.961,0.01,0.02,1.01,0.1,0.2,0.3,0,0,0,0\n" for k in range(40, 60))
RTKLIB = (
    "%  GPST latitude(deg) longitude(deg) height(m) Q ns sdn(m) sde(m) sdu(m) sdne sdeu sdun age "
    "ratio\n" + "2025/08/28 17:30:39.749 40.5 -105.25 1601 1 25 0.01 0.02 0.03 0 0 0 0 9\n" * 3
)
KFGINS_IMU = "".join(
    f"456300.{k:03d} 1e-5 2e-5 -3e-5 1e-3 2e-3 -4.9e-2\n" for k in range(0, 100, 5)
)
KFGINS_GNSS = "".join(f"45630{k}.0 30.44 114.47 20.9 0.005 0.004 0.008\n" for k in range(9))
KFGINS_NAV = "".join(
    f"0 45630{k}.0 30.44 114.47 20.9 0.1 0.2 0.3 0.85 -2.0 185.7\n" for k in range(9)
)
PYINS_IMU = (
    "time,gyro_x,gyro_y,gyro_z,accel_x,accel_y,accel_z\n0,0,0,0,0,0,-9.8\n0.01,0,0,0,0,0,-9.8\n"
)
PYINS_STEPS = "t,dt,theta_x,theta_y,theta_z,dv_x,dv_y,dv_z\n0,0.01,0,0,0,0,0,-0.098\n"
PYINS_PATH = "time,lat,lon,alt,VN,VE,VD,roll,pitch,heading\n0,50,10,200,1,2,3,0,0,0\n"
EUROC_IMU = (
    "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
    "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]\n"
    "1403636579758555392,0,0,0,9.8,0,0\n"
)
EUROC_TRUTH = (
    "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z "
    "[], v_RS_R_x [m s^-1], v_RS_R_y [m s^-1], v_RS_R_z [m s^-1], b_w_RS_S_x [rad s^-1]\n"
    "1403636580838555648,4.6,-1.7,0.7,1,0,0,0,0,0,0,0\n"
)
NAMED_IMU = (
    "# frames: FRD\ntime_s,gyro_x_deg_s,gyro_y_deg_s,gyro_z_deg_s,accel_x_g,accel_y_g,accel_z_g\n"
    "0.01,0,0,0,0,0,-1\n"
)
NAMED_PATH = (
    "time_ms,lat_deg,lon_deg,height_m,v_north_m_s,v_east_m_s,v_down_m_s,q_w,q_x,q_y,q_z\n"
    "100,48,11,500,1,2,0,1,0,0,0\n"
)
XIO = (
    "Time (s),Gyroscope X (deg/s),Gyroscope Y (deg/s),Gyroscope Z (deg/s),Accelerometer X (g),"
    "Accelerometer Y (g),Accelerometer Z (g),Magnetometer X (uT),Magnetometer Y (uT),"
    "Magnetometer Z (uT)\n0.01,0,0,0,0,0,1,15,1,-41\n"
)
PHONE = (
    "time,bearingAccuracy,speedAccuracy,verticalAccuracy,horizontalAccuracy,speed,bearing,altitude,"
    "longitude,latitude,acc_z,acc_y,acc_x,gyro_z,gyro_y,gyro_x,mag_z,mag_y,mag_x\n"
    "2025-06-11 20:34:27+00:00,9,1,3,5,2,30,23,-75.1,39.9,9.8,0,0,0,0,0,-40,20,1\n"
)
SAMPLES = {
    "gnss-imu": (GNSS_IMU, ImuTable),
    "rtklib-pos": (RTKLIB, GnssTable),
    "kfgins-imu": (KFGINS_IMU, ImuTable),
    "kfgins-gnss": (KFGINS_GNSS, GnssTable),
    "kfgins-nav": (KFGINS_NAV, Trajectory),
    "pyins-imu": (PYINS_IMU, ImuTable),
    "pyins-trajectory": (PYINS_PATH, Trajectory),
    "euroc-imu": (EUROC_IMU, ImuTable),
    "euroc-truth": (EUROC_TRUTH, Trajectory),
    "named-imu": (NAMED_IMU, ImuTable),
    "named-path": (NAMED_PATH, Trajectory),
    "xio-csv": (XIO, Dataset),
    "phone-csv": (PHONE, Dataset),
    "broad-npz": (broad_bytes(), Dataset),
    "px4-ulog": (flight(0.1)[0], Dataset),
}


def test_there_is_a_sample_of_every_format():
    assert set(SAMPLES) == {f.name for f in FORMATS}


@pytest.mark.parametrize("name", SAMPLES)
@pytest.mark.parametrize("pack", [bytes, lzma.compress], ids=["", "xz"])
def test_every_format_is_recognised_by_content_alone(tmp_path, name, pack):
    if name == "px4-ulog":
        pytest.importorskip("pyulog", reason="the extra `logs` is not installed")
    content, kind = SAMPLES[name]
    path = tmp_path / "no_telling_name"
    path.write_bytes(pack(content.encode() if isinstance(content, str) else content))
    assert recognise(path).name == name
    assert isinstance(open_log(path, findings=[]), kind)


def test_increments_of_pyins_are_recognised_too(tmp_path):
    path = tmp_path / "increments.csv"
    path.write_text(PYINS_STEPS)
    assert open_log(path).kind == "increment"


def test_a_recording_that_began_mid_line_is_still_recognised(tmp_path):
    path = tmp_path / "imu.csv"
    path.write_text(GNSS_IMU[15:])
    assert recognise(path).name == "gnss-imu"


def test_an_unknown_file_is_refused_with_the_candidates(tmp_path):
    path = tmp_path / "notes.txt"
    path.write_text("dear diary\n")
    with pytest.raises(LogError) as caught:
        open_log(path)
    text = str(caught.value)
    first, *rows = text.splitlines()
    assert first == (
        f"{path} line 1: no known format fits ('dear diary'); "
        "name the format, or convert the file to one of these:"
    )
    assert [row.split(maxsplit=1) for row in rows] == [[f.name, f.about] for f in FORMATS]
    assert max(map(len, rows)) < 120


def test_decimal_commas_are_told_when_no_format_fits(tmp_path):
    path = tmp_path / "comma.csv"
    path.write_text("1756402240,961;0,01;0,02;1,01;0,1;0,2;0,3\n" * 3)
    with pytest.raises(LogError, match=r"write numbers with a decimal point, not a comma:\n"):
        open_log(path)


def test_a_format_that_does_not_exist(tmp_path):
    with pytest.raises(LogError, match="no format is called 'kitti'; choose one of rtklib-pos, "):
        open_log(tmp_path / "x", "kitti")


def test_the_wrong_format_is_refused_not_misread(tmp_path):
    path = tmp_path / "imu.csv"
    path.write_text(GNSS_IMU)
    for name in ("kfgins-imu", "kfgins-nav", "rtklib-pos", "euroc-truth", "pyins-imu"):
        with pytest.raises(LogError):
            open_log(path, name, [])


@pytest.fixture
def three(tmp_path):
    paths = {}
    for name in ("kfgins-imu", "kfgins-gnss", "kfgins-nav"):
        paths[name] = tmp_path / f"{name}.txt"
        paths[name].write_text(SAMPLES[name][0])
    return paths


def test_files_of_one_recording_become_one_dataset(three):
    paths = [three["kfgins-nav"], str(three["kfgins-imu"]), three["kfgins-gnss"]]
    data = load_dataset(paths, mounting=Mounting(180.0, lever_arm_b_m=(0.1, 0.2, 0.3)))
    assert data.name == "kfgins-imu"
    assert data.meta["files"] == {
        "imu": str(three["kfgins-imu"]),
        "gnss": str(three["kfgins-gnss"]),
        "truth": str(three["kfgins-nav"]),
    }
    assert data.meta["lever_arm_b_m"] == (0.1, 0.2, 0.3)
    assert data.meta["findings"] == []
    plain = load_dataset(paths, name="mine")
    assert plain.name == "mine"
    np.testing.assert_array_equal(data.imu.gyro, plain.imu.gyro * [1, -1, -1])


def test_findings_of_readers_come_along(three):
    path = Path(three["kfgins-imu"])
    path.write_text(path.read_text()[:-3])
    assert [f.code for f in load_dataset([path]).meta["findings"]] == ["ends_early"]


def test_a_named_format_overrides_recognition(three):
    path = str(three["kfgins-gnss"])
    data = load_dataset([path], formats={path: "kfgins-imu"})
    assert data.imu.gyro[0].tolist() == [30.44, 114.47, 20.9]


@pytest.mark.parametrize(
    ("names", "formats", "message"),
    [
        ([], None, r"^\(no file\): no IMU log among the files; give one IMU log"),
        (["kfgins-gnss"], None, "no IMU log among the files"),
        (["kfgins-imu", "kfgins-imu"], None, "is a second file of the kind of .*; give one of the"),
        (["kfgins-imu"], {"other.txt": "kfgins-gnss"}, "other.txt: a format is given, but not the"),
    ],
)
def test_sets_of_files_that_make_no_dataset(three, names, formats, message):
    with pytest.raises(LogError, match=message):
        load_dataset([three[n] for n in names], formats=formats)
