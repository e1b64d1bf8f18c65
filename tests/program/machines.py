"""The same function by JAX and in C, and how far what they give is apart."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from robins.filters import FilterState, filter_step
from robins.program import FLAGS, compiled_step, interpreted_step, native

# Compiled without optimisation: most programs of the tests are called once. The bits are the same.
QUICK = tuple("-O0" if flag == "-O2" else flag for flag in FLAGS)
quickly = partial(compiled_step, flags=QUICK)


def in_c(function, *args, unroll=None):
    """A function as a program on the machine, for arguments like these: its bits are those of C."""
    return native(function, *args, unroll=unroll, engine=interpreted_step)


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
NEAR = range(1, 9)  # runs with numbers that far off
AMPLIFIED = 1e-9  # of its size a number is moved by a million roundings


def _sizes(series):
    """Scale of each number of a series: itself over time, or a row of its matrix."""
    size = np.max(np.abs(series), axis=0, initial=0.0, where=np.isfinite(series))
    return np.max(size, axis=-1, keepdims=True, initial=0.0) if series.ndim > 2 else size


def stepping(filter_, model):
    """A whole step of a filter as one function, and what a log has of it; traced once for all."""

    @jax.jit
    def step(state, u, y, aux):
        state, done = filter_step(filter_, model, state, u, y, aux)
        return state, (state, done.info, done.prediction.code)

    return step


def _nudges(numbers, steps, run):
    """Deviation of each number of each step of a run, in parts of itself; zero in run 0."""
    rng = np.random.default_rng(run)
    sizes = [(steps, *np.shape(x)) for x in jax.tree.leaves(numbers)]
    return [NUDGE * rng.choice((-1.0, 1.0), size) * (run > 0) for size in sizes]


def _off(numbers, nudges):
    """Numbers off by a part of themselves, those in a covariance's factor by one of their row."""
    paths, tree = jax.tree_util.tree_flatten_with_path(numbers)

    def off(path, x, nudge):
        if x.dtype != float:
            return x
        if getattr(path[-1], "name", "") != "factor":
            return x * (1 + nudge)
        row = jnp.max(jnp.abs(x), axis=-1, keepdims=True)
        return x + nudge * jnp.tril(jnp.ones_like(x)) * row

    return tree.unflatten([off(*each, nudge) for each, nudge in zip(paths, nudges, strict=True)])


class Runs:
    """Runs of a filter by JAX, by JAX with its numbers a rounding off, and in C.

    Off are the state before each step and the log: each number by itself, but in a covariance's
    factor by a rounding of its row, which is what a factorisation leaves in the row's zeros. What a
    run gives is series of all that is known.
    """

    def __init__(self, filter_, model, start, y, u, aux, unroll):
        self.step, self.rows = stepping(filter_, model), (u, y, aux or {})
        first = start if isinstance(start, FilterState) else filter_.init(start, model.dims)
        self.first = jax.tree.map(lambda x: jnp.asarray(x, jnp.asarray(x).dtype), first)
        self.steps = len(jax.tree.leaves((y, u))[0])
        self.one = (self.first, *_row(self.rows, 0))
        self.program = in_c(self.step, *self.one, unroll=unroll)

        def one(alone, state, given):
            before, row, nudges = given
            state = jax.tree.map(partial(jnp.where, alone), before, state)
            return self.step(*_off((state, *row), nudges))

        # Not batched, so that its branches stay branches.
        self._scan = jax.jit(lambda a, *given: jax.lax.scan(partial(one, a), self.first, given)[1])

    def by_jax(self, run, before=None):
        """A run from the first state on, or each step from a state; in run 0 no number is off."""
        there = before is not None
        if before is None:
            before = jax.tree.map(lambda x: np.broadcast_to(x, (self.steps, *x.shape)), self.first)
        given = before, self.rows, _nudges(self.one, self.steps, run)
        return jax.device_get(self._scan(there, *given))

    def in_c(self, before=None):
        """The run from the first state on, or each step from a state."""
        state, made = self.first, []
        for k in range(self.steps):
            state = state if before is None else _row(before, k)
            state, kept = self.program(state, *_row(self.rows, k))
            made.append(kept)
        return _stacked(made)

    def before(self, states):
        """The states before the steps that these are after."""
        return jax.tree.map(
            lambda x, y: np.concatenate([np.asarray(x)[None], y[:-1]]), self.first, states
        )


def _row(rows, k):
    return jax.tree.map(lambda x: np.asarray(x)[k], rows)


def _stacked(steps):
    return jax.tree.map(lambda *x: np.stack(x), *steps)


def differs(want, near, got, within):
    """Differences of C and JAX beyond roundings, and a flag for a run that amplifies these.

    Codes and counts are to be the same; a flag may be the other way where a rounding turns it.
    Numbers are to be within a bound, or five times what roundings move in the runs that are near.
    """
    wrong, most = [], 0.0
    told = jax.tree_util.tree_flatten_with_path(want)[0]
    for (path, a), c, *b in zip(told, *map(jax.tree.leaves, (got, *near)), strict=True):
        where = jax.tree_util.keystr(path)
        assert a.dtype == c.dtype, where
        if a.dtype != float:
            changed = np.any([a != one for one in b], axis=0)
            most = max(most, float(np.any(changed)))
            differ = (a != c) & ~(changed & (a.dtype == bool))
            if np.any(differ):
                wrong.append((where, np.argwhere(differ)[:5]))
            continue
        size = _sizes(a)
        moved = max((np.nan_to_num(apart(a, one, size), posinf=0.0) for one in b), default=0.0)
        most, off = max(most, moved), apart(a, c, size)
        if not off <= within + 5 * moved:
            wrong.append((where, off, moved))
    return wrong, most > AMPLIFIED


def runs_the_same(filter_, model, start, y, u=None, aux=None, unroll=None, within=1e-12):
    """Check that a filter runs in C as by JAX; gives what it gave in C, and the program.

    Only what is further apart than the bound is measured by what roundings move. A run that
    amplifies roundings may end anywhere, by JAX as well: its steps are judged one by one, each from
    the state that JAX has there.
    """
    runs = Runs(filter_, model, start, y, u, aux, unroll)
    want, got = runs.by_jax(0), runs.in_c()
    wrong, amplifies = differs(want, [], got, within)
    if wrong:
        near = [runs.by_jax(run) for run in NEAR]
        wrong, amplifies = differs(want, near, got, within)
    if wrong and amplifies:
        before = runs.before(want[0])
        near = [runs.by_jax(run, before) for run in NEAR]
        wrong, _ = differs(want, near, runs.in_c(before), within)
    assert not wrong, wrong
    return got, runs.program
