"""Measurements that come late: put each in its place and filter again from there.

The last steps are kept: the state each began with, its input, and what was measured. A late
measurement is entered at the step it belongs to, and the filter, its rules and their memories
included, goes once more through what followed. That costs as many steps as the measurement is old,
and is exact where shortcuts that move the belief back in time are not (Bar-Shalom, Li & Kirubarajan
2001, sec. 6.2; Larsen, Andersen, Ravn & Poulsen 1998 compare the shortcuts).
"""

from __future__ import annotations

import operator
from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from robins.errors import require
from robins.filters.audit import Again, audit
from robins.filters.belief import Belief, Code, StepInfo, is_failure
from robins.filters.kalman import Filter, FilterState, compiled, functions
from robins.filters.model import Model, Motion, Sensor
from robins.filters.trees import select

_WHOLE = 1e-6  # how far an age may be off a whole number: the rounding of a ratio of times


class Late(NamedTuple):
    """A measurement and how many steps ago it was made; 0 is now."""

    value: Any  # as the sensor reads it, NaN where missing
    age: Any  # whole steps


class _Past(NamedTuple):
    """The last steps, each with a leading axis of ``depth + 1``; step k lies at k mod that."""

    before: FilterState  # the state a step begins with
    moved: Array  # bool, begins with a prediction; False where the run or a reset begins
    u: Any
    y: dict[str, Any]  # by sensor, NaN where nothing is known yet
    aux: dict[str, Any]
    asked: Array  # (., sensors) bool, the filter has been asked to update with the sensor
    known: Array  # (., sensors) bool, a measurement has been used
    log_likelihood: Array  # (., sensors)


class Delay(NamedTuple):
    """Memory of a delayed filter."""

    inner: Any  # memory of the filter itself
    past: _Past
    now: Array  # number of the present step
    reach: Array  # how many steps back there are to go
    model: Model  # its numbers, as last seen

    def audit(self, start: Delay, again: Again | None, time: Any) -> None:
        """Ask the filter that is delayed, not its past (`robins.filters.audit`)."""

        def rerun(inner: Any) -> Any:
            assert again is not None
            before = start.past.before._replace(memory=_rows(inner, len(start.past.moved)))
            past = start.past._replace(before=before)
            return again(start._replace(inner=inner, past=past)).inner

        audit(start.inner, self.inner, None if again is None else rerun, time)


def delayed(
    filter_: Filter, model: Model, depth: int, u: Any = None, aux: Mapping[str, Any] | None = None
) -> Filter:
    """A filter that takes measurements up to ``depth`` steps late, in any order.

    Give a late measurement as `Late`; a plain one is of age 0. However they come in, the belief and
    the sum of the log-likelihoods are those of a run in which each came in its own step, sensors in
    the model's order. A rule that counts the updates it is asked for sees one of each sensor in a
    step, as in `run`.

    A measurement older than the buffer, or than the start, has the code ``TOO_OLD``. ``REFUSED``
    are: a second one of a sensor for the same step, one from the future (a negative age: keep it
    until its step has been predicted), and one whose age is not a whole number. In all these cases
    the belief stands, as if it were missing.

    The `StepInfo` of a late measurement is that of its own step, with its innovation there; only
    ``log_likelihood`` is what it adds to that of all measurements so far, and ``code`` the first
    update that fails now that it is repeated, where there is one.

    A prediction holds no transition, for what follows may revise it: such a run is not smoothed.
    Forward derivatives work (`jax.jvp`, `jax.jacfwd`), backward ones do not: how many steps are
    repeated is only known as it runs.

    Args:
        filter_: the filter to go back with, from `kalman` and its kin.
        model: the motion and sensors of the run; its numbers may later be others, not its shape.
        depth: greatest age [steps]; memory and the cost of the oldest measurement grow with it.
        u: any one input of a step (its shapes are wanted), where the motion has inputs.
        aux: any one ``aux`` by sensor name, for those that need it.

    Raises:
        ValueError: depth is negative, or aux names no sensor. Of a run: its model or its inputs are
            of other shapes than were given here.
    """
    depth = operator.index(depth)
    require(depth >= 0, "depth of a delayed filter must not be negative", depth)
    names = tuple(model.dims)
    given = dict(aux or {})
    if unknown := set(given) - set(names):
        raise ValueError(f"aux names no sensor {sorted(unknown)}; the model has {sorted(names)}")
    extra = {name: _numbers(given.get(name)) for name in names}
    size = depth + 1

    def begin(inner: FilterState, known: Model) -> FilterState:
        """With an empty buffer; the present step has no prediction to repeat."""
        asked = jnp.zeros((size, len(names)), bool)
        past = _Past(
            before=_rows(inner, size),
            moved=jnp.zeros(size, bool),
            u=_rows(_numbers(u), size),
            y={s.name: _rows(_unread(s, inner, extra[s.name]), size) for s in known.sensors},
            aux=_rows(extra, size),
            asked=asked,
            known=asked,
            log_likelihood=jnp.zeros(asked.shape),
        )
        zero = jnp.zeros((), int)
        return _outer(inner, Delay(inner.memory, past, zero, zero, known))

    def init(belief: Belief, dims: Mapping[str, int]) -> FilterState:
        return begin(filter_.init(belief, dims), _numbers(model))

    def predict(state: FilterState, motion: Motion, u: Any = None):
        held = state.memory
        _check_same("the motion", motion, held.model.motion)
        _check_same("an input u", u, jax.tree_util.tree_map(lambda a: a[0], held.past.u))
        inner = _inner(state)
        now = held.now + 1
        at = now % size
        past = held.past
        entry = _Past(
            before=inner,
            moved=jnp.ones((), bool),
            u=_numbers(u),
            y=jax.tree_util.tree_map(lambda a: jnp.full(a.shape[1:], jnp.nan), past.y),
            aux=jax.tree_util.tree_map(lambda a: a[at], past.aux),
            asked=jnp.zeros(len(names), bool),
            known=jnp.zeros(len(names), bool),
            log_likelihood=jnp.zeros(len(names)),
        )
        past = jax.tree_util.tree_map(lambda a, x: a.at[at].set(x), past, entry)
        inner, prediction = filter_.predict(inner, motion, u)
        reach = jnp.minimum(held.reach + 1, depth)
        known = Model(_numbers(motion), held.model.sensors)
        new = _outer(inner, Delay(inner.memory, past, now, reach, known))
        return new, prediction._replace(transition=None, origin=None)

    def update(state: FilterState, sensor: Sensor, y: Any, aux: Any = None):
        held = state.memory
        if sensor.name not in names:
            raise ValueError(f"sensor '{sensor.name}' is new; delayed() was told of {list(names)}")
        which = names.index(sensor.name)
        _check_same(f"sensor '{sensor.name}'", sensor, held.model.sensors[which])
        _check_same(f"aux of sensor '{sensor.name}'", aux, extra[sensor.name])
        mine = _numbers(sensor)
        sensors = tuple(mine if s.name == sensor.name else s for s in held.model.sensors)
        known = Model(held.model.motion, sensors)
        past = held.past

        value, age = y if isinstance(y, Late) else (y, jnp.zeros(()))
        age = jnp.asarray(age, float)
        there = jnp.any(jnp.stack([jnp.any(jnp.isfinite(x)) for x in jax.tree.leaves(value)]))
        steps = jnp.round(jnp.where(jnp.isfinite(age), age, -1.0)).astype(int)
        sound = (jnp.abs(age - steps.astype(float)) <= _WHOLE) & (steps >= 0)
        too_old = there & sound & (steps > held.reach)
        steps = jnp.clip(steps, 0, depth)
        at, now = (held.now - steps) % size, held.now % size
        used = there & sound & ~too_old & ~past.known[at, which]
        # One of this step is used at once, unless a sensor whose turn comes later already was.
        overtaken = jnp.any(past.known[now, which + 1 :])
        at_once = used & (steps == 0) & ~overtaken
        again = used & ~at_once

        fresh = jax.tree_util.tree_map(lambda v: jnp.where(at_once, v, jnp.nan), value)
        inner, info = filter_.update(_inner(state), sensor, fresh, aux)

        def entered(rows, v, here):
            """In its own step; and in this one, where the sensor has been asked for too."""
            rows = rows.at[now].set(jnp.where(here, v, rows[now]))
            return rows.at[at].set(jnp.where(used, v, rows[at]))

        first = ~past.asked[now, which]
        asked = past.asked.at[now, which].set(True)
        past = past._replace(
            y=_with(past.y, sensor.name, partial(entered, here=False), value),
            aux=_with(past.aux, sensor.name, partial(entered, here=first), aux),
            asked=asked.at[at, which].set(asked[at, which] | used),
            known=past.known.at[at, which].set(past.known[at, which] | used),
            log_likelihood=past.log_likelihood.at[now, which].add(
                jnp.where(again, 0.0, info.log_likelihood)
            ),
        )

        def repeat(i: Array, carry: tuple) -> tuple:
            inner, before, gained, own, taken, failed = carry
            j = (at + i) % size
            row = jax.tree_util.tree_map(lambda a: a[j], past)
            before = jax.tree_util.tree_map(lambda a, x: a.at[j].set(x), before, inner)
            moved, prediction = filter_.predict(inner, known.motion, row.u)
            inner = select(row.moved, moved, inner)
            taken = taken & (~row.moved | (prediction.code == int(Code.DONE)))
            for k, each in enumerate(known.sensors):
                after, seen = filter_.update(inner, each, row.y[each.name], row.aux[each.name])
                inner = select(row.asked[k], after, inner)
                gained = gained.at[j, k].set(jnp.where(row.asked[k], seen.log_likelihood, 0.0))
                told = jnp.isneginf(row.log_likelihood[k])  # when it was first asked
                failed = _first_failure(failed, row.asked[k] & ~told, seen.code)
                if k == which:
                    own = select(i == 0, seen, own)
            return inner, before, gained, own, taken, failed

        start = jax.tree_util.tree_map(lambda a: a[at], past.before)
        inner = select(again, start, inner)
        fine = (jnp.ones((), bool), jnp.asarray(int(Code.DONE)))
        carry = (inner, past.before, past.log_likelihood, info, *fine)
        inner, before, gained, own, taken, failed = jax.lax.fori_loop(
            0, jnp.where(again, steps + 1, 0), repeat, carry
        )
        added = _change(jnp.sum(past.log_likelihood), jnp.sum(gained), own, taken)
        own = own._replace(code=_first_failure(own.code, again, failed))
        past = past._replace(before=before, log_likelihood=gained)
        code = jnp.where(too_old, int(Code.TOO_OLD), jnp.where(used, own.code, int(Code.REFUSED)))
        own = own._replace(
            log_likelihood=jnp.where(again, added, own.log_likelihood),
            code=jnp.where(there, code, own.code),
        )
        return _outer(inner, Delay(inner.memory, past, held.now, held.reach, known)), own

    def reset(state: FilterState, belief: Belief) -> FilterState:
        # What was measured before the new belief is part of it, or meant to be forgotten.
        return begin(filter_.reset(_inner(state), belief), state.memory.model)

    return compiled(functions(init, predict, update, reset))


def _inner(state: FilterState) -> FilterState:
    """The state of the filter that is delayed."""
    return state._replace(memory=state.memory.inner)


def _outer(inner: FilterState, memory: Delay) -> FilterState:
    return inner._replace(memory=memory)


def _numbers(tree: Any) -> Any:
    return jax.tree_util.tree_map(jnp.asarray, tree)


def _rows(tree: Any, count: int) -> Any:
    return jax.tree_util.tree_map(lambda x: jnp.broadcast_to(x, (count, *jnp.shape(x))), tree)


def _with(rows: dict[str, Any], name: str, enter: Any, value: Any) -> dict[str, Any]:
    """The same rows with something entered for one sensor."""
    return {**rows, name: jax.tree_util.tree_map(enter, rows[name], value)}


def _unread(sensor: Sensor, state: FilterState, aux: Any) -> Any:
    """A measurement of a sensor that tells nothing."""
    like = jax.eval_shape(sensor.read, state.belief.mean, aux)
    return jax.tree_util.tree_map(lambda leaf: jnp.full(leaf.shape, jnp.nan), like)


def _first_failure(code: Array, asked: Array, found: Array) -> Array:
    """The code, or the first failure that is found in what was asked of the filter."""
    return jnp.where(asked & ~is_failure(code) & is_failure(found), found, code)


def _change(earlier: Array, later: Array, own: StepInfo, taken: Array) -> Array:
    """What a late measurement adds to the log-likelihood of all; -inf where a step failed."""
    # Steps that failed before have made the whole minus infinity already.
    change = jnp.where(jnp.isfinite(earlier), later - earlier, own.log_likelihood)
    return jnp.where(taken, change, -jnp.inf)


def _check_same(what: str, found: Any, known: Any) -> None:
    """Raise if two pytrees differ in structure, shapes or kinds of number."""
    if _form(found) != _form(known):
        raise ValueError(
            f"{what} is of another form than delayed() was told of: {_form(found)}, not "
            f"{_form(known)}; give it the model of the run and, where there are inputs, one of "
            "them as u=... and one aux by sensor as aux={...}"
        )


def _form(tree: Any) -> tuple:
    leaves, structure = jax.tree_util.tree_flatten(tree)
    return structure, tuple((jnp.shape(x), str(jnp.result_type(x))) for x in leaves)
