"""The simulated drive: laid out right, consistent when it should be, caught when it is not."""

from functools import cache, partial

import numpy as np
import pytest
from in_lanes import each
from test_replay import DRIVE

from robins import scenario
from robins.campaign import Statistics
from robins.campaign.machine import first_worlds, one_by_one
from robins.campaign.monte_carlo import blocks_of, contender, one_record
from robins.systems.ins_gnss import Drive
from robins.systems.ins_gnss.study import DRIVE as STUDY
from robins.systems.ins_gnss.world import lay_out

RUNS = 100


def parsed(*settings):
    return scenario.parse(Drive, DRIVE, settings)


# an EKF is right only about small errors, and a gate cuts the tails of a right one
SMALL = ("start.tilt=0.5 deg", "start.heading=2 deg", "update.gate=0")


@cache
def flown():
    """The runs, whatever is believed of them."""
    return first_worlds(STUDY.problem(parsed(*SMALL), (), 1), RUNS)


def campaign(*settings):
    problem = STUDY.problem(parsed(*SMALL, *settings), ("ekf",), 1)
    statistics, of = Statistics(problem.blocks), contender(problem, "ekf")
    statistics.add(each(partial(one_record, blocks_of(problem), of, over=one_by_one))(flown()))
    metrics = problem.metrics(statistics)
    return metrics, {c["id"]: c["verdict"] for c in problem.claims({"ekf": metrics})}


@pytest.fixture(scope="module")
def right():
    return campaign()


def test_a_right_filter_is_consistent(right):
    metrics, verdicts = right
    assert set(verdicts.values()) == {"reproduced"}, metrics
    # 100 runs scatter by 7 %; four of these for the largest of 15 states
    np.testing.assert_allclose(metrics["error_over_sigma"], 1.0, atol=0.28)
    assert metrics["diverged_runs"] == 0


def test_a_wrong_filter_is_caught():
    _, verdicts = campaign("believed.r_factor=1.2")
    assert verdicts["nis"] == "not"


def test_the_truth_of_the_epochs_is_that_of_the_motion():
    course = lay_out(parsed())
    k = course.motion.at(course.epoch_s)
    np.testing.assert_allclose(course.truth.position.lat, k.lat, rtol=0, atol=1e-10)
    np.testing.assert_allclose(course.truth.v_n, k.v_n, rtol=0, atol=1e-8)
    np.testing.assert_allclose(course.truth.position.alt, k.alt, rtol=0, atol=1e-3)


def test_legs_and_filters_that_cannot_be():
    with pytest.raises(ValueError, match="'turn' needs 'rate'"):
        lay_out(parsed('legs=[{do="turn", angle="9 deg"}]'))
    with pytest.raises(ValueError, match="'stop' does not take 'speed'"):
        lay_out(parsed('legs=[{do="stop", seconds="9 s", speed="2 m/s"}]'))
    with pytest.raises(ValueError, match="robins replay"):
        STUDY.problem(parsed(), ("ekf+rts",), 0)
    with pytest.raises(ValueError, match="multiple of gnss"):
        lay_out(parsed('update.longest_block="0.31 s"'))
