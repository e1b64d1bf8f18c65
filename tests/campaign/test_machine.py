"""The same campaign by batches of JAX and by programs in lanes."""

import shutil
from dataclasses import replace

import jax
import numpy as np
import pytest
from test_campaign import problem as three  # noqa: F401 a fixture

from robins.campaign import compilation, simulate
from robins.campaign import machine as machines
from robins.campaign.machine import JaxMachine, LaneMachine, machine_for
from robins.errors import RobinsError
from robins.filters import Belief
from robins.program import CPP, LANE_FLAGS, BuildError

FOUND = any(map(shutil.which, CPP.names))
needs_compiler = pytest.mark.skipif(not FOUND, reason="lanes need a C++ compiler")
RUNS = 53  # no whole number of chunks or lanes


@pytest.fixture
def problem(three):  # noqa: F811
    """Problem with one filter, as each is compiled."""
    return replace(three, contenders={"right": three.contenders["right"]})


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    """Compile without optimisation; the bits are the same."""
    flags = tuple("-O0" if flag == "-O2" else flag for flag in LANE_FLAGS)
    monkeypatch.setattr("robins.program.lanes.LANE_FLAGS", flags)


@needs_compiler
def test_lanes_have_the_results_of_jax(problem):
    said = []
    mine = simulate(problem, RUNS, 16, machine="c", progress=lambda share, what: said.append(what))
    want = simulate(problem, RUNS, 16, machine="jax")
    interpreted = simulate(problem, RUNS, 16, machine="vm")
    assert interpreted.machine == "vm"
    assert interpreted.solution.identical(mine.solution.assign_attrs(interpreted.solution.attrs))
    assert (mine.machine, want.machine) == ("c", "jax")
    assert mine.summary["machine"] == "c"
    assert mine.notes == want.notes
    assert mine.counts == want.counts
    assert set(mine.solution.variables) == set(want.solution.variables)
    for name, variable in want.solution.variables.items():
        if variable.dtype.kind == "f":
            np.testing.assert_allclose(mine.solution[name], variable, rtol=1e-11, atol=1e-12)
    assert f"right: runs 49 to {RUNS} of {RUNS}" in said


@needs_compiler
def test_chunks_in_lanes_come_in_order_and_without_what_fills_them(problem):
    records = [(n, of("right")) for _, n, of in LaneMachine(problem).chunks(RUNS, 8)]
    assert sum(n for n, _ in records) == RUNS == sum(len(r["error"]) for _, r in records)
    found = np.concatenate([r["error"] for _, r in records])
    want = np.concatenate([of("right")["error"] for _, _, of in JaxMachine(problem).chunks(RUNS)])
    np.testing.assert_allclose(found, want, atol=1e-12)


@needs_compiler
def test_a_failure_in_a_chunk_comes_out(problem, monkeypatch):
    lanes = LaneMachine(problem)

    def failing(*_):
        raise RuntimeError("no more")

    monkeypatch.setattr(lanes, "_chunk", failing)
    with pytest.raises(RuntimeError, match="no more"):
        list(lanes.chunks(RUNS, 8))


def test_what_computes_is_the_interpreter_where_it_can_be(problem, monkeypatch):
    assert machine_for(problem).name == ("vm" if FOUND else "jax")
    for name in machines.MACHINES:
        if FOUND or name == "jax":
            assert machine_for(problem, name).name == name

    def missing():
        raise BuildError("there is no C compiler on this machine")

    monkeypatch.setattr(machines, "interpreter_of_many", missing)
    by = machine_for(problem)
    assert isinstance(by, JaxMachine)
    by.width(9)
    (note,) = by.notes
    assert "JAX computed" in note
    assert "no C compiler" in note
    with pytest.raises(RobinsError, match="no C compiler"):
        machine_for(problem, "vm")
    monkeypatch.setenv("CXX", "no-such-compiler")
    with pytest.raises(RobinsError, match="no-such-compiler"):
        machine_for(problem, "c")


@needs_compiler
def test_a_long_campaign_goes_over_to_compiled_lanes_with_the_same_bits(problem, monkeypatch):
    want = simulate(problem, 80, 8, machine="vm")
    for name in ("LOOP_S", "NODE_S"):
        monkeypatch.setattr(compilation, name, 0.0)
    monkeypatch.setattr(machines, "available_cores", lambda: 1)
    lanes = LaneMachine(problem)
    by, scans = lanes._hand_over, []
    record = by.record_time

    def taken(*of):
        record(*of)
        if by.compiling is not None:
            by.compiling.join()
        scans.append([loop.rounds.lanes for loop in by._loops])

    monkeypatch.setattr(by, "record_time", taken)
    found = simulate(problem, 80, 8, machine=lanes)
    assert found.solution.identical(want.solution)
    assert found.machine == "vm"
    assert len(scans) == 9
    assert scans[0] == [64] * len(scans[0])  # the first does not judge
    assert all(lanes < 64 for lanes in scans[-1])


def test_compiling_has_to_pay(problem):
    by = LaneMachine(problem)._hand_over
    for left in (10_000_000, 1, 0):  # the first may have traced, the others are too few
        by.record_time(8, 1e-3, left)
    assert by.compiling is None


def test_a_machine_that_is_not_there_is_refused(problem):
    with pytest.raises(RobinsError, match=r"no machine 'cuda'.*say vm, c or jax"):
        machine_for(problem, "cuda")


@needs_compiler
def test_what_stays_with_jax_is_said(problem, monkeypatch):
    monkeypatch.setattr("robins.program.stages.WORTH", 0)  # nothing is too little

    def simulated(index):
        case = problem.simulate(index)
        rows = jax.lax.map(lambda y: y + 0.0 * jax.lax.digamma(1.0 + y * y), case.y["y"])
        return case._replace(y={"y": rows}, start=Belief(case.start.mean, case.start.factor))

    one = simulate(replace(problem, simulate=simulated), 9, machine="c")
    (note,) = one.notes
    assert "digamma" in note
    assert "the simulation" in note
