"""A scan by the interpreter, and programs that the cache knows by the names of functions."""

import enum
import importlib
import shutil
from collections import OrderedDict

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from robins.filters import Belief, Model, Motion, Sensor, kalman, run, unscented
from robins.filters.rules import huber
from robins.filters.run import Solution, everything, nothing
from robins.program import CPP, NativeState, ProgramError, kept, names, scanned
from robins.program.names import by_name
from robins.program.scanned import scan
from robins.rotation import Rotation

memory_module = importlib.import_module("robins.program.memory")
pytestmark = pytest.mark.skipif(
    not any(map(shutil.which, CPP.names)), reason="the interpreter needs a C++ compiler"
)
RNG = np.random.default_rng(0)
ROWS = {"x": RNG.normal(size=(40, 3)), "n": RNG.integers(0, 9, 40)}
CARRY = (np.zeros(3), np.array(0), np.array(False), np.array([1.0, 0.0, 0.0, 0.0]))


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    """A cache of its own, of programs of any size."""
    for name, value in (("WORTH", 0), ("cache_folder", lambda: tmp_path)):
        monkeypatch.setattr(kept, name, value)
    return tmp_path


def body(carry, row):
    total, count, odd, q = carry
    turned = Rotation(q).retract(1e-2 * row["x"])
    now = total + row["x"], count + row["n"], odd ^ (row["n"] % 2 == 1), turned.wxyz
    return now, {"turned": turned, "both": (jnp.sum(total), count)}


def test_it_gives_what_jax_gives():
    found, want = (
        scan(body, "walk", CARRY, ROWS),
        lax.scan(body, jax.tree.map(jnp.asarray, CARRY), ROWS),
    )
    assert jax.tree.structure(found) == jax.tree.structure(want)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(want), strict=True):
        assert a.dtype == b.dtype
        np.testing.assert_allclose(a, b, rtol=1e-14, atol=1e-15)


def moved(row):
    x, turn = row
    return {"x": Rotation(x).retract(turn), "length": jnp.sum(turn**2)}


def test_a_function_is_computed_on_each_row_with_an_interpreter_and_without(monkeypatch):
    q = RNG.normal(size=(30, 4))
    rows = q / np.linalg.norm(q, axis=1)[:, None], RNG.normal(size=(30, 3))
    found = scanned.mapped_rows(moved, rows)
    monkeypatch.setattr(scanned, "_can_interpret", lambda: False)
    want = scanned.mapped_rows(moved, rows)
    assert jax.tree.structure(found) == jax.tree.structure(want)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(want), strict=True):
        assert isinstance(a, np.ndarray)
        np.testing.assert_allclose(a, b, rtol=1e-14, atol=1e-15)
    np.testing.assert_allclose(found["length"], np.sum(rows[1] ** 2, axis=1), rtol=1e-14)


def test_a_round_that_leaves_another_form_is_refused():
    with pytest.raises(ProgramError, match="another form"):
        scan(lambda c, r: (c[:2], r["x"]), "shorter", CARRY, ROWS)


@pytest.fixture
def named(monkeypatch):
    """Functions of this file have names, and the process remembers nothing."""
    monkeypatch.setattr(names, "NAMED", {*names.NAMED, __name__})

    def forget():
        monkeypatch.setattr(scanned, "_known", OrderedDict())

    forget()
    return forget


def never(*_args, **_named):
    raise AssertionError("traced")


def another(carry, row):
    return carry, row["x"]


def test_the_second_time_nothing_is_traced(monkeypatch, named):
    want = scan(body, "walk", CARRY, ROWS)
    named()
    monkeypatch.setattr("robins.program.scanned.trace", never)
    monkeypatch.setattr("jax.eval_shape", never)
    found = scan(body, "walk", CARRY, ROWS)
    assert jax.tree.structure(found) == jax.tree.structure(want)
    jax.tree.map(np.testing.assert_array_equal, found, want)
    with pytest.raises(AssertionError, match="traced"):
        scan(body, "another", CARRY, ROWS)
    with pytest.raises(AssertionError, match="traced"):
        scan(another, "walk", CARRY, ROWS)
    with pytest.raises(AssertionError, match="traced"):
        scan(body, "walk", CARRY, ROWS | {"n": ROWS["n"].astype(np.int32)})


def constant(x, u):
    return x + u


def distance(x, _):
    return jnp.hypot(x[0], x[1])[None]


MODEL = Model(
    Motion(constant, noise=0.1 * np.eye(2)), (Sensor(distance, np.array([[0.2]]), 1, "r"),)
)
START = Belief(np.array([3.0, 4.0]), np.eye(2))
Y, U = 5.0 + RNG.normal(size=(60, 1)), 0.01 * RNG.normal(size=(60, 2))
Y[7] = np.nan


def test_a_run_by_the_interpreter_is_the_run_by_jax():
    whole = kalman(unscented(), rules=(huber(),))
    for filter_, keep in ((whole, everything), (kalman(), nothing)):
        found, want = (
            run(filter_, MODEL, START, Y, U, keep=keep, machine=m) for m in ("vm", "jax")
        )
        assert isinstance(found, Solution)
        assert jax.tree.structure(found) == jax.tree.structure(want)
        for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(want), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-11, atol=1e-13)


def test_a_state_steps_without_tracing_once_the_cache_knows_its_program(monkeypatch):
    def stepped():
        monkeypatch.setattr("robins.program.memory._known", OrderedDict())
        memory = NativeState(np.array([1.0, 2.0]), "adder", persistent=True)
        told = memory.step(
            "add", lambda s, u: (s + u, Belief(s * u, (s - u)[None])), np.array([3.0, 0.5])
        )
        return memory.state, told, memory.step("sum", lambda s: (s, jnp.sum(s)))

    want = stepped()
    monkeypatch.setattr("robins.program.memory.trace", never)
    found = stepped()
    assert isinstance(found[1], Belief)
    jax.tree.map(np.testing.assert_array_equal, found, want)
    np.testing.assert_array_equal(found[0], [4.0, 2.5])


def test_a_function_with_no_name_is_traced_in_each_process():
    """A text may stand for another function there: nothing is kept unless it is asked for."""
    for f in (lambda s, u: (s + u, u), lambda s, u: (s - u, u)):
        memory = NativeState(np.ones(2), "mine")
        memory.step("advance", f, np.ones(2))
        np.testing.assert_array_equal(memory.state, f(np.ones(2), np.ones(2))[0])
        memory_module._known.clear()


def test_without_a_round_nothing_changes():
    rows = {"x": np.zeros((0, 3)), "n": np.zeros(0, int)}
    carry, kept_ = scan(body, "walk", CARRY, rows)
    jax.tree.map(np.testing.assert_array_equal, carry, CARRY)
    assert kept_["turned"].wxyz.shape == (0, 4)


def test_what_no_program_takes_is_refused():
    for x in (np.zeros(3, np.int16), jax.random.split(jax.random.key(0), 3)):
        with pytest.raises(ProgramError, match="no place"):
            scan(lambda c, r: (c, r), "any", np.zeros(2), x)
    for rows in ((), (np.zeros(3), np.zeros(2)), np.zeros(())):
        with pytest.raises(ValueError, match="rows must be arrays of one length"):
            scan(lambda c, r: (c, r), "any", np.zeros(2), rows)
    with pytest.raises(ValueError, match="machine must be 'jax' or 'vm', got 'c'"):
        run(kalman(unscented()), MODEL, START, Y, U, machine="c")


class Colour(enum.IntEnum):
    RED = 1


def test_names_are_of_robins_and_tell_values_apart():
    some = [
        1,
        1.0,
        True,
        "1",
        b"1",
        None,
        (1,),
        ((1,),),
        [1],
        Belief(1, 1),
        (1, 1),
        np.dtype(int),
        np.dtype(float),
        run,
        Belief,
    ]
    trees = [jax.tree.structure(t) for t in (1, (1,), [1], {"a": 1}, {"b": 1}, None, Belief(1, 1))]
    texts = list(map(by_name, [*some, *trees]))
    assert len(set(texts)) == len(texts)
    for stranger in (lambda: 0, constant, Colour.RED, Colour, object(), np.zeros(2), CARRY[0].sum):
        with pytest.raises(LookupError):
            by_name((1, stranger))
