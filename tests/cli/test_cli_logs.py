"""The commands that look at logs: the doctor, and the noise of an IMU at rest."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from robins import logs, results, scenario, units
from robins.cli import ExitStatus
from robins.dataset import ImuTable
from robins.ins import allan
from robins.ins.allan_noise import moments
from robins.report import numbers
from robins.workbench import allan as find_noise
from robins.workbench.allan import expected as expected_deviation
from robins.workbench.allan import resting_imu

RATE_HZ = 100.0
GYRO_NOISE = np.deg2rad(0.3) / 60.0  # rad/sqrt(s), 0.3 deg/sqrt(h)
ACCEL_NOISE = 5e-4  # m/s^2/sqrt(Hz)


def a_still_imu(seconds=60.0, gravity=-9.81, kind="rate"):
    """White noise at rest, in forward-right-down axes."""
    rng = np.random.default_rng(11)
    n = int(seconds * RATE_HZ)
    gyro = rng.normal(size=(n, 3)) * GYRO_NOISE * np.sqrt(RATE_HZ)
    accel = rng.normal(size=(n, 3)) * ACCEL_NOISE * np.sqrt(RATE_HZ) + [0.0, 0.0, gravity]
    time_ns = 1_700_000_000_000_000_000 + (np.arange(n) * (1e9 / RATE_HZ)).astype(np.int64)
    if kind == "increment":
        gyro, accel = gyro / RATE_HZ, accel / RATE_HZ
    return ImuTable(time_ns, gyro, accel, kind)


def written(path, table):
    logs.write_log(path, table, "euroc-imu")
    return path


@pytest.fixture(scope="module")
def still_log(tmp_path_factory):
    return written(tmp_path_factory.mktemp("logs") / "still.csv", a_still_imu())


@pytest.fixture(scope="module")
def upside_down(tmp_path_factory):
    return written(tmp_path_factory.mktemp("logs") / "upside down.csv", a_still_imu(gravity=9.81))


@pytest.fixture(scope="module")
def in_g(tmp_path_factory):
    return written(tmp_path_factory.mktemp("logs") / "in g.csv", a_still_imu(gravity=-1.0))


# ------------------------------------------------------------------------------------ bad TOML


@pytest.mark.parametrize(
    "command",
    [
        ("run", "unit.toml"),
        ("run", "unit.toml", "--master", "imu.csv", "--slave", "imu.csv"),
        ("bound", "unit.toml"),
        ("replay", "imu.csv", "unit.toml"),
        ("doctor", "imu.csv", "unit.toml"),
        ("calibrate", "imu.csv", "unit.toml"),
        ("design", "unit.toml"),
        ("bench", "up", "unit.toml"),
    ],
    ids=" ".join,
)
def test_a_fault_of_syntax_is_told_with_its_file(robins, command):
    Path("unit.toml").write_text('system = "ins-gnss"\n[imu\n')
    answer = robins(*command)
    assert answer.status == 2
    assert answer.err.startswith("robins: unit.toml: ")
    assert "not TOML: Expected ']'" in answer.err
    assert "line 2" in answer.err


def test_a_system_that_is_no_text_is_refused(robins):
    Path("list.toml").write_text('system = ["ins-gnss"]\n')
    answer = robins("run", "list.toml")
    assert answer.status == 2
    assert answer.err.startswith('robins: list.toml: write system = "..." into its first lines')


# -------------------------------------------------------------------------------------- the doctor


def test_a_healthy_log_is_fit_to_navigate(robins, still_log):
    answer = robins("doctor", still_log)
    assert answer.status == 0
    assert "0 errors" in answer.out
    assert f"robins replay {still_log}" in answer.out
    answer = robins("doctor", still_log, still_log)
    assert answer.status == 2
    assert "is a second file of the kind of" in answer.out


def test_a_wrong_log_is_bad_input_and_the_reason_is_told(robins, in_g):
    answer = robins("doctor", in_g)
    assert answer.status == 2
    (error,) = [line for line in answer.out.splitlines() if line.startswith("error:")]
    assert "in g.csv" in error
    assert "gravity" in error
    assert "1 error," in answer.out
    assert answer.err == ""


def test_findings_are_one_object_for_scripts(robins, in_g):
    answer = robins("doctor", in_g, "--json")
    assert answer.status == 2
    told = json.loads(answer.out)
    assert told["files"] == [str(in_g)]
    assert (told["errors"], told["warnings"]) == (1, 0)
    assert set(told["findings"][0]) == {"severity", "code", "file", "where", "value", "sentence"}
    assert told["findings"][0]["severity"] == "error"
    assert len(told["findings"]) == told["errors"] + told["warnings"] + told["notes"]


def test_the_mounting_of_a_configuration_is_heeded(robins, upside_down, monkeypatch, systems):
    class System:
        replay_parameters = object
        orientation = staticmethod(lambda parameters: (np.pi, 0.0, 0.0))

    monkeypatch.setitem(sys.modules["robins.systems"].SYSTEMS, "car", System)
    monkeypatch.setattr(scenario, "parse", lambda *args, **kwargs: None)
    Path("unit.toml").write_text('system = "car"\n')
    assert "1 note." in robins("doctor", upside_down).out
    assert "0 notes." in robins("doctor", upside_down, "unit.toml").out
    Path("other.toml").write_text('system = "plane"\n')
    refused = robins("doctor", upside_down, "other.toml")
    assert refused.status == 2
    assert refused.err.startswith('robins: other.toml: write system = "..." into it')
    assert robins("doctor", upside_down, "unit.toml", "other.toml").status == 2


@pytest.mark.parametrize("command", ["doctor", "replay", "calibrate"])
def test_a_configuration_alone_is_no_log(robins, command):
    answer = robins(command, "unit.toml")
    assert answer.status == 2
    said = "robins: unit.toml: is a configuration; give the files of the log beside it.\n"
    assert answer.err == said
    assert not list(Path().iterdir())


@pytest.fixture
def nine_axis():
    """A tumbling sensor's field beside a still IMU, as an archive of BROAD."""
    table = a_still_imu(seconds=20.0, gravity=9.81)
    rng = np.random.default_rng(2)
    n = len(table)
    np.savez(
        "trial.npz",
        imu_gyr=table.gyro,
        imu_acc=table.accel,
        imu_mag=np.array([1.0, 20.0, -44.0]) + 0.3 * rng.normal(size=(n, 3)),
        opt_quat=np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)),
        movement=np.zeros(n, bool),
        sampling_rate=RATE_HZ,
    )
    return Path("trial.npz")


def test_what_a_log_holds_is_shown_before_it_is_judged(robins, still_log, nine_axis):
    answer = robins("doctor", still_log)
    assert answer.out.startswith("inertial samples 6000 rows at 100 Hz, 60.0 s  (still.csv)\n")
    answer = robins("doctor", nine_axis)
    assert answer.status == 0
    kinds = [line.split("  ")[0].split(" 2000")[0] for line in answer.out.splitlines()[:3]]
    assert [k.strip() for k in kinds] == ["inertial samples", "magnetic field", "true attitude"]
    # There are no fixes to find a place with.
    assert answer.out.endswith("robins replay trial.npz --system marg\n")
    told = json.loads(robins("doctor", nine_axis, "--json").out)
    assert [(t["kind"], t["samples"], t["file"]) for t in told["tables"]] == [
        (kind, 2000, "trial.npz") for kind in ("imu", "mag", "attitude")
    ]
    assert told["tables"][1]["rate_hz"] == pytest.approx(100.0)
    assert told["tables"][1]["span_s"] == pytest.approx(19.99)


def test_the_noise_of_an_imu_is_found_beside_its_magnetometer(robins, nine_axis):
    density = find_noise(nine_axis, terms="N").metrics["x"]["gyro_angle_random_walk_deg_per_sqrt_h"]
    assert density == pytest.approx(0.3, rel=0.1)


@pytest.mark.parametrize("command", ["doctor", "allan"])
def test_a_file_that_is_no_log_is_refused_in_a_line(robins, command):
    Path("poem.txt").write_text("roses are red\n")
    for path in ("poem.txt", "nothing.csv", "."):
        answer = robins(command, path)
        assert answer.status == 2
        assert answer.err.startswith(f"robins: {path}")
        first, *formats = answer.err.splitlines()
        assert len(first) < 140
        assert all(line.startswith(("robins:   ", "robins: Next:")) for line in formats)
        assert answer.out == ""
    assert [p.name for p in Path().iterdir()] == ["poem.txt"]


# ------------------------------------------------------------------------------------------- Allan


def test_noise_parameters_are_found_and_written(robins, still_log, curve):
    answer = robins("allan", still_log, "--terms", "N", "--json", "--out", "noise")
    assert answer.status == 0
    told = json.loads(answer.out)
    assert answer.out == Path("noise/summary.json").read_text("utf-8")
    table = a_still_imu()
    for sensor, name, ending, truth in (
        ("gyro", "angle_random_walk", "deg_per_sqrt_h", 0.3),
        ("accel", "noise_density", "ug_per_sqrt_hz", ACCEL_NOISE / 9.80665e-6),
    ):
        fitted = allan.fit(allan.deviation(getattr(table, sensor), dt_s=1.0 / RATE_HZ), "N")
        want = allan.in_field_units(fitted, sensor)[name]
        for k, axis in enumerate("xyz"):
            value = told["filters"][axis][f"{sensor}_{name}_{ending}"]
            interval = told["filters"][axis][f"{sensor}_{name}_interval_{ending}"]
            assert value == pytest.approx(want.value[k], rel=1e-6)
            assert interval == pytest.approx([want.lower[k], want.upper[k]], rel=1e-6)
            assert value == pytest.approx(truth, rel=0.03)  # sigma of the estimate: 0.9 %
    back = results.read("noise")
    assert back.summary["scenario"] == "allan/still"
    assert set(back.figures) == {"allan_gyro", "allan_accel"}
    assert "Gyro angle random walk" in back.report.read_text("utf-8")
    np.testing.assert_allclose(back.solution["allan_gyro"], curve.deviation, rtol=1e-6)
    np.testing.assert_allclose(back.solution["tau"], curve.tau_s, rtol=1e-9)
    assert list(back.solution["process"].values) == ["random walk"]


def test_people_see_the_parameters_with_their_units(robins, still_log):
    answer = robins("allan", still_log)
    assert answer.status == 0
    for expected in (
        "Gyro angle random walk [deg/√h]",
        "Accelerometer bias instability [µg]",
        "Result: results/allan-still",
        "Report: results/allan-still/report.html",
        "Next:",
    ):
        assert expected in answer.out


def test_increments_give_what_rates_give(tmp_path):
    rates, increments = tmp_path / "rates.csv", tmp_path / "increments.csv"
    logs.write_log(rates, a_still_imu(10.0), "pyins-imu")
    logs.write_log(increments, a_still_imu(10.0, kind="increment"), "pyins-imu")
    one, other = resting_imu(rates), resting_imu(increments)
    np.testing.assert_allclose(one.rates["gyro"], other.rates["gyro"], rtol=1e-9)
    np.testing.assert_allclose(one.rates["accel"], other.rates["accel"], rtol=1e-9)


@pytest.mark.parametrize("kind", ["rate", "increment"])
def test_all_stretches_between_gaps_are_used_and_it_is_said(tmp_path, kind):
    table = a_still_imu(30.0, kind=kind)
    keep = np.ones(len(table), bool)
    keep[1000:1050] = False
    gapped = ImuTable(table.time_ns[keep], table.gyro[keep], table.accel[keep], kind)
    logs.write_log(tmp_path / "gapped.csv", gapped, "pyins-imu")
    found = resting_imu(tmp_path / "gapped.csv")
    per = 1.0 if kind == "rate" else 1.0 / RATE_HZ
    np.testing.assert_allclose(found.rates["gyro"], table.gyro[keep] / per, atol=1e-9)
    (note,) = found.notes
    assert note.startswith("The log has 1 gap(s): the Allan deviation is the mean over its 2")
    assert note.endswith("of which the longest has 19.49 s.")


def test_a_moving_sensor_is_noticed(tmp_path):
    table = a_still_imu(10.0)
    turning = table.gyro.copy()
    turning[400:600, 2] += 0.2
    for gyro, turned in ((turning, True), (table.gyro, False)):
        imu = ImuTable(table.time_ns, gyro, table.accel, "rate")
        notes = resting_imu(written(tmp_path / "log.csv", imu)).notes
        assert any("turned" in note for note in notes) == turned


def test_a_stuck_sensor_is_refused(robins, tmp_path):
    table = a_still_imu(10.0)
    stuck = ImuTable(table.time_ns, np.zeros_like(table.gyro), table.accel, "rate")
    written(tmp_path / "stuck.csv", stuck)
    answer = robins("allan", "stuck.csv")
    assert answer.status == 2
    assert answer.err.startswith("robins: stuck.csv: gyro: axis 0 is constant")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["stuck.csv"]


def test_a_short_log_gives_its_curve_and_the_reason_why_no_parameters(tmp_path):
    log, heard = written(tmp_path / "short.csv", a_still_imu(2.0)), []
    found = find_noise(log, terms="QNBKR", progress=lambda share, what: heard.append(share))
    assert [note[:53] for note in found.notes] == [
        "No parameters of the gyro: too short for the 5 terms ",
        "No parameters of the accel: too short for the 5 terms",
    ]
    assert "process" not in found.solution.sizes
    assert np.isfinite(found.solution["allan_gyro"]).all()
    assert found.metrics == {"x": {}, "y": {}, "z": {}}
    assert heard == sorted(heard)


@pytest.fixture(scope="module")
def curve():
    return allan.deviation(a_still_imu().gyro, dt_s=1.0 / RATE_HZ)


@pytest.mark.parametrize("terms", ["Q", "N", "B", "K", "QNBKR"])
def test_the_parts_of_the_fit_are_those_it_was_fitted_with(terms, curve):
    ones = allan.NoiseCoefficients(*(np.full(3, 1.0 + k) for k in range(5)))
    dof = np.ones(3, int)
    fitted = allan.AllanFit(ones, ones, ones, np.zeros(3), dof, terms, 0.95, curve.tau_s[:1])
    parts = expected_deviation(fitted, curve.tau_s)
    assert "".join(parts) == terms
    mean = moments(curve.clusters, curve.n_samples, curve.dt_s).mean
    for term, part in parts.items():
        k = "QNBKR".index(term)
        want = np.sqrt(mean[:, k]) * (1.0 + k)
        np.testing.assert_allclose(part, np.stack([want] * 3, axis=1), rtol=1e-12)


@pytest.mark.parametrize(
    ("unit", "ending", "shown"),
    [
        ("deg/sqrt(h)", "deg_per_sqrt_h", "deg/√h"),
        ("deg/h/sqrt(h)", "deg_per_h_per_sqrt_h", "deg/h/√h"),
        ("ug/sqrt(Hz)", "ug_per_sqrt_hz", "µg/√Hz"),
        ("deg/h/h", "deg_per_h_per_h", "deg/h/h"),
        ("m/s^2", "m_per_s2", "m/s²"),
        ("arcsec", "arcsec", "arcsec"),
    ],
)
def test_units_survive_the_name_of_a_metric(unit, ending, shown):
    assert units.as_ending(unit) == ending
    assert numbers.label(f"x_{units.as_ending(unit)}") == ("X", shown)


def test_every_unit_of_the_fit_can_be_told():
    for sensor in allan._FIELD_UNITS.values():
        for name, (_, unit) in sensor.items():
            assert numbers.label(f"{name}_{units.as_ending(unit)}").unit != ""


LOGGER = """
separator = ";"
[columns]
time = { name = "t", unit = "us" }
""" + "".join(
    f'{holds}_{axis} = {{ name = "{name}{axis}", unit = "{unit}" }}\n'
    for holds, name, unit in (("gyro", "w", "deg/s"), ("accel", "a", "g"))
    for axis in "xyz"
)


def test_declared_columns_are_read_by_the_commands_and_refused_with_their_key(robins, tmp_path):
    declared, log = tmp_path / "logger.toml", tmp_path / "my.csv"
    declared.write_text(LOGGER)
    table = a_still_imu(20.0)
    logs.write_log(log, table, logs.columns_from(declared))
    np.testing.assert_allclose(resting_imu(log, [declared]).rates["gyro"], table.gyro, rtol=1e-12)
    answer = robins("doctor", log, "--columns", declared)
    assert answer.status == ExitStatus.DONE, answer.err
    assert f"robins replay {log} --columns {declared}" in answer.out
    answer = robins("calibrate", log, "--columns", declared)
    assert "holds no magnetic field" in answer.err
    answer = robins("run", "transfer-alignment/s0", "--columns", declared)
    assert answer.status == ExitStatus.BAD_INPUT
    said = f"--columns {declared}: the option is for logs; give --master and --slave too."
    assert said in " ".join(answer.err.split())
    slave = ("--master", log, "--slave", log)
    answer = robins("run", "transfer-alignment/replay", *slave, "--columns", declared)
    assert answer.status == ExitStatus.BAD_INPUT
    assert "holds no path of a master INS" in answer.err
    declared.write_text(LOGGER.replace("gyro_y", "gyro_w"))
    for command in (("doctor",), ("allan",), ("replay",), ("calibrate",)):
        answer = robins(*command, log, "--columns", declared)
        assert answer.status == ExitStatus.BAD_INPUT
        assert f"{declared} columns.gyro_w: is no quantity" in answer.err.replace("\n", " ")
        assert "did you mean gyro_" in answer.err


def test_a_table_is_guessed_declared_and_examined_and_a_path_named(robins, tmp_path):
    log, table = tmp_path / "my own.csv", a_still_imu(20.0)
    columns = [table.time_ns / 1e9, table.accel / 9.80665, table.gyro]
    rows = np.column_stack(columns).tolist()
    lines = [";".join(map(repr, row)) for row in rows]
    log.write_text("\n".join(["t;ax;ay;az;wx (rad/s);wy (rad/s);wz (rad/s)", *lines]) + "\n")
    answer = robins("guess", log)
    assert answer.status == ExitStatus.DONE, answer.err
    assert 'unit = "g" }   # proved by gravity: median size 1' in answer.out
    assert f"robins doctor '{log}' --columns 'my own.toml'" in answer.err
    Path("my own.toml").write_text(answer.out)
    answer = robins("doctor", log, "--columns", "my own.toml")
    assert answer.status == ExitStatus.DONE, answer.out
    assert json.loads(robins("guess", log, "--json").out)["toml"].startswith("# my own.csv")
    path = tmp_path / "path.txt"
    path.write_text(
        "".join(f"{k}00000000,0,0,{k},0,0,0,1,9\n" for k in range(30)).replace(",", " ")
    )
    answer = robins("doctor", path, "--format", "orbslam-euroc")
    assert answer.status == ExitStatus.DONE, answer.err
    assert "30 rows" in answer.out
    assert "Next:   give the log of an IMU too" in answer.out  # no replay of a path alone
    answer = robins("doctor", path, "--format", "orbslam")
    assert answer.status == ExitStatus.BAD_INPUT
    assert "no format is called 'orbslam'; choose one of gnss-imu" in answer.err.replace("\n", " ")
