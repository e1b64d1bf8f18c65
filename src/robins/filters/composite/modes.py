"""Filters of one state side by side, as the modes of a mixture: any filters, or a family of one.

Filters of different kinds are each a part of the program. A *family* differs in numbers only, so
its filters are one part, batched: seven modes compile in the time of one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from robins.filters.belief import Belief, StepInfo
from robins.filters.kalman import Filter, FilterState
from robins.filters.model import Motion, Sensor
from robins.filters.trees import select


class Mode(NamedTuple):
    """A filter and what of the model is its own."""

    filter_: Filter
    motion: Motion | None = None
    sensors: tuple[Sensor, ...] = ()

    def predict(self, state: FilterState, motion: Motion, u: Any):
        """State and code of a prediction, by the motion of this mode if it has one."""
        own = motion if self.motion is None else self.motion
        state, prediction = self.filter_.predict(state, own, u)
        return state, prediction.code

    def update(self, state: FilterState, sensor: Sensor, y: Any, aux: Any):
        """State and information of an update, by the sensor of this mode if it has one."""
        own = next((s for s in self.sensors if s.name == sensor.name), sensor)
        return self.filter_.update(state, own, y, aux)


class Family(NamedTuple):
    """Modes that differ in numbers only.

    Attributes:
        make: makes a filter, or what `mode` makes of one, of one row of the numbers. What depends
            on a number is computed with it, not decided by it: the numbers are stand-ins then.
        numbers: pytree of arrays, one row a mode.
    """

    make: Callable[[Any], Filter | Mode]
    numbers: Any

    def of(self, row: Any) -> Mode:
        """The mode of one row."""
        return _as_mode(self.make(row))


class Bank(NamedTuple):
    """The modes as one: states are kept as the layout likes, beliefs have a leading axis of modes.

    Attributes:
        size: number of modes.
        init: ``(belief, dims) -> states``.
        beliefs: ``states -> Belief``.
        restart: ``(states, beliefs, alone) -> states``: each goes on from its belief, unless it is
            alone, (modes,) bool.
        predict: ``(states, motion, u) -> (states, codes)``.
        update: ``(states, sensor, y, aux) -> (states, StepInfo, notes)``; notes by mode and name.
        reset: ``(states, belief) -> states``, all to one belief.
    """

    size: int
    init: Callable[[Belief, Mapping[str, int]], Any]
    beliefs: Callable[[Any], Belief]
    restart: Callable[[Any, Belief, Array], Any]
    predict: Callable[[Any, Motion, Any], tuple[Any, Array]]
    update: Callable[[Any, Sensor, Any, Any], tuple[Any, StepInfo, dict[str, Array]]]
    reset: Callable[[Any, Belief], Any]


def bank(modes: Sequence[Filter | Mode] | Family) -> Bank:
    """The modes as one."""
    if isinstance(modes, Family):
        return _batched(modes)
    return _each(tuple(map(_as_mode, modes)))


def _as_mode(one: Filter | Mode) -> Mode:
    return one if isinstance(one, Mode) else Mode(one)


def _known(modes: Sequence[Mode], dims: Mapping[str, int]) -> None:
    own = {s.name for m in modes for s in m.sensors}
    if unknown := own - set(dims):
        raise ValueError(f"modes of imm bring {sorted(unknown)}; the model has {list(dims)}")


def _each(modes: tuple[Mode, ...]) -> Bank:
    """A tuple of states; each mode is traced by itself."""
    filters = [m.filter_ for m in modes]

    def init(belief, dims):
        _known(modes, dims)
        return tuple(f.init(belief, dims) for f in filters)

    def restart(states, beliefs, alone):
        begun = []
        for j, (f, state) in enumerate(zip(filters, states, strict=True)):
            belief = jax.tree_util.tree_map(lambda a, j=j: a[j], beliefs)
            begun.append(select(alone[j], state, f.reset(state, belief)))
        return tuple(begun)

    def predict(states, motion, u):
        done = [m.predict(s, motion, u) for m, s in zip(modes, states, strict=True)]
        after, codes = zip(*done, strict=True)
        return after, jnp.stack(codes)

    def update(states, sensor, y, aux):
        done = [m.update(s, sensor, y, aux) for m, s in zip(modes, states, strict=True)]
        after, infos = zip(*done, strict=True)
        notes = {f"{i}.{k}": v for i, info in enumerate(infos) for k, v in info.notes.items()}
        return after, _stack([info._replace(notes={}) for info in infos]), notes

    def reset(states, belief):
        return tuple(f.reset(s, belief) for f, s in zip(filters, states, strict=True))

    def beliefs(states):
        return _stack([s.belief for s in states])

    return Bank(len(modes), init, beliefs, restart, predict, update, reset)


def _batched(family: Family) -> Bank:
    """States with a leading axis of modes; one mode is traced, for all."""
    numbers = jax.tree_util.tree_map(jnp.asarray, family.numbers)
    lengths = {np.shape(x)[:1] for x in jax.tree_util.tree_leaves(numbers)}
    if len(lengths) != 1 or lengths == {()}:
        raise ValueError(
            "the numbers of a family must be arrays with one row a mode; "
            f"their shapes begin with {sorted(lengths)}"
        )
    ((count,),) = lengths

    def rows(of: Callable) -> Callable:
        """``of(mode, *parts)`` of every mode; parts have a leading axis of modes."""
        return lambda *parts: jax.vmap(lambda row, *part: of(family.of(row), *part))(
            numbers, *parts
        )

    def init(belief, dims):
        def one(mode: Mode):
            _known([mode], dims)
            return mode.filter_.init(belief, dims)

        return rows(one)()

    def restart(states, beliefs, alone):
        def one(mode: Mode, state, belief, alone):
            return select(alone, state, mode.filter_.reset(state, belief))

        return rows(one)(states, beliefs, alone)

    def predict(states, motion, u):
        return rows(lambda mode, state: mode.predict(state, motion, u))(states)

    def update(states, sensor, y, aux):
        after, info = rows(lambda mode, state: mode.update(state, sensor, y, aux))(states)
        notes = {f"{i}.{k}": v[i] for i in range(count) for k, v in info.notes.items()}
        return after, info._replace(notes={}), notes

    def reset(states, belief):
        return rows(lambda mode, state: mode.filter_.reset(state, belief))(states)

    return Bank(count, init, lambda s: s.belief, restart, predict, update, reset)


def _stack(trees: Sequence[Any]) -> Any:
    return jax.tree_util.tree_map(lambda *x: jnp.stack([jnp.asarray(a) for a in x]), *trees)
