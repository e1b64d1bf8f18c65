"""Arrays between loops, moved by NumPy and computed by programs, against the same by JAX."""

import shutil
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from machines import apart

from robins.program import CPP, arrays, stages
from robins.program.stages import StagedFunction

pytestmark = pytest.mark.skipif(
    not any(map(shutil.which, CPP.names)), reason="the interpreter needs a C++ compiler"
)
RUNS = 5
RNG = np.random.default_rng(1)
AT = RNG.integers(-2, 9, (4, 3))
POINTS = jnp.asarray(RNG.integers(0, 6, (7, 1)))
SOME = RNG.normal(size=(6, 4))


def moved(x):
    """All that moves entries: (6, 4) of a run."""
    first, second = jnp.split(x, [2])
    return {
        "joined": jnp.concatenate([x, SOME, first], 0),
        "stacked": jnp.stack([x, 2.0 * x], 1),
        "turned": jnp.transpose(x.reshape(2, 3, 4), (2, 0, 1))[::-1],
        "part": x[1:6:2, 1:],
        "padded": lax.pad(x, -1.5, ((1, 2, 1), (-1, 0, 0))),
        "tiled": jnp.tile(second, (2, 3)),
        "wide": jnp.broadcast_to(x[:, None, :1], (6, 3, 1)),
    }


def indexed(mode, x):
    """Gathers and scatters at indices that are known, some of them outside."""
    rows = x.at[AT[:, 0]].get(mode=mode, fill_value=7.5)
    pairs = x.at[AT[:, 1], AT[:, 2] % 4].get(mode=mode)
    put = x.at[jnp.asarray([4, 1, 11, -13])].set(2.0 * x[:4], mode=mode)
    column = jnp.zeros((6, 4)).at[:, 2].set(x[:, 0])
    windows = jax.vmap(lambda k: lax.dynamic_slice(x, (k, 1), (2, 3)))(POINTS[:, 0])
    each = jnp.take_along_axis(x, jnp.asarray(AT[:, :1] % 6), 0, mode=mode)
    return rows, pairs, put, column, windows, each


def by_run(x):
    """Entries at an index that depends on the run; sums, products, factors, draws, a short scan."""
    place = jnp.argmax(x[:, 0])
    key = jax.random.fold_in(jax.random.key(5), place)
    q, r = jnp.linalg.qr(x)
    last, rows = lax.scan(lambda s, row: (s + row, s * row), x[0], x, reverse=True)
    return {
        "picked": x[place], "sum": jnp.sum(x, 0), "product": x.T @ x, "q": q, "r": r,
        "noise": jax.random.normal(key, (6, 2)), "keys": jax.random.split(key, 3), "last": last,
        "rows": rows, "sorted": jnp.sort(x, 1), "whole": jnp.round(x).astype(int) % 3,
        "known": jnp.cumsum(jnp.sin(SOME), 1), "scaled": x * jnp.max(x) + place.astype(float),
    }  # fmt: skip


def kind(step):
    if isinstance(step, arrays.ArrayProgram):
        return "entries" if step._entries else "written"
    return "moved"


def alike(function, within=1e-13):
    x = RNG.normal(size=(RUNS, 6, 4))
    one = StagedFunction(function, jax.ShapeDtypeStruct((6, 4), float))
    want, got = jax.vmap(function)(x), one(x)
    for (path, a), b in zip(
        jax.tree_util.tree_leaves_with_path(want), jax.tree.leaves(got), strict=True
    ):
        if jnp.issubdtype(a.dtype, jax.dtypes.prng_key):
            a, b = jax.random.key_data(a), jax.random.key_data(b)
        assert (a.shape, a.dtype) == (np.shape(b), b.dtype), path
        assert apart(a, b) <= (within if np.asarray(a).dtype == float else 0.0), path
    (stage,) = one._stages
    return {kind(step) for *_, step in stage._steps}, stage, jax.tree.leaves(got), one, x


@pytest.fixture(params=[0, 10**6], ids=["large", "small"])
def size(request, monkeypatch):
    """All arrays are large, or none is."""
    for room in (arrays, stages):
        monkeypatch.setattr(room, "LARGE", request.param)
    return request.param


def test_what_moves_entries(size):
    kinds, stage, *_ = alike(moved, 0.0)
    assert stage.refused == []
    if size:
        assert kinds == {"written"}
    else:
        assert kinds == {"moved", "entries"}  # a product by two


@pytest.mark.parametrize("mode", ["clip", "fill"])
def test_indices_that_are_known(size, mode):
    kinds, *_ = alike(partial(indexed, mode), 0.0)
    assert ("moved" in kinds) is not bool(size)


def test_what_depends_on_the_run(size):
    kinds, stage, got, one, x = alike(by_run)
    assert stage.refused == []
    assert "written" in kinds
    alone = jax.tree.leaves(one(x[2:3]))
    for a, b in zip(got, alone, strict=True):
        if not jnp.issubdtype(a.dtype, jax.dtypes.prng_key):
            np.testing.assert_array_equal(a[2], b[0])


def test_what_has_no_place_in_a_program_stays_with_jax_and_says_why(size):
    _, stage, *_ = alike(lambda x: jnp.cos(lax.digamma(1.0 + x * x)) + 1.0)
    (why,) = stage.refused
    assert "digamma" in str(why)
    assert __file__ in str(why)


def test_what_is_too_long_to_be_written_out_stays_with_jax(monkeypatch):
    monkeypatch.setattr(arrays, "MOST", 100)
    _, stage, *_ = alike(lambda x: (x @ x.T, 2.0 * x))
    assert stage.refused == []
    written = [step for *_, step in stage._steps if isinstance(step, arrays.ArrayProgram)]
    by_jax = [one for one in written if "by_jax" in one._compute.__qualname__]
    assert [e.primitive.name for one in by_jax for e in one._equations] == ["dot_general"]


def test_a_short_scan_over_large_arrays_is_written_out(size):
    def function(x):
        def rounds(s, rows):
            return s + rows[0] * rows[1][0], (jnp.sin(s), rows[0] - s)

        return lax.scan(rounds, x[0], (x, (x[:, :1], SOME)), reverse=True)

    kinds, *_ = alike(function)
    assert ("entries" in kinds) is not bool(size)


def test_values_are_dropped_after_their_last_use(monkeypatch):
    monkeypatch.setattr(arrays, "LARGE", 0)
    _, stage, *_ = alike(lambda x: jnp.sin(jnp.cos(x.T)[::-1]).T)
    assert sorted(map(len, stage._dropped)) == [0, 1, 1, 1, 1]
