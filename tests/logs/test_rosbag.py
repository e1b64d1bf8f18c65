"""Recordings of ROS 2: read from bytes by hand, written and read by others, damaged, refused."""

import dataclasses
import math
import stat
import struct
import warnings
from io import BytesIO

import lz4.frame
import numpy as np
import pytest
import zstandard
from made_rosbag import FIX, IMU, MAG, NS, drive, fix, header, imu, rosbag
from mcap.reader import make_reader
from mcap.writer import CompressionType

from robins import foreign
from robins.dataset import AttitudeTable, Dataset, GnssTable, ImuTable, MagTable, Trajectory
from robins.gps_time import gps_of, utc_of
from robins.ins.frames import to_enu_rfu
from robins.logs import LogError, LogWarning, load_dataset, open_log, write_log
from robins.logs.timebase import calendar_to_ns

BEGIN = 1_756_402_219 * NS  # UTC, 2025-08-28 17:30:19


def read(path, content, findings=None):
    path.write_bytes(content)
    return open_log(path, findings=[] if findings is None else findings)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "drive.mcap"


# ------------------------------------------------------------------------------------------ reading


@pytest.mark.parametrize("compression", CompressionType)
def test_a_drive_is_read_into_the_tables_of_robins(path, compression):
    data, findings = read(path, rosbag(drive(), compression), findings := []), findings
    assert findings == []
    assert isinstance(data, Dataset)
    assert (data.name, data.time_unit_known) == ("drive", (str(path),))
    assert (len(data.imu), len(data.mag), len(data.gnss)) == (30, 30, 3)
    gps = calendar_to_ns("2025/8/28", "17:30:19", utc=True)
    assert data.imu.time_ns.tolist() == [gps + k * NS // 10 for k in range(30)]
    assert gps == BEGIN + 18 * NS
    assert (data.imu.kind, data.imu.body, data.mag.body) == ("rate", "FRD", "FRD")
    # forward, right, down: of forward, left, up the last two turned
    assert np.unique(data.imu.gyro, axis=0).tolist() == [[0.01, -0.02, -0.03]]
    assert np.unique(data.imu.accel, axis=0).tolist() == [[0.0, -0.1, -9.8]]
    assert np.unique(data.mag.field_t, axis=0).tolist() == [[2e-5, -1e-6, 4e-5]]
    fixes = data.gnss
    assert fixes.time_ns.tolist() == [gps + k * NS for k in range(3)]
    assert fixes.lat_rad[0] == math.radians(48.0)
    assert fixes.lon_rad[0] == math.radians(11.0)
    assert (fixes.alt_m[0], fixes.quality[0], fixes.nav) == (500.0, 5, "NED")
    assert fixes.sigma_m.tolist() == [[2.0, 1.0, 3.0]] * 3  # north, east, down
    assert fixes.v_n is None


def test_what_is_not_known_is_missing(path):
    data = read(
        path,
        rosbag(
            [
                ("/imu", IMU, imu(5, (1, 2, 3), (4, 5, 6), known=(-1, -1, 0))),
                ("/imu", IMU, imu(6, (1, math.nan, 3), (4, 5, 6), known=(0, 0, -1))),
                ("/fix", FIX, fix(5, (48, 11, 500), (1, 1, 1), status=-1)),
                ("/fix", FIX, fix(6, (48, 11, math.nan), (1, 1, 1), status=1, kind=0)),
                ("/fix", FIX, fix(7, (48, 11, 1), (1, 1, 1), status=2, kind=3)),
            ]
        ),
    )
    np.testing.assert_array_equal(data.imu.gyro, [[math.nan] * 3, [1, math.nan, -3]])
    np.testing.assert_array_equal(data.imu.accel, [[4, -5, -6], [math.nan] * 3])
    assert data.imu.time_ns.tolist() == [5, 6]  # of a clock that began at zero, not UTC
    assert data.mag is None
    fixes = data.gnss
    assert np.isnan([fixes.lat_rad[0], fixes.lon_rad[0], fixes.alt_m[0], fixes.alt_m[1]]).all()
    assert fixes.lat_rad[1] == math.radians(48)
    np.testing.assert_array_equal(fixes.sigma_m, [[1] * 3, [math.nan] * 3, [1] * 3])
    assert fixes.quality.tolist() == [0, 3, 4]


def test_the_first_of_several_topics_is_read(path):
    other = [("/rear/imu", IMU, imu(k, (9, 9, 9), (9, 9, 9))) for k in range(3)]
    found = []
    data = read(path, rosbag([*drive(), *other, ("/chatter", "std_msgs/msg/String", b"")]), found)
    assert len(data.imu) == 30
    (note,) = found
    assert (note.severity, note.code, note.value) == ("note", "several_instances", 2)
    assert "the first, /imu, is read and the others are left alone: /rear/imu." in note.sentence


def test_fixes_or_field_alone_are_a_table(path):
    fixes = read(path, rosbag([m for m in drive() if m[1] == FIX]))
    assert isinstance(fixes, GnssTable)
    assert len(fixes) == 3
    field = read(path, rosbag([m for m in drive() if m[1] == MAG]))
    assert isinstance(field, MagTable)
    with pytest.raises(LogError, match="has no messages sensor_msgs/msg/Imu; it holds sensor_ms"):
        read(path, rosbag([m for m in drive() if m[1] != IMU]))
    for kept, encoding, held in (([], "cdr", "no messages"), (drive(), "json", f"{IMU} in json, ")):
        with pytest.raises(LogError, match=f"it holds {held}"):
            read(path, rosbag(kept, encoding=encoding))


def test_files_of_one_drive_become_one_dataset(tmp_path):
    for name, kind in (("imu", IMU), ("fix", FIX)):
        (tmp_path / name).write_bytes(rosbag([m for m in drive() if m[1] == kind]))
    data = load_dataset([tmp_path / "imu", tmp_path / "fix"])
    assert (len(data.imu), len(data.gnss), data.mag) == (30, 3, None)


def test_a_file_that_breaks_off_gives_what_comes_before(path):
    content = rosbag(drive(20), CompressionType.NONE)
    found = []
    whole = read(path, content)
    data = read(path, content[: len(content) // 2], found)
    (warning,) = found
    assert (warning.severity, warning.code) == ("warning", "ends_early")
    assert warning.value == len(content) // 2
    n = len(data.imu)
    assert 20 < n < len(whole.imu)
    np.testing.assert_array_equal(data.imu.gyro, whole.imu.gyro[:n])
    open_end = read(path, rosbag(drive(20), CompressionType.NONE, finish=False), found := [])
    assert [f.code for f in found] == ["ends_early"]
    assert len(open_end.imu) > 180


def test_damage_is_refused(path):
    content = bytearray(rosbag(drive(), CompressionType.NONE))
    content[content.index(b"abc") + 40] ^= 1
    with pytest.raises(
        LogError, match=r"drive.mcap: is damaged .CRCValidationError.*fetch it again"
    ):
        read(path, bytes(content))
    with pytest.raises(LogError, match=r"is damaged .RosError: sensor_msgs/msg/Imu of 20 bytes"):
        read(path, rosbag([("/imu", IMU, header(5))]))

    for compression in (CompressionType.ZSTD, CompressionType.LZ4):
        content = bytearray(rosbag(drive(), compression))
        content[len(content) // 8] ^= 1
        with pytest.raises(LogError, match=r"is damaged .*fetch it again"):
            read(path, bytes(content))


@pytest.mark.parametrize(
    ("packed", "declared", "why"),
    [
        (zstandard.compress(bytes(30 << 20)), 30 << 20, "its chunks would take 31457280 bytes"),
        (zstandard.compress(bytes(3 << 20)), 100, "unpacks to 101 bytes or more, declared are 100"),
        (zstandard.compress(bytes(100)), 1 << 60, "its chunks would take 115[0-9]{16} bytes"),
        (lz4.frame.compress(bytes(3 << 20)), 100, "unpacks to 101 bytes or more, declared are 100"),
        (zstandard.compress(bytes(100)), 101, "unpacks to 100 bytes or more, declared are 101"),
        (bytes(100), 1 << 19, "unpacks to 100 bytes"),
    ],
)
def test_sizes_that_chunks_declare_are_not_believed(path, monkeypatch, packed, declared, why):
    monkeypatch.setattr(foreign, "FREE", 1 << 20)
    kind = "zstd" if packed[:1] == b"\x28" else "lz4" if packed[:1] == b"\x04" else ""
    content = rosbag(drive(), CompressionType.NONE)
    body = struct.pack("<QQQI", 0, 1, declared, 0)
    body += struct.pack("<I", len(kind)) + kind.encode() + struct.pack("<Q", len(packed)) + packed
    chunk = struct.pack("<BQ", 6, len(body)) + body
    at = 17 + struct.unpack_from("<Q", content, 9)[0]  # behind the record of the header
    with pytest.raises(LogError, match=rf"drive.mcap: is damaged .*{why}"):
        read(path, content[:at] + chunk + content[at:])


# ------------------------------------------------------------------------------------------ writing


def some(count=50, begin_ns=BEGIN):
    rng = np.random.default_rng(8)
    time_ns = begin_ns + np.arange(count) * 10_000_001
    gyro, accel, field = rng.normal(size=(3, count, 3))
    gyro[3, 1] = math.nan
    lat, lon, alt = np.stack([rng.uniform(-1.5, 1.5, 9), rng.uniform(-3, 3, 9), np.arange(9.0)])
    lat[4] = lon[4] = alt[4] = math.nan
    sigma = rng.uniform(0.1, 3.0, size=(9, 3))
    sigma[5] = math.nan
    quality = np.array([5, 5, 4, 3, 0, 5, 5, 5, 4])
    return Dataset(
        "some",
        ImuTable(time_ns, gyro, accel, "rate"),
        GnssTable(time_ns[3:12] + 7, lat, lon, alt, sigma, quality=quality),
        mag=MagTable(time_ns[::2], 5e-5 * field[::2]),
    )


def assert_same(back, data):
    for table in ("imu", "mag", "gnss"):
        one, other = getattr(back, table), getattr(data, table)
        np.testing.assert_array_equal(one.time_ns, other.time_ns)
    np.testing.assert_array_equal(back.imu.gyro, data.imu.gyro)
    np.testing.assert_array_equal(back.imu.accel, data.imu.accel)
    np.testing.assert_array_equal(back.mag.field_t, data.mag.field_t)
    for name in ("lat_rad", "lon_rad", "alt_m", "sigma_m"):
        one, other = getattr(back.gnss, name), getattr(data.gnss, name)
        np.testing.assert_allclose(one, other, rtol=5e-16)
    np.testing.assert_array_equal(back.gnss.quality, data.gnss.quality)


@pytest.mark.parametrize("begin_ns", [0, BEGIN, 1_167_264_017 * NS])
def test_what_is_written_is_read_as_it_was(path, begin_ns):
    data = some(begin_ns=begin_ns)
    write_log(path, data)
    findings = []
    assert_same(open_log(path, findings=findings), data)
    assert findings == []
    # tables in the other pair of frames make the same file
    turned = {k: to_enu_rfu(getattr(data, k)) for k in ("imu", "gnss", "mag")}
    other = path.with_name("other.mcap")
    write_log(other, dataclasses.replace(data, **turned))
    assert other.read_bytes() == path.read_bytes()
    packed = path.with_name("packed.xz")
    write_log(packed, data, "ros-mcap")
    assert_same(open_log(packed), data)


def test_others_read_what_is_written(path):
    typesys = pytest.importorskip("rosbags.typesys", reason="the cross-check needs rosbags")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    data = some()
    write_log(path, data)
    reader = make_reader(BytesIO(path.read_bytes()), validate_crcs=True)
    assert reader.get_header().profile == "ros2"
    found = {"/imu/data_raw": [], "/imu/mag": [], "/gnss/fix": []}
    stamps = []
    for schema, channel, m in reader.iter_messages():
        one = store.deserialize_cdr(m.data, schema.name)
        stamp = one.header.stamp.sec * NS + one.header.stamp.nanosec
        assert m.log_time == m.publish_time == stamp
        stamps.append(stamp)
        found[channel.topic].append((stamp, one))
    assert stamps == sorted(stamps)
    samples = found["/imu/data_raw"]
    # 2025: GPS time is 18 s ahead of UTC
    assert [stamp for stamp, _ in samples] == (data.imu.time_ns - 18 * NS).tolist()
    for (_, m), w, f in zip(samples, data.imu.gyro, data.imu.accel, strict=True):
        v = m.angular_velocity
        np.testing.assert_array_equal([v.x, v.y, v.z], w * [1, -1, -1])
        a = m.linear_acceleration
        np.testing.assert_array_equal([a.x, a.y, a.z], f * [1, -1, -1])
        assert m.orientation_covariance[0] == -1.0
        assert m.header.frame_id == "imu"
    for (_, m), lat, sigma in zip(
        found["/gnss/fix"], data.gnss.lat_rad, data.gnss.sigma_m, strict=True
    ):
        np.testing.assert_allclose(m.latitude, np.degrees(lat), rtol=5e-16)
        n, e, d = sigma**2
        np.testing.assert_array_equal(m.position_covariance, np.ravel(np.diag([e, n, d])))
        assert m.position_covariance_type == (0 if np.isnan(sigma).any() else 2)
    assert [m.status.status for _, m in found["/gnss/fix"]] == [0, 0, 2, 1, -1, 0, 0, 0, 2]
    assert len(found["/imu/mag"]) == len(data.mag)


def test_velocities_of_fixes_are_left_out_with_a_warning(path):
    data = some()
    fixes = dataclasses.replace(data.gnss, v_n=np.ones((9, 3)), sigma_v=np.ones((9, 3)))
    with pytest.warns(LogWarning, match="drive.mcap: velocities of the fixes are left out"):
        write_log(path, fixes)
    assert open_log(path).v_n is None
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        write_log(path, data.gnss)


def test_what_cannot_be_written(path):
    data = some()
    rows = data.imu.time_ns, data.imu.gyro, data.imu.accel
    turn = np.tile([1.0, 0.0, 0.0, 0.0], (50, 1))
    flat = Trajectory(data.imu.time_ns, *np.zeros((3, 50)), np.zeros((50, 3)), turn)
    for table, words in (
        (ImuTable(*rows, "increment"), "ros-mcap wants rates, these are increments; divide"),
        (AttitudeTable(rows[0], turn), "holds inertial samples, magnetic field and fixes, not att"),
        (dataclasses.replace(data, truth=flat), "and fixes, not path; choose another format"),
        (ImuTable(rows[0] - 2 * BEGIN, *rows[1:], "rate"), "ROS has times from 1970 to 2038 only"),
        (ImuTable(rows[0] + BEGIN, *rows[1:], "rate"), "ROS has times from 1970 to 2038 only"),
    ):
        with pytest.raises(LogError, match=words):
            write_log(path, table)
    with pytest.raises(LogError, match="neither a GPS week nor local metres; give no week"):
        write_log(path, data, week=2300)
    with pytest.raises(LogError, match="no format is called 'px4-ulog'; choose one of"):
        write_log(path, data, "px4-ulog")
    assert not path.exists()


def test_permissions_and_an_earlier_file(path):
    path.write_bytes(b"before")
    mode = stat.S_IMODE(path.stat().st_mode)
    imu = some().imu
    with pytest.raises(IndexError):
        write_log(path, dataclasses.replace(imu, gyro=imu.gyro[:10]))
    assert path.read_bytes() == b"before"
    assert list(path.parent.iterdir()) == [path]
    write_log(path, some())
    assert stat.S_IMODE(path.stat().st_mode) == mode


def test_utc_and_back():
    utc = np.concatenate(
        [k * NS + np.arange(-3, 3) * NS // 2 for k in (315_964_800, 1_483_228_800)]
    )
    np.testing.assert_array_equal(utc_of(gps_of(utc)).astype(np.int64), utc)
    assert (gps_of(utc) - utc).tolist() == [0] * 6 + [17 * NS] * 3 + [18 * NS] * 3
