"""Chunks by the memory that they need, and their statistics joined in order."""

import os
import pickle
import shutil
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest
from test_campaign import chunks, collect
from test_campaign import problem as three  # noqa: F401 a fixture

from robins.campaign import machine as machines
from robins.campaign import memory, simulate
from robins.campaign.machine import JaxMachine, LaneMachine
from robins.program import CPP, LANE_FLAGS
from robins.systems.study import Limit, Norm

FOUND = any(map(shutil.which, CPP.names))
needs_compiler = pytest.mark.skipif(not FOUND, reason="lanes need a C++ compiler")
RUNS = 53


@pytest.fixture
def problem(three):  # noqa: F811
    """Problem with one filter, limits, norms and windows."""
    return replace(
        three,
        contenders={"right": three.contenders["right"]},
        limits=(Limit("1_m", "line", 1.0),),
        norms=(Norm("both", (0, 1)),),
        windows=(slice(3, 9), slice(20, 40)),
    )


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    """Compile without optimisation; the bits are the same."""
    flags = tuple("-O0" if flag == "-O2" else flag for flag in LANE_FLAGS)
    monkeypatch.setattr("robins.program.lanes.LANE_FLAGS", flags)


def equal(a, b):
    """Equality to the bit, in all that statistics hold."""
    assert (a.runs, a.diverged, a.n) == (b.runs, b.diverged, b.n)
    assert list(a.sums) == list(b.sums)
    for name in a.sums:
        np.testing.assert_array_equal(a.sums[name], b.sums[name], err_msg=name)
    assert list(a.each) == list(b.each)
    for name in a.each:
        np.testing.assert_array_equal(a._all(name), b._all(name), err_msg=name)
    assert list(a.bins) == list(b.bins)
    for name in a.bins:
        np.testing.assert_array_equal(a.bins[name], b.bins[name], err_msg=name)
    for x, y in zip(jax.tree.leaves(a.example), jax.tree.leaves(b.example), strict=True):
        np.testing.assert_array_equal(x, y)


def test_joined_chunks_are_chunks_added(problem):
    settings = {name: getattr(problem, name) for name in ("limits", "norms", "windows")}
    records = list(chunks(problem, "right", 10, chunk=4))
    records[1]["error"] = records[1]["error"].copy()
    records[1]["error"][2, 5] = np.nan  # a run that diverged
    added = collect(records, problem.blocks, **settings)
    joined = collect([], problem.blocks, **settings)
    for one in records:
        part = joined.blank()
        part.add(one)
        joined.merge(pickle.loads(pickle.dumps(part)))  # as another process would send them
    equal(joined, added)
    assert joined.diverged == 1
    assert joined.tally.counts() == added.tally.counts()
    assert joined.tally.predictions.shape[0] == 10
    assert joined.nis("y") == added.nis("y")


def test_an_example_does_not_hold_its_chunk(problem):
    (record,) = chunks(problem, "right", 8, chunk=8)
    one = collect([record], problem.blocks)
    assert all(np.asarray(x).base is None for x in jax.tree.leaves(one.example))


@needs_compiler
def test_the_number_of_threads_changes_no_bit(problem, monkeypatch):
    found = []
    for cores in (1, 5):
        monkeypatch.setattr(machines, "available_cores", lambda cores=cores: cores)
        found.append(simulate(problem, RUNS, 8, machine="c").solution)
    one, five = found
    for name, variable in one.variables.items():
        np.testing.assert_array_equal(five[name], variable)


@needs_compiler
def test_statistics_are_taken_where_a_chunk_was_computed(problem):
    where = []

    def taken(name, record):
        where.append(threading.current_thread())
        return len(record["error"])

    got = [(world, n, of("right")) for world, n, of in LaneMachine(problem).chunks(RUNS, 8, taken)]
    assert [n for _, n, _ in got] == [8] * 6 + [5] == [n for _, _, n in got]
    assert threading.current_thread() not in where
    assert [world is None for world, _, _ in got] == [False] + [True] * 6
    first = problem.simulate(0)
    np.testing.assert_allclose(got[0][0].y["y"], first.y["y"], atol=1e-12)


@needs_compiler
def test_lanes_give_all_that_statistics_need_and_show_the_first_run(problem):
    by_lanes, by_jax = (machine(problem).chunks(8) for machine in (LaneMachine, JaxMachine))
    got, want = (of("right") for _, _, of in (next(by_lanes), next(by_jax)))
    assert len(got["mean"]) == len(got["updates"]["y"].code) == 1
    np.testing.assert_allclose(got["mean"][0], want["mean"][0], atol=1e-12)
    for name in ("nis", "dof", "innovation"):
        mine, all_ = (getattr(r["updates"]["y"], name) for r in (got, want))
        np.testing.assert_allclose(mine, all_[: len(mine)], atol=1e-12)
    assert len(got["updates"]["y"].nis) == 8


def test_the_width_of_a_chunk_is_that_which_fits():
    kib = 1 << 10
    assert memory.width_of(kib, 128 * kib) == 64
    assert memory.width_of(4 * kib, 128 * kib) == 32
    assert memory.width_of(3 * kib, 128 * kib) == 32  # 40 would, and take longer for a run
    assert memory.width_of(5 * kib, 128 * kib) == 24  # 25 would
    assert memory.width_of(100 * kib, 128 * kib) == 8
    assert memory.concurrent_chunks(memory.MEMORY // 64, 8, cores=64) == 8
    assert memory.concurrent_chunks(memory.MEMORY, 8, cores=64) == 1
    assert memory.concurrent_chunks(1, 8, cores=3) == 3


@pytest.mark.parametrize("machine", [JaxMachine, pytest.param(LaneMachine, marks=needs_compiler)])
def test_the_width_depends_on_the_problem_alone(problem, machine, monkeypatch):
    by = machine(problem)
    assert by.width(1000) == 64
    monkeypatch.setattr(machines, "available_cores", lambda: 64)
    assert by.width(1000) == machine(problem).width(10**6) == 64
    assert by.notes == []
    # 60 epochs; error, sigma, both NEES, NIS and its degrees are eight numbers of each at least
    least = 60 * 8 * 8
    for name in ("MEMORY", "CHUNK_BYTES"):
        monkeypatch.setattr(machines, name, 24 * least)
    assert by.width(1000) in (8, 16, 24)


def test_one_width_serves_any_number_of_runs_and_a_few_pay_for_no_more(problem):
    assert [memory.filled(n) for n in (1, 2, 16, 32, 33, 50, 1000)] == [1, 2, 16, 32, 64, 64, 64]
    by = JaxMachine(problem)
    (fifty,) = (of("right") for _, n, of in by.chunks(50) if n == 50)
    for begin, first in (("", 0), ("later", 1)):
        (many,) = (of("right") for k, (_, _, of) in enumerate(by.chunks(90)) if k == first)
        assert len(many["error"]) == (26 if begin else 64)
        if not begin:
            np.testing.assert_array_equal(many["error"][:50], fifty["error"])


def test_filters_of_one_structure_are_compiled_once_and_meanwhile(three, monkeypatch, caplog):  # noqa: F811
    monkeypatch.setattr(machines, "available_cores", lambda: 4)
    numbers = ("right", "wrong R")
    one = replace(three, contenders={name: three.contenders[name] for name in numbers})
    jax.config.update("jax_log_compiles", True)
    try:
        simulate(one, 11, machine="jax")  # as no other test
    finally:
        jax.config.update("jax_log_compiles", False)
    what = "Finished XLA compilation of jit(_records)"
    (done,) = (record for record in caplog.records if record.getMessage().startswith(what))
    assert done.threadName != threading.current_thread().name


@pytest.mark.parametrize("machine", ["jax", pytest.param("c", marks=needs_compiler)])
def test_more_than_the_bound_is_said(problem, machine, monkeypatch):
    monkeypatch.setattr(memory, "MEMORY", 1000)
    (note,) = simulate(problem, 9, 0, machine=machine).notes
    assert note.startswith("9 runs" if machine == "jax" else "8 runs")
    assert "MB of memory" in note
    assert "shorten" in note


@pytest.mark.skipif(sys.platform != "linux", reason="the C library of Linux is meant")
def test_what_threads_have_freed_is_given_back():
    pages = Path("/proc/self/statm")
    page = os.sysconf("SC_PAGE_SIZE")

    def resident():
        return page * int(pages.read_text().split()[1])

    def hold(block):
        kept = [bytearray(block) for _ in range(400)]  # too small to be mapped each by itself
        last = kept[-1]
        del kept
        return last  # in front of which all is free

    with ThreadPoolExecutor(1) as pool:
        last = pool.submit(hold, 120_000).result()
        before = resident()
        memory.release_memory()
        assert resident() < before - 20_000_000
    assert len(last) == 120_000
