"""Recordings that other packages wrote: read to the numbers that went in, damaged, in parts."""

import datetime
import shutil
import sqlite3
import struct
import sys
from dataclasses import replace
from itertools import islice

import made_binary as made
import numpy as np
import pytest
from made_binary import GPS_NS, MADE, NS

from robins import foreign
from robins.dataset import GnssTable, ImuTable
from robins.logs import LogError, load_dataset, open_log
from robins.logs.merging import gps_clock, merged
from robins.logs.rtcm import crc24q

PLACE = {"rtol": 0, "atol": 1e-9}


def read(tmp_path, content, name="drive.log"):
    path, findings = tmp_path / name, []
    path.write_bytes(content)
    return open_log(path, findings=findings), {f.code: f for f in findings}


def assert_fixes(gnss, offset_ns=GPS_NS, down=True, atol=1e-9, sigma=MADE.sigma, quality=5):
    np.testing.assert_array_equal(gnss.time_ns - offset_ns, MADE.fix_ns)
    found = np.stack([np.rad2deg(gnss.lat_rad), np.rad2deg(gnss.lon_rad)], axis=-1)
    np.testing.assert_allclose(found, MADE.place[:, :2], rtol=0, atol=atol)
    np.testing.assert_allclose(gnss.alt_m, MADE.place[:, 2], rtol=0, atol=6e-3)
    np.testing.assert_allclose(gnss.sigma_m, np.tile(sigma, (4, 1)), rtol=1e-12)
    parts = 3 if down else 2
    np.testing.assert_allclose(gnss.v_n[:, :parts], MADE.v_n[:, :parts], rtol=0, atol=6e-3)
    assert down or np.isnan(gnss.v_n[:, 2]).all()
    assert (gnss.quality.tolist(), gnss.nav) == ([quality] * 4, "NED")


def assert_samples(imu, mag=None, offset_ns=GPS_NS, gyro=0.0, accel=0.0, field=0.0):
    np.testing.assert_array_equal(imu.time_ns - offset_ns, MADE.imu_ns)
    np.testing.assert_allclose(imu.gyro, MADE.gyro, rtol=0, atol=gyro)
    np.testing.assert_allclose(imu.accel, MADE.accel, rtol=0, atol=accel)
    assert (imu.kind, imu.body) == ("rate", "FRD")
    if mag is not None:
        np.testing.assert_array_equal(mag.time_ns, imu.time_ns)
        np.testing.assert_allclose(mag.field_t, MADE.mag_t, rtol=0, atol=field)


# -------------------------------------------------------------------------------------------- ROS

CONTAINERS = {
    "bag": lambda path: made.bag(path),
    "bag, lz4": lambda path: made.bag(path, "LZ4"),
    "bag, bz2": lambda path: made.bag(path, "BZ2"),
    "db3": lambda path: made.folder(path),
    "db3, messages packed": lambda path: made.folder(path, packed=True),
    "mcap": lambda path: made.folder(path, "MCAP"),
}


@pytest.mark.parametrize("make", CONTAINERS.values(), ids=CONTAINERS)
def test_a_drive_of_ros_is_read_from_any_container(tmp_path, make):
    path, findings = make(tmp_path / "drive"), []
    data = open_log(path, findings=findings)
    assert_samples(data.imu, data.mag)
    assert_fixes(data.gnss)
    np.testing.assert_allclose(data.gnss.sigma_v, [[0.2, 0.1, 0.3]] * 4)  # north, east, down
    assert (data.name, data.time_unit_known) == ("drive", (str(path),))
    assert [f.code for f in findings] == ["velocity_taken"]
    assert load_dataset([path]).imu.time_ns.tolist() == data.imu.time_ns.tolist()


def test_a_chunk_that_unpacks_to_no_measurements_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(foreign, "FREE", 1000)
    monkeypatch.setattr(foreign, "RATIO", 0)
    for packed in ("BZ2", "LZ4"):
        with pytest.raises(LogError, match=r"is damaged or was not closed"):
            open_log(made.bag(tmp_path / packed, packed), findings=[])


def test_rates_and_forces_on_topics_of_their_own_are_merged(tmp_path):
    path, findings = made.folder(tmp_path / "drive", apart=True, velocity="base"), []
    data = open_log(path, findings=findings)
    assert [f.code for f in findings] == ["sensors_merged"]
    assert data.gnss.v_n is None  # of another frame: not the receiver's
    # forces lie half a period later, so that each is the mean of its neighbours
    np.testing.assert_array_equal(data.imu.time_ns, GPS_NS + MADE.imu_ns[1:])
    np.testing.assert_array_equal(data.imu.gyro, MADE.gyro[1:])
    means = (MADE.accel[1:] + MADE.accel[:-1]) / 2
    np.testing.assert_allclose(data.imu.accel, means, rtol=0, atol=1e-12)


def test_rates_and_forces_in_files_of_their_own_are_merged(tmp_path):
    whole = open_log(made.folder(tmp_path / "drive", apart=True), findings=[])
    paths = []
    for name, kept in (("accel", "/gyro/sample"), ("gyro", "/accel/sample")):
        paths.append(tmp_path / f"{name}.db3")
        shutil.copy(tmp_path / "drive" / "drive.db3", paths[-1])
        with sqlite3.connect(paths[-1]) as db:
            db.execute("DELETE FROM topics WHERE name IN (?, '/mag', '/fix', '/vel')", [kept])
        db.close()
    both = load_dataset(paths)
    np.testing.assert_array_equal(both.imu.time_ns, whole.imu.time_ns)
    np.testing.assert_array_equal(both.imu.gyro, whole.imu.gyro)
    np.testing.assert_array_equal(both.imu.accel, whole.imu.accel)
    assert [f.code for f in both.findings] == ["sensors_merged"]


def test_across_a_gap_no_force_is_interpolated():
    time_ns = np.arange(30) * NS // 10
    gone = np.zeros((30, 3))
    gyro = ImuTable(time_ns, gone + 1, gone, "rate")
    kept = np.r_[0:10, 20:30]
    both = merged(gyro, ImuTable(time_ns[kept] + 1, gone[kept], gone[kept] + 2, "rate"), [])
    missing = np.isnan(both.accel).all(axis=1)
    assert both.time_ns[missing].tolist() == time_ns[10:21].tolist()
    with pytest.raises(LogError, match="share no time"):
        merged(gyro, ImuTable(time_ns + 10**12, gone, gone, "rate"), [])


def test_parts_of_a_folder_follow_their_list_or_numbers(tmp_path):
    one = made.folder(tmp_path / "drive")
    base, about = one / "drive.db3", (one / "metadata.yaml").read_text()
    halves = [one / f"drive_{k}.db3" for k in (0, 1)]
    for k, half in enumerate(halves):
        shutil.copy(base, half)
        with sqlite3.connect(half) as db:
            db.execute(f"DELETE FROM messages WHERE timestamp {('<', '>=')[k]} {made.UTC_NS + NS}")
        db.close()
    base.unlink()
    (one / "metadata.yaml").write_text(
        about.replace("- drive.db3", "- drive_1.db3\n  - drive_0.db3")
    )
    data = open_log(one, findings=[])
    np.testing.assert_array_equal(np.sort(data.imu.time_ns), GPS_NS + MADE.imu_ns)
    (one / "metadata.yaml").unlink()
    later = open_log(one, findings=[]).imu
    assert sorted(later.time_ns.tolist()) == sorted(data.imu.time_ns.tolist())
    assert later.time_ns[0] != data.imu.time_ns[0]  # in the other order
    halves[0].unlink()
    (one / "metadata.yaml").write_text(
        about.replace("- drive.db3", "- drive_1.db3\n  - drive_0.db3")
    )
    with pytest.raises(LogError, match=r"lacks drive_0.db3, which its metadata.yaml names; copy"):
        open_log(one)
    (tmp_path / "empty").mkdir()
    with pytest.raises(LogError, match="a folder with nothing; give files, or the"):
        open_log(tmp_path / "empty")


def test_recordings_of_ros_that_cannot_be_read(tmp_path, monkeypatch):
    content = made.content(made.bag, "drive.bag")
    for part, words in (
        (content[: len(content) // 2], "is damaged or was not closed .*rosbag reindex FILE"),
        (content.replace(b"index_pos=", b"index_pox=", 1), "was not closed"),
    ):
        with pytest.raises(LogError, match=words):
            read(tmp_path, part)
    base = made.content(made.folder, "drive")
    with pytest.raises(LogError, match="is damaged"):
        read(tmp_path, base[: len(base) // 2])
    other = tmp_path / "other.db3"
    with sqlite3.connect(other) as db:
        db.execute("CREATE VIEW messages AS WITH RECURSIVE n(x) AS (SELECT 1 UNION ALL SELECT x "
                   "FROM n) SELECT * FROM n")  # fmt: skip
    db.close()
    with pytest.raises(LogError, match="is an SQLite file, but no recording of ROS 2: it holds m"):
        open_log(other)
    path = tmp_path / "drive.db3"
    path.write_bytes(base)
    path.with_name("drive.db3-wal").write_bytes(b"x")
    findings = []
    open_log(path, findings=findings)
    assert "ends_early" in {f.code for f in findings}
    monkeypatch.setitem(sys.modules, "rosbags.rosbag1", None)
    with pytest.raises(LogError, match=r"is not installed; install it with: pip install 'robins\["):
        read(tmp_path, content)


# ------------------------------------------------------------------------------------------ u-blox


def test_fixes_and_samples_of_a_receiver(tmp_path):
    data, found = read(tmp_path, made.ubx())
    assert_fixes(data.gnss, quality=1, atol=5e-8)
    assert data.gnss.sigma_v.tolist() == [[0.25] * 3] * 4
    # each fix arrives with the sample that is 0.45 s later
    first = GPS_NS - 450_000_000
    later, _ = read(tmp_path, made.ubx()[17:40] + made.nmea() + made.ubx())  # begins midway
    np.testing.assert_array_equal(later.imu.time_ns, data.imu.time_ns)
    sentences = iter(made.nmea().splitlines(True))  # three of each fix, in place of NAV-PVT
    parts = made.ubx().split(b"$GNTXT,01*00\r\n")[:4]
    parts = [p.split(b"\xb5\x62\x01\x07")[0] + b"".join(islice(sentences, 3)) for p in parts]
    mixed, found_nmea = read(tmp_path, b"".join(parts))
    assert_fixes(mixed.gnss, down=False, atol=2e-9)
    np.testing.assert_array_equal(mixed.imu.time_ns, data.imu.time_ns)
    assert found_nmea.keys() == {"clock_aligned", "sigma_assumed"}
    assert_samples(data.imu, offset_ns=first, gyro=np.deg2rad(2**-13) * 1.01, accel=2**-11 * 1.01)
    assert found.keys() == {"clock_aligned"}
    alone, found = read(tmp_path, made.ubx(inertial=False, carrSoln=1))
    assert isinstance(alone, GnssTable)
    assert (alone.quality.tolist(), found) == ([2] * 4, {})


@pytest.mark.parametrize(
    ("changes", "quality", "lost"),
    [
        ({"carrSoln": 0}, 5, ""),
        ({"carrSoln": 0, "diffSoln": 1}, 4, ""),
        ({"fixType": 2}, 1, "alt_m"),
        ({"gnssFixOk": 0}, 0, "alt_m lat_rad"),
        ({"fixType": 5}, 0, "alt_m lat_rad"),
    ],
)
def test_kinds_of_fixes_of_a_receiver(tmp_path, changes, quality, lost):
    gnss, _ = read(tmp_path, made.ubx(inertial=False, **changes))
    assert gnss.quality.tolist() == [quality] * 4
    for name in ("lat_rad", "alt_m"):
        assert np.isnan(getattr(gnss, name)).all() == (name in lost.split())


def test_a_receiver_without_a_date_and_with_more_digits(tmp_path):
    with pytest.raises(LogError, match="has no messages NAV-PVT or ESF-MEAS; switch on UBX"):
        read(tmp_path, made.ubx(inertial=False).replace(b"\x01\x07", b"\x01\x06"))
    imu, found = read(tmp_path, made.ubx().split(b"\xb5\x62\x01\x07")[0])
    assert (len(imu), imu.time_ns[0], found) == (10, 90 * NS, {})  # on the clock of the receiver
    gnss, found = read(tmp_path, made.ubx(inertial=False, validDate=0))
    assert (len(gnss), found["undated"].value) == (0, 4)
    more = struct.pack("<B3xIiiiibbbbII", 0, made.TOW_MS, 112 * 10**6, 481 * 10**6, 500_000, 0,
        -32, 41, 7, 0, 141, 210)  # fmt: skip
    more = made.UBXMessage("NAV", "NAV-HPPOSLLH", made.GET, payload=more)
    fixes = made.ubx(inertial=False)  # of which the last is repeated
    again = fixes[fixes.rindex(b"\xb5\x62\x01\x07") :]
    gnss, _ = read(tmp_path, fixes + again + more.serialize())
    found = np.rad2deg([gnss.lat_rad[0], gnss.lon_rad[0]])
    np.testing.assert_allclose(found, [more.lat, more.lon], rtol=0, atol=1e-12)
    found = [gnss.alt_m[0], *gnss.sigma_m[0]]
    np.testing.assert_allclose(np.array(found) * 1e3, [more.height, 14.1, 14.1, 21.0], rtol=1e-12)
    np.testing.assert_allclose(gnss.sigma_m[1], MADE.sigma)


def test_a_sync_word_in_a_correction_is_no_message(tmp_path):
    """Framed as the example of RTCM 10403.3, whose checksum the standard prints."""
    example = bytes.fromhex("D300133ED7D30202980EDEEF34B4BD62AC0941986F33360B98")
    assert crc24q(example[:-3]).to_bytes(3, "big") == example[-3:]

    def correction(inside):
        frame = b"\xd3" + len(inside).to_bytes(2, "big") + inside
        return frame + crc24q(frame).to_bytes(3, "big")

    for inside in (
        b"\x3e\xd3\xb5\x62\x01\x07\x02\x00",
        b"\xb5\x62\x01\x07\xff\xff",
        b"\xb5\x62\xd3",
    ):
        whole = correction(inside)
        parts = (made.ubx(inertial=False), whole, made.ubx(inertial=False), whole)
        gnss, found = read(tmp_path, b"".join(parts))
        assert (len(gnss), found) == (8, {})
        whole = bytes([whole[0], whole[1], whole[2] ^ 1, *whole[3:]])  # no correction now
        _, found = read(tmp_path, b"".join([*parts[:1], whole, *parts[2:]]))
        assert found["damaged_frames"].value == 1
    text = correction(b"\x40\x50$GPGGA,120000.00,4806,N*00")
    gnss, found = read(tmp_path, made.nmea() + text)
    assert (len(gnss), found.keys()) == (4, {"sigma_assumed"})


# -------------------------------------------------------------------------------------------- NMEA


def test_sentences_become_fixes(tmp_path):
    gnss, found = read(tmp_path, made.nmea(talkers=("GP", "GN")))
    assert_fixes(gnss, down=False, atol=2e-9)
    assert found.keys() == {"several_instances", "sigma_assumed"}  # that of the velocity
    gnss, found = read(tmp_path, made.nmea(gst=False))
    assert_fixes(gnss, down=False, atol=2e-9, sigma=[3.0, 3.0, 6.0])
    assert found["sigma_assumed"].value == 4


def test_midnight_and_a_missing_date(tmp_path):
    late = datetime.datetime(2024, 12, 31, 23, 59, 59)
    begin = int(late.replace(tzinfo=datetime.UTC).timestamp() + 18) * NS
    content = made.nmea(late)
    gnss, _ = read(tmp_path, content)
    assert_fixes(gnss, begin, down=False, atol=2e-9)
    # the date is stated after the first fixes only, a day later
    lines = content.splitlines(True)
    kept = [x for k, x in enumerate(lines) if b"RMC" not in x or k > 9]
    gnss, _ = read(tmp_path, b"".join(kept))
    np.testing.assert_array_equal(gnss.time_ns - begin, MADE.fix_ns)
    gnss, found = read(tmp_path, made.nmea(late, date=False))
    assert_fixes(gnss, (86_400 - 1) * NS, down=False, atol=2e-9)  # velocities by VTG
    assert "undated" in found
    pairs = made.nmea(late, date=False, gst=False).splitlines(True)
    swapped = b"".join(b + a for a, b in zip(pairs[::2], pairs[1::2], strict=True))
    gnss, _ = read(tmp_path, swapped)  # VTG begins each burst
    np.testing.assert_allclose(gnss.v_n[:, :2], MADE.v_n[:, :2], rtol=0, atol=6e-3)


def test_sentences_without_a_right_checksum_are_counted(tmp_path):
    lines = made.nmea().splitlines(True)
    wrong = lines[3].replace(b"48", b"47", 1)
    gnss, found = read(tmp_path, b"".join([*lines[:3], wrong, lines[4].split(b"*")[0], *lines[5:]]))
    assert (len(gnss), found["damaged_frames"].value) == (4, 2)  # one by its RMC
    gnss, found = read(tmp_path, b"".join(lines)[:-20])
    assert (len(gnss), "ends_early" in found) == (4, True)
    rest = [x for x in lines if b"GGA" not in x]
    gnss, _ = read(tmp_path, b"".join(rest))  # the place by RMC, without a height
    np.testing.assert_allclose(np.rad2deg(gnss.lat_rad), MADE.place[:, 0], **PLACE)
    assert (gnss.alt_m.tolist(), gnss.sigma_m[:, 2].tolist()) == ([0.0] * 4, [1000.0] * 4)
    with pytest.raises(LogError, match="has no sentence GGA or RMC"):
        read(tmp_path, b"".join(x for x in rest if b"RMC" not in x))


def test_epochs_without_a_sentence_gga_have_the_place_of_another(tmp_path):
    """RMC at twice the rate of GGA, GNS for GGA, and modes of receivers that know no GGA."""
    lines = made.nmea().splitlines(True)  # GGA, GST, RMC of each fix
    gnss, found = read(tmp_path, b"".join(x for k, x in enumerate(lines) if k not in (0, 1, 6)))
    assert found["other_kinds"].value == 2
    assert "2 of 4 epochs have RMC and no GGA; their place is that of RMC" in str(
        found["other_kinds"]
    )
    assert np.isnan(gnss.alt_m).tolist() == [True, False, True, False]
    heights = np.where(np.isnan(gnss.alt_m), MADE.place[:, 2], gnss.alt_m)
    sigma = np.where(np.isnan(gnss.alt_m)[:, None], [3.0, 3.0, 6.0], MADE.sigma)
    sigma[2] = MADE.sigma  # stated by GST
    np.testing.assert_array_equal(gnss.sigma_m, sigma)
    assert_fixes(
        replace(gnss, alt_m=heights, sigma_m=np.tile(MADE.sigma, (4, 1))), down=False, atol=2e-9
    )
    gns = [made.as_gns(x) if b"GGA" in x else x for x in lines]
    gnss, found = read(tmp_path, b"".join(gns))
    assert_fixes(gnss, down=False, atol=2e-9)
    assert found.keys() == {"sigma_assumed"}
    for modes, quality in (("NN", 0), ("AN", 5), ("AR", 1), ("DF", 2), ("DA", 4), ("EN", 0)):
        gnss, found = read(tmp_path, b"".join(made.as_gns(x, modes) for x in lines if b"GGA" in x))
        assert gnss.quality.tolist() == [quality] * 4
        assert ("other_kinds" in found) == ("E" in modes)
        rest = [made.changed(x, f12=modes[0]) for x in lines if b"RMC" in x]
        gnss, _ = read(tmp_path, b"".join(rest))
        assert gnss.quality.tolist() == [{"A": 5, "D": 4}.get(modes[0], 0)] * 4
        assert np.isfinite(gnss.v_n[:, 0]).all() == (modes[0] in "AD")


# ----------------------------------------------------------------------------- MAVLink, ArduPilot


@pytest.mark.parametrize(("kind", "version"), [("HIGHRES_IMU", 2), ("SCALED_IMU", 1)])
def test_telemetry_of_a_vehicle(tmp_path, kind, version):
    data, found = read(tmp_path, made.tlog(kind, version))
    loose = {"gyro": 1e-6, "accel": 1e-5, "field": 1e-10}
    if kind == "SCALED_IMU":
        loose = {"gyro": 5.1e-4, "accel": 5e-3, "field": 5.1e-8}
    assert_samples(data.imu, data.mag, offset_ns=100 * NS, **loose)
    if version == 2:
        assert found.keys() == set()
        np.testing.assert_allclose(data.gnss.sigma_v[:, :2], 0.25)
    else:
        assert found.keys() == {"height_above_geoid", "sigma_assumed"}
        assert data.gnss.sigma_m[0].tolist() == [3.0, 3.0, 6.0]
        data.gnss.alt_m[:] += MADE.geoid_m
        data.gnss.sigma_m[:] = MADE.sigma
    assert_fixes(data.gnss, 100 * NS, down=False, atol=5.1e-8)


def test_of_several_units_and_vehicles_the_first_is_read(tmp_path):
    data, found = read(tmp_path, made.tlog(units=2))
    np.testing.assert_allclose(data.imu.gyro, MADE.gyro, rtol=0, atol=1e-6)
    assert (len(data.gnss), found["several_instances"].value) == (4, 2)


def test_telemetry_that_is_damaged(tmp_path, monkeypatch):
    content = made.tlog()
    at = content.index(b"\xfd", 2000)
    flipped = content[: at + 20] + bytes([content[at + 20] ^ 4]) + content[at + 21 :]
    data, found = read(tmp_path, flipped)
    assert len(data.imu) + len(data.gnss) == 43
    assert found["damaged_frames"].value == 1
    data, found = read(tmp_path, content[:3000] + b"garbage" + content[3000:-5])
    assert {"damaged_frames", "ends_early"} <= found.keys()
    monkeypatch.setitem(sys.modules, "pymavlink.dialects.v20", None)
    with pytest.raises(LogError, match="is telemetry of MAVLink, and the package that reads it"):
        read(tmp_path, content)


def test_a_log_of_ardupilot(tmp_path):
    """The fix that arrived fastest was 0.12 s late, by which the samples seem early."""
    data, found = read(tmp_path, made.dataflash())
    loose = {"gyro": 1e-6, "accel": 1e-6, "field": 5.1e-8}
    assert_samples(data.imu, data.mag, offset_ns=GPS_NS - 120_000_000, **loose)
    assert_fixes(data.gnss, quality=1, atol=5.1e-8)
    np.testing.assert_allclose(data.gnss.sigma_v, 0.25)
    assert found.keys() == {"several_instances", "clock_aligned"}
    assert abs(found["clock_aligned"].value - 0.03) < 1e-9
    data, found = read(tmp_path, made.dataflash(geoid=False))
    np.testing.assert_allclose(data.gnss.alt_m, MADE.place[:, 2] - MADE.geoid_m, atol=6e-3)
    assert "height_above_geoid" in found
    data, _ = read(tmp_path, made.dataflash(receiver=1))
    assert_fixes(data.gnss, quality=1, atol=5.1e-8)


def test_pymavlink_reads_the_same_log(tmp_path):
    """Its own reader of dataflash, which decodes by itself."""
    from pymavlink.DFReader import DFReader_binary

    path = tmp_path / "log.bin"
    path.write_bytes(made.dataflash())
    with DFReader_binary(str(path)) as reader:
        gps = [reader.recv_match(type="GPS") for _ in range(4)]
    gnss = open_log(path, findings=[]).gnss
    np.testing.assert_allclose(np.rad2deg(gnss.lat_rad), [m.Lat for m in gps], **PLACE)
    np.testing.assert_allclose(gnss.alt_m - MADE.geoid_m, [m.Alt for m in gps], atol=1e-9)


def test_a_log_of_ardupilot_that_is_damaged(tmp_path):
    content = made.dataflash()
    whole = open_log_of(tmp_path, content)
    start = content.index(b"\xa3\x95\x0a", 1500)
    data, found = read(tmp_path, content[:start] + b"\xa3\x95\x0a\x00\x00" + content[start + 9 :])
    assert found["damaged_frames"].value > 9
    assert len(whole.imu) - len(data.imu) <= 1
    assert set(data.imu.gyro[:, 0]) <= set(whole.imu.gyro[:, 0])  # no number is made up
    data, found = read(tmp_path, content[:-9] + bytes(4096) + b"\xff" * 99)  # a page that is empty
    assert "damaged_frames" not in found or found["damaged_frames"].value < 100
    data, found = read(tmp_path, content[:-9])
    assert "ends_early" in found
    for old, new, words in (
        (
            b"QBffffffIIfBBHH",
            b"QBfffffzIIfBBHH",
            "the definition of 'IMU' at byte .* has no layout",
        ),
        (
            b"QBffffffIIfBBHH",
            b"QBfffffdIIfBBHH",
            "in dataflash the definition of 'IMU' states 54 bytes",
        ),
        (b"AccX", b"AccW", "has no field AccX; it has "),
    ):
        with pytest.raises(LogError, match=words):
            read(tmp_path, content.replace(old, new))


def open_log_of(tmp_path, content):
    return read(tmp_path, content)[0]


def test_the_clock_of_a_vehicle_drifts():
    """1000 s at 40 ppm, delays of 0.1 to 0.3 s: within a hundredth of a second of the fastest."""
    gps_ns = GPS_NS + np.arange(5000) * NS // 5
    delay_s = 0.1 + 0.2 * np.random.default_rng(2).random(5000)
    local_ns = np.rint((np.arange(5000) / 5 * (1 + 4e-5) + 77 + delay_s) * 1e9).astype(np.int64)
    clock = gps_clock("log", local_ns, gps_ns, [])
    true_ns = np.rint((np.arange(5000) / 5 * (1 + 4e-5) + 77) * 1e9).astype(np.int64)
    assert np.abs((clock(true_ns) - gps_ns) * 1e-9 + 0.1).max() < 0.01
    set_back = np.where(np.arange(5000) % 2, local_ns, local_ns + 10**12)
    with pytest.raises(LogError, match="do not run at one rate"):
        gps_clock("log", set_back, gps_ns, [])
