"""Delayed measurements: insert each in its own step and repeat the filter from there.

A buffer keeps the last steps: the state before each, its input and its measurements. A late
measurement is inserted in its step, and the filter, with its rules and their memories, repeats the
steps that followed. The cost is one step per step of delay; the result is exact, unlike that of
methods that propagate the belief back in time (Bar-Shalom, Li & Kirubarajan 2001, sec. 6.2; Larsen,
Andersen, Ravn & Poulsen 1998 compare these).
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Hashable, Mapping
from functools import partial
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike

from robins.errors import require
from robins.filters.belief import Belief, Code, StepInfo, is_failure
from robins.filters.kalman import Advanced, Filter, FilterState, FilterWrapper, Updated
from robins.filters.model import Data, Model, Motion, Sensor
from robins.filters.trees import repeated, row_of, select
from robins.filters.values import kind, on_device, value

T = TypeVar("T")
_WHOLE = 1e-6  # tolerance of an age as a whole number: the rounding of a ratio of times


class DelayedMeasurement(NamedTuple):
    """Measurement and its age in steps; 0 is the present step."""

    value: Data  # as the sensor reads it, NaN where missing
    age: ArrayLike  # whole steps


class _StepBuffer(NamedTuple):
    """Last steps as a ring, each field with a leading axis of depth + 1; step k is row k mod that.

    A dot in a shape stands for that axis.
    """

    before: FilterState  # state before the step
    moved: Array  # (.) bool, the step has a prediction; False at the start and after a reset
    u: Data
    y: dict[str, Data]  # by sensor, NaN where not measured yet
    aux: dict[str, Data]
    asked: Array  # (., sensors) bool, an update with the sensor has been requested
    known: Array  # (., sensors) bool, a measurement has been used
    log_likelihood: Array  # (., sensors)


class DelayMemory(NamedTuple):
    """Memory of a delayed filter."""

    inner: Data  # memory of the filter itself
    past: _StepBuffer
    now: Array  # number of the present step
    reach: Array  # greatest age that can be inserted [steps]
    model: Model  # with its latest numbers


class _Place(NamedTuple):
    """Place of a measurement in the buffer, and its treatment."""

    which: int  # index of its sensor in the model
    at: Array  # row of its step
    now: Array  # row of the present step
    steps: Array  # age [steps]
    there: Array  # bool, it has a finite component
    too_old: Array  # bool
    used: Array  # bool, it is inserted
    at_once: Array  # bool, it is used in the present state, without repeated steps

    @property
    def again(self) -> Array:
        """True if steps are repeated for it."""
        return self.used & ~self.at_once


# Of repeated steps: state of the filter; `before` and `log_likelihood` as in `_StepBuffer`; the
# information of the late measurement; () bool, all predictions were taken; first failure, a `Code`.
_Repeated = tuple[FilterState, FilterState, Array, StepInfo, Array, Array]


@value
class Delayed(FilterWrapper):
    """Filter made by `delayed`."""

    model: Model
    u: Data  # an example of an input
    aux: dict[str, Data]  # an example by sensor
    depth: int = kind()

    def parts(self, state: FilterState) -> tuple[FilterState, ...]:
        return (_inner(state),)

    @property
    def size(self) -> int:
        """Rows of the buffer."""
        return self.depth + 1

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self.model.dims)

    def begin(self, inner: FilterState, known: Model) -> FilterState:
        """Start with an empty buffer; the present step has no prediction to repeat."""
        size, extra = self.size, on_device(self.aux)
        asked = jnp.zeros((size, len(self.names)), bool)
        past = _StepBuffer(
            before=repeated(inner, size),
            moved=jnp.zeros(size, bool),
            u=repeated(on_device(self.u), size),
            y={s.name: repeated(_no_reading(s, inner, extra[s.name]), size) for s in known.sensors},
            aux=repeated(extra, size),
            asked=asked,
            known=asked,
            log_likelihood=jnp.zeros(asked.shape),
        )
        zero = jnp.zeros((), int)
        return inner._replace(memory=DelayMemory(inner.memory, past, zero, zero, known))

    def init(self, belief: Belief, dims: Mapping[str, int]) -> FilterState:
        return self.begin(self.inner.init(belief, dims), on_device(self.model))

    def reset(self, state: FilterState, belief: Belief) -> FilterState:
        # Earlier measurements are part of the new belief, or meant to be forgotten.
        return self.begin(self.inner.reset(_inner(state), belief), state.memory.model)

    # `predict` and `update` are overridden: the inner filter tracks whether its prediction was
    # taken, since a late measurement can change that.

    @jax.jit
    def predict(self, state: FilterState, motion: Motion, u: Data = None) -> Advanced:
        """Predict, and open a row of the buffer."""
        held = state.memory
        _check_same("the motion", motion, held.model.motion)
        _check_same("an input u", u, row_of(held.past.u, 0))
        inner, now = _inner(state), held.now + 1
        past = self.opened(held.past, now % self.size, inner, u)
        inner, prediction = self.inner.predict(inner, motion, u)
        reach = jnp.minimum(held.reach + 1, self.depth)
        known = Model(on_device(motion), held.model.sensors)
        new = inner._replace(memory=DelayMemory(inner.memory, past, now, reach, known))
        return new, prediction._replace(transition=None, origin=None)

    def opened(self, past: _StepBuffer, at: Array, inner: FilterState, u: Data) -> _StepBuffer:
        """Open the row of a new step."""
        none = jnp.zeros(len(self.names), bool)
        entry = _StepBuffer(
            before=inner,
            moved=jnp.ones((), bool),
            u=on_device(u),
            y=jax.tree_util.tree_map(lambda a: jnp.full(a.shape[1:], jnp.nan), past.y),
            aux=row_of(past.aux, at),
            asked=none,
            known=none,
            log_likelihood=jnp.zeros(len(self.names)),
        )
        return jax.tree_util.tree_map(lambda a, x: a.at[at].set(x), past, entry)

    @jax.jit
    def update(self, state: FilterState, sensor: Sensor, y: Data, aux: Data = None) -> Updated:
        """Insert a measurement in its step, and repeat the filter from there."""
        held = state.memory
        which, known = self.recognised(held.model, sensor, aux)
        value, age = y if isinstance(y, DelayedMeasurement) else (y, jnp.zeros(()))
        place = self.place_of(held, which, value, age)
        fresh = jax.tree_util.tree_map(lambda v: jnp.where(place.at_once, v, jnp.nan), value)
        inner, info = self.inner.update(_inner(state), sensor, fresh, aux)
        past = _entered(held.past, place, sensor.name, value, aux, info)
        repeat_steps = self.repeat_steps(past, place, known, inner, info)
        inner, before, gained, own, taken, failed = repeat_steps
        told = _update_info(past, place, gained, own, taken, failed)
        past = past._replace(before=before, log_likelihood=gained)
        kept = DelayMemory(inner.memory, past, held.now, held.reach, known)
        return inner._replace(memory=kept), told

    def recognised(self, model: Model, sensor: Sensor, aux: Data) -> tuple[int, Model]:
        """Index of a sensor, and the model with the numbers of that sensor.

        Raises:
            ValueError: the sensor is unknown, or its shapes or those of ``aux`` differ.
        """
        names = self.names
        if sensor.name not in names:
            raise ValueError(f"sensor '{sensor.name}' is new; delayed() was told of {list(names)}")
        which = names.index(sensor.name)
        _check_same(f"sensor '{sensor.name}'", sensor, model.sensors[which])
        _check_same(f"aux of sensor '{sensor.name}'", aux, self.aux[sensor.name])
        mine = on_device(sensor)
        sensors = tuple(mine if s.name == sensor.name else s for s in model.sensors)
        return which, Model(model.motion, sensors)

    def place_of(self, held: DelayMemory, which: int, value: Data, age: ArrayLike) -> _Place:
        """Place in the buffer of a measurement of this age [steps]."""
        age = jnp.asarray(age, float)
        there = jnp.any(jnp.stack([jnp.any(jnp.isfinite(x)) for x in jax.tree.leaves(value)]))
        steps = jnp.round(jnp.where(jnp.isfinite(age), age, -1.0)).astype(int)
        sound = (jnp.abs(age - steps.astype(float)) <= _WHOLE) & (steps >= 0)
        too_old = there & sound & (steps > held.reach)
        steps = jnp.clip(steps, 0, self.depth)
        at, now = (held.now - steps) % self.size, held.now % self.size
        used = there & sound & ~too_old & ~held.past.known[at, which]
        # One of this step is used at once, unless a later sensor of the model has been used.
        overtaken = jnp.any(held.past.known[now, which + 1 :])
        at_once = used & (steps == 0) & ~overtaken
        return _Place(which, at, now, steps, there, too_old, used, at_once)

    def repeat_steps(
        self, past: _StepBuffer, place: _Place, known: Model, inner: FilterState, info: StepInfo
    ) -> _Repeated:
        """Repeat the steps from that of the measurement on, if `place.again`."""
        inner = select(place.again, row_of(past.before, place.at), inner)
        fine = (jnp.ones((), bool), jnp.asarray(int(Code.DONE)))
        return jax.lax.fori_loop(
            0,
            jnp.where(place.again, place.steps + 1, 0),
            lambda i, done: self.step_again(past, place, known, i, done),
            (inner, past.before, past.log_likelihood, info, *fine),
        )

    def step_again(
        self, past: _StepBuffer, place: _Place, known: Model, i: Array, done: _Repeated
    ) -> _Repeated:
        """Repeat the step i steps after that of the measurement."""
        inner, before, gained, own, taken, failed = done
        j = (place.at + i) % self.size
        row = row_of(past, j)
        before = jax.tree_util.tree_map(lambda a, x: a.at[j].set(x), before, inner)
        moved, prediction = self.inner.predict(inner, known.motion, row.u)
        inner = select(row.moved, moved, inner)
        taken = taken & (~row.moved | (prediction.code == int(Code.DONE)))
        for k, each in enumerate(known.sensors):
            after, seen = self.inner.update(inner, each, row.y[each.name], row.aux[each.name])
            inner = select(row.asked[k], after, inner)
            gained = gained.at[j, k].set(jnp.where(row.asked[k], seen.log_likelihood, 0.0))
            told = jnp.isneginf(row.log_likelihood[k])  # reported as failed the first time
            failed = _first_failure(failed, row.asked[k] & ~told, seen.code)
            if k == place.which:
                own = select(i == 0, seen, own)
        return inner, before, gained, own, taken, failed


def delayed(
    filter_: Filter, model: Model, depth: int, u: Data = None, aux: Mapping[str, Data] | None = None
) -> Filter:
    """Filter that accepts measurements up to ``depth`` steps late, in any order.

    Give a late measurement as `DelayedMeasurement`; a plain one is of age 0. For any order of
    arrival, the belief and the sum of the log-likelihoods are those of a run in which each
    measurement came in its own step, sensors in the model's order. A rule that counts its updates
    gets one of each sensor per step, as in `run`.

    A measurement older than the buffer, or than the start, has the code ``TOO_OLD``. The code is
    ``REFUSED`` for a second measurement of a sensor for the same step, one from the future (a
    negative age: keep it until its step has been predicted), and one whose age is not a whole
    number. In all these cases the belief is unchanged, as if it were missing.

    The `StepInfo` of a late measurement is that of its own step, with its innovation there, with
    two exceptions: ``log_likelihood`` is the change in that of all measurements so far, and
    ``code`` is that of the first repeated update that newly fails, if any.

    A prediction holds no transition, since later measurements may revise it: such a run cannot be
    smoothed. Forward derivatives work (`jax.jvp`, `jax.jacfwd`), backward ones do not: the number
    of repeated steps is only known at run time.

    Args:
        filter_: the filter to repeat, such as `kalman` returns.
        model: the motion and sensors of the run; its numbers may change later, not its shapes.
        depth: greatest age [steps]; memory and the cost of the oldest measurement grow with it.
        u: an example of the input of a step, for its shapes, if the motion has inputs.
        aux: an example of ``aux`` by sensor name, for sensors that need it.

    Raises:
        ValueError: depth is negative, or aux names no sensor; in a run, its model or its inputs
            have other shapes than were given here.
    """
    depth = operator.index(depth)
    require(depth >= 0, "depth of a delayed filter must not be negative", depth)
    names = tuple(model.dims)
    given = dict(aux or {})
    if unknown := set(given) - set(names):
        raise ValueError(f"aux names no sensor {sorted(unknown)}; the model has {sorted(names)}")
    extra = {name: _as_arrays(given.get(name)) for name in names}
    return Delayed(filter_, model, _as_arrays(u), extra, depth)


def _entered(
    past: _StepBuffer, place: _Place, name: str, value: Data, aux: Data, info: StepInfo
) -> _StepBuffer:
    """Buffer with a measurement in its own step, and its sensor marked as requested in this one."""
    now, at, which, used = place.now, place.at, place.which, place.used

    def entered(rows: Array, v: Array, here: Array | bool) -> Array:
        rows = rows.at[now].set(jnp.where(here, v, rows[now]))
        return rows.at[at].set(jnp.where(used, v, rows[at]))

    first = ~past.asked[now, which]
    asked = past.asked.at[now, which].set(True)
    gained = jnp.where(place.again, 0.0, info.log_likelihood)
    return past._replace(
        y=_with(past.y, name, partial(entered, here=False), value),
        aux=_with(past.aux, name, partial(entered, here=first), aux),
        asked=asked.at[at, which].set(asked[at, which] | used),
        known=past.known.at[at, which].set(past.known[at, which] | used),
        log_likelihood=past.log_likelihood.at[now, which].add(gained),
    )


def _update_info(
    past: _StepBuffer, place: _Place, gained: Array, own: StepInfo, taken: Array, failed: Array
) -> StepInfo:
    """Information of an update in its own step, with its effect on all steps so far."""
    again, total = place.again, (jnp.sum(past.log_likelihood), jnp.sum(gained))
    added = _change(*total, own, taken)
    code = _first_failure(own.code, again, failed)
    place_of = jnp.where(place.used, code, int(Code.REFUSED))
    place_of = jnp.where(place.too_old, int(Code.TOO_OLD), place_of)
    return own._replace(
        log_likelihood=jnp.where(again, added, own.log_likelihood),
        code=jnp.where(place.there, place_of, code),
    )


def _inner(state: FilterState) -> FilterState:
    """State of the inner filter."""
    return state._replace(memory=state.memory.inner)


def _as_arrays(tree: Data) -> Data:
    """Tree with arrays in place of Python numbers, which have weak types."""
    return jax.tree_util.tree_map(lambda x: x if isinstance(x, jax.Array) else np.asarray(x), tree)


def _with(
    rows: dict[str, Data], name: str, enter: Callable[..., Array], value: Data
) -> dict[str, Data]:
    """Rows with a value inserted for one sensor."""
    return {**rows, name: jax.tree_util.tree_map(enter, rows[name], value)}


def _no_reading(sensor: Sensor, state: FilterState, aux: Data) -> Data:
    """Measurement of a sensor without information: all NaN."""
    like = jax.eval_shape(sensor.read, state.belief.mean, aux)
    return jax.tree_util.tree_map(lambda leaf: jnp.full(leaf.shape, jnp.nan), like)


def _first_failure(code: Array, asked: Array, found: Array) -> Array:
    """The first failure: ``code`` if it is one, else ``found`` if requested and a failure."""
    return jnp.where(asked & ~is_failure(code) & is_failure(found), found, code)


def _change(earlier: Array, later: Array, own: StepInfo, taken: Array) -> Array:
    """Change of the total log-likelihood by a late measurement; -inf where a step failed."""
    # If a step failed earlier, the total is minus infinity already.
    change = jnp.where(jnp.isfinite(earlier), later - earlier, own.log_likelihood)
    return jnp.where(taken, change, -jnp.inf)


def _check_same(what: str, found: Data, known: Data) -> None:
    """Raise if two pytrees differ in structure, shapes or dtypes.

    Raises:
        ValueError: they differ; the message names `what` and states both.
    """
    if _form(found) != _form(known):
        raise ValueError(
            f"{what} is of another form than delayed() was told of: {_form(found)}, not "
            f"{_form(known)}; give it the model of the run and, where there are inputs, one of "
            "them as u=... and one aux by sensor as aux={...}"
        )


def _form(tree: Data) -> Hashable:
    leaves, structure = jax.tree_util.tree_flatten(tree)
    return structure, tuple((jnp.shape(x), str(jnp.result_type(x))) for x in leaves)
