"""A small filter as an exported library with its test: memories, an angle that wraps, and a gap."""

from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from robins.filters import Belief, Model, Motion, Sensor, kalman
from robins.filters.rules import huber, sage_husa
from robins.manifold import Angle
from robins.program import DOUBLE, trace_steps
from robins.program.harness import Recorded, check_c, makefile, recorded_h
from robins.program.library import Entry, Library

STEPS = 12


class State(NamedTuple):
    heading: Angle
    rate: Any


class Told(NamedTuple):
    code: Any
    used: Any


def drift(x, u):
    """The heading turns, a little faster where it is south."""
    return x._replace(heading=x.heading.retract(u * (x.rate + 0.01 * jnp.sin(x.heading.rad))))


MODEL = Model(
    Motion(drift, np.array([0.01, 0.02])),
    (Sensor(lambda x, aux: x.heading, np.array([0.1]), 1, "compass"),),
)
FILTER = kalman(rules=[huber(0.95), sage_husa(0.98)])


def predict(state, u):
    state, prediction = FILTER.predict(state, MODEL.motion, u)
    return state, Told(prediction.code, jnp.ones(0, dtype=bool))


def update(state, y, aux):
    state, info = FILTER.update(state, MODEL.sensors[0], y, aux)
    return state, Told(info.code, info.used)


@cache
def made():
    """The entry points, the start, and steps by JAX: inputs, states, codes."""
    start = Belief.of(State(Angle(jnp.array(3.1)), jnp.array([0.4])), np.diag([0.1, 0.2]))
    begin = state = FILTER.init(start, MODEL.dims)
    u = np.full((STEPS, 1), 0.1)
    y = Angle(3.1 + 0.05 * np.arange(STEPS) + np.where(np.arange(STEPS) == 5, np.nan, 0.0))
    steps = [(predict, (u[0],)), (update, (Angle(y.rad[0]), None))]
    told = [
        ("predict", ("input",), "Moves on by one step."),
        ("update_compass", ("reading", "about"), "Uses a reading."),
    ]
    programs = trace_steps(steps, state)
    entries = [Entry(n, p, takes, text) for (n, takes, text), p in zip(told, programs, strict=True)]
    go, use = jax.jit(predict), jax.jit(update)
    states, codes = [], []
    for k in range(STEPS):
        state, moved = go(state, u[k])
        state, seen = use(state, Angle(jnp.asarray(y.rad[k])), None)
        states.append(state)
        codes.append([int(moved.code), int(seen.code)])
    stacked = jax.tree_util.tree_map(lambda *a: np.stack([np.asarray(x) for x in a]), *states)
    given = {"predict": (u,), "update_compass": (y, None)}
    return entries, begin, Recorded(given, stacked, np.array(codes))


def write_boat(folder, precision=DOUBLE, name="boat"):
    """Write all files of the library into a folder."""
    entries, start, record = made()
    notes = {("state", "mean_rate"): "rad/s"}
    library = Library(name, entries, start, ("A boat.",), notes, precision)
    if precision is not DOUBLE:  # twelve steps of some ten roundings each
        record = record._replace(tolerances={f.name: 120 * 6e-8 for f in library.state})
    for file, text in {
        f"{name}.h": library.header(),
        f"{name}.c": library.source(),
        "recorded.h": recorded_h(library, record),
        "test.c": check_c(library, record),
        "Makefile": makefile(library),
    }.items():
        (folder / file).write_text(text)
    return folder
