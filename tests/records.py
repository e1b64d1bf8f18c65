"""Record of a test run: what it cost, compared with the budget, written where `make costs` asks."""

import json
import os
import re
from collections import Counter
from pathlib import Path

import budget
import meter
import pytest
import tiers

# Each of two workers compiles what tests share, and which test of a room is the first varies. The
# records are held to the ceilings themselves.
SPREAD = 1.25
FIRST = 5  # what a worker asks for once, in whatever room it begins


class Records:
    """Plugin of the controller: the sums of all workers at the end of a run."""

    def __init__(self, config: pytest.Config) -> None:
        # A part of the tests compiles and starts for itself what others do for it in the whole.
        option = config.option
        self.whole = (
            config.args_source is pytest.Config.ArgsSource.TESTPATHS
            and option.markexpr == "not certify"
            and not (option.keyword or option.deselect or option.ignore or option.lf)
            and (option.numprocesses or 1) <= 2  # each worker compiles what tests share
            and "PART" not in os.environ
        )
        self.meter: meter.Meter = config.pluginmanager.get_plugin("meter")
        self.write = os.environ.get("COSTS")
        self.failed: set[str] = set()

    def passed(self) -> list[str]:
        """Ceilings that the run passed; seconds are compared where they are recorded."""
        files = {file: tests.values() for file, tests in self.meter.rows.items()}
        most = {
            room: {kind: round(limit * SPREAD) + FIRST for kind, limit in row.items()}
            for room, row in budget.ceilings()["rooms"].items()
        }
        return budget.passed(budget.by_room(files), most, budget.COUNTS) if self.whole else []

    def pytest_runtest_logreport(self, report):
        """Note the files with a failure, whose cost is not that of their tests."""
        if report.failed:
            self.failed.add(report.nodeid.removeprefix("tests/").partition("::")[0])

    @pytest.hookimpl(trylast=True)
    def pytest_sessionfinish(self, session, exitstatus):
        """Fail a run that passed a ceiling; write the record of the files whose tests passed."""
        if exitstatus not in (pytest.ExitCode.OK, pytest.ExitCode.TESTS_FAILED):
            return
        if self.write:
            for file in self.failed:
                self.meter.rows.pop(file, None)
            written = lines(record(self.meter, whole=self.write == "all" and not self.failed))
            new = budget.COSTS.with_suffix(".new")
            new.write_text(written, "utf-8")
            new.replace(budget.COSTS)
        elif exitstatus == pytest.ExitCode.OK and self.passed():
            session.exitstatus = pytest.ExitCode.TESTS_FAILED

    def pytest_terminal_summary(self, terminalreporter):
        """Print what the run cost, and the ceilings that it passed."""
        sums = sum((Counter(c) for t in self.meter.rows.values() for c in t.values()), Counter())
        counts = ", ".join(f"{sums[kind]} {kind}" for kind in budget.COUNTS)
        terminalreporter.write_line(
            f"{self.meter.spent_s:.0f} s of processor, {counts}; {self.meter.modules} modules at "
            f"collection; a worker takes {self.meter.peak[0]} MiB at most, in {self.meter.peak[1]}."
        )
        for line in self.passed():
            terminalreporter.write_line(f"Budget (tests/budget.py): {line}", red=True)


def record(measured: meter.Meter, whole: bool) -> dict:
    """`costs.json`: rows of the files measured, and with ``whole`` the figures of the run.

    Files that are gone, and in a whole run those that were not run, lose their rows.
    """
    before = json.loads(budget.COSTS.read_text("utf-8")) if budget.COSTS.exists() else {"files": {}}
    kept = {} if whole else {f: r for f, r in before["files"].items() if (meter.HERE / f).exists()}
    for file, tests in measured.rows.items():
        sums = sum(tests.values(), Counter())
        row = {"digest": meter.digest(file), **{kind: sums[kind] for kind in meter.KINDS}}
        row["seconds"] = round(sums["seconds"], 1)
        dear = {t: round(c["seconds"], 1) for t, c in sorted(tests.items())}
        row["tests"] = {t: s for t, s in dear.items() if s >= budget.LEAST_S}
        kept[file] = meter.sealed(row)
    if whole:
        before = {"modules": measured.modules, "peak_mib": measured.peak[0]}
    return before | {"files": dict(sorted(kept.items()))}


def lines(written: dict) -> str:
    """`costs.json` as text, a line for each file, so that a diff shows whose cost changed."""
    rows = (f"{json.dumps(file)}: {json.dumps(row)}" for file, row in written["files"].items())
    head = json.dumps({k: v for k, v in written.items() if k != "files"})
    return head[:-1] + ', "files": {\n' + ",\n".join(rows) + "\n}}\n"


def named(file: Path) -> set[str]:
    """Names of the tests of a file."""
    return set(re.findall(r"^ *def (test_\w+)", file.read_text("utf-8"), re.MULTILINE))


def unsound(files: dict[str, dict]) -> list[str]:
    """A sentence for each row of `costs.json` that is missing, stale or edited by hand.

    A file whose tests all belong to `make certify` needs no row.
    """
    moved = {entry["test"] for entry in tiers.certified() if "only" not in entry}
    found = []
    for path in sorted(meter.HERE.rglob("test_*.py")):
        file = str(path.relative_to(meter.HERE))
        row = files.get(file)
        if row is None:
            if not {f"{file}::{name}" for name in named(path)} <= moved:
                found.append(f"{file} was never measured")
        elif row["digest"] != meter.digest(file):
            found.append(f"{file} has changed since it was measured")
        elif meter.sealed(row) != row:
            found.append(f"{file}: its figures are not those that were measured")
    return found + [f"{file} is gone" for file in files if not (meter.HERE / file).exists()]
