"""Runs on the bench: bits, faults, deaths, clocks, boards.

Bits and deaths are those of real processes; where they would make no difference, the parts are on
threads.
"""

import json
import os
import resource
import signal
import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np
import pytest
from clockwork import CLOCKWORK
from stations import Station, alive, config, on_threads, one_program

from robins.bench.broker import BenchError
from robins.bench.evaluation import RunResult
from robins.bench.ports.cable import cable
from robins.bench.recording import read_record
from robins.bench.rigs.satellite import RIG
from robins.bench.rigs.satellite.judging import flag
from robins.bench.rigs.satellite.messages import WIRE
from robins.bench.run import LoadedRun
from robins.bench.run.session import Session
from robins.bench.run.setup import built_in, changed, config_of, read, setup_of
from robins.bench.run.telemetry import difference
from robins.bench.wire.frames import Frame
from robins.bench.wire.receiver import Receiver
from robins.scenario import ScenarioError

LOOP = "duration=60 s", "counted_from=10 s"
PARTS = ("plant", "table", "gyro", "star", "adm", "acm", "actuators")


def flight(**options: Any) -> LoadedRun:
    return changed(read("satellite/s1", LOOP), {"seconds": 20.0, **options})


class Watch:
    """Does things at steps of a run."""

    def __init__(self, at: dict[int, Any] | None = None):
        self.at, self.events, self.pids = at or {}, [], {}

    def event(self, kind: str, time_s: float, text: str) -> None:
        self.events.append((kind, time_s, text))

    def step(self, session: Session, step: int) -> None:
        pids = {part: session.part_processes.process(part) for part in session.rig.parts}
        self.pids |= {part: pid for part, pid in pids.items() if pid is not None}
        if (do := self.at.pop(step, None)) is not None:
            do(session)

    def over(self, session: Session, failed: bool) -> None:
        self.failed = failed

    def commands(self, session: Session) -> list[dict[str, Any]]:
        return []


class Done(NamedTuple):
    result: RunResult
    off: float  # from the same inside one program
    watch: Watch


def run(of: LoadedRun, at: dict[int, Any] | None = None, record: Any = None) -> Done:
    watch, what = Watch(at), ("satellite/s1", of.setup.filter, *LOOP)
    made = config(*what) if of.rig is RIG else config_of(of)
    result = Session(of, record, watch, config=made).run()
    assert not any(alive(pid) for pid in watch.pids.values()), "a process was left over"
    inside = one_program(*what) if of.rig is RIG else of.rig.inside(made, result.steps)
    return Done(result, difference(result.series, inside), watch)


@pytest.fixture
def threads(monkeypatch):
    on_threads(monkeypatch)


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    """A run in lock-step: one part is stopped for two seconds, two are killed and started anew."""

    def stop(session):
        pid = session.part_processes.process("adm")
        os.kill(pid, signal.SIGSTOP)
        threading.Timer(2.0, os.kill, (pid, signal.SIGCONT)).start()

    record = tmp_path_factory.mktemp("bench") / "plain.mcap"
    began = time.monotonic()
    # the star sensor after it has put its memory aside
    at = {20: kill("gyro"), 50: stop, 265: kill("star")}
    done = run(flight(on_death="restart", seconds=28.0), at, record)
    assert time.monotonic() - began > 2.0
    return done, record


def kill(part):
    return lambda session: os.kill(session.part_processes.process(part), signal.SIGKILL)


def test_lock_step_has_the_bits_of_one_program_even_if_a_part_is_stopped(plain):
    done, _ = plain
    assert done.result.failure == ""
    assert done.result.steps == 280
    assert done.off == 0.0
    assert max(h.wrong + h.lost + h.late + h.strange for h in done.result.health.values()) == 0
    assert np.sum(flag(done.result.series, "star used")) == 56
    assert done.result.deaths == 2
    told = [e.text.split(" told ")[1] for e in done.result.events if e.kind == "restarted"]
    assert told == ["all again", "all since step 255 again"]


def test_it_has_the_bits_of_a_campaign_of_one_run(plain):
    from robins.campaign.monte_carlo import record, worlds
    from robins.systems.satellite.study import STUDY

    done, _ = plain
    problem = STUDY.problem(flight().given, ("mekf",), 0)
    ((world, count),) = worlds(problem, 1)
    found = record(problem, "mekf", world, count)
    for series, wanted in (
        (done.result.series["estimate.q_ib"], found["mean"].attitude.wxyz),
        (done.result.series["estimate.gyro_bias"], found["mean"].gyro_bias),
        (done.result.series["wheels.momentum"], found["outputs"]["wheel_momentum"]),
    ):
        np.testing.assert_array_equal(series, wanted[0, :280])


def test_the_record_holds_all_that_went_over_the_links(plain):
    done, path = plain
    record = read_record(path)
    assert record.complete
    assert record.header["steps"] == 280
    said: dict[tuple[str, str], list[Frame]] = {}
    for entry in record.entries:
        said.setdefault((entry.link, entry.direction), []).extend(Receiver().feed(entry.data))
    assert {link for link, _ in said} == set(PARTS)
    # by time: a tick that was sent twice is answered twice, with the same
    estimates = {
        f.header.time_ns: f.payload
        for f in said["adm", "from"]
        if f.header.type == WIRE.message("estimate").number
    }
    q = np.array([WIRE.decode("estimate", estimates[time])["q_ib"] for time in sorted(estimates)])
    np.testing.assert_array_equal(q, done.result.series["estimate.q_ib"])
    ticks = [f for f in said["adm", "to"] if f.header.type == WIRE.message("tick").number]
    # the one that was not answered for two seconds was sent again
    assert 280 < len(ticks) <= 283
    assert [f.header.sequence for f in said["adm", "to"]] == list(range(len(said["adm", "to"])))


# --------------------------------------------------------------------------------------- deaths


def test_each_part_is_killed_in_turn_and_started_anew_to_the_last_bit(tmp_path):
    killed_at = {}

    def note(part):
        def now(session):
            killed_at[part] = session._wall_ns()
            kill(part)(session)

        return now

    # four of them after they have put their memory aside
    at = {10 * (k + 1) + 250 * (k > 2): note(part) for k, part in enumerate(PARTS)}
    done = run(flight(on_death="restart", seconds=33.0), at, tmp_path / "r.mcap")
    assert done.result.failure == ""
    assert done.result.deaths == 7
    assert done.off == 0.0
    died = {e.text.split("'")[1]: e for e in done.result.events if e.kind == "died"}
    assert list(died) == list(PARTS)
    for part, event in died.items():
        assert event.received_ns - killed_at[part] < 2e9
        assert "SIGKILL" in event.text
    record = read_record(tmp_path / "r.mcap")
    assert record.complete
    told = [e.text.split(" told ")[1] for e in record.events if e.kind == "restarted"]
    assert told == ["all again"] * 3 + ["all since step 255 again"] * 4


@pytest.fixture(scope="module")
def failed(tmp_path_factory):
    """A run in which a part dies, with the best scheduler there is; schedulers by who has them."""
    schedulers, of = {}, changed(read(CLOCKWORK), {"fifo": True})

    def look(session):
        numbers = {part: session.part_processes.process(part) for part in of.rig.parts} | {
            "bench": 0
        }
        if hasattr(os, "SCHED_FIFO"):
            schedulers.update({who: os.sched_getscheduler(n) for who, n in numbers.items()})

    record = tmp_path_factory.mktemp("bench") / "failed.mcap"
    began = time.monotonic()
    done = run(of, {20: look, 30: kill("counter")}, record)
    assert time.monotonic() - began < 60.0
    return done, record, schedulers


def test_a_death_fails_the_run_that_says_so_and_leaves_no_process(failed):
    done, path, _ = failed
    assert "'counter' was killed by SIGKILL, at 3." in done.result.failure
    assert done.result.steps == 31
    assert done.off == 0.0  # as far as it went
    assert done.watch.events[-1][0] == "failed"
    record = read_record(path)
    assert record.complete
    assert record.events[-1].kind == "failed"


@pytest.mark.skipif(not hasattr(os, "SCHED_FIFO"), reason="this system has no SCHED_FIFO")
def test_a_better_scheduler_is_had_or_its_refusal_told(failed):
    done, _, schedulers = failed
    refused = [event.text for event in done.result.events if event.kind == "scheduler"]
    if refused:
        assert refused[0].startswith("no real-time scheduler: ")
        assert set(schedulers.values()) == {os.SCHED_OTHER}
    else:
        assert set(schedulers.values()) == {os.SCHED_FIFO}
    assert os.sched_getscheduler(0) == os.SCHED_OTHER  # only while it runs


def test_parts_end_when_the_bench_is_killed(tmp_path):
    code = (
        "import sys, pathlib\n"
        "from robins.bench.run.session import Session\n"
        "from robins.bench.run.setup import changed, read\n"
        f"of = changed(read({CLOCKWORK!r}), {{'baud': 57600}})\n"
        "class Watch:\n"
        "    def event(self, *a): pass\n"
        "    def over(self, *a): pass\n"
        "    def commands(self, s): return []\n"
        "    def step(self, s, k):\n"
        "        if k != 5: return\n"
        "        print(*(s.part_processes.process(p) for p in s.broker.links), flush=True)\n"
        "if __name__ == '__main__':\n"
        f"    Session(of, pathlib.Path({str(tmp_path / 'k.mcap')!r}), Watch()).run()\n"
    )
    bench = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    pids = [int(word) for word in bench.stdout.readline().split()]
    assert len(pids) == 2
    time.sleep(0.6)  # the record is written at least each half second
    bench.kill()
    bench.wait()
    bench.stdout.close()
    until = time.monotonic() + 10.0
    while any(alive(pid) for pid in pids) and time.monotonic() < until:
        time.sleep(0.05)
    assert not any(alive(pid) for pid in pids)
    record = read_record(tmp_path / "k.mcap")
    assert not record.complete
    assert len(record.entries) > 100


def test_a_disk_that_fills_up_fails_the_run_and_keeps_what_was_written(tmp_path, threads):
    path = tmp_path / "full.mcap"
    before = resource.getrlimit(resource.RLIMIT_FSIZE)

    def fill(session):
        resource.setrlimit(resource.RLIMIT_FSIZE, (path.stat().st_size + 5_000, before[1]))

    ignored = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        result = run(flight(), {100: fill}, path).result
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, ignored)
    assert "the record cannot be written" in result.failure
    assert "File too large" in result.failure
    assert 100 <= result.steps < 200
    record = read_record(path)
    assert not record.complete
    assert len(record.entries) > 100


# --------------------------------------------------------------------------------------- clocks


def test_real_time_keeps_its_deadlines_and_counts_those_it_misses(threads):
    result = run(flight(clock="realtime", rate=25.0, seconds=6.0)).result
    assert result.steps == 60
    assert result.failure == ""
    # never sleep(1/f): 60 steps take 60 periods, however late each was
    assert result.seconds > 59 / 25.0
    told = result.latencies.summary()
    assert told["cycles"] == 60
    assert sum(told["histogram"]["counts"]) == 60
    assert told["cycle"]["lateness_us"]["count"] == 60
    assert told["missed"] == sum(e.kind == "missed" for e in result.events)


def test_a_part_that_is_stopped_in_real_time_is_not_waited_for(monkeypatch):
    goes = threading.Event()
    goes.set()

    class Stopped(Station):
        def feed(self, data):
            goes.wait(30.0)
            return super().feed(data)

    on_threads(monkeypatch, star=Stopped)
    of = flight(clock="realtime", rate=25.0, seconds=10.0, patience=0.5, filter="mekf-gate")
    done = run(of, {20: lambda _: goes.clear(), 60: lambda _: goes.set()})
    assert done.result.steps == 100
    assert done.result.silent["star"] >= 30
    assert np.any(flag(done.result.series, "star silent"))
    # what it says afterwards is of steps that are over
    assert done.result.health["star"].late + done.result.health["star"].frames > 0


def test_overrun_may_abort_the_run(threads):
    of = flight(clock="realtime", rate=25.0, overrun="abort", seconds=10.0)
    result = run(of, dict.fromkeys(range(20, 25), lambda _: time.sleep(0.3))).result
    assert 'overrun = "abort"' in result.failure
    assert result.steps < 40


# --------------------------------------------------------------------------------------- faults


@pytest.mark.parametrize("name", built_in())
def test_every_scenario_of_the_bench_flies(threads, name):
    of = changed(read(name), {"seconds": 2.0})
    result = Session(of).run()
    assert (result.failure, result.steps) == ("", round(2.0 / of.timing.step_s))
    assert sum(health.frames for health in result.health.values()) >= result.steps
    if of.rig.truth:
        true = [x for key, x in result.series.items() if key.startswith(f"{of.rig.truth}.")]
        assert len(true) >= 2
        assert all(np.isfinite(x).all() for x in true)


def test_faults_are_the_same_however_fast_it_goes(threads):
    faults = (
        RIG.fault(kind="bit errors", begin=2.0, share=0.05),
        RIG.fault(kind="loss", begin=4.0, end=8.0, share=0.05, direction="to"),
        RIG.fault(kind="duplication", begin=2.0, share=0.05),
        RIG.fault(kind="delay", begin=5.0, link="star", delay=0.5, share=0.3),
        RIG.fault(kind="reorder", begin=8.0, link="gyro", share=0.3),
    )
    fast, slow = (
        run(flight(filter="mekf-gate", seconds=12.0, faults=faults, **more))
        for more in ({}, {"baud": 460_800})
    )
    np.testing.assert_array_equal(
        fast.result.series["estimate.q_ib"], slow.result.series["estimate.q_ib"]
    )
    np.testing.assert_array_equal(
        fast.result.series["motion.q_ib"], slow.result.series["motion.q_ib"]
    )
    assert fast.result.injected == slow.result.injected
    assert {kind for kind, _ in fast.result.injected} == {f.kind for f in faults}
    health = fast.result.health.values()
    damaged = sum(n for (kind, _), n in fast.result.injected.items() if kind == "bit errors")
    # one that is doubled is wrong twice, and one with a new zero in it too
    assert damaged <= sum(h.wrong for h in health) <= 2 * damaged
    held = sum(n for (kind, _), n in fast.result.injected.items() if kind in ("delay", "reorder"))
    assert damaged <= sum(h.lost for h in health) <= damaged + held  # a number that never came
    assert sum(h.repeated for h in health) > 0
    assert fast.off > 0.0
    assert slow.result.seconds > fast.result.seconds


# --------------------------------------------------------------------------------------- boards


@contextmanager
def board(part: str, path: str, scenario: str):
    robins = [sys.executable, "-c", "from robins.cli import main; raise SystemExit(main())"]
    command = [*robins, "bench", "node", part, path, scenario]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def test_a_part_may_be_a_board_on_a_real_port(threads, tmp_path):
    """Here the board is a process started by hand, at the other end of a cable."""
    scenario = tmp_path / "short.toml"
    scenario.write_text(f'bench = "satellite"\nseconds = "5 s"\nset = {json.dumps(LOOP)}\n')
    complete = read(str(scenario))
    with cable() as ends, board("gyro", ends.board, str(scenario)) as process:
        of = changed(complete, {"ports": {"gyro": ends.bench}})
        result = Session(of).run()
        assert result.failure == ""
        assert result.steps == 50
        assert difference(result.series, one_program("satellite/s1", "mekf", *LOOP)) == 0.0
        said, _ = process.communicate(timeout=20.0)
        assert "The bench has said stop." in said


def test_what_does_not_fit_is_refused_before_anything_starts():
    with pytest.raises(ScenarioError, match=r"seconds: 1000 s is not from a step \(0.1 s\) to"):
        Session(flight(seconds=1000.0))
    with pytest.raises(ScenarioError, match=r"ports: there is no part 'gyros', only plant"):
        flight(ports={"gyros": "/dev/null"})
    with pytest.raises(ScenarioError, match="rate: a clock in lock-step has none"):
        flight(rate=100.0)
    with pytest.raises(ValueError, match="there is no such path"):
        Session(flight(ports={"gyro": "/dev/ttyNOTHERE"}))
    with pytest.raises(ScenarioError, match="no filter 'mekff' for the satellite; did you mean 'm"):
        flight(filter="mekff")


def test_a_board_that_says_nothing_is_named(monkeypatch, threads):
    monkeypatch.setattr("robins.bench.run.session.FIRST_HELLO_S", 0.2)
    with cable() as ends:
        of = flight(ports={"gyro": ends.bench})
        result = Session(of, config=config("satellite/s1", "mekf", *LOOP)).run()
    assert "no hello from" in result.failure
    assert "gyro" in result.failure
    assert result.steps == 0
    assert isinstance(BenchError("x"), RuntimeError)
    assert setup_of(RIG)().clock == "lockstep"
