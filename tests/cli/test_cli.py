"""Promises of the command: statuses, streams, errors in a line, nothing left behind."""

import importlib.machinery
import importlib.metadata
import importlib.util
import json
import os
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from robins import cli, report, results
from robins.bench.rigs import RIGS
from robins.cli import ExitStatus, cache, running
from robins.logs import Finding, LogError
from robins.results.errors import result_error
from robins.scenario import ScenarioError
from robins.units import UnitError

PACKAGE = Path(cli.__file__).parents[1]

# ------------------------------------------------------------------------------------------- runs


def test_json_is_the_summary_and_nothing_else(robins, workbench):
    answer = robins("run", "car/town", "--json", "--out", "drive")
    assert answer.status == ExitStatus.DONE == 0
    assert answer.out == Path("drive/summary.json").read_text("utf-8")
    told = json.loads(answer.out)
    assert list(told) == [
        *("scenario", "seed", "runs", "filters", "claims", "counts", "warnings", "files", "seconds")
    ]
    assert told["filters"] == {"ekf": {"horizontal_rms_m": 0.25, "worst_m": None}}
    assert "noise of some library" in answer.err


def test_people_get_tables_paths_and_what_to_do_next(robins, workbench):
    answer = robins("run", "car/town", "--seed", 4)
    assert answer.status == 0
    for expected in (
        "Horizontal RMS [m]",
        "0.25",
        "reproduced",
        "1 of 1 claim reproduced.",
        "Refused samples: IMU nan 2",
        "A note for the reader.",
        "Result: results/car-town",
        "Report: results/car-town/report.html",
        "Next:   look into results/car-town",
    ):
        assert expected in answer.out
    assert answer.err == ""


def test_a_doubt_is_told_to_people_and_to_scripts(robins, workbench):
    workbench.warnings = ["ekf: 76 % of the fixes were refused."]
    assert "\nWarning: ekf: 76 % of the fixes were refused.\n" in robins("run", "car/town").out
    answer = robins("run", "car/town", "--json")
    assert json.loads(answer.out)["warnings"] == workbench.warnings
    assert "Warning: ekf: 76 %" in answer.err


def test_options_reach_the_workbench(robins, workbench):
    arguments = (
        *("run", "car/town", "--runs", 3, "--seed", 9, "--filters", "ekf, ukf", "--out", "a b"),
        *("--set", "imu.gyro_bias=5 deg/h", "--set", "note=a=b"),
    )
    robins(*arguments)
    asked = workbench.asked
    assert asked["name"] == "car/town"
    assert (asked["runs"], asked["seed"]) == (3, 9)
    assert asked["filters"] == ("ekf", "ukf")
    assert asked["settings"] == ("imu.gyro_bias=5 deg/h", "note=a=b")
    command = results.read("a b").manifest["command"]
    assert shlex.split(command) == ["robins", *map(str, arguments)]


def test_what_is_not_given_is_left_to_the_scenario(robins, workbench):
    robins("run", "folder/town.toml")
    asked = workbench.asked
    assert (asked["runs"], asked["seed"], asked["filters"], asked["settings"]) == (None, 0, (), ())
    assert os.listdir("results") == ["town"]


def test_a_log_is_replayed_and_the_doctor_is_heard(robins, workbench):
    workbench.findings = [
        Finding("warning", "gap", "imu.csv", "line 3", 1.0, "imu.csv line 3: a gap."),
        Finding("error", "unit", "imu.csv", "", 1.0, "imu.csv: degrees."),
    ]
    answer = robins("replay", "x/imu.csv.xz", "gnss.pos", "unit.toml", "--seed", 2, "--json")
    assert answer.status == 0
    assert workbench.asked["paths"] == tuple(map(Path, ("x/imu.csv.xz", "gnss.pos", "unit.toml")))
    assert workbench.asked["system"] == "ins-gnss"
    assert os.listdir("results") == ["imu"]
    assert json.loads(answer.out)["seed"] == 2
    assert "robins: warning: imu.csv line 3: a gap." in answer.err
    assert "degrees" not in answer.err  # an error ends the command and is told there


def test_exports_are_asked_for_by_name(robins, workbench):
    assert robins("replay", "imu.csv", "--export", "csv, kml").status == 0
    assert workbench.asked["exports"] == ("csv", "kml")
    assert robins("replay", "imu.csv").status == 0
    assert workbench.asked["exports"] == ()
    assert robins("replay", "imu.csv", "--export", "csv,").status == ExitStatus.BAD_INPUT


def test_a_log_is_one_run(robins, workbench):
    assert robins("replay", "imu.csv", "--runs", 1).status == 0
    answer = robins("replay", "imu.csv", "--runs", 5)
    assert answer.status == ExitStatus.BAD_INPUT
    assert answer.err == "robins: --runs 5: a recorded log is one run; omit the option.\n"


@pytest.mark.parametrize("verdict", ["reproduced", "not", None])
def test_the_demonstration_tells_its_claims_and_is_done_whatever_they_came_to(
    robins, workbench, verdict
):
    workbench.verdict = verdict
    answer = robins("demo", "--runs", 2, "--filters", "ekf,adaptive")
    assert answer.status == ExitStatus.DONE
    held = {"reproduced": "1 of 1 claim reproduced.", "not": "0 of 1 claim reproduced, 1 not."}
    assert [text in answer.out for text in held.values()] == [verdict == name for name in held]
    assert "Report: results/demo/report.html" in answer.out
    assert (workbench.asked["runs"], workbench.asked["filters"]) == (2, ("ekf", "adaptive"))
    assert robins("demo", "--json").out == Path("results/demo/summary.json").read_text("utf-8")


def test_the_answer_stands_before_its_report_is_written(robins, workbench, monkeypatch, capsys):
    seen = []

    def page(writer, *_):
        seen.append(capsys.readouterr().out)
        writer.save_report("<p>")

    monkeypatch.setattr(report, "add", page)
    after = robins("run", "car/town").out
    assert "1 of 1 claim reproduced." in seen[0]
    assert seen[0].endswith("\nWriting the report ...\n")
    assert after.splitlines()[0] == "Result: results/car-town"
    assert robins("run", "car/town", "--json").out.startswith("{")


def test_what_nobody_reads_is_written_all_the_same(robins, workbench, monkeypatch):
    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("click.echo", full)
    assert robins("run", "car/town").status == ExitStatus.FAILED
    assert results.read("results/car-town").summary["scenario"] == "car/town"


# ----------------------------------------------------------------------------------------- errors


REFUSED = results.ResultError("out", "is a file, not a folder", "choose a new folder")
FULL_DISK = result_error("out", "write", OSError(28, "No space left on device"))


@pytest.mark.parametrize(
    ("error", "status", "lines"),
    [
        (ScenarioError(["a.toml: imu.gyro_bais: unknown"]), 2, ["a.toml: imu.gyro_bais: unknown"]),
        (ScenarioError(["x: one", "y: two"]), 2, ["x: one", "y: two"]),
        (UnitError("deg is an angle"), 2, ["deg is an angle"]),
        (LogError("imu.csv", "is empty", "give another"), 2, ["imu.csv: is empty; give another"]),
        (REFUSED, 2, ["out: is a file, not a folder; choose a new folder"]),
        (FULL_DISK, 1, ["out: cannot write: No space left on device; free some space"]),
        (MemoryError(), 1, ["out of memory; ask for fewer runs or filters at a time."]),
        (OSError(13, "Permission denied", "x"), 2, ["x: Permission denied; choose another path."]),
        (ValueError("shapes\nand more"), 1, ["failed: ValueError: shapes", "this may be a fault"]),
        (RuntimeError(""), 1, ["failed: RuntimeError: ", "this may be a fault of robins"]),
    ],
)
@pytest.mark.parametrize("as_json", [True, False])
def test_an_error_is_told_in_a_line_with_its_status(
    robins, workbench, error, status, lines, as_json
):
    workbench.error = error
    answer = robins("run", "car/town", "--out", "out", *(["--json"] if as_json else []))
    assert answer.status == status
    told = [line for line in answer.err.splitlines() if "noise" not in line]
    assert len(told) <= 3
    for line, expected in zip(told, lines, strict=False):
        assert line.startswith(f"robins: {expected}")
    assert "Traceback" not in answer.err
    if as_json:
        assert answer.out == ""
    assert not Path("out").exists()


def test_debug_shows_where(robins, workbench):
    workbench.error = RuntimeError("somewhere")
    for arguments in (("--debug", "run", "x/y"), ("run", "x/y", "--debug")):
        answer = robins(*arguments)
        assert answer.status == 1
        assert "Traceback" in answer.err
        assert "in _work" in answer.err


def test_an_interrupt_is_told_and_leaves_the_earlier_result(robins, workbench):
    robins("run", "car/town", "--out", "out", "--seed", 1)
    workbench.error = KeyboardInterrupt()
    answer = robins("run", "car/town", "--out", "out", "--seed", 2)
    assert answer.status == ExitStatus.INTERRUPTED == 3
    assert answer.err.strip().startswith("robins: interrupted.")
    assert results.read("out").summary["seed"] == 1
    assert os.listdir() == ["out"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["rnu"], "No such command 'rnu'"),
        (["run"], "Missing argument 'SCENARIO'"),
        (["run", "x", "--rnus", "3"], "No such option"),
        (["run", "x", "--runs", "0"], "'--runs': 0 is not in the range"),
        (["run", "x", "--runs", "nan"], "'--runs': 'nan' is not a valid int"),
        (["run", "x", "--seed", "-1"], "'--seed': -1 is not in the range"),
        (["run", "x", "--seed", "1e3"], "'--seed': '1e3' is not a valid int"),
        (["run", "x", "--filters", "a,,b"], "'--filters': 'a,,b' has an empty name"),
        (["run", "x", "--filters", ""], "'--filters': '' has an empty name"),
        (["run", "x", "--set", "imu"], "'--set': 'imu' is not key=value"),
        (["run", "x", "--set", "=3"], "'--set': '=3' is not key=value"),
        (["replay"], "Missing argument 'LOG"),
        (["doctor"], "Missing argument 'LOG"),
        (["allan", "x", "--terms", "NN"], "--terms NN: give different letters out of"),
        (["allan", "x", "--terms", "NZ"], "--terms NZ: give different letters out of"),
    ],
)
def test_bad_usage_is_refused_in_a_line_or_two(robins, arguments, message):
    answer = robins(*arguments)
    assert answer.status == ExitStatus.BAD_INPUT == 2
    assert message in answer.err
    assert len(answer.err.splitlines()) <= 2
    assert all(line.startswith("robins: ") for line in answer.err.splitlines())
    assert answer.out == ""


# ------------------------------------------------------------------------------------------- help


def all_commands():
    return [(), *((name,) for name in cli.app.commands)]


@pytest.mark.parametrize("command", all_commands())
def test_help_is_given(robins, command):
    answer = robins(*command, "--help")
    assert answer.status == 0
    assert answer.out.startswith("Usage: robins")
    assert robins(*command, "-h").out == answer.out


def test_help_teaches_the_contract(robins):
    text = " ".join(robins("--help").out.split())
    assert "Exit status: 0 done, 1 failed, 2 bad input, 3 interrupted" in text
    for command in ("demo", "run", "replay", "doctor", "allan", "design", "list"):
        assert f"robins {command}" in text


def test_the_version_is_told(robins):
    import robins as package

    assert robins("--version").out == f"robins, version {package.__version__}\n"


# ------------------------------------------------------------------------------------------- list


def test_the_list_names_everything(robins, systems):
    answer = robins("list", "--json")
    assert answer.status == 0
    scenarios, filters = ["car/town", "car/road"], ["ekf", "ukf"]
    claim = {"id": "C1", "text": "it holds"}
    car = {"name": "car", "summary": "a car", "scenarios": scenarios, "filters": filters}
    car |= {"default": "ukf", "claims": [claim], "replays": True}
    kite = {"name": "kite", "summary": "a kite", "scenarios": [], "filters": ["ekf"]}
    kite |= {"default": None, "claims": [], "replays": False}
    assert json.loads(answer.out) == {
        "scenarios": scenarios,
        "systems": [car, kite],
        "filters": filters,
        "claims": [claim | {"system": "car"}],
        "rigs": sorted(RIGS),
        "bench": sorted(p.stem for p in PACKAGE.glob("bench/rigs/*/scenarios/*.toml")),
        "designs": sorted(p.stem for p in PACKAGE.glob("workbench/problems/*.toml")),
    }
    assert json.loads(robins("list", "car", "--json").out) == car
    for name in ("bench", "laboratory"):
        bench = json.loads(robins("list", name, "--json").out)
        assert sorted(bench["rigs"]) == sorted(RIGS)
        assert bench["scenarios"]["noisy-line"] == "Noisy lines"


def test_people_get_a_line_a_scenario_and_the_details_of_a_system(robins, systems):
    lines = robins("list").out.splitlines()
    assert lines[:4] == [
        "car  a car",
        "  car/town                     A car in town",
        "  car/road                     A car on the road",
        "",
    ]
    shown = ("noisy-line", "Noisy lines"), ("two-states", "Two coupled states")
    for name, title in (*shown, ("multirotor", "A multirotor on the bench, flown by PX4 or")):
        assert any(line.startswith(f"  {name} ") and title in line for line in lines)
    assert "robins run car/town" in lines[-1]
    assert "C1" not in "\n".join(lines)
    car = robins("list", "car").out
    for expected in (
        "car  a car",
        "A car in town",
        "ekf, ukf",
        "C1: it holds",
        "logs     yes",
        "default  ukf",
    ):
        assert expected in car
    assert "robins replay LOG --system kite" in robins("list", "kite").out
    assert "Next:   robins bench up laboratory" in robins("list", "laboratory").out
    refused = robins("list", "boat")
    assert refused.status == ExitStatus.BAD_INPUT
    assert refused.err.startswith("robins: no system 'boat'. There are car, kite; for one of your ")


# ------------------------------------------------------------------------------------------- cache


def test_compiled_filters_are_kept_where_the_user_keeps_caches(monkeypatch, tmp_path):
    monkeypatch.delitem(sys.modules, "jax")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR", raising=False)
    monkeypatch.setenv("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "7")
    monkeypatch.delenv("TF_CPP_MIN_LOG_LEVEL", raising=False)
    cache.enable()
    folder = Path(os.environ["JAX_COMPILATION_CACHE_DIR"])
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR")
    assert folder.is_dir()
    assert folder.parent == tmp_path / "robins"
    assert os.environ["TF_CPP_MIN_LOG_LEVEL"] == "3"
    for age, name in enumerate(("new", "old")):
        (folder / name).write_bytes(bytes(100))
        os.utime(folder / name, (1e9 - age, 1e9 - age))
    monkeypatch.setattr(cache, "_MOST", 150)
    cache.enable()
    assert os.listdir(folder) == ["new"]
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR")
    assert os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] == "7"
    monkeypatch.setattr(cache, "_machine", lambda: "another")
    cache.enable()
    assert Path(os.environ["JAX_COMPILATION_CACHE_DIR"]) != folder
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR")


@pytest.mark.parametrize(
    ("user", "jaxlib", "plugins", "platform", "chosen"),
    [
        (None, "0.10.2", False, None, True),
        ("", "0.10.2", False, None, False),
        (None, "0.11.0", False, None, True),
        (None, "0.12.0", False, None, False),
        (None, "0.10.2", True, None, False),
        (None, "0.10.2", True, "cpu", True),
    ],
    ids=["bare", "told by the user", "newer", "newer and changed", "a GPU", "a GPU unused"],
)
def test_the_compiler_is_set_up_where_it_takes_the_settings(
    monkeypatch, tmp_path, capsys, user, jaxlib, plugins, platform, chosen
):
    monkeypatch.delitem(sys.modules, "jax")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    tried = []

    def trial(*_, env, **__):
        tried.append(env["XLA_FLAGS"])
        return subprocess.CompletedProcess((), jaxlib == "0.12.0", stderr=cache._UNKNOWN)

    monkeypatch.setattr(subprocess, "run", trial)
    for name, value in (("XLA_FLAGS", user), ("JAX_PLATFORMS", platform)):
        monkeypatch.setenv(name, "put back afterwards")
        monkeypatch.delenv(name) if value is None else monkeypatch.setenv(name, value)
    monkeypatch.setattr(importlib.metadata, "version", {"jaxlib": jaxlib}.get)
    found = importlib.machinery.ModuleSpec("jax_plugins", None) if plugins else None
    monkeypatch.setattr(importlib.util, "find_spec", {"jax_plugins": found}.get)
    for _ in range(2):
        cache.enable()
        refused = "" if not plugins and user is None else user
        assert os.environ.get("XLA_FLAGS") == (cache._XLA_FLAGS if chosen else refused)
        if user is None:
            monkeypatch.delenv("XLA_FLAGS", raising=False)
    told = capsys.readouterr().err.splitlines()
    assert len(told) == (2 if jaxlib == "0.12.0" else 0)
    assert all(line.startswith("robins: note: this jaxlib (0.12.0) does not take") for line in told)
    assert tried == ([cache._XLA_FLAGS] if jaxlib > "0.11" else [])  # once, then remembered


def test_the_compiler_knows_its_settings():
    """It ends the process otherwise; what is tried in a process of its own finds that out."""
    assert cache._accepts_settings("of this test", None)
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(cache, "_XLA_FLAGS", "--xla_no_such_setting=1")
        assert cache._accepts_settings("of this test", None) is False
        patched.setattr(cache, "_TRIAL", "raise SystemExit(3)")  # which tells nothing of XLA
        assert cache._accepts_settings("of this test", None) is None
    code = "from robins.cli import cache; cache.enable(); import os, jax.numpy as n; n.ones(1) + 1"
    ours = ("XLA_FLAGS", "TF_CPP_MIN_LOG_LEVEL")
    bare = {k: v for k, v in os.environ.items() if k not in ours}
    told = [sys.executable, "-c", f"{code}; print(os.environ['XLA_FLAGS'])"]
    done = subprocess.run(told, env=bare, capture_output=True, text=True, check=True, timeout=120)
    assert done.stdout == f"{cache._XLA_FLAGS}\n"
    # of which XLA complains in its log, if it compiles
    failing = bare | {
        "XLA_FLAGS": "--xla_dump_to=/proc/nowhere",
        "JAX_ENABLE_COMPILATION_CACHE": "false",
    }
    for level, silent in ({}, True), ({"TF_CPP_MIN_LOG_LEVEL": "0"}, False):
        done = subprocess.run(
            told, env=failing | level, capture_output=True, text=True, check=True, timeout=120
        )
        assert (done.stderr == "") == silent


@pytest.mark.parametrize("why", ["told by the user", "jax is there", "no home"])
def test_the_cache_keeps_out_of_the_way(monkeypatch, tmp_path, why):
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    if why != "jax is there":
        monkeypatch.delitem(sys.modules, "jax")
    if why == "told by the user":
        monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", "mine")
    if why == "no home":
        (tmp_path / "cache").write_text("a file where the folder should be")
    cache.enable()
    told = os.environ.get("JAX_COMPILATION_CACHE_DIR")
    assert told == ("mine" if why == "told by the user" else None)


def test_statuses_are_those_of_the_contract():
    told = {s.name: int(s) for s in ExitStatus}
    assert told == {"DONE": 0, "FAILED": 1, "BAD_INPUT": 2, "INTERRUPTED": 3}
    assert running.main is cli.main


def test_a_folder_that_cannot_be_written_is_refused_before_anything_is_computed(robins, workbench):
    Path("out").write_text("a thesis")
    answer = robins("run", "car/town", "--out", "out")
    assert answer.status == ExitStatus.BAD_INPUT
    assert answer.err == "robins: out: is a file, not a folder; choose a new folder\n"
    assert workbench.asked == {}
