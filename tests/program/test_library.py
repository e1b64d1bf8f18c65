"""An exported library, compiled and run as its user does."""

import subprocess
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from robins.filters import Belief, Model, Motion, Sensor, kalman
from robins.filters.rules import huber, sage_husa
from robins.manifold import Angle
from robins.program import trace
from robins.program.harness import Recorded, check_c, makefile, recorded_h
from robins.program.library import Entry, Library, fields_of, number

STEPS = 12


class State(NamedTuple):
    heading: Angle
    rate: Any


class Told(NamedTuple):
    code: Any
    used: Any


MODEL = Model(
    Motion(lambda x, u: x._replace(heading=x.heading.retract(u * x.rate)), np.array([0.01, 0.02])),
    (Sensor(lambda x, aux: x.heading, np.array([0.1]), 1, "compass"),),
)
FILTER = kalman(rules=[huber(0.95), sage_husa(0.98)])


def predict(state, u):
    state, prediction = FILTER.predict(state, MODEL.motion, u)
    return state, Told(prediction.code, jnp.ones(0, dtype=bool))


def update(state, y, aux):
    state, info = FILTER.update(state, MODEL.sensors[0], y, aux)
    return state, Told(info.code, info.used)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A library with its test, of a filter with memories, an angle that wraps, and a gap."""
    start = Belief.of(State(Angle(jnp.array(3.1)), jnp.array([0.4])), np.diag([0.1, 0.2]))
    state = FILTER.init(start, MODEL.dims)
    u = np.full((STEPS, 1), 0.1)
    y = Angle(3.1 + 0.05 * np.arange(STEPS) + np.where(np.arange(STEPS) == 5, np.nan, 0.0))
    entries = [
        Entry("predict", trace(predict, state, u[0]), ("input",), "Moves on by one step."),
        Entry(
            "update_compass", trace(update, state, Angle(y.rad[0]), None), ("reading", "about"), ""
        ),
    ]
    library = Library("boat", entries, state, ("A boat.",), {("state", "mean_rate"): "rad/s"})
    states, codes = [], []
    for k in range(STEPS):
        state, moved = predict(state, u[k])
        state, seen = update(state, Angle(jnp.asarray(y.rad[k])), None)
        states.append(state)
        codes.append([int(moved.code), int(seen.code)])
    stacked = jax.tree_util.tree_map(lambda *a: np.stack([np.asarray(x) for x in a]), *states)
    record = Recorded({"predict": (u,), "update_compass": (y, None)}, stacked, np.array(codes))
    made = tmp_path_factory.mktemp("boat")
    for name, text in {
        "boat.h": library.header(),
        "boat.c": library.source(),
        "recorded.h": recorded_h(library, record),
        "test.c": check_c(library, record),
        "Makefile": makefile(library),
    }.items():
        (made / name).write_text(text)
    return made


def check(folder, *settings):
    return subprocess.run(
        ["make", "-B", "-C", str(folder), "check", *settings], capture_output=True, text=True
    )


def test_it_is_what_jax_computes_and_no_compiler_warns(folder):
    done = check(folder, "CC=cc -Werror")
    assert done.returncode == 0, done.stderr
    assert f"{STEPS} steps: 0 codes differ" in done.stdout
    assert "passed" in done.stdout
    codes = (folder / "recorded.h").read_text().split("codes[STEPS]")[1]
    assert "{0, 1}" in codes  # the gap is in the record


@pytest.mark.parametrize(
    ("file", "old", "new"),
    [
        ("boat.c", "const real r", "real const r"),  # nothing changes
        ("boat.c", "{0.4}", "{0.4000001}"),  # the rate to begin with
        ("recorded.h", "{0, 1}", "{0, 0}"),  # a code
    ],
)
def test_its_test_sees_what_is_wrong(folder, tmp_path, file, old, new):
    for one in folder.iterdir():
        if one.suffix in (".c", ".h") or one.name == "Makefile":
            (tmp_path / one.name).write_text(one.read_text())
    text = (tmp_path / file).read_text()
    assert old in text
    (tmp_path / file).write_text(text.replace(old, new, 1 if file == "recorded.h" else -1))
    done = check(tmp_path)
    assert (done.returncode == 0) == (new == "real const r"), done.stdout


def test_fields_have_the_names_of_the_model(folder):
    text = (folder / "boat.h").read_text()
    assert "boat_real mean_heading_rad;" in text
    assert "boat_real mean_rate[1]; /* rad/s */" in text
    assert "boat_real factor[2][2];" in text
    assert "int boat_predict(boat_state *state, const boat_predict_input *input," in text
    assert "boat_update_compass_about" not in text  # it takes nothing


def test_fields_lie_where_the_program_has_them():
    def function(state, row):
        return state, row

    row = {"a": jnp.zeros((2, 3)), "b": jnp.zeros((), dtype=bool), "none": jnp.zeros((0, 4))}
    program = trace(function, {"x": jnp.zeros(2), "n": jnp.zeros(3, dtype=int)}, row)
    assert [(f.name, f.at, f.size) for f in fields_of(program.inputs, 0)] == [
        ("n", 0, 3),
        ("x", 0, 2),
    ]
    assert [(f.name, f.at, f.is_real) for f in fields_of(program.inputs, 1)] == [
        ("a", 2, True),
        ("b", 3, False),
    ]


def test_numbers_are_written_to_the_bit():
    assert float(number(0.1 + 0.2, True)) == 0.1 + 0.2
    assert [number(x, True) for x in (np.nan, np.inf, -np.inf)] == ["NAN", "INFINITY", "-INFINITY"]
    assert number(True, False) == "1"
