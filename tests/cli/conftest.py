"""The command line run in this process, with a workbench and systems that compute nothing."""

import sys
from collections import namedtuple
from dataclasses import replace
from pathlib import Path

import pytest

from robins import report, results
from robins.cli import main
from robins.systems import Scenario, Study, System, catalogue
from robins.systems.judgement import Claim
from robins.workbench import publishing

Answer = namedtuple("Answer", "status out err")


@pytest.fixture
def robins(capsys, monkeypatch, tmp_path, sketched):
    """Run a command line in an empty folder: status, standard output, standard error."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")

    def run(*arguments):
        status = main([str(argument) for argument in arguments])
        return Answer(status, *capsys.readouterr())

    return run


class Workbench:
    """Stand-in for `robins.workbench`: notes requests, computes nothing or raises."""

    publishing = staticmethod(publishing)

    def __init__(self):
        self.asked = {}
        self.verdict = "reproduced"
        self.error = None
        self.findings = []
        self.warnings = []

    def run(self, name, **asked):
        return self._work(name, asked)

    def demo(self, **asked):
        return self._work("car/town", asked)

    def replay(self, paths, *, findings, **asked):
        findings(self.findings)
        return self._work("ins-gnss/log", asked | {"paths": paths})

    def align(self, name, master, slave, *, findings, **asked):
        return self._work(name, asked | {"master": master, "slave": slave})

    def _work(self, name, asked):
        self.asked = asked | {"name": name}
        print("noise of some library on standard output")
        asked["progress"](0.5, "half way")
        if self.error is not None:
            raise self.error
        claim = {"id": "C1", "text": "it holds", "value": 1.0, "band": [0.0, 2.0]}
        return results.Outcome(
            metrics={"ekf": {"horizontal_rms_m": 0.25, "worst_m": float("nan")}},
            claims=[claim | {"verdict": self.verdict}] if self.verdict else [],
            counts={"imu_nan": 2},
            notes=["A note for the reader."],
            warnings=self.warnings,
            scenario=name,
            seed=asked.get("seed", 0),
            runs=asked.get("runs") or 1,
            last_lines=["Next:   look into {out}"],
        )


@pytest.fixture
def workbench(monkeypatch):
    made = Workbench()
    monkeypatch.setitem(sys.modules, "robins.workbench", made)
    monkeypatch.setattr(report, "add", lambda writer, *_: writer.save_report("<p>"))
    return made


@pytest.fixture
def systems(monkeypatch):
    """Two systems in the registry, and what the catalogue says of them."""
    claims = {"C1": Claim("it holds", (), len, None)}
    study = Study(Scenario, ("ekf", "ukf"), print, print, print, claims=claims)
    car = System("car", {"drive": study}, default="ukf", replay=print)
    kite = System("kite", {"fly": replace(study, filters=("ekf",), claims={})})
    its = {"town": catalogue.ListedScenario(Path("town.toml"), "A car in town", "")}
    its["road"] = catalogue.ListedScenario(Path("road.toml"), "A car on the road", "")
    monkeypatch.setattr("robins.systems.SYSTEMS", {"car": car, "kite": kite})
    monkeypatch.setattr(catalogue, "SUMMARIES", {"car": "a car", "kite": "a kite"})
    monkeypatch.setattr(catalogue, "listed", lambda system: its if system == "car" else {})
