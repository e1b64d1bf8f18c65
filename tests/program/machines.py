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
NUDGES = 8  # runs with numbers that far off
AMPLIFIED = 1e-9  # of its size a number is moved by a million roundings


def _sizes(series):
    """What each number of a series is small against: itself over time, or a row of its matrix."""
    size = np.max(np.abs(series), axis=0, initial=0.0, where=np.isfinite(series))
    return np.max(size, axis=-1, keepdims=True, initial=0.0) if series.ndim > 2 else size


def stepping(filter_, model):
    """A whole step of a filter as one function, and what a log has of it."""

    def step(state, u, y, aux):
        state, done = filter_step(filter_, model, state, u, y, aux)
        return state, (state, done.info, done.prediction.code)

    return step


def _off(numbers, nudge, key):
    """Each number off by a part of itself, up or down; in a factor of a covariance of its row."""

    def off(path, x):
        if x.dtype != float:
            return x
        nudges = nudge * jax.random.choice(key, jnp.array([-1.0, 1.0]), x.shape)
        if getattr(path[-1], "name", "") != "factor":
            return x * (1 + nudges)
        row = jnp.max(jnp.abs(x), axis=-1, keepdims=True)
        return x + nudges * jnp.tril(jnp.ones_like(x)) * row

    return jax.tree_util.tree_map_with_path(off, numbers)


def run_in_both(filter_, model, start, y, u=None, aux=None, unroll=None):
    """Runs by JAX, by JAX with its numbers a rounding off, and in C; series of all that is known.

    Off are the state before each step and the log: each number by itself, but in a covariance's
    factor by a rounding of its row, which is what a factorisation leaves in the row's zeros.

    Returns:
        What `differs` takes, of the runs and of their steps taken each from the state of JAX; and
        the program.
    """
    step, rows = stepping(filter_, model), (u, y, aux or {})
    first = start if isinstance(start, FilterState) else filter_.init(start, model.dims)
    first = jax.tree.map(lambda x: jnp.asarray(x, jnp.asarray(x).dtype), first)
    steps = len(jax.tree.leaves((y, u))[0])
    keys = jax.random.split(jax.random.key(0), (1 + NUDGES, steps))
    nudges = np.where(np.arange(1 + NUDGES) > 0, NUDGE, 0.0)

    def nudged(nudge, state, keyed):
        return step(*_off((state, *keyed[1]), nudge, keyed[0]))

    @jax.jit  # not batched, so that its branches stay branches
    def one(nudge, keys):
        return jax.lax.scan(lambda s, row: nudged(nudge, s, row), first, (keys, rows))[1]

    want, *near = (jax.device_get(one(*each)) for each in zip(nudges, keys, strict=True))
    before = jax.tree.map(lambda x, y: np.concatenate([x[None], y[:-1]]), first, want[0])
    program = in_c(step, first, *_row(rows, 0), unroll=unroll)

    @jax.jit
    def alone(nudge, keys):
        return jax.lax.map(lambda each: nudged(nudge, *each)[1], (before, (keys, rows)))

    def by_steps():
        near = [jax.device_get(alone(*each)) for each in zip(nudges[1:], keys[1:], strict=True)]
        made = [program(_row(before, k), *_row(rows, k))[1] for k in range(steps)]
        return want, _stacked(near), _stacked(made)

    state, made = first, []
    for k in range(steps):
        state, kept = program(state, *_row(rows, k))
        made.append(kept)
    return (want, _stacked(near), _stacked(made)), by_steps, program


def _row(rows, k):
    return jax.tree.map(lambda x: np.asarray(x)[k], rows)


def _stacked(steps):
    return jax.tree.map(lambda *x: np.stack(x), *steps)


def differs(want, nudged, got, within):
    """Where C differs from JAX by more than roundings do, and whether the run amplifies these.

    Codes and counts are to be the same; a flag may be the other way where a rounding turns it.
    Numbers are to be within a bound, or five times what roundings move.
    """
    wrong, most = [], 0.0
    told = jax.tree_util.tree_flatten_with_path(want)[0]
    for (path, a), b, c in zip(told, *map(jax.tree.leaves, (nudged, got)), strict=True):
        where = jax.tree_util.keystr(path)
        assert a.dtype == c.dtype, where
        if a.dtype != float:
            most = max(most, float(np.any(a != b)))
            turned = np.any(a != b, axis=0) & (a.dtype == bool)
            if np.any((a != c) & ~turned):
                wrong.append((where, np.argwhere((a != c) & ~turned)[:5]))
            continue
        size = _sizes(a)
        moved = max(np.nan_to_num(apart(a, one, size), posinf=0.0) for one in b)
        most, off = max(most, moved), apart(a, c, size)
        if not off <= within + 5 * moved:
            wrong.append((where, off, moved))
    return wrong, most > AMPLIFIED


def runs_the_same(filter_, model, start, y, u=None, aux=None, unroll=None, within=1e-12):
    """Check that a filter runs in C as by JAX.

    A run that amplifies roundings may end anywhere, by JAX as well: its steps are judged one by
    one, each from the state that JAX has there.
    """
    run, by_steps, program = run_in_both(filter_, model, start, y, u, aux, unroll)
    wrong, amplifies = differs(*run, within)
    if wrong and amplifies:
        wrong, _ = differs(*by_steps(), within)
    assert not wrong, wrong
    return run[-1], program
