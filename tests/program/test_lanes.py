"""Lanes, and the machine for one run and for many: each run has the bits of its own in C."""

import ctypes
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from machines import quickly, stepping
from rule_table import RULES, START, Y, line

from robins.filters import kalman
from robins.program import CPP, LANE_FLAGS, Native, build, function, header, interpreted_step, trace
from robins.program.interpreter import interpreted_rounds
from robins.program.lanes import CompiledRounds

FOUND = any(map(shutil.which, CPP.names))
pytestmark = pytest.mark.skipif(not FOUND, reason="lanes need a C++ compiler")
FLAGS = tuple("-O0" if flag == "-O2" else flag for flag in LANE_FLAGS)


def in_lanes(program, lanes):
    """A program on arrays with a trailing axis of lanes."""
    text = header("lanes.h") + 'extern "C" {\n' + function(program) + "}\n"
    return ctypes.CDLL(str(build(text, (*FLAGS, f"-DLANES={lanes}"), CPP))).robins_step


def flat(leaves):
    """Reals, and all else, of arrays."""
    leaves = [np.asarray(x) for x in leaves]
    reals = [x.ravel() for x in leaves if x.dtype == float]
    others = [x.ravel().astype(np.int64) for x in leaves if x.dtype != float]
    return (np.concatenate([*reals, np.zeros(0)]), np.concatenate([*others, np.zeros(0, np.int64)]))


def check(step, cases, unroll=None):
    """Check lanes to the bit against one run after the other."""
    program = trace(step, *cases[0], unroll=unroll)
    one = Native(program, quickly)
    given = [flat(jax.tree.leaves(case)) for case in cases]
    want = [flat(jax.tree.leaves(one(*case))) for case in cases]
    x, k = (np.ascontiguousarray(np.stack(rows, axis=-1)) for rows in zip(*given, strict=True))
    y, m = (np.zeros_like(np.stack(rows, axis=-1)) for rows in zip(*want, strict=True))
    in_lanes(program, len(cases))(*(ctypes.c_void_p(a.ctypes.data) for a in (x, k, y, m)))
    for lane, (reals, others) in enumerate(want):
        np.testing.assert_array_equal(y[:, lane], reals)
        np.testing.assert_array_equal(m[:, lane], others)
    interpreted = Native(program, interpreted_step)
    many = in_one_round(program, cases)
    for lane, (case, (reals, others)) in enumerate(zip(cases, want, strict=True)):
        for got in (jax.tree.leaves(interpreted(*case)), [a[lane, 0] for a in many]):
            np.testing.assert_array_equal(flat(got)[0], reals)
            np.testing.assert_array_equal(flat(got)[1], others)


def in_one_round(program, cases):
    """The results of some runs at a time on the machine, with axes of runs and of one round."""
    given = [np.stack(rows) for rows in zip(*map(jax.tree.leaves, cases), strict=True)]
    rounds = CompiledRounds(program, 1, 0, len(given), engine=interpreted_rounds)
    return rounds(len(cases), [(a, True) for a in given])


@pytest.mark.parametrize(("lanes", "unroll"), [(8, None), (4, 200), (2, None), (1, None)])
def test_a_filter(lanes, unroll):
    model = line()
    one = kalman(rules=[RULES["gate"], RULES["h_infinity"]])
    state = jax.tree.map(jnp.asarray, one.init(START, model.dims))
    state = jax.tree.map(lambda x: jnp.asarray(x, x.dtype), state)
    spread = [
        state._replace(belief=state.belief._replace(mean=state.belief.mean + 0.1 * k))
        for k in range(lanes)
    ]
    rows = [Y[3], Y[4], Y[7], Y[9], Y[11], np.full(3, np.inf), Y[0], Y[1]]
    cases = [(s, None, {"y": y}, {}) for s, y in zip(spread, rows, strict=False)]
    check(stepping(one, model), cases, unroll)


def numbers(x, k, u, c):
    """Operations that a filter may not use: words, conversions, loops ended by numbers, indices."""
    i = jnp.clip(k, 0, 8)
    return (
        jax.lax.while_loop(lambda s: s < 100.0, lambda s: s * 1.7, jnp.abs(x[0]) + 1.0),
        x[i], x.at[i].set(0.0), jnp.floor(x), jnp.round(x), jnp.sqrt(jnp.abs(x)),
        jnp.sin(100.0 * x),
        jnp.cos(1e7 * x), jnp.exp(x), jnp.arctan2(x, x[::-1]), x.astype(int), k.astype(float),
        jnp.where(c, k, -k), k // 3, jnp.sign(x), jnp.maximum(k, 2), c.astype(int), c.astype(float),
        u * u + 7, u >> 3, jnp.where(c, u, u + 1), u.astype(jnp.uint64) << 5, jnp.linalg.eigvalsh(
            x[:5, None] @ x[None, :5]), jnp.linalg.inv(x[:3, None] @ x[None, :3] + jnp.eye(3)),
        jnp.isfinite(x), jnp.nextafter(x, 0.0), jnp.argsort(x), ~c & (x[0] > 0.0),
    )  # fmt: skip


def test_all_kinds_of_numbers():
    rng = np.random.default_rng(0)
    cases = [
        (rng.normal(size=9), np.int64(k - 2), np.uint32(2**31 + 77 * k), np.bool_(k % 2))
        for k in range(8)
    ]
    check(numbers, cases)
    check(numbers, cases, unroll=0)
