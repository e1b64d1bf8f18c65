"""On what machine a filter is stepped: the functions of a step, compiled by JAX or as programs.

A machine keeps a state and steps it by the filter's own functions. `ByJax` calls them compiled by
JAX. `ByProgram` hands them, each under a name, to a memory that compiles them for this one state:
in C it is that of `robins.program`, which knows no filter.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping
from functools import partial
from typing import Any, Literal, Protocol

import jax
import jax.numpy as jnp

from robins.filters.belief import StepInfo
from robins.filters.checks import one_of
from robins.filters.kalman import Filter, FilterState, Prediction
from robins.filters.model import Data, Model
from robins.filters.run import Step, filter_step
from robins.filters.values import content, on_device

Name = Literal["jax", "c"]
Codes = tuple[Any, dict[str, Any]]  # of a step: of its prediction, and by sensor


class Memory(Protocol):
    """What keeps a state and compiles functions of it; `robins.program.Memory` is one."""

    state: Any

    def step(self, name: Hashable, function: Callable[..., Any], *args: Any) -> Any:
        """Step the state by ``(state, *args) -> (state, result)``; gives the result."""
        ...

    def look(self, name: Hashable, function: Callable[..., Any], *args: Any) -> Any:
        """What ``(state, *args) -> result`` gives; the state stays."""
        ...


Machine = Callable[[Any, Hashable], Memory]  # of a state, and of what the functions hold


@jax.jit
def _predict(filter_, motion, state, u):
    return filter_.predict(state, motion, u)


@jax.jit
def _update(filter_, sensor, state, y, aux):
    return filter_.update(state, sensor, y, aux)


@partial(jax.jit, static_argnames=("keep",))
def _step(filter_, model, state, u, y, aux, keep):
    return _stepped(filter_, model, state, u, y, aux, keep)


@partial(jax.jit, static_argnames=("question",))
def _look(filter_, model, state, args, question):
    return question(filter_, model, state, *args)


def _stepped(filter_, model, state, u, y, aux, keep):
    state, step = filter_step(filter_, model, state, u, y, aux)
    return state, (keep(step), (step.prediction.code, {k: i.code for k, i in step.info.items()}))


class ByJax:
    """A state, stepped by functions that JAX compiles.

    Attributes:
        state: what they step.
    """

    is_numpy = False

    def __init__(self, filter_: Filter, model: Model, state: FilterState):
        """Take a filter and a model, whose numbers are handed to the device once."""
        self._filter, self._model = on_device((filter_, model))
        self.state = state

    def predict(self, u: Data) -> Prediction:
        """Move on by one step."""
        self.state, told = _predict(self._filter, self._model.motion, self.state, u)
        return told

    def update(self, name: str, y: Data, aux: Data) -> StepInfo:
        """Use a measurement of a sensor."""
        self.state, told = _update(self._filter, self._model.sensor(name), self.state, y, aux)
        return told

    def step(
        self, u: Data, y: Mapping[str, Any], aux: Mapping[str, Any], keep: Callable[[Step], Any]
    ) -> tuple[Any, Codes]:
        """A whole step: what is kept of it, and its codes."""
        self.state, told = _step(self._filter, self._model, self.state, u, y, aux, keep)
        return told[0], jax.device_get(told[1])

    def look(self, question: Callable[..., Any], *args: Any) -> Any:
        """What ``question(filter, model, state, *args)`` gives."""
        return _look(self._filter, self._model, self.state, args, question)


class ByProgram:
    """A state in a memory, stepped by functions that the memory compiles for it.

    Here the numbers of a filter and of a model are known, and folded into the programs.
    """

    is_numpy = True

    def __init__(self, filter_: Filter, model: Model, state: FilterState, machine: Machine):
        """Of a filter, a model and a state, in the memory that a machine gives."""
        self._filter, self._model = filter_, model
        self._memory = machine(state, content(filter_, model))
        self._sensors = {
            s.name: (("update", s.name), partial(_used, filter_, s)) for s in model.sensors
        }

    @property
    def state(self) -> FilterState:
        """What they step; to be assigned too."""
        return self._memory.state

    @state.setter
    def state(self, state: FilterState) -> None:
        self._memory.state = state

    def predict(self, u: Data) -> Prediction:
        """Move on by one step."""
        return self._memory.step("predict", self._predicted, u)

    def _predicted(self, state: FilterState, u: Data) -> tuple[FilterState, Prediction]:
        return self._filter.predict(state, self._model.motion, u)

    def update(self, name: str, y: Data, aux: Data) -> StepInfo:
        """Use a measurement of a sensor."""
        return self._memory.step(*self._sensors[name], y, aux)

    def step(
        self, u: Data, y: Mapping[str, Any], aux: Mapping[str, Any], keep: Callable[[Step], Any]
    ) -> tuple[Any, Codes]:
        """A whole step: what is kept of it, and its codes."""

        def stepped(state: FilterState, u: Data, y: Data, aux: Data) -> Any:
            return _stepped(self._filter, self._model, state, u, y, aux, keep)

        return self._memory.step(("step", keep), stepped, u, y, aux)

    def look(self, question: Callable[..., Any], *args: Any) -> Any:
        """What ``question(filter, model, state, *args)`` gives."""
        return self._memory.look(question, partial(question, self._filter, self._model), *args)


def _used(filter_, sensor, state, y, aux):
    return filter_.update(state, sensor, y, aux)


def on(
    machine: Machine | str, filter_: Filter, model: Model, state: FilterState
) -> ByJax | ByProgram:
    """A state on a machine.

    Args:
        machine: "jax", "c", or what makes a memory.
        filter_: what is stepped,
        model: with what.
        state: to begin with.

    Raises:
        ValueError: there is no machine of this name.
        robins.program.BuildError: there is no C compiler.
        robins.program.ProgramError: the state holds numbers that have no place in a program.
    """
    if callable(machine):
        return ByProgram(filter_, model, state, machine)
    one_of("machine", machine, Name)
    if machine == "jax":
        return ByJax(filter_, model, state)
    # Imported here: a filter needs neither programs nor a compiler.
    from robins.program import Memory

    return ByProgram(filter_, model, state, Memory)


def settled(state: FilterState) -> FilterState:
    """With types of their own: a weak one would have all compiled again after the first step."""
    if not any(getattr(x, "weak_type", False) for x in jax.tree_util.tree_leaves(state)):
        return state
    return jax.tree_util.tree_map(lambda x: jnp.asarray(x, jnp.asarray(x).dtype), state)
