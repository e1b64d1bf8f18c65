"""Filter with some of its parameters in its state, to be set on board without a new program.

A program of scalars folds the numbers of a filter: a threshold is a constant in the C code. Numbers
named in `adjustable` are fields of the state instead, with the filter's own as initial values.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import replace

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike

from robins.errors import require
from robins.filters.belief import Belief
from robins.filters.kalman import Advanced, Again, Filter, FilterState, FilterWrapper, Updated
from robins.filters.model import Data, Motion, Sensor
from robins.filters.values import kind, number, value


@value
class AdjustableMemory:
    """Memory of an `adjustable` filter."""

    inner: Data  # memory of the filter itself
    numbers: dict[str, Array]  # by name


@value
class Adjustable(FilterWrapper):
    """Filter made by `adjustable`."""

    names: tuple[str, ...] = kind()

    def begun(self, state: FilterState) -> FilterState:
        """Extend a state of the inner filter by the named numbers of that filter."""
        named = named_numbers(self.inner)
        numbers = {name: jnp.asarray(named[name], float) for name in self.names}
        return state._replace(memory=AdjustableMemory(state.memory, numbers))

    def filter_of(self, state: FilterState) -> Filter:
        """Inner filter with the numbers of a state."""
        held = {name: state.memory.numbers[name] for name in self.names}
        flat, shape = jax.tree_util.tree_flatten_with_path(self.inner)
        return shape.unflatten([held.get(_named(path), leaf) for path, leaf in flat])

    def parts(self, state: FilterState) -> tuple[FilterState, ...]:
        return (state._replace(memory=state.memory.inner),)

    def init(self, belief: Belief, dims: Mapping[str, int]) -> FilterState:
        return self.begun(self.inner.init(belief, dims))

    @jax.jit
    def predict(self, state: FilterState, motion: Motion, u: Data = None) -> Advanced:
        new, prediction = self.filter_of(state).predict(self.parts(state)[0], motion, u)
        return self._with(new, state), prediction

    @jax.jit
    def update(self, state: FilterState, sensor: Sensor, y: Data, aux: Data = None) -> Updated:
        new, info = self.filter_of(state).update(self.parts(state)[0], sensor, y, aux)
        return self._with(new, state), info

    def reset(self, state: FilterState, belief: Belief) -> FilterState:
        return self._with(self.filter_of(state).reset(self.parts(state)[0], belief), state)

    def report(
        self, start: FilterState, final: FilterState, again: Again | None, time: ArrayLike | None
    ) -> None:
        # a rerun with other numbers must not use those of the state
        own = replace(self, inner=self.filter_of(start), names=())
        super(Adjustable, own).report(start, final, again, time)

    def _with(self, new: FilterState, old: FilterState) -> FilterState:
        return new._replace(memory=replace(old.memory, inner=new.memory))


def named_numbers(filter_: Filter) -> dict[str, ArrayLike]:
    """Numbers of a filter by name, such as "rules[0].limit"."""
    flat, _ = jax.tree_util.tree_flatten_with_path(filter_)
    return {_named(path): leaf for path, leaf in flat}


def _named(path: tuple[Hashable, ...]) -> str:
    return jax.tree_util.keystr(path).removeprefix(".")


def adjustable(filter_: Filter, names: Sequence[str]) -> Adjustable:
    """Move some of the numbers of a filter into its state.

    The estimates are those of the given filter. `adjusted` sets a number; in exported C it is a
    field of the state, ``memory_numbers_`` and its name.

    Args:
        filter_: the filter, such as `kalman` returns.
        names: names of numbers, as `named_numbers` lists them.

    Raises:
        ValueError: the filter has no number of such a name.
    """
    known = list(named_numbers(filter_))
    for name in names:
        if name not in known:
            listed = ", ".join(known) or "none"
            raise ValueError(f"no number '{name}' in this filter; its numbers are: {listed}")
    return Adjustable(filter_, tuple(names))


def adjusted(state: FilterState, numbers: Mapping[str, ArrayLike]) -> FilterState:
    """State of an `adjustable` filter with other numbers, by name; a scalar fills an array.

    Raises:
        TypeError: a value is not of real numbers.
        ValueError: the state has no number of such a name, or one of another shape.
    """
    held = state.memory.numbers
    for name, given in numbers.items():
        require(name in held, f"no number '{name}' in this state; it has {sorted(held)}")
        found = jnp.asarray(number(f"{name} must be real", given), float)
        if found.shape not in ((), held[name].shape):
            raise ValueError(f"{name} has shape {held[name].shape}, got {found.shape}")
        held = held | {name: jnp.broadcast_to(found, held[name].shape)}
    return state._replace(memory=replace(state.memory, numbers=held))
