from pathlib import Path

import made_binary
import numpy as np
import pytest
from log_samples import GNSS_IMU, PYINS_STEPS, SAMPLES

from robins.logs import FORMATS, LogError, Mounting, load_dataset, open_log
from robins.logs.registry import recognise
from robins.workbench.doctor import examine


def test_increments_and_recordings_that_began_mid_line_are_recognised_too(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text(PYINS_STEPS)
    assert open_log(path).kind == "increment"
    path.write_text(GNSS_IMU[15:])
    assert recognise(path).name == "gnss-imu"


def test_an_unknown_file_is_refused_with_the_candidates(tmp_path):
    path = tmp_path / "notes.txt"
    path.write_text("dear diary\n")
    with pytest.raises(LogError) as caught:
        open_log(path)
    text = str(caught.value)
    first, *rows, last = text.splitlines()
    assert first == (
        f"{path} line 1: no known format fits ('dear diary'); "
        "give --format, or --columns (`robins guess` writes them); these are known:"
    )
    assert [row.split(maxsplit=1) for row in rows] == [[f.name, f.about] for f in FORMATS]
    assert max(map(len, rows)) < 120
    assert last == f"Next:   robins guess {path} > notes.toml"


def test_decimal_commas_are_told_when_no_format_fits(tmp_path):
    path = tmp_path / "comma.csv"
    path.write_text("1756402240,961;0,01;0,02;1,01;0,1;0,2;0,3\n" * 3)
    with pytest.raises(LogError, match=r"write numbers with a decimal point, not a comma:\n"):
        open_log(path)


def test_the_wrong_format_is_refused_not_misread(tmp_path):
    path = tmp_path / "imu.csv"
    path.write_text(GNSS_IMU)
    for name in ("kfgins-imu", "kfgins-nav", "rtklib-pos", "euroc-truth", "pyins-imu"):
        with pytest.raises(LogError):
            open_log(path, name, [])
    with pytest.raises(LogError, match="no format is called 'kitti'; choose one of gnss-imu, "):
        open_log(path, "kitti")


@pytest.fixture
def three(tmp_path):
    paths = {}
    for name in ("kfgins-imu", "kfgins-gnss", "kfgins-nav"):
        paths[name] = tmp_path / f"{name}.txt"
        paths[name].write_text(SAMPLES[name])
    return paths


def test_files_of_one_recording_become_one_dataset(three):
    paths = [three["kfgins-nav"], str(three["kfgins-imu"]), three["kfgins-gnss"]]
    data = load_dataset(paths, mounting=Mounting(180.0, lever_arm_b_m=(0.1, 0.2, 0.3)))
    assert data.name == "kfgins-imu"
    assert data.imu.source == str(three["kfgins-imu"])
    assert data.gnss.source == str(three["kfgins-gnss"])
    assert data.truth.source == str(three["kfgins-nav"])
    assert data.lever_arm_b_m == (0.1, 0.2, 0.3)
    assert data.findings == []
    plain = load_dataset(paths, name="mine")
    assert (plain.name, plain.lever_arm_b_m) == ("mine", None)
    np.testing.assert_array_equal(data.imu.gyro, plain.imu.gyro * [1, -1, -1])


def test_a_file_of_fixes_replaces_those_of_a_recording(tmp_path):
    """Any order will do, a note reports it; of two recordings nothing is replaced."""
    log, better = tmp_path / "flight.BIN", tmp_path / "better.nmea"
    log.write_bytes(made_binary.dataflash(geoid=False))
    better.write_bytes(made_binary.nmea())
    own = load_dataset([log])
    assert "height_above_geoid" in {f.code for f in own.findings}
    for paths in ([log, better], [better, log]):
        data = load_dataset(paths)
        np.testing.assert_array_equal(data.imu.time_ns, own.imu.time_ns)
        np.testing.assert_array_equal(data.gnss.alt_m, open_log(better, findings=[]).alt_m)
        assert (data.gnss.source, len(data.mag)) == (str(better), len(own.mag))
        (note,) = [f for f in data.findings if f.code == "table_replaced"]
        assert "flight.BIN: its GNSS fixes are not used; those of better.nmea" in note.sentence
        assert "height_above_geoid" not in {f.code for f in data.findings}
        found = examine(paths).findings
        assert note in found
        assert {f.file for f in found if f.code == "sigma_assumed"} == {str(better)}
    again = tmp_path / "again.BIN"
    again.write_bytes(log.read_bytes())
    with pytest.raises(LogError, match="is a second file of the kind of"):
        load_dataset([log, again])


@pytest.mark.parametrize(
    ("names", "arm", "why"),
    [
        (["kfgins-imu"], (0.1, 0.2, 0.3), "has no GNSS fixes, but is given a lever arm"),
        (["kfgins-imu", "kfgins-gnss"], (0.1, np.nan, 0.3), r"lever arm of \(0.1, nan, 0.3\) m"),
    ],
)
def test_a_lever_arm_that_cannot_be_used_is_refused(three, names, arm, why):
    with pytest.raises(LogError, match=why):
        load_dataset([three[name] for name in names], mounting=Mounting(lever_arm_b_m=arm))


def test_findings_of_readers_come_along(three):
    path = Path(three["kfgins-imu"])
    path.write_text(path.read_text()[:-3])
    assert [f.code for f in load_dataset([path]).findings] == ["ends_early"]


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


@pytest.mark.parametrize(
    ("start", "kind"),
    [
        (b"PAR1", "a Parquet file,"),
        (b"\x89HDF\r\n\x1a\n", "an HDF5 file,"),
        (b"MATLAB 5.0 MAT-file", "a MATLAB file,"),
        (b"\x93NUMPY", "an array of NumPy,"),
    ],
)
def test_a_damaged_archive_is_refused_by_its_kind(tmp_path, start, kind):
    path = tmp_path / "log.bin"
    path.write_bytes(start + bytes(400))
    with pytest.raises(LogError, match=f"is {kind} cut short or damaged after"):
        open_log(path)


def test_a_text_is_no_archive(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("t, a\n0, 1\n")
    with pytest.raises(LogError, match="is no archive, or one cut short or damaged after"):
        open_log(path, "broad-npz")
