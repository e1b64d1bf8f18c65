"""A campaign in a folder: the same table whoever fills it, whatever is killed, damaged or added."""

import json
import shlex
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from robins import workbench
from robins.campaign import plan as plans
from robins.campaign import simulate
from robins.campaign.gather import gather
from robins.campaign.plan import require_plan, write
from robins.campaign.retention import content_of
from robins.campaign.store import GOES_ON, open_store
from robins.campaign.work import MissingShards, Worker, missing
from robins.cli import campaign as coordinating
from robins.cli import main
from robins.errors import RobinsError
from robins.program import CPP, LANE_FLAGS
from robins.results import Outcome
from robins.workbench import workers as work
from robins.workbench.campaign import (
    campaign_report,
    campaign_show,
    campaign_status,
    campaign_verify,
    campaign_work,
    plan_campaign,
    problem_of,
    remove_damaged,
)
from robins.workbench.errors import InputError
from robins.workbench.workers import work_here

BALLOON = f"{Path(__file__).parents[2] / 'docs' / 'examples' / 'balloon.py'}:study"
SHORT = ("duration=20 s",)
RUNS = 53


def begun(where, *, runs=RUNS, width=8, filters=("gated", "kf"), machine="jax"):
    """A campaign of narrow chunks."""
    plan = plan_campaign(
        where, BALLOON, runs=runs, filters=filters, settings=SHORT, machine=machine
    )
    plan = plans.replace(plan, width=width)
    write(open_store(where), plan)
    return plan


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    where = tmp_path_factory.mktemp("campaign") / "serial"
    begun(where)
    *_, last = campaign_work(where)
    assert last == (14, 14)
    return where


def test_it_is_the_campaign_that_is_run_at_once(undisturbed):
    _, plan = open_store(undisturbed), require_plan(open_store(undisturbed))
    want = simulate(problem_of(plan), RUNS, 8, machine="jax")
    mine = campaign_report(undisturbed)
    assert mine.summary["filters"] == want.summary["filters"]
    assert mine.counts == want.counts
    for name, variable in want.solution.variables.items():
        np.testing.assert_array_equal(mine.solution[name], variable)


@pytest.mark.parametrize("workers", [2, 3])
def test_any_number_of_workers_make_one_table(undisturbed, tmp_path, workers):
    plan = begun(tmp_path)
    store, problem = open_store(tmp_path), problem_of(plan)
    turns = [Worker(store, plan, problem).work() for _ in range(workers)]
    while missing(store, plan.shards):
        for one in turns:
            next(one, None)
    assert campaign_status(tmp_path).digest == campaign_status(undisturbed).digest


def test_one_more_worker_finds_nothing_to_do(undisturbed, capsys):
    assert main(["campaign", "work", str(undisturbed), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["done"] == 14


def test_what_was_claimed_by_the_dead_is_computed(undisturbed, tmp_path, monkeypatch):
    plan = begun(tmp_path)
    store = open_store(tmp_path)
    for one in missing(store, plan.shards)[::2]:
        store.put(one.claim, b"")
    monkeypatch.setattr("robins.campaign.work.LEAST_S", 0.0)
    monkeypatch.setattr("robins.campaign.work.CLAIM_CHUNKS", 0.0)
    *_, last = campaign_work(tmp_path)
    assert last == (14, 14)
    assert campaign_status(tmp_path).digest == campaign_status(undisturbed).digest


def test_damage_is_told_and_mended(undisturbed, tmp_path):
    begun(tmp_path)
    list(campaign_work(tmp_path))
    plan = require_plan(open_store(tmp_path))
    first, *_, last = plan.shards.values()
    path = tmp_path / last[0].name
    path.write_bytes(path.read_bytes()[:-1000])
    found = campaign_status(tmp_path)
    assert found.damaged == [f"shards/{path.name}"]
    assert (found.missing, found.digest) == (0, None)
    assert found.done == {"gated": RUNS, "kf": RUNS} | {last[0].filter: RUNS - 5}
    assert campaign_verify(tmp_path).damaged == found.damaged
    told = f"{last[0].filter}: {RUNS - 5} of {RUNS} runs are done"
    assert told in campaign_report(tmp_path).warnings
    (tmp_path / first[0].name).write_bytes(b"")
    with pytest.raises(RobinsError, match="has no first run"):
        campaign_report(tmp_path)
    assert remove_damaged(tmp_path) == 2
    list(campaign_work(tmp_path))
    assert campaign_status(tmp_path).digest == campaign_status(undisturbed).digest


def test_a_shard_that_another_code_made_is_told(undisturbed, tmp_path):
    plan = begun(tmp_path, runs=8)
    store = open_store(tmp_path)
    list(campaign_work(tmp_path))
    chunk, shards = next(iter(plan.shards.items()))
    worker = Worker(store, plan, problem_of(plan))
    wrong = worker.found(chunk, [shards[0].filter])[shards[0].filter]
    wrong.sums["square"] = np.nextafter(wrong.sums["square"], 1e9)
    store.put(shards[0].name, worker.packed(shards[0], chunk, wrong), overwrite=True)
    found = campaign_verify(tmp_path, share=1.0)
    assert (found.shards, found.damaged, found.different) == (2, [], [shards[0].name])
    assert len(found.recomputed) == 2


def test_more_runs_and_filters_compute_what_is_new(undisturbed, tmp_path):
    begun(tmp_path, runs=24, filters=("gated",))
    list(campaign_work(tmp_path))
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "shards").iterdir()}
    assert len(before) == 3
    plan = plan_campaign(tmp_path, BALLOON, runs=RUNS, filters=("kf",), settings=SHORT)
    assert (plan.runs, plan.filters) == (RUNS, ("gated", "kf"))
    list(campaign_work(tmp_path))
    after = {path: path.stat().st_mtime_ns for path in (tmp_path / "shards").iterdir()}
    assert len(after) == 14
    assert before.items() <= after.items()
    assert campaign_status(tmp_path).digest == campaign_status(undisturbed).digest


@pytest.mark.parametrize("run", [0, 37, RUNS - 1])
def test_a_run_shown_alone_is_that_of_the_campaign(undisturbed, run):
    store = open_store(undisturbed)
    plan = require_plan(store)
    problem = problem_of(plan)
    whole = gather(store, plan, problem).found
    shown = campaign_show(undisturbed, run)
    assert shown.runs == 1
    again = Worker(store, plan, problem).run_statistics(
        plan.chunk_of(run), list(plan.filters), [run]
    )
    for name, (one,) in ((name, of.values()) for name, of in again.items()):
        np.testing.assert_array_equal(one.run_rms[0], whole[name].run_rms[run])
        first = one.first_run["error"]
        np.testing.assert_array_equal(np.sqrt(np.mean(first**2, axis=0)), one.run_rms[0])
        if run == 0:
            for x, y in zip(*map(jax.tree.leaves, (one.example, whole[name].example)), strict=True):
                np.testing.assert_array_equal(x, y)


@pytest.mark.skipif(not any(map(shutil.which, CPP.names)), reason="lanes need a C++ compiler")
def test_a_run_in_lanes_is_that_of_the_campaign(tmp_path, monkeypatch):
    flags = tuple("-O0" if flag == "-O2" else flag for flag in LANE_FLAGS)
    monkeypatch.setattr("robins.program.lanes.LANE_FLAGS", flags)
    plan = begun(tmp_path, runs=21, filters=("kf",), machine="c")
    store, problem = open_store(tmp_path), problem_of(plan)
    worker = Worker(store, plan, problem)
    list(worker.work())
    whole = gather(store, plan, problem).found["kf"]
    chunks = list(plan.chunks)
    alone = {
        run: worker.run_statistics(chunks[run // 8], ["kf"], [run])["kf"][run]
        for run in (0, 13, 20)
    }
    for run, one in alone.items():
        np.testing.assert_array_equal(one.run_rms[0], whole.run_rms[run])
    again = Worker(store, plan, problem).found(chunks[1], ["kf"])["kf"]
    shard = plan.shard(chunks[1], "kf")
    assert worker.packed(shard, chunks[1], again) == store.get(shard.name)
    keeps = plan_campaign(
        tmp_path / "keeps",
        BALLOON,
        runs=21,
        filters=("kf",),
        settings=(*SHORT, "keep=[13]"),
        machine="c",
    )
    keeps = plans.replace(keeps, width=8)
    worker = Worker(open_store(tmp_path / "keeps"), keeps, problem)
    worker.compute(MissingShards(chunks[1], [shard]))
    assert open_store(tmp_path / "keeps").get(shard.name) == store.get(shard.name)
    kept = content_of(worker.store, shard, 13)
    assert kept == worker.packed(shard, chunks[1], alone[13])


def test_runs_that_diverge_are_named(tmp_path):
    plan = begun(tmp_path, runs=8, filters=("kf",))
    store = open_store(tmp_path)
    worker = Worker(store, plan, problem_of(plan))
    chunk, (shard,) = next(iter(plan.shards.items()))
    record = worker.machine.histories(chunk, plan.width, ["kf"])["kf"]
    record["error"] = record["error"].copy()
    record["error"][5, 3] = np.nan
    found = worker.found(chunk, ["kf"])["kf"].blank()
    found.add(record)
    store.put(shard.name, worker.packed(shard, chunk, found))
    status = campaign_status(tmp_path)
    assert status.diverged == {"kf": [5]}
    assert status.done == {"kf": 8}


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"settings": ("duration=21 s",)}, "another scenario"),
        ({"seed": 3}, "another seed: 0 there, 3 asked for"),
        ({"machine": "c"}, "another machine: jax there, c asked for"),
    ],
)
def test_another_campaign_is_refused(undisturbed, change, sentence):
    asked = {"runs": RUNS, "settings": SHORT} | change
    with pytest.raises(RobinsError, match=sentence):
        plan_campaign(undisturbed, BALLOON, **asked)
    assert require_plan(open_store(undisturbed)).runs == RUNS


def test_other_code_is_refused(tmp_path, monkeypatch):
    begun(tmp_path, runs=8)
    monkeypatch.setattr(plans, "_of_package", lambda: "other")
    with pytest.raises(RobinsError, match="was begun by code"):
        list(campaign_work(tmp_path))
    assert campaign_status(tmp_path).missing == 2  # reading needs no code


def test_what_is_no_campaign_is_told(tmp_path):
    with pytest.raises(RobinsError, match="is no campaign"):
        campaign_status(tmp_path)
    (tmp_path / "campaign.json").write_text("{")
    with pytest.raises(RobinsError, match="is damaged"):
        campaign_status(tmp_path)
    plan = {
        "schema": 1,
        "asked": "a",
        "scenario": "a",
        "text": "",
        "seed": 0,
        "runs": 4,
        "width": 4,
    }
    plan |= {"filters": ["kf"], "machine": "jax", "code": "0"}
    for wrong in ({"width": 0}, {"runs": -1}, {"runs": "4"}, {"filters": [1]}, {"text": None}):
        (tmp_path / "campaign.json").write_text(json.dumps(plan | wrong))
        with pytest.raises(RobinsError, match=r"campaign.json is damaged"):
            campaign_status(tmp_path)
    for content in ("{", "[" * 5000, "[]", '{"points": [1]}'):
        (tmp_path / "sweep.json").write_text(content)
        with pytest.raises(InputError, match=r"sweep.json is damaged .*the same `robins sweep`"):
            campaign_status(tmp_path)


@pytest.mark.parametrize("command", ["work", "status", "verify", "report", "show --run 0"])
def test_a_file_in_place_of_a_campaign_is_bad_input(tmp_path, capsys, command):
    path = tmp_path / "file"
    path.write_text("")
    word, *options = command.split()
    assert main(["campaign", word, str(path), *options]) == 2
    told = capsys.readouterr().err
    assert "name the folder of a campaign" in told
    assert told.count(str(path)) == 1


def test_a_worker_that_finds_the_disk_full_is_told_once(monkeypatch):
    error = RobinsError("cannot write shards/a: No space left", "out", f"make room; {GOES_ON}")
    monkeypatch.setattr(work._Process, "status", 1)
    monkeypatch.setattr(work._Process, "error_output", f"robins: a warning\nrobins: {error}")
    ended = object.__new__(work._Process)
    with pytest.raises(RobinsError) as caught:
        work._judged(ended, "out")
    assert str(caught.value) == (
        "out: a worker failed: cannot write shards/a: No space left; make room; the same command "
        "goes on."
    )
    monkeypatch.setattr(work._Process, "error_output", "")
    with pytest.raises(RobinsError, match="ended with 1; the same command goes on"):
        work._judged(ended, "out")


def test_a_second_coordinator_waits_for_the_report_of_the_first(tmp_path, monkeypatch):
    monkeypatch.setattr(coordinating, "command_line", str)
    (tmp_path / "summary.json").write_text("{}")
    asked = []

    def publish(outcome, to, **options):
        asked.append((to, options["patience_s"]))
        return SimpleNamespace(path=tmp_path, report="")

    monkeypatch.setattr(workbench, "publish", publish)
    coordinating._deliver(workbench, "out", Outcome(), True)
    coordinating._deliver(workbench, "out", Outcome(), True, tmp_path / "elsewhere")
    assert asked == [(Path("out/report"), 600.0), (tmp_path / "elsewhere", 0.0)]


ROBINS = [sys.executable, "-c", "from robins.cli import main; raise SystemExit(main())", "campaign"]


@pytest.mark.parametrize("kills", [1, 20])
def test_killed_at_any_moment_it_goes_on(undisturbed, tmp_path, kills):
    """Workers and the whole are killed; two campaigns are started on one folder at once."""
    settings = [word for one in SHORT for word in ("--set", one)]
    run = [*ROBINS, "run", BALLOON, "--runs", str(RUNS), "--filters", "gated,kf", *settings]
    run += ["--machine", "jax", "--json"]
    rng = np.random.default_rng(0)
    where = tmp_path / "killed"
    begun(where)
    for _ in range(kills):
        process = subprocess.Popen(
            [*run, "--out", str(where)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        time.sleep(rng.uniform(0.5, 8.0))
        if process.poll() is None:
            process.send_signal(signal.SIGKILL)
        process.wait()
    both = [
        subprocess.Popen(
            [*run, "--out", str(where)], stdout=subprocess.PIPE, stderr=subprocess.PIPE
        )
        for _ in range(2)
    ]
    told = [one.communicate() for one in both]
    assert {one.returncode for one in both} <= {0, 2}, told  # the report is written by one of them
    assert 0 in {one.returncode for one in both}, told
    assert campaign_status(where).digest == campaign_status(undisturbed).digest


UNSHARED = ("unshare", "--user", "--map-root-user", "--mount", "sh", "-c")


def test_a_disk_that_gets_full_loses_nothing(undisturbed, tmp_path):
    """On a file system of its own that has room for half of the shards."""
    small, left = tmp_path / "small", tmp_path / "left"
    mounted = f"mount -t tmpfs -o size={{size}} none {small}"
    small.mkdir()
    try:
        subprocess.run([*UNSHARED, mounted.format(size="64k")], check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("this machine lets nobody mount a small file system")
    begun(left)
    size = sum(path.stat().st_size for path in undisturbed.rglob("*.npz")) // 2
    worker = f"{shlex.join([*ROBINS, 'work', str(small), '--json'])}; code=$?"
    script = f"{mounted.format(size=size)} && cp -r {left}/. {small} && {worker}"
    told = subprocess.run(
        [*UNSHARED, f"{script}; cp -r {small}/. {left}; exit $code"], capture_output=True, text=True
    )
    assert told.returncode == 1, told
    assert "No space left on device; make room" in told.stderr
    status = campaign_status(left)
    assert 0 < status.missing < 14
    assert not status.damaged
    list(campaign_work(left))
    assert campaign_status(left).digest == campaign_status(undisturbed).digest


def test_ctrl_c_ends_all_at_once_and_it_goes_on(tmp_path):
    psutil = pytest.importorskip("psutil")
    where = tmp_path / "stopped"
    begun(where, runs=4000, filters=("kf",))
    settings = [word for one in SHORT for word in ("--set", one)]
    run = [*ROBINS, "run", BALLOON, "--runs", "4000", "--filters", "kf", *settings]
    run += ["--machine", "jax", "--workers", "2", "--out", str(where)]
    process = subprocess.Popen(run, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    until = time.monotonic() + 120.0
    while not open_store(where).names("shards"):  # workers are at it
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < until
        time.sleep(0.1)
    workers = psutil.Process(process.pid).children(recursive=True)
    assert len(workers) >= 2
    process.send_signal(signal.SIGINT)
    told = process.communicate(timeout=60.0)[1]
    assert process.returncode == 3
    assert "interrupted" in told
    assert not psutil.wait_procs(workers, timeout=10.0)[1]
    status = campaign_status(where)
    assert 0 < status.done["kf"] < 4000
    assert not status.damaged


def test_dask_makes_the_same_table(undisturbed, tmp_path):
    distributed = pytest.importorskip("distributed", reason="Dask is an extra")
    begun(tmp_path)
    settings = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": None}
    settings["processes"] = False  # threads are workers too
    with (
        distributed.LocalCluster(**settings) as cluster,
        distributed.Client(cluster) as client,
    ):
        workers = client.scheduler_info(n_workers=-1)["workers"]
        jobs = [
            client.submit(work_here, str(tmp_path), workers=[one], pure=False) for one in workers
        ]
        assert client.gather(jobs) == [14, 14]
    assert campaign_status(tmp_path).digest == campaign_status(undisturbed).digest


def test_what_a_worker_complains_of_comes_out(tmp_path):
    with pytest.raises(RobinsError, match="is no campaign"):
        work_here(tmp_path)
