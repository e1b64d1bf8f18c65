"""Costs of single precision: of a filter that it does not hurt, and of one that it ruins."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from robins.export.library import EntryPoint, Library
from robins.export.runs import board_runs, by_jax, ends, entry_functions
from robins.export.single_precision import BlockCost, PrecisionCost, cost, differences, in_floats
from robins.filters import Belief, Model, Motion, Sensor, kalman
from robins.filters.rules import gate
from robins.program import SINGLE, trace_steps
from robins.systems.study import Case, Contender, Problem, SensorAxes, StateBlock

STEPS, NOISE = 200, 0.1


def drive(place):
    """A car at some distance from the origin [m], whose position is measured to 0.1 m."""

    def step(x, u):
        return jnp.array([[1.0, 0.1], [0.0, 1.0]]) @ x

    model = Model(
        Motion(step, np.array([1e-3, 1e-2])), (Sensor(lambda x, aux: x[:1], [NOISE], 1, "fix"),)
    )
    start = Belief.of(np.array([place, 1.0]), np.diag([1.0, 0.1]))

    def simulate(run):
        keys = jax.random.split(jax.random.key(run), 2)
        walk = np.array([[1e-3, 1e-2]]) * jax.random.normal(keys[0], (STEPS, 2))
        truth = jax.lax.scan(lambda x, w: 2 * (step(x, None) + w,), start.mean, walk)[1]
        y = truth[:, :1] + NOISE * jax.random.normal(keys[1], (STEPS, 1))
        y = jnp.where(jnp.arange(STEPS)[:, None] % 50 == 7, y + 5.0, y)  # refused by the gate
        return Case(start, None, {"fix": y}, {}, truth)

    return Problem(
        epoch_s=0.1 * np.arange(STEPS),
        blocks=[
            StateBlock("position", slice(0, 1), "m", "cm", "line", ("x",)),
            StateBlock("speed", slice(1, 2), "m/s", "m/s", "line", ("x",)),
        ],
        sensors={"fix": SensorAxes("m", "line", ("x",))},
        simulate=simulate,
        contenders={"kf": Contender(kalman(rules=[gate(0.999)]), model)},
        claims=lambda metrics: [],
        count_from=20,
    )


def judged(problem, count=2):
    contender = problem.contenders["kf"]
    runs = board_runs(problem, "kf", count)
    functions = entry_functions(contender.filter, contender.model, runs[0].given)
    row = runs[0].row(0)
    programs = trace_steps([(functions[e], row[e]) for e in functions], runs[0].start)
    entries = [
        EntryPoint(name, program, takes, "")
        for (name, takes), program in zip(
            [("predict", ("input",)), ("update_fix", ("reading", "about"))], programs, strict=True
        )
    ]
    library = Library("robins", entries, runs[0].start, precision=SINGLE)
    doubles = [by_jax(functions, run, ends) for run in runs]
    singles = in_floats(library, runs, ends)
    found = cost(problem, contender, library, runs, doubles, singles)
    return found, library, doubles, singles, runs


@pytest.fixture(scope="module")
def near():
    return judged(drive(10.0))


def test_a_filter_of_small_numbers_stays_what_it_was(near):
    found, _, doubles, singles, runs = near
    assert found.bearable
    assert found.verdict == "Single precision costs nothing that shows in the errors."
    assert (found.runs, found.steps, found.codes, found.codes_off) == (2, STEPS, 800, 0)
    assert 1e-8 < found.fields["factor"] < 1e-5
    # The figures again, from means and covariances.
    error, nees = [], []
    for (states, _), run in zip(doubles, runs, strict=True):
        e = np.asarray(run.case.truth)[20:, 0] - states.belief.mean[20:, 0]
        S = states.belief.factor[20:]
        error.append(e)
        nees.append(e**2 / (S @ S.transpose(0, 2, 1))[:, 0, 0])
    position = found.blocks[0]
    assert position.rms == pytest.approx(100.0 * np.sqrt(np.mean(np.square(error))), rel=1e-9)
    assert position.nees == pytest.approx(np.mean(nees), rel=1e-9)
    assert position.unit == "cm"
    assert position.rms_single == pytest.approx(position.rms, rel=1e-3)
    assert singles[0][0].belief.mean.shape == (STEPS, 2)
    assert "| position | cm |" in found.table()


def test_a_filter_of_large_numbers_is_ruined_and_told_so():
    found, *_ = judged(drive(6.4e6), count=1)
    assert not found.bearable
    assert found.verdict.startswith("Single precision RUINS this filter: ")
    # Half a unit in the last place of 6.4e6 is 0.25 m; the filter knows its place to centimetres.
    assert found.blocks[0].rms_single > 10.0 > found.blocks[0].rms
    assert found.as_data()["bearable"] is False


def test_each_reason_is_told():
    fine = BlockCost("height", "m", 1.0, 1.0, 0.9, 0.9)
    base = PrecisionCost(1, 10, {"factor": 1e-6}, [fine], 20, 0, True)
    assert base.bearable
    much = base._replace(blocks=[fine, fine._replace(name="heading", rms_single=1.2)])
    assert "heading: RMS 1 becomes 1.2 m" in much.verdict
    assert not much.bearable
    some = base._replace(blocks=[fine._replace(rms_single=1.05)])
    assert some.bearable
    assert some.verdict.startswith("Single precision costs something: height")
    for nees in (0.5, 2.0):  # sure of what it does not know, or the other way round
        assert not base._replace(blocks=[fine._replace(nees_single=nees)]).bearable
    assert "not stay finite" in base._replace(finite=False).verdict
    assert "5.0% of its codes" in base._replace(codes_off=1).verdict
    lost = fine._replace(rms_single=np.nan)
    assert not base._replace(blocks=[lost]).bearable
    assert base._replace(blocks=[lost]).as_data()["blocks"][0]["rms_single"] is None


def test_what_is_not_a_number_in_one_precision_only_is_infinitely_far(near):
    _, library, doubles, *_ = near
    states, _ = doubles[0]
    mean = states.belief.mean.copy()
    mean[3] = np.nan
    lost = states._replace(belief=states.belief._replace(mean=mean))
    assert differences(library.state, states, lost)["mean"] == np.inf
    assert differences(library.state, lost, lost)["mean"] == 0.0


def test_a_case_is_given_arrays_of_jax():
    problem = drive(10.0)

    def gap(world):
        return world._replace(y={"fix": world.y["fix"].at[3].set(jnp.nan)})

    without = {"kf": replace(problem.contenders["kf"], case=gap)}
    (run,) = board_runs(replace(problem, contenders=without), "kf", 1)
    assert np.isnan(run.given["update_fix"][0][3]).all()
