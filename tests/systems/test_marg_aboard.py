"""The filter "marg" for a board, and the simulated hand by which it is tried."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from interpreted import run
from scipy.spatial.transform import Rotation

from robins.export.field_notes import field_notes, tangent_axes
from robins.export.library import EntryPoint, Library
from robins.export.runs import entry_functions
from robins.filters import Code
from robins.program.kinds import kind_of
from robins.program.nodes import Graph
from robins.program.walk import Leaf, Program
from robins.systems.marg import MargReplay, filter_of, model, model_of, prepare
from robins.systems.marg.aboard import (
    COUNTED_S,
    FIELD_N,
    MAGNET_S,
    RUNS,
    STILL_S,
    case_of,
    export_problem,
    model_on_board,
    simulated_hand,
)

PARAMETERS = MargReplay()
BLOCK_S = PARAMETERS.update.block


def of(seed=0, number=0):
    log, truth = simulated_hand(PARAMETERS, seed, number)
    return log, truth, case_of(PARAMETERS, log, truth)


@pytest.fixture(scope="module")
def ran():
    """A hand, its case, and the run of the filter that takes increments."""
    log, _, case = of()
    filter_, known = filter_of(PARAMETERS), model_on_board(PARAMETERS)
    return log, case, run(filter_, known, case.start, case.y, case.u, case.aux)


def test_it_is_the_filter_of_a_replay(ran):
    """Which is given blocks that were integrated before."""
    log, _, found = ran
    prepared = prepare(log, PARAMETERS)
    w = prepared.world
    expected = run(filter_of(PARAMETERS), model_of(PARAMETERS), w.start, w.y, w.u, w.aux)
    for got, want in zip(
        jax.tree_util.tree_leaves(found.steps.posterior),
        jax.tree_util.tree_leaves(expected.steps.posterior),
        strict=True,
    ):
        size = np.max(np.abs(want))
        np.testing.assert_allclose(got, want, rtol=0.0, atol=1e-10 * max(size, 1e-9))


@pytest.mark.parametrize("use", ["undisturbed", "always", "never"])
def test_its_comments_are_on_fields_that_it_has(use):
    parameters = PARAMETERS.model_copy(update={"use_magnetometer": use})
    problem = export_problem(parameters, 0)
    library = library_of(problem, problem.contenders["marg"])
    sensors = {entry.name for entry in library.entries}
    assert ("update_magnetometer" in sensors) == (use != "never")
    library.header()  # refuses a note on a field that is not there
    for name, fields, _ in library.structs():
        for f in fields:
            noted = (name, f.name) in library.notes or f.name in ("factor", "code")
            assert noted, f"{name}.{f.name} has no comment"


def library_of(problem, contender):
    """A library whose programs have arguments and results only, by their shapes."""
    case = problem.simulate(jnp.asarray(0))
    filter_, model_ = contender.filter, contender.model
    state = jax.tree.map(jnp.asarray, filter_.init(case.start, model_.dims))
    rows = jax.tree.map(lambda a: jnp.asarray(a)[0], (case.u, dict(case.y), dict(case.aux)))
    given = {"predict": (rows[0],)}
    given |= {f"update_{s}": (y, rows[2].get(s)) for s, y in rows[1].items()}
    entries = []
    functions = entry_functions(filter_, model_, given)
    for name, function in functions.items():
        made = jax.eval_shape(function, state, *given[name])
        takes = ("input",) if name == "predict" else ("reading", "about")
        program = Program(Graph(), leaves((state, *given[name])), [], leaves(made), ((), ()))
        entries.append(EntryPoint(name, program, takes, ""))
    axes = tangent_axes(problem, contender.reported, len(state.belief.factor))
    notes = field_notes(problem, axes, state, given, filter_.suspects)
    del notes["reset_belief", "factor"]  # there is no reset here
    return Library("hand", entries, state, (), notes)


def leaves(tree):
    found = jax.tree_util.tree_flatten_with_path(tree)[0]
    paths = (f"arguments{jax.tree_util.keystr(path)}" for path, _ in found)
    return [
        Leaf(x.shape, x.dtype, kind_of(x.dtype), p) for p, (_, x) in zip(paths, found, strict=True)
    ]


def test_its_samples_are_of_its_truth():
    """Without the errors that the truth tells, gyros turn and accelerometers push as they must."""
    _, whole, case = of(seed=3)
    whole = jax.tree_util.tree_map(np.asarray, whole)
    u, truth = case.u, case.truth
    turn = np.einsum("ij,knj->kni", np.eye(3) + whole.gyro_gain[0], u.theta_b)
    turn = turn - whole.gyro_bias[0] * u.dt_s[..., None]
    noise = PARAMETERS.gyro.noise * np.sqrt(BLOCK_S)
    before, v = Rotation.from_quat(np.roll(whole.q_nb.wxyz[0], -1)), whole.v_n[0]
    attitude = Rotation.from_quat(np.roll(truth.q_nb.wxyz, -1, axis=-1))
    for k in range(len(turn)):
        here, pushed = before, np.zeros(3)
        for one, dv, dt in zip(turn[k], u.dv_b[k], u.dt_s[k], strict=True):
            middle = here * Rotation.from_rotvec(0.5 * one)
            here = here * Rotation.from_rotvec(one)
            pushed += middle.apply(dv - whole.accel_bias[0] * dt)
        assert (here.inv() * attitude[k]).magnitude() < 6.0 * noise
        pushed[2] += PARAMETERS.accelerometer.gravity * np.sum(u.dt_s[k])
        # the noise, and the turn of a sample that is itself noise
        spread = 6.0 * (PARAMETERS.accelerometer.noise * np.sqrt(BLOCK_S) + 9.81 * BLOCK_S * noise)
        assert np.linalg.norm(truth.v_n[k] - v - pushed) < spread
        before, v = attitude[k], truth.v_n[k]


def test_the_magnet_is_seen_and_nothing_else(ran):
    _, case, _ = ran
    field = np.asarray(case.aux[model.MAGNETOMETER])
    attitude = Rotation.from_quat(np.roll(case.truth.q_nb.wxyz, -1, axis=-1))
    off = np.linalg.norm(attitude.apply(field) - FIELD_N, axis=1)
    end = BLOCK_S * (1 + np.arange(len(off)))
    near = np.any([(end > a + BLOCK_S) & (end < b) for a, b in MAGNET_S], axis=0)
    far = np.all([(end < a) | (end > b + 2 * BLOCK_S) for a, b in MAGNET_S], axis=0)
    assert np.min(off[near]) > 20e-6
    assert np.max(off[far]) < 4e-6


def test_the_recorded_steps_rest_move_and_refuse(ran):
    """The first sixty, by which `make check` tries a compiler."""
    _, case, found = ran
    moves = np.asarray(case.u.still)[:60] == 0.0
    rest = np.flatnonzero(~moves)  # known after 1.5 s of it
    assert len(rest) >= 3
    assert PARAMETERS.rest.after - 2 * BLOCK_S < BLOCK_S * rest[0]
    assert BLOCK_S * rest[-1] < STILL_S + 0.5
    told = {
        name: set(np.asarray(info.code)[:60].tolist()) for name, info in found.steps.info.items()
    }
    assert told[model.REST] >= {Code.DONE, Code.MISSING}
    assert told[model.MAGNETOMETER] >= {Code.DONE, Code.MISSING, Code.REFUSED}
    assert told[model.TRAVEL] >= {Code.DONE, Code.MISSING}


def test_the_attitude_is_found_as_well_as_the_filter_says():
    problem = export_problem(PARAMETERS, 0)
    contender = problem.contenders["marg"]
    ratios = []
    for k in jnp.arange(RUNS):
        case = problem.simulate(k)
        found = run(contender.filter, contender.model, case.start, case.y, case.u, case.aux)
        belief = found.steps.posterior
        q = Rotation.from_quat(np.roll(belief.mean.q_nb.wxyz, -1, axis=-1))
        true = Rotation.from_quat(np.roll(case.truth.q_nb.wxyz, -1, axis=-1))
        error = (true * q.inv()).as_rotvec()[problem.count_from :]
        sigma = np.sqrt(np.sum(np.asarray(belief.factor) ** 2, axis=-1))[problem.count_from :, :3]
        assert np.degrees(np.sqrt(np.mean(error**2))) < 3.0
        ratios.append(np.mean((error / sigma) ** 2))
    assert problem.epoch_s[problem.count_from] == pytest.approx(COUNTED_S)
    assert np.mean(ratios) < 4.0  # errors last, so a few runs tell little


def test_each_run_is_its_own_and_comes_again():
    (one, truth), (again, _), (_, other), (_, elsewhere) = (
        simulated_hand(PARAMETERS, seed, number)
        for seed, number in [(0, 0), (0, 0), (0, 1), (1, 0)]
    )
    np.testing.assert_array_equal(one.imu.gyro, again.imu.gyro)
    assert not np.allclose(truth.gyro_bias, other.gyro_bias)
    assert not np.allclose(truth.gyro_bias, elsewhere.gyro_bias)
