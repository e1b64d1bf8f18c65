"""A function of one run in stages, for many runs, against the same function batched by JAX."""

import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from machines import apart

from robins.program import CPP, LANE_FLAGS
from robins.program.stages import StagedFunction, as_jaxpr

FOUND = any(map(shutil.which, CPP.names))
pytestmark = pytest.mark.skipif(not FOUND, reason="lanes need a C++ compiler")
T, N = 240, 11
NUMBER = jax.ShapeDtypeStruct((), jnp.asarray(0).dtype)


@pytest.fixture(autouse=True, scope="module")
def quick():
    """Compile without optimisation; the bits are the same."""
    flags = tuple("-O0" if flag == "-O2" else flag for flag in LANE_FLAGS)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("robins.program.lanes.LANE_FLAGS", flags)
        patch.setattr("robins.program.stages.WORTH", 0)  # nothing is too little
        yield


def world(number):
    """World of a simulation: noise, walks, scans over them, and arithmetic along the time."""
    key = jax.random.fold_in(jax.random.key(3), number)
    a, b, c = jax.random.split(key, 3)
    noise = jax.random.normal(a, (T, 3))
    each = jax.vmap(lambda k: jax.random.normal(jax.random.fold_in(b, k), (2,)))(jnp.arange(T))
    keys = jax.random.split(c, T)
    coins = jax.vmap(lambda k: jax.random.uniform(k, ()))(keys)
    time = 0.01 * jnp.arange(T, dtype=float)

    def step(x, row):
        w, t = row
        x = 0.9 * x + jnp.tanh(w) * jnp.sin(t)
        return x, (x[::-1], jnp.sum(x) > 0.0)

    last, (path, above) = lax.scan(step, jnp.zeros(3), (noise, time))
    walk = jnp.cumsum(noise, axis=0)
    rest = jnp.cumsum(walk[::-1], axis=0)[::-1]  # to the end
    most = lax.cummax(each[:, 0], axis=0, reverse=True)
    size = jnp.sqrt(jnp.sum(path**2, axis=1, keepdims=True)) + jnp.abs(walk)
    turned = jnp.stack([size[:, 1], -size[:, 0], each[:, 1]], axis=1)
    back, tail = lax.scan(lambda s, r: (s + r[0], s * r[1]), 0.0, each, reverse=True)
    gap = jnp.where(coins > 0.8, jnp.nan, turned @ jnp.array([1.0, 2.0, 3.0]))
    return {
        "last": last, "above": above, "walk": walk, "rest": rest, "most": most, "turned": turned,
        "back": back, "tail": tail, "gap": gap, "steps": jnp.diff(walk, axis=0), "time": time,
        "keys": jax.random.key_data(keys), "outer": turned[:, :, None] * path[:, None, :],
        "mean": jnp.mean(size, axis=0), "const": 2.0, "bits": jax.random.bits(a, (T, 2), "uint32"),
    }  # fmt: skip


def close(want, got, within=1e-13):
    for (path, a), b in zip(
        jax.tree_util.tree_leaves_with_path(want), jax.tree.leaves(got), strict=True
    ):
        a, b = np.asarray(a), np.asarray(b)
        assert (a.shape, a.dtype) == (b.shape, b.dtype), path
        assert apart(a, b) <= (within if a.dtype == float else 0.0), path


@pytest.fixture(scope="module")
def staged(quick):
    return StagedFunction(world, NUMBER)


def test_a_simulation(staged):
    runs = jnp.arange(5, 5 + N)
    close(jax.jit(jax.vmap(world))(runs), staged(runs))
    assert [loop.refused for loop in staged.loops if loop.refused] == []
    assert {loop.axis for loop in staged.loops} >= {(T, False), (T, True)}


def test_a_run_has_the_bits_of_a_run_alone(staged):
    many, alone = staged(jnp.arange(N)), staged(jnp.array([7]))
    for a, b in zip(jax.tree.leaves(many), jax.tree.leaves(alone), strict=True):
        np.testing.assert_array_equal(np.asarray(a)[7], np.asarray(b)[0])


def some_of_one_run(number):
    """All of a world, and some of it that is wanted of one run only."""
    made = world(number)
    alone = ("above", "tail", "back", "mean", "outer", "const", "keys", "time", "walk")
    return {k: v for k, v in made.items() if k not in alone[:5]}, {k: made[k] for k in alone}


def test_what_is_wanted_of_one_run_is_kept_of_the_first():
    runs = jnp.arange(5, 5 + N)
    many, one = StagedFunction(some_of_one_run, NUMBER, named=True)(runs)
    want, first = some_of_one_run(5)
    close(jax.tree.map(lambda x: np.asarray(x)[None], first), one)
    close(want, jax.tree.map(lambda x: np.asarray(x)[0], many))
    assert {x.shape[0] for x in jax.tree.leaves(many)} == {N}
    held = [
        x if x.base is None else x.base for x in jax.tree.leaves(one) if isinstance(x, np.ndarray)
    ]
    assert all(x.nbytes <= 8 * 9 * T for x in held)  # "outer" of one run is the largest


def test_values_are_dropped_after_their_last_use(staged, monkeypatch):
    """The bytes of a run are those that are held at the fullest stage, counted there."""
    runs, held = jnp.arange(N), []
    staged(runs)

    def watching(kind):
        call = kind.__call__

        def called(self, count, values):
            made = call(self, count, values)
            mine = [x for v, x in (values | made).items() if v in staged._batched]
            held.append(sum(x.nbytes for x in mine))
            return made

        monkeypatch.setattr(kind, "__call__", called)

    for kind in {type(one) for one in staged._stages}:
        watching(kind)
    staged(runs)
    within = max(one.touched.within for one in staged._stages)
    assert max(held) / N <= staged.bytes_of_run <= max(held) / N + within


def test_what_goes_along_one_axis_is_one_loop():
    def function(x):
        rows = jnp.sin(x) * jnp.arange(T, dtype=float)[:, None] / T
        total, sums = lax.scan(lambda s, r: (s + r, s), jnp.zeros(3), rows)
        return jnp.cos(sums) + 1.0, total

    one = StagedFunction(function, jax.ShapeDtypeStruct((T, 3), float))
    x = np.random.default_rng(0).normal(size=(N, T, 3))
    close(jax.vmap(function)(x), one(x))
    (loop,) = one.loops
    assert len(loop.body.rows) == 2  # x, and the numbers of the rows, which are known
    assert len(loop.body.made) == 1


def test_zeros_that_do_not_hold_are_not_taken_for_granted():
    def function(x):
        return lax.scan(lambda s, r: (0.5 * s, s @ s), x, jnp.arange(100.0))[1]

    one = StagedFunction(function, jax.ShapeDtypeStruct((2, 2), float))
    zeros = np.zeros((N, 2, 2)) + np.diag([1.0, 2.0])
    close(jax.vmap(function)(zeros), one(zeros))
    before = one.loops[0].rounds.program
    assert before.zeros[1].tolist() == [[False, True], [True, False]]
    full = np.random.default_rng(0).normal(size=(N, 2, 2))
    close(jax.vmap(function)(full), one(full))
    assert one.loops[0].rounds.program is not before


def test_what_has_no_place_stays_with_jax_and_says_why():
    def function(x):
        return lax.scan(lambda s, r: (s, lax.digamma(s + r)), 1.0, x)[1] + 1.0

    one = StagedFunction(function, jax.ShapeDtypeStruct((T,), float))
    x = np.random.default_rng(0).uniform(size=(N, T))
    close(jax.vmap(function)(x), one(x))
    (loop,) = [loop for loop in one.loops if loop.refused]
    assert "digamma" in str(loop.refused)
    assert __file__ in str(loop.refused)


def test_calls_are_written_out():
    flat, _ = as_jaxpr(jax.jit(lambda x: jax.jit(jnp.cos)(jax.jit(jnp.sin)(x))), NUMBER)
    assert [e.primitive.name for e in flat.eqns][-2:] == ["sin", "cos"]


@pytest.mark.parametrize("kind", ["float64", "int64", "int32", "uint32", "uint64", "bool"])
def test_rows_of_every_kind(kind):
    def function(x):
        return lax.scan(lambda s, r: (r, s), x[0], x, reverse=True)

    # Trivial rounds, which are worth nothing: all the more of them.
    one = StagedFunction(function, jax.ShapeDtypeStruct((50, 2), kind))
    x = np.random.default_rng(0).integers(0, 2**31, (3, 50, 2)).astype(kind)
    close(jax.vmap(function)(x), one(x), 0.0)
    assert one.loops
