"""A stranger's folder: no command imports or starts anything of it unless the user names it."""

import ast
import json
import shlex
import shutil
import sys
from dataclasses import asdict
from pathlib import Path

import click
import mcap.writer
import pytest

import robins as package
from robins.bench.recording import layout, read_record
from robins.bench.wire.frames import VERSION
from robins.campaign.plan import CampaignPlan, code_of
from robins.cli import app
from robins.systems import trust

ROOT = Path(__file__).resolve().parents[2]
RECORD = ROOT / "tests" / "bench" / "records" / "adm.mcap"
BALLOON = ROOT / "docs" / "examples" / "balloon.py"
PENDULUM = ROOT / "docs" / "examples" / "pendulum.py"
RUNS = "import pathlib\npathlib.Path(__file__).with_name('ran').write_text('')\n"
IN_THE_WAY = ("numpy", "jax", "json", "multiprocessing", "sitecustomize", "netCDF4", "yaml")


def record_of(path: Path, rig: str, ports: dict[str, str]) -> None:
    """A record whose header names another rig and other ports than its run had."""
    header = read_record(RECORD).header
    header = {**header, "rig": rig, "setup": header["setup"] | {"ports": ports}}
    text = json.dumps(header)
    with path.open("wb") as file:
        writer = mcap.writer.Writer(file, compression=mcap.writer.CompressionType.NONE)
        writer.start(profile=layout.PROFILE, library="")
        check = layout.check_of(str(VERSION) + text)
        data = {"wire": str(VERSION), "header": text, "check": check}
        writer.add_metadata(layout.METADATA, data)
        writer.finish()


def campaign_of(folder: Path, asked: str, text: str) -> None:
    folder.mkdir()
    plan = CampaignPlan(asked, "x", text, 0, 2, ("kf",), "jax", 2, code_of(asked, text))
    (folder / "campaign.json").write_text(json.dumps({"schema": 1} | asdict(plan)))


@pytest.fixture
def hostile(robins, tmp_path, monkeypatch):
    """A folder whose every file tries to have its code run, as the working directory."""
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    monkeypatch.setattr(trust, "_here", {})
    monkeypatch.delitem(sys.modules, "evil", raising=False)
    monkeypatch.setattr("subprocess.Popen", lambda *_, **__: pytest.fail("a process would start"))
    (tmp_path / "evil.py").write_text(RUNS + BALLOON.read_text() + "\nrig = study\n")
    for name in IN_THE_WAY:
        (tmp_path / f"{name}.py").write_text(RUNS)
    program = tmp_path / "part"
    program.write_text("#!/bin/sh\ntouch ran\n")
    program.chmod(0o755)
    (tmp_path / "study.toml").write_text('system = "evil.py:study"\nruns = 2\n')
    (tmp_path / "rig.toml").write_text('bench = "evil.py:rig"\n')
    (tmp_path / "system.toml").write_text('system = "evil.py:rig"\n')
    (tmp_path / "ports.toml").write_text('bench = "satellite"\n[ports]\nadm = "./part"\n')
    record_of(tmp_path / "rig.mcap", "evil.py:rig", {})
    record_of(tmp_path / "ports.mcap", "satellite", {"adm": "./part"})
    campaign_of(tmp_path / "campaign", "evil.py:study", 'system = "evil.py:study"\nruns = 2\n')
    campaign_of(tmp_path / "by-file", "study.toml", 'system = "evil.py:study"\nruns = 2\n')
    for name in ("sweep/points/0", "result", "board-c"):
        (tmp_path / name).mkdir(parents=True)
    campaign_of(tmp_path / "sweep/points/0/x", "evil.py:study", 'system = "evil.py:study"\n')
    shutil.move(tmp_path / "sweep/points/0/x/campaign.json", tmp_path / "sweep/points/0")
    (tmp_path / "sweep/sweep.json").write_text('{"vary": ["push=1"], "points": ["points/0"]}')
    (tmp_path / "result/summary.json").write_text('{"system": "evil.py:study", "files": {}}')
    (tmp_path / "columns.toml").write_text('reader = "evil.py:study"\n')
    (tmp_path / "log.csv").write_text("t,ax\n0,__import__('evil')\n")
    return robins


REFUSED = (
    *(f"run {file} --out o" for file in ("study.toml", "rig.toml")),
    "bound study.toml --out o",
    "tune study.toml --vary barometer --out o",
    'sensitivity study.toml --vary "barometer=1 m to 2 m" --out o',
    "sweep study.toml --vary barometer=1,2 --out o",
    "export study.toml --to o",
    "campaign run study.toml --out o",
    *(
        f"campaign {what} {folder}"
        for what in ("work", "report", "show --run 0")
        for folder in ("campaign", "by-file", "sweep/points/0")
    ),
    *(f"campaign {what} sweep" for what in ("work", "report")),
    *(f"bench up {file}" for file in ("rig.toml", "system.toml", "ports.toml")),
    *(f"bench node adm /dev/null {file}" for file in ("rig.toml", "system.toml", "ports.toml")),
    *(f"bench replay {file} --node adm" for file in ("rig.mcap", "ports.mcap")),
    "bench replay rig.mcap --node adm --diff ports.mcap",
)
HARMLESS = (
    "demo --runs 0",
    "replay log.csv study.toml --out o",
    "replay log.csv --columns columns.toml --out o",
    "doctor log.csv --columns columns.toml",
    "guess log.csv",
    "allan log.csv --columns columns.toml --out o",
    "calibrate log.csv --columns columns.toml --out o",
    "design study.toml --out o",
    "bench status",
    "bench ports",
    "bench header --help",
    *(
        f"campaign {what} {folder}"
        for what in ("status", "verify")
        for folder in ("campaign", "by-file", "sweep")
    ),
    "compare result result",
    "verify result",
    "verify board-c",
    "list",
    "bench replay rig.mcap --node adm --help",
)


def commands(group: click.Group, before: str = "") -> list[str]:
    """All commands, with the groups that they are of."""
    found = []
    for name, one in group.commands.items():
        inside = isinstance(one, click.Group)
        found += commands(one, f"{before}{name} ") if inside else [before + name]
    return found


def test_every_command_is_tried():
    tried = [line for line in REFUSED + HARMLESS if "--help" not in line or "header" in line]
    assert [c for c in commands(app) if not any(t.startswith(c) for t in tried)] == []


@pytest.mark.parametrize("line", REFUSED)
def test_code_that_a_file_names_does_not_run(hostile, tmp_path, line):
    before = {path for path in tmp_path.rglob("*") if "config" not in path.parts}
    answer = hostile(*shlex.split(line))
    assert not (tmp_path / "ran").exists()
    assert answer.status == 2
    assert "Traceback" not in answer.err
    if "rig.toml" in line and line.startswith("run"):
        return  # a scenario of the bench is none of `run`
    file = "part" if "ports." in line and "diff" not in line else "evil.py"
    assert f"--trust {tmp_path / file}" in answer.err
    assert {path for path in tmp_path.rglob("*") if "config" not in path.parts} == before


@pytest.mark.parametrize("line", HARMLESS)
def test_what_reads_only_runs_nothing(hostile, tmp_path, line):
    hostile(*shlex.split(line))
    assert not (tmp_path / "ran").exists()


def test_the_command_of_the_error_goes_on_and_is_needed_once(hostile, tmp_path):
    evil = tmp_path / "evil.py"
    assert hostile("campaign", "work", "campaign").status == 2
    told = hostile("bound", "study.toml", "--filters", "x", "--trust", evil).err
    assert (tmp_path / "ran").exists()
    assert "no filter 'x'" in told
    trust._here.clear()  # as in a new process
    assert "no filter 'x'" in hostile("bound", "study.toml", "--filters", "x").err
    evil.write_text(evil.read_text() + "\n")
    assert "has changed since you confirmed it" in hostile("bound", "study.toml").err


def test_code_that_the_user_names_needs_no_confirmation(hostile, tmp_path):
    told = hostile("bound", "evil.py:study", "--filters", "x").err
    assert "no filter 'x'" in told
    trust._here.clear()
    assert "no filter 'x'" in hostile("bound", "study.toml", "--filters", "x").err


def test_no_python_that_robins_starts_looks_into_the_working_directory():
    """Option -P of each: else a file `json.py` there would be imported."""
    starts = 0
    for path in Path(package.__file__).parent.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.List | ast.Tuple) and node.elts:
                texts = [ast.unparse(element) for element in node.elts]
                if texts[0] == "sys.executable":
                    starts += 1
                    assert texts[1] == "'-P'", f"{path}, line {node.lineno}"
    assert starts >= 5
