"""A scenario over one parameter and over two: points, figures with their bounds, going on."""

import csv
import io
import sys
from pathlib import Path

import numpy as np
import pytest

from robins.campaign import simulate
from robins.campaign.store import open_store
from robins.errors import RobinsError
from robins.report import figures
from robins.results import find, read
from robins.workbench import publish, workers
from robins.workbench.campaign import campaign_status, campaign_work, problem_of, require_plan
from robins.workbench.sweep import SweptParameter, report, status, sweep, swept_parameter

BALLOON = f"{Path(__file__).parents[2] / 'docs' / 'examples' / 'balloon.py'}:study"
SHORT = ("duration=20 s",)
SIGMAS = "barometer=1 m,4 m"
RUNS = 8  # everywhere: one program serves all


class Here(workers._Process):
    """Stand-in for a worker's process: computes in this one, and has ended."""

    status, said = 0, ""

    def __init__(self, where):
        list(campaign_work(where))

    def close(self):
        pass


@pytest.fixture(autouse=True)
def here(monkeypatch):
    monkeypatch.setattr(workers, "_Process", Here)


def test_a_parameter_has_numbers_with_a_unit_or_names():
    assert swept_parameter("a.b = 1 m , 2.5 m") == SweptParameter("a.b", ("1 m", "2.5 m"))
    assert swept_parameter("a=1 m,2.5 m").coordinate == ([1.0, 2.5], "m")
    assert swept_parameter("a=0.1,-2e3").coordinate == ([0.1, -2000.0], "1")
    assert swept_parameter("a=1 m,1 km").coordinate == (["1 m", "1 km"], "")
    assert swept_parameter("a=up,down").coordinate == (["up", "down"], "")


@pytest.mark.parametrize(
    ("vary", "message"),
    [
        ([], "one parameter or two"),
        (["a"], "is not key=a,b,c"),
        (["=1"], "is not key=a,b,c"),
        (["a=1,,2"], "is not key=a,b,c"),
        (["a=1,1"], "has a value twice"),
        (["a=1", "a=2"], "one parameter or two"),
        (["a=1", "b=2", "c=3"], "one parameter or two"),
        ([f"a={','.join(map(str, range(401)))}"], "has 401 points"),
        (["nothing=1"], "nothing: unknown key"),
    ],
)
def test_what_cannot_be_swept_is_refused(tmp_path, vary, message):
    with pytest.raises(RobinsError, match=message):
        sweep(BALLOON, tmp_path, vary=vary)
    assert not list(tmp_path.rglob("*.npz"))


def test_each_point_is_the_campaign_of_its_values(tmp_path):
    found = sweep(BALLOON, tmp_path, vary=[SIGMAS], runs=RUNS, filters=("kf",), settings=SHORT)
    rms = find(found.solution, "sweep_rms")["height"]
    low, high = (find(found.solution, f"sweep_{k}")["height"] for k in ("low", "high"))
    assert rms.shape == (1, 2, 1)
    assert found.solution["sweep_1"].attrs == {"units": "m", "long_name": "barometer"}
    np.testing.assert_array_equal(found.solution["sweep_1"], [1.0, 4.0])
    problem = problem_of(require_plan(open_store(tmp_path / "points" / "1")))
    alone = simulate(problem, RUNS, machine="vm").metrics["kf"]["height_rms_m"]
    assert float(rms[0, 1, 0]) == pytest.approx(alone, rel=1e-12)
    assert np.all((low < rms) & (rms < high))
    assert found.metrics["kf"]["height_rms_m"] == [float(x) for x in rms[0, :, 0]]
    rows = list(csv.DictReader(io.StringIO(found.files["sweep.csv"].decode())))
    assert [(r["barometer"], r["block"]) for r in rows[::2]] == [
        ("1 m", "height"),
        ("4 m", "height"),
    ]
    assert float(rows[0]["rms"]) == float(rms[0, 0, 0])
    assert rows[0]["runs"] == str(RUNS)
    with pytest.raises(RobinsError, match="holds the 2 campaigns of a sweep"):
        campaign_status(tmp_path)
    assert status(tmp_path)["barometer=4 m"] == campaign_status(tmp_path / "points" / "1")
    again = report(tmp_path.rename(tmp_path.with_name("moved")))
    assert (again.metrics, again.files, again.scenario) == (
        found.metrics,
        found.files,
        found.scenario,
    )


@pytest.mark.usefixtures("sketched")
def test_two_parameters_make_a_map_and_more_runs_go_on(tmp_path):
    two = [SIGMAS, "outlier_share=0,0.2"]
    asked = {"vary": two, "filters": ("kf",), "settings": SHORT}
    sweep(BALLOON, tmp_path / "s", runs=RUNS, **asked)
    before = set((tmp_path / "s").rglob("*.npz"))
    assert len(before) == 4
    found = sweep(BALLOON, tmp_path / "s", runs=2 * RUNS, **asked)
    assert before < set((tmp_path / "s").rglob("*.npz"))
    assert find(found.solution, "sweep_rms")["height"].shape == (1, 2, 2)
    result = publish(found, tmp_path / "r")
    assert {"sweep_height", "sweep_climb"} <= set(result.figures)
    drawn = [draw() for draw in figures.drawings(read(tmp_path / "r").solution, found.summary)]
    titles = [picture.title for picture in drawn if picture]
    assert "height over barometer [m] and outlier_share" in titles


def test_damage_at_a_point_is_computed_again(tmp_path):
    asked = {"vary": [SIGMAS], "runs": RUNS, "filters": ("kf",), "settings": SHORT}
    want = sweep(BALLOON, tmp_path, **asked)
    path = next((tmp_path / "points" / "1" / "shards").iterdir())
    path.write_bytes(path.read_bytes()[:-200])
    assert sweep(BALLOON, tmp_path, **asked).metrics == want.metrics


def test_a_worker_finds_all_points(tmp_path, monkeypatch):
    monkeypatch.setattr(sys.modules[sweep.__module__], "fill", lambda *_: None)
    with pytest.raises(RobinsError, match="points/0: has no run of 'kf' yet"):
        sweep(BALLOON, tmp_path, vary=[SIGMAS], runs=RUNS, filters=("kf",), settings=SHORT)
    assert list(campaign_work(tmp_path)) == [(0, 2), (1, 2), (2, 2)]
