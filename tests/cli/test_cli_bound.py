"""`robins bound`, with the real workbench on short scenarios."""

import json
import re

import numpy as np
import pytest

from robins import results
from robins.cli import ExitStatus
from robins.systems import SYSTEMS

pytestmark = pytest.mark.usefixtures("unchecked")


@pytest.fixture(scope="module")
def car(tmp_path_factory):
    """The packaged drive with its first three legs only."""
    text = SYSTEMS["ins-gnss"].scenarios["drive"].read_text()
    head, *legs = text.split("[[legs]]")
    path = tmp_path_factory.mktemp("bound") / "car.toml"
    head = head.replace('settle = "60 s"', 'settle = "5 s"')
    path.write_text("[[legs]]".join([head, *legs[:3]]))
    return path


@pytest.fixture
def robins_at(robins, car):
    """Run `robins bound` on it."""
    return lambda *arguments: robins("bound", car, *arguments)


def test_people_get_the_bound_what_is_seen_and_what_a_sensor_buys(robins_at, tmp_path):
    answer = robins_at("--at", "10 s", "--at", "0.5 min", "--out", "seen", "--seed", 3)
    assert (answer.status, answer.err) == (ExitStatus.DONE, "")
    lines = answer.out.splitlines()
    head = lines[0]
    assert re.search(r"prior +10 s +30 s +of prior +verdict +without GNSS position", head)
    rows = {line[:27].strip(): line for line in lines[1:16]}
    assert len(rows) == 15
    assert " seen " in rows["attitude down"]
    assert " hardly seen " in rows["gyro bias down"] or " not seen " in rows["gyro bias down"]
    assert "The observability Gramian has rank" in answer.out
    assert "Report: seen/report.html" in answer.out
    result = results.read("seen")
    ds = result.solution
    assert ds.attrs["filter"] == "ekf"
    velocity = ds.bound_without_velocity.sel(sensor="gnss_velocity")[-1]
    assert np.all(velocity.values > ds.bound_velocity[-1].values)
    assert len(result.summary["files"]["figures"]) == 6
    assert result.summary["files"]["other"] == ["bound.csv"]
    assert "verdict" in (tmp_path / "seen" / "report.html").read_text()


def test_scripts_get_the_summary(robins):
    answer = robins(
        *("bound", "transfer-alignment/s0", "--json", "--filters", "kf"),
        *("--set", "manoeuvre.duration=16 s"),
    )
    assert answer.status == 0
    told = json.loads(answer.out)
    (metrics,) = told["filters"].values()
    assert list(told["filters"]) == ["kf"]
    assert set(metrics) == {
        *("attitude_bound_arcmin", "gyro_bias_bound_deg_per_h", "mounting_bound_arcmin")
    }
    # The master is read to 1 arcmin, 320 times; the gyro bias of 1 deg/h takes longer to be seen.
    assert all(0.1 < v < 0.6 for v in metrics["attitude_bound_arcmin"])
    assert all(0.8 < v < 1.0 for v in metrics["gyro_bias_bound_deg_per_h"])
    assert results.read("results/bound-transfer-alignment-s0").summary == told


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("--filters", "ekg"), "car.toml; did you mean 'ekf'?"),
        (("--without", "sonar"), "no sensor 'sonar'; this model has ['gnss_position', "),
        (("--at", "10"), "unit"),
        (("--at", "1 h"), "3600 s is not within the run, 1 s to "),
        (("--filters", "ekf,ukf"), "a bound is that of one model; name one."),
        (("--set", "gnss.colour=red"), "gnss.colour"),
    ],
)
def test_bad_input_is_named_with_what_there_is(robins_at, tmp_path, arguments, sentence):
    answer = robins_at(*arguments)
    assert answer.status == ExitStatus.BAD_INPUT
    assert sentence in answer.err
    assert answer.out == ""
    assert not (tmp_path / "results").exists() or not any((tmp_path / "results").iterdir())


def test_an_unknown_scenario_is_named(robins):
    answer = robins("bound", "ins-gnss/drove")
    assert answer.status == ExitStatus.BAD_INPUT
    assert "no scenario 'ins-gnss/drove'; did you mean 'ins-gnss/drive'?" in answer.err


def test_help_teaches_it(robins):
    assert "robins bound ins-gnss/drive" in robins("--help").out
    assert "--without SENSOR" in robins("bound", "--help").out
