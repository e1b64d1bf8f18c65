"""`robins run` with a recorded master and slave in the place of the simulation."""

from pathlib import Path

import pytest


def test_a_pair_takes_the_place_of_the_simulation(robins, workbench):
    answer = robins(
        *("run", "car/town", "--master", "m.csv", "--slave", "flight.csv.xz", "--seed", 3),
        *("--filters", "a,b", "--set", "mounting.sigma=1 deg"),
    )
    assert answer.status == 0
    asked = workbench.asked
    assert (asked["master"], asked["slave"]) == (Path("m.csv"), Path("flight.csv.xz"))
    assert [path.name for path in Path("results").iterdir()] == ["flight"]
    assert (asked["filters"], asked["settings"]) == (("a", "b"), ("mounting.sigma=1 deg",))
    assert asked["seed"] == 3
    assert "runs" not in asked


@pytest.mark.parametrize("given", [("--master", "m.csv"), ("--slave", "s.csv")])
def test_one_half_of_a_pair_is_refused(robins, workbench, given):
    answer = robins("run", "car/town", *given)
    assert answer.status == 2
    assert answer.err == (
        "robins: --master and --slave belong together; give both files, or neither.\n"
    )
    assert not workbench.asked


def test_a_recorded_pair_is_one_run(robins, workbench):
    pair = ("--master", "m.csv", "--slave", "s.csv")
    answer = robins("run", "car/town", *pair, "--runs", 5)
    assert answer.status == 2
    assert "--runs 5: a recorded pair is one run" in answer.err
    assert robins("run", "car/town", *pair, "--runs", 1).status == 0
