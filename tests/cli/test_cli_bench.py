"""The commands of the bench: their words, and what they refuse before anything is started."""

import ast
import json
import os
import re
import typing
from functools import partial
from pathlib import Path

import click
import mcap.writer
import pydantic
import pytest

from robins.bench.rigs.satellite import RIG
from robins.bench.rigs.satellite.messages import WIRE
from robins.bench.run.session import Session
from robins.bench.run.setup import built_in
from robins.bench.wire.c_header import c_header
from robins.cli import app
from robins.results import ResultWriter
from robins.workbench.bench import flight_of

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "bench.md").read_text("utf-8")
CONTRACT = (ROOT / "docs" / "contract.md").read_text("utf-8")
BENCH = app.commands["bench"]
assert isinstance(BENCH, click.Group)
COMMANDS = BENCH.commands
SATELLITE = "satellite/s1"
PARTS = ", ".join(RIG.parts)
OF_A_FILTER = ("--node", "adm", "--filter", "mekf")
RECORD = ROOT / "tests" / "bench" / "records" / "adm.mcap"


@pytest.fixture(autouse=True)
def nothing_starts(monkeypatch):
    """Whatever would start a process or run a bench fails the test."""

    def refuse(*_, **__):
        pytest.fail("a process would have been started")

    monkeypatch.setattr("subprocess.Popen", refuse)
    monkeypatch.setattr(Session, "run", refuse)


@pytest.fixture(autouse=True)
def own_runtime(monkeypatch, tmp_path):
    """Benches that run on this machine for other reasons are not seen."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))


def rows(text: str, heading: str) -> list[list[str]]:
    """Cells of the tables below a heading whose first cell is code."""
    part = text.split(f"\n## {heading}\n")[1].split("\n## ")[0]
    found = [line.strip("|").split("|") for line in part.splitlines() if line.startswith("| `")]
    return [[cell.strip() for cell in row] for row in found]


def code(text: str) -> list[str]:
    return re.findall(r"`([^`]+)`", text)


# -------------------------------------------------------------------------------------- help


@pytest.mark.parametrize("name", ["", *COMMANDS])
def test_help_tells_what_it_does_and_how(robins, name):
    told = robins("bench", *name.split(), "--help")
    assert told.status == 0
    assert "Usage: robins bench" in told.out
    if name not in ("status", "ports"):  # those take nothing
        assert f"robins bench {name}" in told.out.split("Examples:")[1]


def test_every_scenario_is_named_in_the_help_and_on_the_page(robins):
    told = " ".join(robins("bench", "up", "--help").out.split()).replace("- ", "-")
    listed = told.split("Scenarios of the bench: ")[1].split(". ")[0]
    assert listed.split(", ") == sorted(built_in())
    named = [code(row[0])[0] for row in rows(PAGE, "Faults")]
    assert [n for n in named if "-" in n] == sorted(built_in())


# ------------------------------------------------------------------------------ what is promised


def test_the_contract_names_commands_and_options():
    told = {code(row[0])[0].split()[2]: code(row[2]) for row in rows(CONTRACT, "The test bench")}
    has = {
        name: [flag for option in command.params for flag in option.opts if flag[:2] == "--"]
        for name, command in COMMANDS.items()
    }
    assert {k: sorted(v) for k, v in told.items()} == {k: sorted(v) for k, v in has.items()}


def function(module: str, name: str) -> ast.FunctionDef:
    tree = ast.parse((ROOT / "src" / "robins" / "bench" / module).read_text("utf-8"))
    found = (n for n in ast.walk(tree) if isinstance(n, ast.FunctionDef) and n.name == name)
    return next(found)


def keys(of: ast.AST) -> list[str]:
    """Names of the keys that a dictionary is written with."""
    assert isinstance(of, ast.Dict)
    return [ast.literal_eval(key) for key in of.keys if key is not None]


def test_the_page_names_every_key_of_the_object():
    (told,) = (
        n.value
        for n in ast.walk(function("run/outcome.py", "figures"))
        if isinstance(n, ast.Return)
    )
    assert isinstance(told, ast.Dict)
    counts = told.values[keys_of(told).index("counts")]
    judge = function("rigs/satellite/judging.py", "judge")
    (metrics,) = (n.value for n in ast.walk(judge) if isinstance(n, ast.Assign) and is_dict(n))
    (said,) = (n.value for n in ast.walk(judge) if isinstance(n, ast.Return))
    assert isinstance(said, ast.Call)
    named = rows(PAGE, "For scripts")
    assert sorted(k for row in named for k in code(row[0])) == sorted([*keys(told), *keys(metrics)])
    (counted,) = (row[1] for row in named if row[0] == "`counts`")
    assert sorted(code(counted)) == sorted([*keys(counts), *keys(said.args[1])])


def is_dict(n: ast.Assign) -> bool:
    return isinstance(n.value, ast.Dict)


def keys_of(d: ast.Dict) -> list[str | None]:
    return [None if key is None else ast.literal_eval(key) for key in d.keys]


def test_the_page_names_every_kind_of_fault_with_its_fields():
    told = {code(row[0])[0]: code(row[2]) for row in rows(PAGE, "Faults") if len(row) == 3}
    kinds = typing.get_args(RIG.fault.model_fields["kind"].annotation)
    assert sorted(told) == sorted(kinds)
    every = {"link": "star", "direction": "to", "message": "star", "share": 0.5, "bits": 2}
    every |= {"delay": 0.1, "angle": 0.1, "wheel": 0}
    for kind in kinds:
        with pytest.raises(pydantic.ValidationError) as refused:
            RIG.fault(kind=kind, begin=0.0, **every)
        (takes,) = re.findall(r"it takes ([\w, ]+\w)", str(refused.value))
        assert told[kind] == [f for f in takes.split(", ") if f not in ("kind", "begin", "end")]


# ------------------------------------------------------------------------------------ small ones


def test_the_header_is_that_of_the_wire(robins):
    assert robins("bench", "header").out == c_header(WIRE)


def test_ports_are_listed_for_programs(robins):
    said = json.loads(robins("bench", "ports", "--json").out)
    known = {"path", "description", "manufacturer", "serial_number", "usable", "why"}
    assert list(said) == ["ports"]
    assert all(set(port) == known for port in said["ports"])


def test_status_where_none_runs(robins):
    assert json.loads(robins("bench", "status", "--json").out) == {"benches": []}
    told = robins("bench", "status")
    assert (told.status, told.out.splitlines()[0]) == (0, "No bench runs.")


# ------------------------------------------------------------------------------------- bad input


@pytest.mark.parametrize(
    ("given", "told"),
    [
        (["noisy-lin"], r"no scenario 'noisy-lin' for the bench; did you mean 'noisy-line'\?"),
        (["satellite/s11"], r"no scenario 'satellite/s11' .*did you mean 'satellite/s1'\?"),
        ([SATELLITE, "--node", "gyros=/dev/x"], r"ports: there is no part 'gyros', only plant, "),
        ([SATELLITE, "--node", "gyro"], r"'--node': 'gyro' is not PART=PORT, such as gyro=/dev/"),
        ([SATELLITE, "--node", "=/dev/x"], r"'--node': '=/dev/x' is not PART=PORT"),
        ([SATELLITE, "--node", "gyro=/dev/none-such"], r"'/dev/none-such'.*no such path"),
        ([SATELLITE, "--paused"], r"--paused waits for the page's Start; give --live too"),
        ([SATELLITE, "--rate", "100"], r'rate: .*lock-step has none; choose the clock "realtime"'),
        ([SATELLITE, "--filter", "mekff"], r"no filter 'mekff' .*did you mean 'mekf"),
        ([SATELLITE, "--seconds", "1e6"], r"seconds: 1e\+06 s .*to the end .* \(1500 s\)"),
        ([SATELLITE, "--seconds", "0.01"], r"seconds: 0\.01 s is not from a step \(0\.1 s\)"),
        (["wrong-star", "--set", "faults.0.kind=turnd"], r"faults\.0\.kind .*mean 'turned'\?"),
        (["none.toml"], r"none\.toml"),
    ],
    ids=lambda x: " ".join(x) if isinstance(x, list) else "",
)
def test_a_run_that_cannot_be_is_refused_with_the_mend(robins, given, told, tmp_path):
    answer = robins("bench", "up", *given)
    assert answer.status == 2
    assert answer.out == ""
    assert re.search(told, answer.err)
    assert not list(tmp_path.rglob("*.mcap"))


def test_an_option_of_nought_is_given(tmp_path):
    (tmp_path / "mine.toml").write_text('bench = "satellite"\nseed = 5\n')
    read = partial(flight_of, str(tmp_path / "mine.toml"), ())
    assert [read({"seed": seed}).setup.seed for seed in (0, None, 7)] == [0, 5, 7]


def test_a_second_bench_with_the_same_folder_is_refused(robins, tmp_path):
    out = tmp_path / "out"
    first = ResultWriter(out)
    record = Path(f"{out}.record.mcap")
    record.write_text("of the first")
    answer = robins("bench", "up", SATELLITE, "--out", out)
    assert (answer.status, answer.out) == (2, "")
    assert f"{out}: is being written by process {os.getpid()} on " in answer.err
    assert "choose another folder (--out)" in answer.err
    assert record.read_text() == "of the first"
    first.discard()


@pytest.mark.parametrize("foreign", [False, True], ids=["text", "foreign"])
def test_what_is_no_record_is_refused(robins, tmp_path, foreign):
    """Text, and an MCAP file that the bench did not write."""
    path = tmp_path / "x.mcap"
    path.write_text("no record")
    if foreign:
        with path.open("wb") as file:
            writer = mcap.writer.Writer(file)
            writer.start()
            writer.finish()
    answer = robins("bench", "replay", path, "--node", "adm")
    assert answer.status == 2
    assert str(path) in answer.err
    assert re.search("a record that the bench wrote|not one that the bench wrote", answer.err)


@pytest.mark.parametrize(
    ("given", "told"),
    [
        (("node", "gyros", "/dev/null", SATELLITE), f"no part 'gyros', only {PARTS}"),
        (("replay", RECORD, "--node", "amd"), f"--node: there is no part 'amd', only {PARTS}"),
        (
            ("replay", RECORD, *OF_A_FILTER, "--diff", RECORD),
            "--filter and --diff: the one runs a filter, the other compares records",
        ),
    ],
)
def test_parts_that_are_none_and_options_that_exclude_each_other(robins, given, told):
    answer = robins("bench", *given)
    assert answer.status == 2
    assert answer.err == f"robins: {told}\n"
