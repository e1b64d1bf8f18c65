"""A filter stepped live in C against the same by JAX: numbers, codes, errors, what is kept."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from machines import apart
from rule_table import ACTING, START, M, N, Y, line
from two_sensors import SYSTEMS, split

from robins.filters import (
    Belief,
    Code,
    Model,
    Motion,
    OnlineFilter,
    Sensor,
    imm,
    kalman,
    unscented,
)
from robins.filters.machine import usual
from robins.filters.rules import Infeasible, gate, h_infinity, with_gamma
from robins.program import BuildError, NativeState, ProgramError, trace

# Compiled without optimisation, which is quicker for so few calls; the bits are the same.
C = NativeState
EKF, MODEL = kalman(), line()


def both(filter_, model, start=START):
    return (OnlineFilter(filter_, model, start, machine) for machine in ("jax", C))


def close(want, got, within=1e-12):
    """The same structure, types and shapes; numbers within parts of the largest of an array."""
    assert jax.tree.structure(want) == jax.tree.structure(got)
    told = jax.tree_util.tree_flatten_with_path(want)[0]
    for (path, a), b in zip(told, jax.tree.leaves(got), strict=True):
        where = jax.tree_util.keystr(path)
        assert (np.shape(a), np.asarray(a).dtype) == (np.shape(b), np.asarray(b).dtype), where
        size = np.max(np.abs(a), initial=1e-3, where=np.isfinite(a))  # what is zero is rounding
        assert apart(a, b, size) <= within, (where, a, b)


def spoilt(rows):
    y = rows.copy()
    y[3] = np.inf
    y[5, 1] = 1e200
    y[6, 0] = np.nan
    return y


@pytest.mark.parametrize("way", ["learning", "plain"])
def test_it_gives_what_jax_gives(way):
    one = kalman(unscented(), ACTING["learning"]) if way == "learning" else EKF
    live, c = both(one, MODEL)
    for row in spoilt(Y):
        close(live.predict(), c.predict())
        close(live.update(row), c.update(row))
        close(live.state, c.state)
        assert c.belief is c.state.belief
    assert c.counts == live.counts
    assert {"DONE", "MISSING", "PARTLY_MISSING", "NOT_FINITE"} <= set(c.counts)


def test_the_memory_grows_to_what_its_programs_need_and_stays():
    _, c = both(EKF, MODEL)
    for _ in range(2):
        c.predict()
        c.update(Y[0])
    memory = c._machine._memory
    there = dict(memory._calls)
    assert len(there) == 2
    for _ in range(3):
        c.predict()
        c.update(Y[0])
    assert all(memory._calls[name] is call for name, call in there.items())


def moved(step):
    return step.posterior.mean, step.info["a"].nis


def test_a_whole_step_is_one_call_and_keeps_what_is_asked():
    s = SYSTEMS[0]
    live, c = both(EKF, split(s), s.start())
    for k in range(4):
        y = {"a": np.array([0.1 * k, np.nan]), "b": np.array([1.0])}
        close(live.step(y), c.step(y))
        close(live.step(y, keep=moved), c.step(y, keep=moved))
        # the memory has grown for the step meanwhile; smaller programs live in it too
        close(live.predict(), c.predict())
        close(live.update([0.1, 0.2], "a"), c.update([0.1, 0.2], "a"))
        close(live.state, c.state)
    assert c.counts == live.counts


def test_a_state_can_be_read_kept_and_restored():
    live, c = both(EKF, MODEL)
    for one in (live, c):
        one.predict()
        one.update(Y[0])
    saved = c.state
    kept = jax.tree.map(np.copy, saved)
    ahead = c.predict()
    close(kept, saved, 0.0)  # what was read is not memory that the next call writes to
    after = jax.tree.map(np.copy, ahead)
    c.update(Y[1])
    close(after, ahead, 0.0)
    c.state = saved
    close(ahead, c.predict(), 0.0)
    c.state = live.state  # of JAX
    close(ahead, c.predict())
    live.state = saved  # and back
    close(live.predict(), ahead)
    close(OnlineFilter(EKF, MODEL, saved, C).predict(), ahead, 0.0)
    with pytest.raises(ProgramError, match=r"state.belief.mean: float64\(3,\) was given where"):
        c.state = saved._replace(belief=Belief(saved.belief.mean[:3], saved.belief.factor))
    with pytest.raises(ProgramError, match="another structure"):
        c.state = saved._replace(memory=(1.0,))


def test_it_refuses_what_jax_refuses():
    for live in both(EKF, split(SYSTEMS[0]), SYSTEMS[0].start()):
        live.predict()
        live.update(np.array([3], dtype=np.int32), "b")
        with pytest.raises(ValueError, match=r"name one of the sensors \['a', 'b'\]"):
            live.update([0.1])
        with pytest.raises(KeyError, match="no sensor 'gps'"):
            live.update([0.1], "gps")
        with pytest.raises(TypeError, match="measurements of 'b' hold <U4"):
            live.update(["fast"], "b")
        with pytest.raises(
            ValueError, match=r"sensor .a. reads shape \(2,\), but was given \(3,\)"
        ):
            live.update(np.zeros(3), "a")
        assert live.counts == {"DONE": 1}


def test_a_memory_that_reports_is_asked_after_every_call():
    """An H-infinity filter whose bound does not exist raises, and goes on with another one."""
    one = kalman(rules=[h_infinity(0.3, np.eye(N))])
    told = []

    def run_on(live):
        for row in Y:
            live.predict()
            live.update(row)

    for live in both(one, MODEL):
        with pytest.raises(Infeasible, match="at step") as caught:
            run_on(live)
        told.append((str(caught.value), live.counts))
        machine = C if live._machine.is_numpy else "jax"
        onward = OnlineFilter(with_gamma(one, 1e3), MODEL, live.state, machine)
        assert int(onward.predict().code) == Code.DONE
    assert told[0] == told[1]


def test_numbers_of_a_filter_are_on_the_device():
    """Numbers of a filter: by JAX none is handed over at each call."""
    leaves = jax.tree.leaves(OnlineFilter(kalman(rules=[gate()]), MODEL, START)._machine._filter)
    assert leaves
    assert all(isinstance(x, jax.Array) for x in leaves)


def test_a_filter_without_anything_to_report_is_not_asked(monkeypatch):
    bound = kalman(rules=[h_infinity(3.0, np.eye(N))])
    even = np.full((2, 2), 0.5)
    silent = (kalman(rules=[gate()]), imm([kalman(), kalman()], even))
    assert not any(one.reports for one in silent)
    assert bound.reports
    assert imm([kalman(), bound], even).reports
    asked = []
    monkeypatch.setattr(type(bound), "report", lambda *given: asked.append(given))
    for one in (silent[0], bound):
        OnlineFilter(one, MODEL, START).predict()
    assert [given[0] for given in asked] == [bound]


def swing(x, u):
    return x + 0.1 * jnp.stack([x[1], -9.8 * jnp.sin(x[0]) + u])


PENDULUM = Model(
    Motion(swing, 0.1 * np.ones(2)), (Sensor(lambda x, aux: x[:1] - aux, np.ones(1), 1),)
)
SMALL = Belief(jnp.array([0.5, 0.0]), jnp.array([[0.3, 0.0], [0.1, 0.5]]))


def test_a_program_is_made_once_for_filters_and_models_that_differ_in_numbers(monkeypatch):
    traced = []

    def heard(function, *args, **how):
        traced.append(function)
        return trace(function, *args, **how)

    monkeypatch.setattr("robins.program.memory.trace", heard)
    for noise, programs in (([0.3, 0.2], 1), ([0.3, 0.2], 1), ([4.0, 7.0], 1), ([0.0, 7.0], 2)):
        model = Model(Motion(swing, np.array(noise)), PENDULUM.sensors)
        live, c = both(kalman(), model, SMALL)
        close(live.predict(0.5), c.predict(0.5))
        close(live.state, c.state)
        assert len(traced) == programs  # zeros are a part of it


def test_inputs_of_another_type_or_shape_have_programs_of_their_own():
    live, c = both(kalman(), PENDULUM, SMALL)
    # of 0.75 in the place of a whole number nothing would be left
    for aux in (1, 0.75, jnp.array([0.75]), np.array([0.5]), np.float64(0.25)):
        close(live.predict(1.5), c.predict(1.5))
        close(live.update(np.array([0.2]), aux=aux), c.update(np.array([0.2]), aux=aux))
    close(live.state, c.state)


def ahead(filter_, model, state, u):
    return filter_.predict(state, model.motion, u)[0].belief.mean


def test_a_look_leaves_the_state_where_it_was():
    live, c = both(kalman(), PENDULUM, SMALL)
    for one in (live, c):
        one.predict(0.5)
    before = c.state
    close(live.look(ahead, 0.7), c.look(ahead, 0.7))
    close(before, c.state, 0.0)
    close(c.look(ahead, 0.5), c.predict(0.5).belief.mean, 0.0)


def test_what_has_no_place_in_c_is_named_with_its_line():
    def turned(x, u):
        return jnp.linalg.svd(jnp.outer(x, x) + jnp.eye(M))[0][0]

    model = Model(Motion(turned, np.ones(M)), ())
    live = OnlineFilter(kalman(), model, Belief(jnp.ones(M), jnp.eye(M)), "c")
    with pytest.raises(ProgramError, match=r"test_online.py:\d+: .*'svd'"):
        live.predict()


def test_machines_that_are_not_there(monkeypatch):
    with pytest.raises(ValueError, match="machine must be 'jax', 'vm' or 'c', got 'fpga'"):
        OnlineFilter(EKF, MODEL, START, "fpga")
    monkeypatch.setenv("CC", "no-such-compiler")
    with pytest.raises(BuildError, match="install one"):
        OnlineFilter(EKF, MODEL, START, "c")


def test_the_usual_machine_is_jax_where_no_interpreter_can_be_had(monkeypatch):
    assert usual() == "vm"

    def none():
        raise BuildError("there is no C++ compiler")

    monkeypatch.setattr("robins.program.interpreter.interpreter_of_one", none)
    assert usual() == "jax"
