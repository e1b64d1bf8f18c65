"""The doctor on a magnetometer: what is no fault, what silences, axes, and real sensors."""

import dataclasses

import numpy as np
import pytest
from made_logs import rows_of
from made_nine_axis import tumble_dataset
from made_spoilt import mag, plus, put, turned, with_imu

from robins.dataset import Dataset, MagTable
from robins.logs import examine, load_dataset


@pytest.fixture(scope="module")
def data():
    return tumble_dataset()


def changed(data, **columns):
    return dataclasses.replace(data, mag=dataclasses.replace(data.mag, **columns))


def found(subject, *kinds):
    """Codes of the findings, those on how the sensor lies left out."""
    told = [f for f in examine(subject) if f.code != "sensor_axes"]
    return [f.code for f in told if not kinds or f.severity in kinds]


def test_what_is_no_fault(data):
    # Iron in the casing is often stronger than the Earth's field, and that is no unit.
    assert found(mag(field_t=plus([120e-6, 0, 0]))(), "error") == []
    # A sensor that hung twice, not for so long at a time.
    field_t = put(slice(1200, 1500), data.mag.field_t[1200])(data.mag.field_t)
    assert found(changed(data, field_t=put(1300, 1.001 * field_t[1300])(field_t))) == []


def test_hard_iron_is_told_by_its_offset():
    offset = np.array([30e-6, -10e-6, 5e-6])
    (f,) = [f for f in examine(mag(field_t=plus(offset))()) if f.code == "field_offset"]
    assert f.value == pytest.approx(np.linalg.norm(offset), rel=0.05)
    told = f.sentence.split("offset of (")[1].split(")")[0]
    np.testing.assert_allclose([float(x) for x in told.split(",")], offset * 1e6, atol=1.0)


def test_too_little_is_not_judged(data):
    few = rows_of(dataclasses.replace(data.mag, field_t=1e6 * data.mag.field_t), slice(5))
    assert found(few) == []
    assert found(rows_of(few, slice(1))) == ["too_short"]


def test_stamps_that_tables_share_are_judged_only_once(data):
    rows = np.delete(np.arange(len(data.imu)), np.r_[700:720])
    every = {kind: rows_of(getattr(data, kind), rows) for kind in ("imu", "mag", "attitude")}
    told = [f for f in examine(dataclasses.replace(data, **every)) if f.code == "gap_short"]
    assert [f.severity for f in told] == ["warning"]
    assert told[0].sentence.startswith("tumble.npz 7.200 s")


def test_a_slow_magnetometer_is_no_wrong_unit_of_time(data):
    for every, codes in ((50, []), (500, ["time_unit"])):
        slow = MagTable(
            data.mag.time_ns[:: every // 2] * 2, data.mag.field_t[:: every // 2], source="m.csv"
        )
        assert found(slow, "error") == codes


def test_a_vehicle_has_a_top_and_a_sensor_has_none(data):
    """A vehicle is known by its fixes; who wants the sensor's attitude lets it lie as it likes."""
    log = with_imu(**turned(np.diag([1, -1, -1])))()
    assert found(log) == ["z_axis_reversed"]
    assert [(f.severity, f.code) for f in examine(log, "attitude")] == [("note", "sensor_axes")]
    assert found(data.imu, "error") == []
    assert found(data, "error") == []
    assert found([data], "error") == []
    bare = Dataset("bare", data.imu, mag=data.mag)
    assert found(bare, "error") == []
    upright = dataclasses.replace(data.imu, accel=-data.imu.accel)
    assert not [f for f in examine([upright, data.mag]) if f.code == "sensor_axes"]


PERMUTED = {
    "(field_y, field_x, -field_z)": [[0, 1, 0], [1, 0, 0], [0, 0, -1]],  # its own inverse
    "(field_y, field_z, field_x)": [[0, 0, 1], [1, 0, 0], [0, 1, 0]],
    "(field_x, -field_y, -field_z)": [[-1, 0, 0], [0, 1, 0], [0, 0, 1]],  # but for all signs
}


@pytest.mark.parametrize("columns", PERMUTED)
def test_axes_other_than_those_of_the_gyros(data, columns):
    """Also where iron in the casing adds as much as the Earth."""
    field_t = data.mag.field_t @ np.array(PERMUTED[columns], float).T
    for offset in (0.0, np.array([40e-6, -30e-6, 20e-6])):
        told = examine(changed(data, field_t=field_t + offset))
        (f,) = [f for f in told if f.code == "field_axes"]
        assert f.severity == "error"
        assert f"with the columns {columns}, or all three of these reversed" in f.sentence
        assert f.value > 1.0
    assert "field_axes" not in found(changed(data, field_t=-data.mag.field_t))
    assert "field_axes" not in found(changed(data, field_t=data.mag.field_t + offset))


def test_axes_are_not_judged_without_turning_or_with_wrong_gyros(data):
    wrong = np.array(PERMUTED["(field_y, field_z, field_x)"], float).T
    still = {kind: rows_of(getattr(data, kind), slice(500)) for kind in ("imu", "mag", "attitude")}
    rest = dataclasses.replace(data, **still)
    assert found(changed(rest, field_t=rest.mag.field_t @ wrong)) == []
    degrees = dataclasses.replace(data.imu, gyro=np.rad2deg(data.imu.gyro))
    both = changed(dataclasses.replace(data, imu=degrees), field_t=data.mag.field_t @ wrong)
    assert "gyro_unit" in found(both, "error")
    assert "field_axes" not in found(both)


@pytest.mark.parametrize(
    "name",
    ["broad_07_undisturbed_fast_rotation_B.npz", "broad_33_disturbed_attached_magnet_2cm.npz"],
)
def test_axes_of_real_sensors_exchanged_on_purpose(data_dir, name):
    """Even with a magnet beside the sensor."""
    trial = load_dataset([data_dir / name])
    for columns, matrix in PERMUTED.items():
        field_t = trial.mag.field_t @ np.array(matrix, float).T
        (f,) = [f for f in examine(changed(trial, field_t=field_t)) if f.code == "field_axes"]
        assert columns in f.sentence


@pytest.mark.parametrize(
    ("name", "codes"),
    [
        ("broad_01_undisturbed_slow_rotation_A.npz", {"field_repeated"}),
        ("broad_07_undisturbed_fast_rotation_B.npz", {"field_repeated"}),
        ("broad_15_undisturbed_fast_translation_A.npz", {"field_repeated"}),
        ("broad_24_disturbed_tapping_A.npz", {"field_repeated"}),
        ("broad_28_disturbed_stationary_magnet_A.npz", {"field_repeated", "field_disturbed"}),
        ("broad_33_disturbed_attached_magnet_2cm.npz", {"field_repeated", "field_varies"}),
        ("fusion_sensor_data.csv.xz", {"field_repeated"}),
        ("pyulog_sample_log_small.ulg.xz", {"field_repeated"}),
        ("strapdownrs_phone_2025-06-11.csv.xz", {"field_varies"}),
    ],
)
def test_real_logs_have_no_errors(data_dir, name, codes):
    if ".ulg" in name:
        pytest.importorskip("pyulog", reason="the extra `logs` is not installed")
    findings = examine(load_dataset([data_dir / name]))
    assert [f for f in findings if f.severity == "error"] == []
    assert {f.code for f in findings if f.code.startswith("field_")} == codes
