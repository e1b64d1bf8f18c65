"""The same function by JAX and in C, and how far what they give is apart."""

import jax
import jax.numpy as jnp
import numpy as np

from robins.filters import FilterState, filter_step
from robins.program import FLAGS, native

# Compiled without optimisation: most programs of the tests are called once. The bits are the same.
QUICK = tuple("-O0" if flag == "-O2" else flag for flag in FLAGS)


def in_c(function, *args, unroll=None):
    """A function in C, for arguments like these."""
    return native(function, *args, unroll=unroll, flags=QUICK)


def apart(want, got, size=None):
    """The largest difference of two arrays, in parts of a size: by default of the largest number.

    Infinite where one has a NaN or an infinity that the other has not.
    """
    want, got = (np.asarray(x, dtype=float) for x in (want, got))
    if size is None:
        size = np.max(np.abs(want), initial=0.0, where=np.isfinite(want))
    same = (want == got) | (np.isnan(want) & np.isnan(got))
    with np.errstate(all="ignore"):
        off = np.where(same, 0.0, np.abs(want - got) / np.where(size > 0.0, size, 1.0))
    return float(np.max(np.where(np.isnan(off), np.inf, off), initial=0.0))


def same_in_c(function, *args, within=0.0, unroll=None, others=()):
    """Check that a function gives in C what it gives by JAX, for arguments and for others."""
    program = in_c(function, *args, unroll=unroll)
    for given in (args, *others):
        want, got = jax.jit(function)(*given), program(*given)
        assert jax.tree.structure(want) == jax.tree.structure(got)
        for a, b in zip(jax.tree.leaves(want), jax.tree.leaves(got), strict=True):
            assert (np.shape(a), a.dtype) == (np.shape(b), b.dtype)
            assert apart(a, b) <= within, (a, b)
    return program


NUDGE = 4e-16  # a rounding or two


def _sizes(series):
    """What each number of a series is small against: itself over time, or a row of its matrix."""
    size = np.max(np.abs(series), axis=0, initial=0.0, where=np.isfinite(series))
    return np.max(size, axis=-1, keepdims=True, initial=0.0) if series.ndim > 2 else size


def stepping(filter_, model):
    """A whole step of a filter as one function, and what a log has of it."""

    def step(state, u, y, aux):
        state, done = filter_step(filter_, model, state, u, y, aux)
        return state, (state.belief, state.memory, done.info, done.prediction.code)

    return step


def run_in_both(filter_, model, start, y, u=None, aux=None, unroll=None):
    """Runs by JAX, with its numbers a rounding off, and in C; series of all that is known."""
    step, rows = stepping(filter_, model), (u, y, aux or {})
    first = start if isinstance(start, FilterState) else filter_.init(start, model.dims)
    first = jax.tree.map(lambda x: jnp.asarray(x, jnp.asarray(x).dtype), first)

    def one(nudge):
        belief, (u, y, aux) = jax.tree.map(lambda x: x * (1 + nudge), (first.belief, rows))
        begun = first._replace(belief=belief)
        return jax.lax.scan(lambda s, row: step(s, *row), begun, (u, y, aux))[1]

    want = jax.jit(jax.vmap(one))(jnp.array([0.0, NUDGE]))

    row = [
        jax.tree.map(lambda x, k=k: np.asarray(x)[k], rows)
        for k in range(len(jax.tree.leaves((y, u))[0]))
    ]
    program, state, made = in_c(step, first, *row[0], unroll=unroll), first, []
    for one in row:
        state, kept = program(state, *one)
        made.append(kept)
    got = jax.tree.map(lambda *x: np.stack(x), *made)
    return *(jax.tree.map(lambda x, k=k: np.asarray(x)[k], want) for k in (0, 1)), got, program


def runs_the_same(filter_, model, start, y, u=None, aux=None, unroll=None, within=1e-12):
    """Check that a filter runs in C as by JAX: codes and counts the same, numbers within 1e-12.

    Numbers that roundings of start and data move further may be as far off as ten of those.
    """
    want, nudged, got, program = run_in_both(filter_, model, start, y, u, aux, unroll)
    told = jax.tree_util.tree_flatten_with_path(want)[0]
    leaves = zip(told, *map(jax.tree.leaves, (nudged, got)), strict=True)
    for (path, a), b, c in leaves:
        where = jax.tree_util.keystr(path)
        assert a.dtype == c.dtype, where
        if a.dtype != float:
            np.testing.assert_array_equal(a, c, err_msg=where)
            continue
        size = _sizes(a)
        moved = np.nan_to_num(apart(a, b, size), posinf=0.0)
        assert apart(a, c, size) <= within + 10 * moved, (where, apart(a, c, size), moved)
    return got, program
