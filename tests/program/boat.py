"""A small filter as an exported library with its test: memories, an angle that wraps, and a gap."""

from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from robins.export.harness import RecordedSteps, check_c, makefile, recorded_h
from robins.export.library import EntryPoint, Library
from robins.export.runs import BoardRun, by_jax, entry_functions, reset_function
from robins.filters import Belief, Model, Motion, Sensor, kalman
from robins.filters.rules import huber, sage_husa
from robins.manifold import Angle
from robins.program import DOUBLE, trace_steps

STEPS = 12


class State(NamedTuple):
    heading: Angle
    rate: Any


class Drive(NamedTuple):
    """Names that a header of C cannot use as they are: a macro of complex.h, and a word of C++."""

    I: Any  # noqa: E741 s
    new: Any  # rad/s


def drift(x, u):
    """The heading turns, a little faster where it is south."""
    rate = x.rate + 0.01 * jnp.sin(x.heading.rad) + u.new
    return x._replace(heading=x.heading.retract(u.I * rate))


MODEL = Model(
    Motion(drift, np.array([0.01, 0.02])),
    (Sensor(lambda x, aux: x.heading, np.array([0.1]), 1, "steering compass"),),
)
FILTER = kalman(rules=[huber(0.95), sage_husa(0.98)])
UPDATE = "update_steering compass"


@cache
def made():
    """The entry points, the start, and steps by JAX: inputs and outputs."""
    belief = Belief.of(State(Angle(jnp.array(3.1)), jnp.array([0.4])), np.diag([0.1, 0.2]))
    start = jax.tree.map(jnp.asarray, FILTER.init(belief, MODEL.dims))
    u = Drive(np.full(STEPS, 0.1), np.zeros(STEPS))
    y = Angle(3.1 + 0.05 * np.arange(STEPS) + np.where(np.arange(STEPS) == 5, np.nan, 0.0))
    run = BoardRun(None, start, {"predict": (u,), UPDATE: (y, None)})
    functions = entry_functions(FILTER, MODEL, run.given)
    anew = reset_function(FILTER, start)
    steps = [(function, run.row(0)[name]) for name, function in functions.items()]
    programs = trace_steps([*steps, (anew, (belief,))], start)
    told = [
        ("predict", ("input",), "Propagates the state by one step."),
        (UPDATE, ("reading", "about"), "Uses a reading."),
        ("reset", ("belief",), "Begins again."),
    ]
    entries = [
        EntryPoint(n, p, takes, text) for (n, takes, text), p in zip(told, programs, strict=True)
    ]
    calls = by_jax(functions, run, dict)
    last = jax.tree.map(lambda a: a[-1], calls[UPDATE][0])
    calls["reset"] = jax.tree.map(lambda a: np.asarray(a)[None], jax.jit(anew)(last, belief))
    result = f"{entries[1].symbol}_result"
    sizes = {(result, "nis"): 1.0, (result, "innovation"): 0.3}
    return entries, start, RecordedSteps(run.given, calls, sizes=sizes, ends={"reset": (belief,)})


def write_boat(folder, precision=DOUBLE, name="boat"):
    """Write all files of the library into a folder."""
    entries, start, record = made()
    notes = {("state", "mean_rate"): "rad/s"}
    library = Library(name, entries, start, ("A boat.",), notes, precision)
    if precision is not DOUBLE:  # twelve steps of some ten roundings each
        keys = [("state", f.name) for f in library.state]
        for entry in entries:
            keys += [(f"{entry.symbol}_result", f.name) for f in library.result(entry)]
        record = record._replace(tolerances=dict.fromkeys(keys, 120 * 6e-8))
    for file, text in {
        f"{name}.h": library.header(),
        f"{name}.c": library.source(),
        "recorded.h": recorded_h(library, record),
        "test.c": check_c(library, record),
        "Makefile": makefile(library),
    }.items():
        (folder / file).write_text(text)
    return folder
