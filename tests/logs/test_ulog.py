"""PX4 logs: what is read of them, and what a cut or damaged one gives (F29)."""

import re
import sys

import numpy as np
import pytest
from made_ulog import GPS, IMU, NEW_GPS, RAW_MAG, flight, message, ulog

from robins.logs import LogError, load_dataset, open_log

pytest.importorskip("pyulog", reason="the extra `logs` is not installed")
LOG, WRITTEN = flight()


def read(tmp_path, content, findings=None):
    path = tmp_path / "flight.ulg"
    path.write_bytes(content)
    return open_log(path, None, [] if findings is None else findings)


def refusal(tmp_path, content):
    with pytest.raises(LogError) as caught:
        read(tmp_path, content)
    return str(caught.value)


def test_every_number_is_as_it_was_written(tmp_path):
    found = []
    data = read(tmp_path, LOG, found)
    assert data.name == "flight"
    imu = WRITTEN["imu"]
    np.testing.assert_array_equal(data.imu.time_ns, imu[:, 0].astype(np.int64) * 1000)
    np.testing.assert_array_equal(data.imu.gyro, imu[:, 1:4])
    np.testing.assert_array_equal(data.imu.accel, imu[:, 4:7])
    assert (data.imu.kind, data.imu.body, data.mag.body) == ("rate", "FRD", "FRD")
    np.testing.assert_array_equal(data.mag.time_ns, WRITTEN["mag"][:, 0].astype(np.int64) * 1000)
    np.testing.assert_allclose(data.mag.field_t * 1e4, WRITTEN["mag"][:, 1:], rtol=1e-15)
    assert data.attitude is None  # PX4's own estimate is no truth
    (note,) = found
    assert (note.severity, note.code, note.value) == ("note", "several_instances", 2)
    assert "sensor_combined was logged of 2 sensors; the first, number 0, is read" in note.sentence


@pytest.mark.parametrize("new", [False, True], ids=["integers", "degrees"])
def test_fixes_of_old_and_new_versions(tmp_path, new):
    log, written = flight(gps=NEW_GPS) if new else (LOG, WRITTEN)
    g = read(tmp_path, log).gnss
    np.testing.assert_allclose(np.rad2deg(g.lat_rad), written["gps"][:, 1], rtol=0, atol=1e-9)
    np.testing.assert_allclose(np.rad2deg(g.lon_rad), -10.4082151, rtol=0, atol=1e-9)
    np.testing.assert_allclose(g.alt_m, 106.766, rtol=1e-12)
    assert g.sigma_m[0].tolist() == [1.5, 1.5, 2.5]
    assert g.v_n[0].tolist() == [3.0, -4.0, 0.5]
    assert g.sigma_v[0].tolist() == [0.25] * 3
    assert g.quality.tolist() == [5, 1, 5, 5, 5]
    # The receiver said of the third that its velocity is not valid.
    assert np.isnan(g.v_n).all(axis=1).tolist() == [False, False, True, False, False]


def test_a_receiver_without_a_fix(tmp_path):
    topics = [("sensor_combined", 0, IMU), ("vehicle_gps_position", 0, GPS)]
    place = (5 * 10**8, 10**8, 0, 1000, *[1.0] * 6)
    fixes = [(1, (7_000_000 + fix, *place, fix, True)) for fix in (0, 1, 2, 3)]
    g = read(tmp_path, ulog(topics, [(0, (6_000_000, *range(6))), *fixes])).gnss
    assert np.isnan(g.lat_rad).tolist() == [True, True, False, False]
    assert np.isnan(g.alt_m).tolist() == [True, True, True, False]
    assert np.isnan(g.v_n[:, 0]).tolist() == [True, True, True, False]
    assert g.quality.tolist() == [0, 0, 5, 5]


def test_the_raw_magnetometer_where_there_is_no_other(tmp_path):
    """It says when it measured, which is earlier than when it was logged."""
    log, written = flight(mag=("sensor_mag", RAW_MAG))
    mag = read(tmp_path, log).mag
    np.testing.assert_array_equal(mag.time_ns, written["mag"][:, 0].astype(np.int64) * 1000)
    np.testing.assert_allclose(mag.field_t * 1e4, written["mag"][:, 1:], rtol=1e-15)


def test_logs_that_lack_something(tmp_path):
    sole = [("sensor_combined", 0, IMU)]
    records = [(0, (10**6 + k, *range(6))) for k in range(3)]
    data = read(tmp_path, ulog(sole, records))
    assert data.mag is None
    assert data.gnss is None
    told = refusal(tmp_path, ulog([("vehicle_air", 0, IMU)], records))
    assert "has no samples of sensor_combined; it holds nothing; log that topic" in told
    fewer = "uint64_t timestamp;float[3] gyro_rad;"
    told = refusal(tmp_path, ulog([("sensor_combined", 0, fewer)], [(0, (1, 2, 3, 4))]))
    assert "sensor_combined: has no field accelerometer_m_s2[0]; it has gyro_rad[0], " in told
    late = ulog(sole, [(0, (2**63, *range(6)))])
    assert "stamps of sensor_combined: are no microseconds since power-up" in refusal(
        tmp_path, late
    )


def test_without_the_package_the_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyulog", None)
    told = refusal(tmp_path, LOG)
    assert told.endswith("is not installed; install it with: pip install 'robins[logs]'")


def test_a_cut_log_gives_the_exact_prefix(tmp_path):
    whole = read(tmp_path, LOG)
    sample = b"\x22\x00D\x00\x00"  # 34 bytes of data, of the first subscription
    ends = [k + 37 for k in range(len(LOG)) if LOG[k : k + 5] == sample]
    assert len(ends) == len(whole.imu) == 200
    for end in [*np.linspace(16, len(LOG) - 1, 60).astype(int), *ends[::20]]:
        found = []
        if end < ends[0]:
            assert "has no samples of sensor_combined" in refusal(tmp_path, LOG[:end])
            continue
        data = read(tmp_path, LOG[:end], found)
        n = sum(e <= end for e in ends)
        np.testing.assert_array_equal(data.imu.gyro, whole.imu.gyro[:n])
        np.testing.assert_array_equal(data.imu.time_ns, whole.imu.time_ns[:n])
        early = [f for f in found if f.code == "ends_early"]
        assert not (early and end in ends)
        for f in early:
            at = int(f.where.removeprefix("byte "))
            assert 0 < end - at < 60  # less than the longest message
            assert f"breaks off at byte {at} of {end}" in f.sentence


def test_broken_framing_ends_the_log_there(tmp_path):
    """A wrong length or type is seen at once; what precedes it is exact."""
    whole = read(tmp_path, LOG)
    starts = [k for k in range(len(LOG) - 40) if LOG[k : k + 5] == b"\x22\x00D\x00\x00"][40::40]
    for start in starts:
        for change in (b"\xff\xff\x44", b"\x00\x00\x44", b"\x22\x00\xc4"):
            found = []
            data = read(tmp_path, LOG[:start] + change + LOG[start + 3 :], found)
            n = len(data.imu)
            np.testing.assert_array_equal(data.imu.accel, whole.imu.accel[:n])
            assert f"breaks off at byte {start} of" in found[0].sentence
            assert 0 < n < 200


def test_damaged_definitions_are_refused(tmp_path):
    """Damaged definitions: the meaning of a number is never guessed."""
    for old, new in (
        (b"float[3] gyro_rad", b"gloat[3] gyro_rad"),
        (b"gyro_rad", b"gyro_rax"),
        (b"sensor_combined:", b"sensor_combinee:"),
        (b"uint64_t timestamp", b"uint64_t timestamq"),
    ):
        assert len(refusal(tmp_path, LOG.replace(old, new))) > 60
    for fields in ("a[60000] x;", "a[300] x;", "root x;"):  # by itself, in each other, in itself
        nested = message("F", f"root:{fields}".encode())
        nested += message("F", b"a:b[400] y;") + message("F", b"b:float[9] z;")
        told = refusal(tmp_path, LOG[:16] + nested + LOG[16:])
        assert re.search(r"the definition of root (has \d+ numbers|contains itself)", told)
    no_magic = b"ULof" + LOG[4:]
    assert "holds NUL bytes: a binary file" in refusal(tmp_path, no_magic)
    assert "Header too short" in refusal(tmp_path, LOG[:8])


def test_the_sample_of_pyulog(data_dir):
    data = load_dataset([data_dir / "pyulog_sample_log_small.ulg.xz"])
    assert (len(data.imu), len(data.mag), len(data.gnss)) == (1298, 319, 32)
    assert data.findings == []
    assert data.imu.time_ns[0] == 20_326_716_000
    force = np.median(data.imu.accel, axis=0)  # it stands: specific force points up, z down
    assert abs(np.linalg.norm(force) - 9.8) < 0.25
    assert force[2] < -9.0
    np.testing.assert_allclose(np.rad2deg(data.gnss.lat_rad), 63.417, atol=1e-3)
    # Near Trondheim the field is 52 uT, 14 of it horizontal; the aeroplane adds its own.
    assert 30e-6 < np.median(np.linalg.norm(data.mag.field_t, axis=1)) < 70e-6
