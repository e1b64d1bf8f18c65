"""Accounts of times: quantiles against NumPy's, bounded memory, what counts and what does not.

And of whole runs: reasons, warnings.
"""

import json
import re
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import flights
import numpy as np
import pytest
from clockwork import CLOCKWORK

from robins.bench.accounting import EDGES_US, RECENT, Histogram, Latencies
from robins.bench.broker.link import BenchError
from robins.bench.evaluation import RunResult
from robins.bench.recording import Event
from robins.bench.rigs import RIGS
from robins.bench.run.outcome import outcome
from robins.bench.run.setup import LoadedRun, built_in, changed, config_of, read, steps_of
from robins.bench.run.telemetry import Telemetry
from robins.bench.run.untested import doubts

US, MS = 1000, 10**6
PENDULUM = f"{Path(__file__).parents[2] / 'docs' / 'examples' / 'pendulum.py'}:rig"


def drawn(kind: str) -> np.ndarray:
    rng = np.random.default_rng(4)
    if kind == "few":
        return np.array([3, 3, 70_001])
    if kind == "one":
        return np.array([123_457])
    if kind == "normal":
        return np.abs(rng.normal(2e5, 5e4, 5001)).astype(int)
    if kind == "exponential":
        return rng.exponential(3e4, 5000).astype(int)
    return np.exp(rng.uniform(0.0, 40.0, 5000)).astype(int)  # up to 7 years


@pytest.mark.parametrize("kind", ["few", "one", "normal", "exponential", "decades"])
def test_quantiles_are_those_of_numpy(kind):
    numbers, histogram = drawn(kind), Histogram()
    for ns in numbers:
        histogram.add(int(ns))
    for share in (0.0, 0.01, 0.1, 0.5, 0.9, 0.99, 0.999, 1.0):
        expected = np.quantile(numbers, share, method="inverted_cdf")
        found = histogram.quantile(share)
        assert found == pytest.approx(expected, rel=1 / 256)
        if expected < 256:
            assert found == expected
    assert (histogram.count, histogram.most) == (len(numbers), numbers.max())


def test_an_empty_histogram_and_negative_numbers():
    histogram = Histogram()
    assert histogram.quantile(0.5) is None
    histogram.add(-5)
    assert (histogram.quantile(0.5), histogram.most) == (0.0, 0)


def test_days_of_numbers_take_little_memory():
    """Every number of a day between a nanosecond and an hour falls into one of these."""
    histogram = Histogram()
    for ns in np.unique(np.geomspace(1, 3.6e12, 60_000).astype(int)):
        histogram.add(int(ns))
    assert len(histogram._cells) <= 256 + 35 * 128


def run(count: int, late_ns, deadlines: bool = True) -> Latencies:
    """Cycles of 10 ms with two parts: one computes 200 us, the other 300 us after the first."""
    accounts = Latencies()
    for k in range(count):
        due = k * 10 * MS
        now = due + int(late_ns[k])
        deadline = due if deadlines else None
        accounts.tick("gyro", k, deadline, now)
        accounts.done("gyro", k, now + 250 * US, 200 * US)
        accounts.tick("adm", k, deadline, now + 300 * US)
        accounts.done("adm", k, now + 900 * US, 500 * US)
        accounts.cycle(k, deadline, now, now + 950 * US, missed=bool(late_ns[k] > 1000 * US))
    return accounts


def test_a_run_is_summed_up():
    late = np.random.default_rng(2).exponential(300 * US, 2000).astype(int)
    found = run(2000, late).summary()
    assert json.loads(json.dumps(found, allow_nan=False)) == found
    assert (found["cycles"], found["missed"]) == (2000, np.sum(late > 1000 * US))
    for name, more in (("gyro", 0), ("adm", 300 * US)):
        times = found["parts"][name]["lateness_us"]
        expected = np.quantile((late + more) / US, [0.5, 0.99, 1.0], method="inverted_cdf")
        assert [times[q] for q in ("p50", "p99")] == pytest.approx(expected[:2], rel=0.004)
        assert times["max"] == expected[2]
        assert times["count"] == 2000
    constant = {
        ("gyro", "compute_us"): 200, ("gyro", "round_trip_us"): 250, ("adm", "compute_us"): 500,
        ("adm", "round_trip_us"): 600,
    }  # fmt: skip
    found["parts"]["cycle"] = found["cycle"]
    constant |= {("cycle", "compute_us"): 700, ("cycle", "round_trip_us"): 950}
    for (name, kind), us in constant.items():
        times = found["parts"][name][kind]
        assert times["p50"] == times["p99"] == pytest.approx(us, rel=0.004)
        assert (times["max"], times["count"]) == (us, 2000)
    expected = np.quantile(late / US, [0.5, 0.99], method="inverted_cdf")
    lateness = found["cycle"]["lateness_us"]
    assert [lateness[q] for q in ("p50", "p99")] == pytest.approx(expected, rel=0.004)


def test_the_histogram_of_lateness():
    late = np.r_[0, 999, 1000, 1999, 2000, np.random.default_rng(2).exponential(1e8, 995)]
    found = run(1000, late.astype(int)).summary()["histogram"]
    assert found["edges_us"] == list(EDGES_US)
    edges = np.r_[0, np.array(EDGES_US) * US, 10**15]
    np.testing.assert_array_equal(found["counts"], np.histogram(late.astype(int), edges)[0])
    assert found["counts"][:3] == [2, 2, 1]


def test_lock_step_has_no_deadlines():
    found = run(10, np.zeros(10), deadlines=False).summary()
    nothing = {"p50": None, "p99": None, "max": None, "count": 0}
    assert found["cycle"]["lateness_us"] == found["parts"]["adm"]["lateness_us"] == nothing
    assert sum(found["histogram"]["counts"]) == 0
    assert found["cycle"]["round_trip_us"]["count"] == 10


def test_what_is_said_again_counts_once():
    accounts = Latencies()
    accounts.done("adm", 0, 5, 5)  # never asked
    accounts.tick("adm", 0, 0, 100 * US)
    accounts.tick("adm", 0, 0, 300 * US)  # its answer was lost: asked again
    accounts.done("adm", 0, 400 * US, 50 * US)
    accounts.done("adm", 0, 500 * US, 60 * US)
    accounts.tick("adm", 0, 0, 600 * US)
    accounts.cycle(0, 0, 100 * US, 700 * US, missed=False)
    accounts.tick("adm", 1, 0, 800 * US)
    accounts.done("adm", 0, 900 * US, 70 * US)  # too late
    times = accounts.summary()["parts"]["adm"]
    assert {kind: (t["count"], t["max"]) for kind, t in times.items()} == {
        "lateness_us": (2, 800.0), "compute_us": (1, 50.0), "round_trip_us": (1, 300.0)
    }  # fmt: skip
    assert accounts.summary()["cycle"]["compute_us"]["max"] == 50.0


def test_recent_is_of_the_last_cycles():
    late = np.r_[np.full(500, 5 * MS), np.full(RECENT, 20 * US)]
    accounts = run(len(late), late)
    found = accounts.recent()
    assert (found["cycles"], found["missed"]) == (RECENT, 0)
    assert found["cycle"]["lateness_us"]["max"] == 20.0
    assert found["parts"]["adm"]["lateness_us"] == {
        "p50": pytest.approx(320.0, rel=0.004), "p99": pytest.approx(320.0, rel=0.004),
        "max": 320.0, "count": RECENT,
    }  # fmt: skip
    assert accounts.summary()["missed"] == 500
    json.dumps(found, allow_nan=False)


def test_the_table_has_the_numbers_of_the_summary():
    lines = run(50, np.full(50, 100 * US)).table().splitlines()
    assert "".join(lines[0].split()) == "lateness[us]compute[us]roundtrip[us]"
    assert lines[1].split() == ["p50", "p99", "max"] * 3
    assert lines[2].split() == ["gyro", *["100.0"] * 3, *["200.0"] * 3, *["250.0"] * 3]
    assert lines[4].split()[:4] == ["cycle", *["100.0"] * 3]
    assert lines[-1] == "50 cycles, 0 missed"
    assert {len(line) for line in lines[1:-1]} == {98}
    assert "-" in run(5, np.zeros(5), deadlines=False).table().splitlines()[2].split()
    assert Latencies().table().splitlines()[-1] == "0 cycles, 0 missed"


# ------------------------------------------------------------------------------ what came of a run


def ran_of(of: LoadedRun, steps: int, **more: Any) -> RunResult:
    """A run of so many steps in which nothing was heard."""
    step_ns = round(1e9 * of.timing.step_s)
    series, config = Telemetry(of.rig, 1 + steps, step_ns).series, SimpleNamespace(step_ns=step_ns)
    return flights.ran_of(series.until(steps), config)._replace(**more)


@pytest.mark.parametrize("name", [*RIGS, CLOCKWORK, PENDULUM])
def test_a_run_without_a_step_has_its_reason_and_no_figures(name, tmp_path):
    of, record = read(name), tmp_path / "record.mcap"
    for failure, reason in (("'adm' died", "'adm' died"), ("", "it was stopped before its first")):
        found = outcome(of, ran_of(of, 0, failure=failure), record)
        told = json.loads(found.files["bench.json"])
        assert found.failure == told["failure"]
        assert found.failure.startswith(reason)
        assert (found.solution, found.warnings, told["steps"]) == (None, [], 0)
        assert found.notes[0] == f"The run failed: {found.failure}."


@pytest.mark.parametrize("wrong", ["judge", "inside"])
def test_what_a_judge_cannot_judge_is_a_result_all_the_same(wrong):
    of = read(CLOCKWORK)
    of = of._replace(rig=of.rig.varied(**{wrong: lambda given, result, *said: [][-1]}))
    for failure in ("", "'adder' died"):
        found = outcome(of, ran_of(of, 3, failure=failure), None)
        said = rf"the {wrong} of the rig 'clockwork' fails \(IndexError: "
        reason = rf"test_accounting.py, line \d+: {said}"
        assert re.match((failure and f"{failure}; {reason}") or reason, found.failure)
        assert found.solution is not None
        assert "value_count_n" in found.solution


def test_what_a_rig_cannot_prepare_is_named():
    of = read(CLOCKWORK)
    of = of._replace(rig=of.rig.varied(prepare=lambda setup, given: given["length"]))
    with pytest.raises(BenchError, match=r"line \d+: the prepare of the rig 'clockwork' fails"):
        config_of(of)


def test_what_a_run_does_not_test_is_said():
    of = read(CLOCKWORK)
    make = partial(of.rig.fault, begin=0.5)
    faults = (
        make(kind="loss", begin=600.0),
        make(kind="silent", link="adder"),
        make(kind="delay", delay=1.0),
    )
    short = changed(of, {"faults": faults})
    result = ran_of(of, 20, injected={("delay", "counter"): 3})
    nothing = "the run tests nothing of it"
    after = f"after the end of the run at 2 s: {nothing}"
    assert doubts(short, result) == [
        f"The fault 'loss' at all links begins at 600 s, {after}",
        f"The fault 'silent' at adder, from 0.5 s on, met nothing: {nothing}",
    ]
    assert outcome(short, result, None).warnings == doubts(short, result)
    late = [Event(k, "behind", f"the run is {k}.0 s behind", {"time_s": 4.0}) for k in (33, 66)]
    behind = ["At 4 s the run is 66.0 s behind"]
    assert doubts(of, result._replace(events=late)) == behind
    assert doubts(short, result._replace(events=late, failure="'adm' died")) == behind
    inner = read("satellite/star-stuck")
    (found,) = doubts(inner, ran_of(inner, 20))
    assert found == f"'star.faults' of what flies begins at 600 s, {after}"
    commanded = read("pointing-command")
    found = doubts(commanded, ran_of(commanded, 20))
    assert found[0].startswith("'reference' was to be said at ")
    assert len(found) == len(commanded.setup.says)


@pytest.mark.parametrize("name", built_in())
def test_a_scenario_as_it_is_comes_to_its_faults(name):
    of = read(name)
    hit = {(one.kind, part): 1 for one in of.setup.faults for part in of.rig.parts}
    assert doubts(of, ran_of(of, 1)._replace(steps=steps_of(of), injected=hit)) == []
