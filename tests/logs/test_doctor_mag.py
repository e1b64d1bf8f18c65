"""The doctor on a magnetometer: each fault put into a healthy record and found, alone."""

import dataclasses

import numpy as np
import pytest
from made_nine_axis import tumble_dataset

from robins.dataset import Dataset, MagTable
from robins.logs import examine, load_dataset

UNIT_MENDS = {
    1e6: ("error", "probably in uT: multiply by 1e-6"),
    1e9: ("error", "probably in nT: multiply by 1e-9"),
    1e4: ("error", "probably in gauss: multiply by 1e-4"),
    1e7: ("error", "probably in milligauss: multiply by 1e-7"),
    1e3: ("error", "in nT where uT is said, or uT where mT: divide by 1000"),
    1e2: ("error", "in uT where gauss is said: divide by 100"),
    1e1: ("warning", "may be in mG where uT is said, or a magnet is near: divide by 10"),
    1e-1: ("warning", "may be in uT where mG is said, or it is shielded: multiply by 10"),
    1e-2: ("error", "probably in gauss where uT is said: multiply by 100"),
    1e-3: ("error", "in uT where nT is said, or mT where uT: multiply by 1000"),
}


@pytest.fixture(scope="module")
def data():
    return tumble_dataset()


def changed(data, **columns):
    return dataclasses.replace(data, mag=dataclasses.replace(data.mag, **columns))


def found(subject, *kinds):
    """Codes of the findings, those on how the sensor lies left out."""
    told = [f for f in examine(subject) if f.code != "sensor_axes"]
    return [f.code for f in told if not kinds or f.severity in kinds]


def the(subject, code):
    """The one finding of this code: a whole sentence that names file and part."""
    (f,) = [f for f in examine(subject) if f.code == code]
    assert f.sentence.startswith("tumble.npz (magnetic field)")
    assert f.sentence.endswith(".")
    assert "\n" not in f.sentence
    return f


def test_a_healthy_sensor_has_no_findings_but_that_it_lies_anyhow(data):
    (note,) = examine(data)
    assert (note.severity, note.code) == ("note", "sensor_axes")
    assert "specific force lies along (-0.00, +0.00, +1.00) of x, y, z" in note.sentence
    assert found(data.mag) == []


@pytest.mark.parametrize("factor", UNIT_MENDS)
def test_the_size_of_the_field_tells_its_unit(data, factor):
    f = the(changed(data, field_t=data.mag.field_t * factor), "field_unit")
    severity, mend = UNIT_MENDS[factor]
    assert f.severity == severity
    assert mend in f.sentence
    assert f.value == pytest.approx(48.6e-6 * factor, rel=0.01)


def test_a_size_that_is_no_unit_at_all(data):
    f = the(changed(data, field_t=data.mag.field_t * 3e11), "field_unit")
    assert f.severity == "error"
    assert "no usual unit makes it that. These are counts of a converter" in f.sentence
    # Iron in the casing is often stronger than the Earth's field, and that is no unit.
    iron = changed(data, field_t=data.mag.field_t + np.array([120e-6, 0, 0]))
    assert found(iron, "error") == []


def test_missing_samples(data):
    field_t = data.mag.field_t.copy()
    field_t[100:140, 1] = np.nan
    f = the(changed(data, field_t=field_t), "field_missing")
    assert (f.severity, f.value, f.where) == ("warning", 40, "1.000 s after the start")
    assert "40 of 4000 samples (1.0%)" in f.sentence
    field_t[:, 2] = np.nan
    f = the(changed(data, field_t=field_t), "field_missing")
    assert "of field_z there is nothing at all" in f.sentence
    assert found(changed(data, field_t=field_t), "error") == []


def test_a_field_of_zero(data):
    field_t = data.mag.field_t.copy()
    field_t[:25] = 0.0
    f = the(changed(data, field_t=field_t), "field_zero")
    assert (f.severity, f.value) == ("warning", 25)
    assert "exactly 0 0 0 in 25 of 4000 samples" in f.sentence
    assert found(changed(data, field_t=field_t)) == ["field_zero"]
    f = the(changed(data, field_t=0.0 * field_t), "field_zero")
    assert f.severity == "error"


def test_a_dead_axis_and_one_that_hangs(data):
    field_t = data.mag.field_t.copy()
    field_t[:, 1] = 12e-6
    f = the(changed(data, field_t=field_t), "field_stuck")
    assert f.severity == "error"
    assert "field_y never changes (12 uT in every sample)" in f.sentence
    field_t = data.mag.field_t.copy()
    field_t[1200:1500] = field_t[1200]
    f = the(changed(data, field_t=field_t), "field_stuck_for_a_while")
    assert (f.severity, f.where) == ("warning", "12.000 s after the start")
    assert "for 300 samples (3.0 s)" in f.sentence
    field_t[1300] *= 1.001  # not for so long at a time
    assert found(changed(data, field_t=field_t)) == []


def test_a_slow_sensor_in_a_fast_log(data):
    field_t = np.repeat(data.mag.field_t[::5], 5, axis=0)
    f = the(changed(data, field_t=field_t), "field_repeated")
    assert f.severity == "note"
    assert "80% of the samples" in f.sentence
    assert "measures about 20 times a second, the log has 100 rows" in f.sentence
    assert found(changed(data, field_t=field_t)) == ["field_repeated"]


def test_a_magnet_drives_the_sensor_to_its_stop(data):
    field_t = data.mag.field_t.copy()
    field_t[2000:2030, 2] -= 500e-6
    field_t = np.maximum(field_t, -400e-6)
    f = the(changed(data, field_t=field_t), "field_saturated")
    assert (f.severity, f.value, f.where) == ("warning", -400e-6, "20.000 s after the start")
    assert "field_z stops at -400 uT in 30 readings, 30 in a row" in f.sentence


def test_hard_iron_is_told_by_its_offset(data):
    offset = np.array([30e-6, -10e-6, 5e-6])
    f = the(changed(data, field_t=data.mag.field_t + offset), "field_offset")
    assert f.severity == "warning"
    assert f.value == pytest.approx(np.linalg.norm(offset), rel=0.05)
    assert "run `robins calibrate`" in f.sentence
    told = f.sentence.split("offset of (")[1].split(")")[0]
    np.testing.assert_allclose([float(x) for x in told.split(",")], offset * 1e6, atol=1.0)


def test_soft_iron_and_places_vary_the_size(data):
    stretch = np.diag([1.3, 0.8, 1.0])
    f = the(changed(data, field_t=data.mag.field_t @ stretch), "field_varies")
    assert f.severity == "warning"
    assert "`robins calibrate`" in f.sentence


def test_a_magnet_passed_by(data):
    field_t = data.mag.field_t.copy()
    bump = np.exp(-(((np.arange(len(field_t)) - 2500) / 20.0) ** 2))
    field_t += bump[:, None] * [40e-6, 0.0, 0.0]
    f = the(changed(data, field_t=field_t), "field_disturbed")
    assert f.severity == "note"
    assert 24.5 < float(f.where.split()[0]) < 25.0
    assert found(changed(data, field_t=field_t)) == ["field_disturbed"]


def test_too_little_is_not_judged(data):
    few = dataclasses.replace(
        data.mag, time_ns=data.mag.time_ns[:5], field_t=1e6 * data.mag.field_t[:5]
    )
    assert found(few) == []
    none = dataclasses.replace(few, time_ns=few.time_ns[:1], field_t=few.field_t[:1])
    assert found(none) == ["too_short"]


def test_stamps_of_their_own_are_judged_and_shared_ones_only_once(data):
    def without(table):
        keep = np.ones(len(table), bool)
        keep[700:720] = False
        columns = {
            f.name: getattr(table, f.name)[keep]
            for f in dataclasses.fields(table)
            if isinstance(getattr(table, f.name), np.ndarray)
        }
        return dataclasses.replace(table, **columns)

    f = the(dataclasses.replace(data, mag=without(data.mag)), "gap_short")
    assert f.severity == "note"
    assert "heading is held by the gyros meanwhile" in f.sentence
    every = {kind: without(getattr(data, kind)) for kind in ("imu", "mag", "attitude")}
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
    """The same samples by themselves are those of a vehicle that lies on its back."""
    assert "z_axis_reversed" in found(data.imu, "error")
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
        f = the(changed(data, field_t=field_t + offset), "field_axes")
        assert f.severity == "error"
        assert f"with the columns {columns}, or all three of these reversed" in f.sentence
        assert f.value > 1.0
    assert "field_axes" not in found(changed(data, field_t=-data.mag.field_t))
    assert "field_axes" not in found(changed(data, field_t=data.mag.field_t + offset))


def test_axes_are_not_judged_without_turning_or_with_wrong_gyros(data):
    wrong = np.array(PERMUTED["(field_y, field_z, field_x)"], float).T
    still = {
        kind: dataclasses.replace(
            getattr(data, kind),
            **{
                f.name: getattr(getattr(data, kind), f.name)[:500]
                for f in dataclasses.fields(getattr(data, kind))
                if isinstance(getattr(getattr(data, kind), f.name), np.ndarray)
            },
        )
        for kind in ("imu", "mag", "attitude")
    }
    rest = dataclasses.replace(data, **still)
    assert found(changed(rest, field_t=rest.mag.field_t @ wrong)) == []
    degrees = dataclasses.replace(data.imu, gyro=np.rad2deg(data.imu.gyro))
    turned = changed(dataclasses.replace(data, imu=degrees), field_t=data.mag.field_t @ wrong)
    assert "gyro_unit" in found(turned, "error")
    assert "field_axes" not in found(turned)


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
