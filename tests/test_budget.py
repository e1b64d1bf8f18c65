"""Nothing costs more than its budget: tests by room, promised commands, counts of the source."""

import json
import os
import subprocess
import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path

import budget
import counting
import jax
import meter
import pytest
import ratchets
import records
from short_drive import DRIVE, write_pos

from robins import logs, scenario
from robins.systems.ins_gnss import Drive, drive_dataset
from robins.workbench.run import _STORY

HERE = Path(__file__).parent
COMPARED = pytest.mark.skipif("COSTS" in os.environ, reason="this run measures what is compared")
ADVICE = "measure these files again: make costs FILES='{}'"

# ------------------------------------------------------------------------------------ the records


@COMPARED
def test_no_ceiling_is_passed():
    assert budget.verdict() == []


@COMPARED
def test_every_file_of_tests_was_measured_as_it_is():
    found = records.unsound(budget.costs()["files"])
    files = " ".join(f"tests/{line.split()[0].rstrip(':')}" for line in found)
    assert found == [], ADVICE.format(files)


def test_a_row_that_is_stale_missing_or_edited_is_found():
    files = budget.costs()["files"]
    name = "test_budget.py"
    row = meter.sealed(files["test_units.py"] | {"digest": meter.digest(name)})
    assert not any(name in line for line in records.unsound(files | {name: row}))
    for planted in ({**row, "digest": "0" * 12}, {**row, "seconds": 1.0}, {**row, "programs": 7}):
        assert [x for x in records.unsound(files | {name: planted}) if name in x]
    gone = {file: row for file, row in files.items() if file != "test_units.py"}
    assert "test_units.py was never measured" in records.unsound(gone)
    assert "test_x.py is gone" in records.unsound(files | {"test_x.py": row})


def test_ceilings_never_rise():
    now = budget.ceilings()
    ceilings, counts = budget.earlier("budget.toml", "ratchets.toml")
    for before in filter(None, ceilings):
        assert budget.raised(now, before) == []
    for allowed in counts:
        then = {room: Counter(row) for room, row in ratchets.most().items() if room in allowed}
        assert ratchets.risen(then, allowed) == []
    less = now | {"whole": {kind: limit - 1 for kind, limit in now["whole"].items()}}
    assert len(budget.raised(now, less)) == len(now["whole"])
    none = {"rooms": {name: row | {"runs": 0} for name, row in now["rooms"].items()}}
    assert budget.raised(now, now | none)  # one of nought is a ceiling too
    room = {"new": dict.fromkeys((*budget.COUNTS, "seconds"), 1)}
    assert len(budget.raised(now | {"rooms": now["rooms"] | room}, now)) == len(room["new"])


def test_a_passed_ceiling_is_named():
    found = {"filters": Counter(programs=3, runs=1)}
    most = {"filters": {"programs": 2, "runs": 1}}
    assert budget.passed(found, most, ("programs", "runs")) == [
        "filters: 3 programs, over the ceiling of 2"
    ]
    assert budget.passed({"new": Counter(runs=1)}, most, budget.COUNTS) == [
        "new: 1 runs, over the ceiling of 0"
    ]


# -------------------------------------------------------------------------- the promised commands


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A short log of a drive; matplotlib knows its fonts, which it looks for by processes."""
    import matplotlib.font_manager  # noqa: F401

    here = tmp_path_factory.mktemp("promised")
    drive = drive_dataset(scenario.parse(Drive, DRIVE), seed=1)
    since_ns = 1_700_000_000 * 10**9
    imu, gnss = (replace(t, time_ns=t.time_ns + since_ns) for t in (drive.imu, drive.gnss))
    logs.write_log(here / "imu.csv", imu)
    write_pos(here / "gnss.pos", gnss)
    return here


@pytest.mark.parametrize("line", budget.ceilings()["commands"])
def test_a_promised_command_stays_within_its_counts(line, folder):
    run = [sys.executable, HERE / "counting.py", folder / "counts.json", *line.split()]
    done = subprocess.run(run, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    counts = Counter(json.loads((folder / "counts.json").read_text()))
    most = budget.ceilings()["commands"]
    assert budget.passed({line: counts}, most, most[line]) == []
    assert counts["runs"] == most[line]["runs"]
    for kind in ("programs", "modules"):  # a ceiling far above is none, and a count of 0 no count
        assert counts[kind] >= 0.8 * most[line][kind]
    if line == "demo":
        pictures = (folder / "results" / "demo").rglob("*.png")
        assert {picture.stem for picture in pictures} == set(_STORY)


def test_what_a_process_asks_for_is_counted():
    counts = counting.Counts(every=True)
    counts.begin()
    jax.jit(lambda x: 3.0 * x + 0.125)(1.0)
    for words in (["git", "log"], ["gcc-12", "-c"], [sys.executable, "-m", "ziglang", "cc"]):
        counts._audit("subprocess.Popen", (words[0], words))
    for name in ("a.so", "a.so", "b.so"):  # the compiler is called where the cache lacks a text
        counts._audit("robins.build", (name,))
    counts._audit("subprocess.Popen", ("gcc", ["gcc", "-o", "/tmp/x/a.so"]))
    counts._audit("robins.simulate", (7,))
    assert dict(counts) == {"programs": 1, "processes": 1, "builds": 4, "runs": 7}


# ------------------------------------------------------------------------------------- the source


def test_counts_of_the_source_do_not_rise():
    assert ratchets.risen(ratchets.measured(), ratchets.most()) == []


def test_what_ratchets_count_is_found(tmp_path):
    (tmp_path / "room").mkdir()
    (tmp_path / "room" / "a.py").write_text(
        '"""What it is."""\nfrom typing import Any\nfrom robins.room import b\n'
        'class A:\n    """A class."""\n    def f(self, x: Any, *y: list[object]) -> Any:\n'
        '        """Whether it is."""\n' + "        x += 1\n" * 60
    )
    back = "def g():\n    from robins.room.a import A\n    return A\n"
    back += "@value\nclass V:\n    x: int\n"  # stands for a function, and is not counted
    (tmp_path / "room" / "b.py").write_text(back)
    found = ratchets.measured(tmp_path)
    assert found == {"room": {"clauses": 2, "classes": 1, "circular": 2, "long": 1, "loose": 3}}
    assert ratchets.risen(found, found) == []
    less = {"room": {**found["room"], "classes": 0}}
    assert ratchets.risen(found, less) == ["room: 1 classes that are no values, 0 allowed"]
