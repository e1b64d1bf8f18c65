"""The command `calibrate`: a turned magnetometer, read from a log, with its iron found."""

import contextlib
import io
import json
import tomllib

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from robins import logs, report, results, scenario
from robins.cli import main
from robins.ins.magnetometer_calibration import calibrate
from robins.sim.magnetometer import observe_field
from robins.systems import SYSTEMS
from robins.workbench.calibrate import FILE, advice
from robins.workbench.calibrate import calibrate as command

RATE_HZ, COUNT = 50.0, 2000
FIELD_N = np.array([20e-6, 0.0, 43e-6])
HARD = np.array([12e-6, -25e-6, 8e-6])
SOFT = np.diag([1.05, 0.96, 1.0]) / (1.05 * 0.96) ** (1.0 / 3.0)


def write(path, euler_rad, disturbed=slice(0, 0)):
    """A log of a sensor at these attitudes, (N, 3) heading, pitch, roll."""
    turned = Rotation.from_euler("ZYX", euler_rad)
    q = turned.as_quat(scalar_first=True)
    there = np.ones(COUNT, bool)
    iron = {"soft_iron": SOFT, "hard_iron_t": HARD}
    field = np.array(observe_field(jax.random.key(1), q, FIELD_N, 2e-7, there, **iron))
    field[disturbed] += 30e-6
    rate = np.gradient(np.unwrap(np.asarray(euler_rad), axis=0), axis=0) * RATE_HZ
    np.savez(
        path,
        imu_gyr=rate[:, ::-1].astype(np.float32),
        imu_acc=turned.inv().apply([0.0, 0.0, -9.81]).astype(np.float32),
        imu_mag=(field * 1e6).astype(np.float32),
        opt_quat=q,
        movement=np.ones(COUNT, bool),
        sampling_rate=RATE_HZ,
    )
    return path


def tumbling():
    time = np.arange(COUNT) / RATE_HZ
    return np.column_stack([1.3 * time, 1.5 * np.sin(0.6 * time), 0.9 * time])


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    return write(tmp_path_factory.mktemp("logs") / "tumbling.npz", tumbling())


@pytest.fixture(scope="module")
def made(log):
    """Output of the command, and its result."""
    said, out = io.StringIO(), log.parent / "result"
    with contextlib.redirect_stdout(said):
        assert main(["calibrate", str(log), "--out", str(out)]) == 0
    return said.getvalue(), results.read(out)


def test_offset_and_matrix_come_back(made, log):
    out, result = made
    columns = result.summary["filters"]
    for k, axis in enumerate("xyz"):
        sigma = columns[axis]["offset_sigma_ut"]
        assert columns[axis]["offset_ut"] == pytest.approx(HARD[k] * 1e6, abs=5.0 * sigma)
    matrix = np.array([columns[axis]["matrix_row"] for axis in "xyz"])
    np.testing.assert_allclose(matrix, np.linalg.inv(SOFT), rtol=0.0, atol=5e-3)
    assert columns["field"]["rms_after_ut"] < 0.05 * columns["field"]["rms_before_ut"]
    assert "Offset [µT]" in out
    assert f"robins replay {log}" in out


def test_the_configuration_is_one_that_a_replay_reads(made):
    _, result = made
    text = (result.path / FILE).read_text()
    magnetometer = scenario.parse(SYSTEMS["marg"].replay_parameters, text, ()).magnetometer
    columns = result.summary["filters"]
    offset = [columns[axis]["offset_ut"] * 1e-6 for axis in "xyz"]
    np.testing.assert_allclose(magnetometer.offset, offset, rtol=0.0, atol=1e-10)
    rows = [columns[axis]["matrix_row"] for axis in "xyz"]
    np.testing.assert_allclose(magnetometer.matrix, rows, rtol=0.0, atol=1e-6)
    assert tomllib.loads(text)["system"] == "marg"


def test_the_figures_show_both_fields(made):
    _, result = made
    names = [picture.name for picture in report.pictures(result.solution, result.summary)]
    assert names == ["field_planes", "field_size"]
    made_files = {p.name for p in (result.path / "figures").iterdir()}
    assert made_files == {"field_planes.png", "field_size.png"}
    after = result.solution["field_calibrated"]
    size = np.linalg.norm(after.values, axis=1)
    assert size.mean() == pytest.approx(after.attrs["strength"], rel=1e-3)


def test_json_is_the_summary_and_nothing_else(robins, log, tmp_path):
    answer = robins("calibrate", log, "--json", "--field", "50 uT", "--out", tmp_path / "r")
    told = json.loads(answer.out)
    assert told["filters"]["field"]["size_ut"] == pytest.approx(50.0)


def test_the_mounting_turns_what_is_found(robins, log, tmp_path):
    """Mounted askew by a half turn about x, the offset along y and z is the other way round."""
    config = tmp_path / "unit.toml"
    config.write_text('system = "marg"\norientation = ["180 deg", "0 deg", "0 deg"]\n')
    plain = robins("calibrate", log, "--json", "--out", tmp_path / "a")
    askew = robins("calibrate", log, config, "--json", "--out", tmp_path / "b")
    offset, turned = (
        [json.loads(a.out)["filters"][axis]["offset_ut"] for axis in "xyz"] for a in (plain, askew)
    )
    np.testing.assert_allclose(turned, np.array(offset) * [1.0, -1.0, -1.0], rtol=1e-5)
    parameters = SYSTEMS["marg"].replay_parameters
    files = [(tmp_path / name / FILE).read_text() for name in "ab"]
    mounts = [scenario.parse(parameters, text, ()).orientation for text in files]
    assert mounts == [
        (0.0, 0.0, 0.0),
        scenario.parse(parameters, config.read_text(), ()).orientation,
    ]


def test_a_part_of_the_log_can_be_left_out(robins, tmp_path):
    """Something magnetic is near from 10 to 14 s."""
    log = write(tmp_path / "disturbed.npz", tumbling(), slice(500, 700))
    whole = robins("calibrate", log, "--out", tmp_path / "a")
    assert "something magnetic was near" in whole.out
    late = robins("calibrate", log, "--begin", "14.01 s", "--end", "38 s", "--out", tmp_path / "b")
    assert "something magnetic" not in late.out
    time_s = results.read(tmp_path / "b").solution["time"].values
    assert 14.0 < time_s[0] < 14.1
    assert 37.9 < time_s[-1] < 38.1


def test_gaps_and_needless_calibrations_are_told():
    rng = np.random.default_rng(2)
    directions = rng.standard_normal((3000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    noise = 1e-7 * rng.standard_normal((3000, 3))
    assert advice(calibrate(4e-5 * directions + HARD + noise)) == []
    (same,) = advice(calibrate(4e-5 * directions + noise))
    assert same.startswith("The offset is within its uncertainty")
    below = directions[directions[:, 2] < 0.1]
    (gap,) = advice(calibrate(4e-5 * below + HARD + noise[: len(below)]))
    assert "of the field along +z" in gap
    cap = directions[directions[:, 2] < -0.8]
    far = 2e-6 * rng.standard_normal((len(cap), 3))
    assert "the matrix is the identity" in advice(calibrate(4e-5 * cap + HARD + far))[0]


def test_what_cannot_be_calibrated_is_told_in_a_line(robins, log, tmp_path):
    flat = write(tmp_path / "flat.npz", tumbling() * [1.0, 0.0, 0.0])
    imu = tmp_path / "imu.csv"
    logs.write_log(imu, logs.open_log(log).imu, "euroc-imu")
    for arguments, says in (
        ((flat,), "turned about one axis only"),
        ((imu,), "holds no magnetic field"),
        ((log, log), "more than once"),
        ((log, "--field", "50 m"), "magnetic field"),
        ((log, "--begin", "99 s"), "the log ends at"),
    ):
        answer = robins("calibrate", *arguments, "--out", tmp_path / "none")
        assert answer.status == 2
        assert says in answer.err
        assert not (tmp_path / "none").exists()


def test_a_vehicle_that_cannot_tilt_drives_a_circle(tmp_path):
    log = write(tmp_path / "circle.npz", tumbling() * [1.0, 0.0, 0.0])
    found = command([log], horizontal=True)
    offset = [found.metrics[axis]["offset_ut"] for axis in "xyz"]
    np.testing.assert_allclose(offset, [12.0, -25.0, 0.0], atol=0.1)
    assert found.notes[0].startswith("The horizontal axes alone were calibrated")
    half = write(tmp_path / "half.npz", tumbling() * [0.06, 0.0, 0.0])
    assert any("A sector of 1" in note for note in command([half], horizontal=True).notes)
