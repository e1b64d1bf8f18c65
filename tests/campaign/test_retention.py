"""Histories that a campaign keeps: of named runs, and of the first that diverge."""

import numpy as np
import pytest
from test_campaign_folder import BALLOON, RUNS, SHORT, begun

from robins.campaign.machine import JaxMachine, whole_record
from robins.campaign.store import open_store
from robins.campaign.work import Worker, missing
from robins.errors import RobinsError
from robins.results.summary import plain as plain_of
from robins.workbench.campaign import (
    campaign_show,
    campaign_status,
    campaign_verify,
    campaign_work,
    plan_campaign,
    problem_of,
    remove_damaged,
)
from robins.workbench.run import run

LOST = (5, 21, 22, 40, 50)
KEPT = ("keep=[0, 13, 40]", "keep_diverged=2")


@pytest.fixture(autouse=True, scope="module")
def diverging():
    """Some runs diverge."""
    compute = JaxMachine.compute

    def broken(self, chunk, width, names, taken=whole_record, left=0):
        def taken_of(name, record):
            error = record["error"].copy()
            for lost in LOST:
                if lost - chunk.begin in range(len(error)):
                    error[lost - chunk.begin, 3:] = np.nan
            return taken(name, record | {"error": error})

        return compute(self, chunk, width, names, taken_of, left)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(JaxMachine, "compute", broken)
        yield


def asked(where, *settings, runs=RUNS):
    return plan_campaign(where, BALLOON, runs=runs, filters=("kf",), settings=(*SHORT, *settings))


def narrow(where, *settings):
    """A campaign of narrow chunks that keeps histories."""
    begun(where, filters=("kf",))
    return asked(where, *settings)


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    where = tmp_path_factory.mktemp("plain")
    narrow(where)
    list(campaign_work(where))
    return where


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    where = tmp_path_factory.mktemp("kept")
    narrow(where, *KEPT)
    list(campaign_work(where))
    return where


def test_named_runs_and_the_first_diverged_are_kept_and_no_shard_changes(plain, kept):
    before, after = campaign_status(plain), campaign_status(kept)
    assert before.kept == {"kf": []}
    assert after.kept == {"kf": [0, 5, 13, 21, 40]}
    assert before.diverged == after.diverged == {"kf": list(LOST)}
    assert before.digest == after.digest
    names = [{p.name for p in (where / "shards").iterdir()} for where in (plain, kept)]
    assert names[0] == names[1]
    assert not (plain / "histories").exists()


def test_which_diverged_runs_are_kept_does_not_depend_on_the_order(tmp_path, kept):
    plan = narrow(tmp_path, *KEPT)
    store = open_store(tmp_path)
    worker = Worker(store, plan, problem_of(plan))
    for one in reversed(missing(store, plan.shards)):
        worker.compute(one)
        assert len(list((tmp_path / "diverged").glob("*"))) <= 2
    assert campaign_status(tmp_path).kept == campaign_status(kept).kept
    for group in ("histories", "diverged"):
        for path in (kept / group).iterdir():
            assert path.read_bytes() == (tmp_path / group / path.name).read_bytes()


def test_kept_runs_are_shown_without_computing_them_again(plain, kept, monkeypatch):
    one = campaign_show(plain, 21)
    again = Worker.run_statistics
    computed = []

    def watched(self, chunk, names, runs):
        computed.append(runs)
        return again(self, chunk, names, runs)

    monkeypatch.setattr(Worker, "run_statistics", watched)
    mine = campaign_show(kept, 21)
    assert plain_of(mine.metrics) == plain_of(one.metrics)
    assert set(mine.solution.variables) == set(one.solution.variables)
    for name, variable in one.solution.variables.items():
        np.testing.assert_array_equal(mine.solution[name], variable)
    campaign_show(kept, 13)
    assert computed == []
    path = next((kept / "diverged").glob("*-5.npz"))
    whole_ = path.read_bytes()
    path.write_bytes(whole_[:-100])
    campaign_show(kept, 5)  # a damaged one is computed again
    path.write_bytes(whole_)
    assert computed == [[5]]


def test_a_damaged_history_is_told_and_mended(tmp_path):
    narrow(tmp_path, *KEPT)
    list(campaign_work(tmp_path))
    path = next((tmp_path / "diverged").glob("*-21.npz"))
    whole_ = path.read_bytes()
    path.write_bytes(whole_[:-100])
    digest = campaign_status(tmp_path).digest
    assert campaign_verify(tmp_path).damaged == [f"diverged/{path.name}"]
    assert remove_damaged(tmp_path) == 1
    list(campaign_work(tmp_path))
    assert campaign_verify(tmp_path).damaged == []
    assert campaign_status(tmp_path).digest == digest
    assert path.read_bytes() == whole_


def test_what_is_kept_may_change_and_all_may_be(tmp_path):
    shards = narrow(tmp_path, "keep_diverged=1").shards
    plan = asked(tmp_path, 'keep_diverged="all"')
    assert plan.keep_diverged is None
    assert plan.shards == shards
    list(campaign_work(tmp_path))
    assert campaign_status(tmp_path).kept == {"kf": list(LOST)}


@pytest.mark.parametrize("setting", ["keep=[53]", "keep=[-1]", 'keep_diverged="some"'])
def test_what_cannot_be_kept_is_refused(plain, setting):
    with pytest.raises(RobinsError, match="keep"):
        asked(plain, setting)
    assert campaign_status(plain).wanted == RUNS


def test_a_run_without_a_folder_says_that_it_keeps_nothing():
    found = run(BALLOON, runs=2, settings=("keep=[1]", "duration=10 s"), machine="jax")
    assert any("`robins campaign run`" in warning for warning in found.warnings)
