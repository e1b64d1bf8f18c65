"""Machines: the state of a filter, stepped by functions that JAX compiles or by programs.

`ProgramStepper` passes the functions of the filter, each under a name, to a `CompiledState`, which
compiles them for this one state. `robins.program`, which does not depend on filters, has one.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping
from functools import partial
from typing import Literal, Protocol, TypeVar

import jax

from robins.filters.belief import StepInfo
from robins.filters.checks import one_of
from robins.filters.kalman import Advanced, Filter, FilterState, Prediction, Updated
from robins.filters.model import Data, Model, Motion, Sensor
from robins.filters.run import Keep, Step, filter_step
from robins.filters.values import Numbers, on_device, split_numbers

T = TypeVar("T")
Name = Literal["jax", "vm", "c"]
Codes = tuple[Numbers, dict[str, Numbers]]  # codes of a step: of its prediction, and by sensor


class CompiledState(Protocol):
    """State with compiled functions that step it, such as `robins.program.NativeState`."""

    state: Data

    def step(
        self, name: Hashable, function: Callable[..., tuple[FilterState, T]], *args: Data
    ) -> T:
        """Step the state by ``(state, *args) -> (state, result)``; return the result."""
        ...


# Makes the memory for a state; the second argument is a key of the content of its functions.
Machine = Callable[[FilterState, Hashable], CompiledState]


def _predicted(filter_: Filter, motion: Motion, state: FilterState, u: Data) -> Advanced:
    return filter_.predict(state, motion, u)


def _updated(filter_: Filter, sensor: Sensor, state: FilterState, y: Data, aux: Data) -> Updated:
    return filter_.update(state, sensor, y, aux)


def _stepped(
    filter_: Filter, model: Model, state: FilterState, u: Data, y: Data, aux: Data, keep: Keep
) -> tuple[FilterState, tuple[Data, Codes]]:
    state, step = filter_step(filter_, model, state, u, y, aux)
    return state, (keep(step), (step.prediction.code, {k: i.code for k, i in step.info.items()}))


def _answer(
    filter_: Filter, model: Model, state: FilterState, args: Data, question: Callable[..., T]
) -> T:
    return question(filter_, model, state, *args)


_predict, _update = jax.jit(_predicted), jax.jit(_updated)
_step = jax.jit(_stepped, static_argnames=("keep",))
_look = jax.jit(_answer, static_argnames=("question",))


class JaxStepper:
    """State stepped by functions that JAX compiles."""

    is_numpy = False

    def __init__(self, filter_: Filter, model: Model, state: FilterState):
        """Copy the numbers of a filter and a model to the device, once."""
        self._filter, self._model = on_device((filter_, model))
        self.state = state

    def predict(self, u: Data) -> Prediction:
        """Predict over one step."""
        self.state, prediction = _predict(self._filter, self._model.motion, self.state, u)
        return prediction

    def update(self, name: str, y: Data, aux: Data) -> StepInfo:
        """Update with a measurement of a sensor."""
        self.state, info = _update(self._filter, self._model.sensor(name), self.state, y, aux)
        return info

    def step(
        self, u: Data, y: Mapping[str, Data], aux: Mapping[str, Data], keep: Callable[[Step], T]
    ) -> tuple[T, Codes]:
        """Take a whole step; return the part that is kept, and the codes."""
        self.state, (kept, codes) = _step(self._filter, self._model, self.state, u, y, aux, keep)
        return kept, jax.device_get(codes)

    def look(self, question: Callable[..., T], *args: Data) -> T:
        """Return ``question(filter, model, state, *args)``."""
        return _look(self._filter, self._model, self.state, args, question)


class ProgramStepper:
    """State stepped by programs, in a memory that also holds the numbers of filter and model.

    Programs made for one filter thus serve all that differ from it in numbers alone. The methods
    are those of `JaxStepper`.
    """

    is_numpy = True

    def __init__(self, filter_: Filter, model: Model, state: FilterState, machine: Machine):
        """Put a filter, a model and a state into the memory that `machine` makes."""
        self._numbers, self._joined, key = split_numbers((filter_, model))
        self._memory = machine(self._held(state), key)

    def _held(self, state: FilterState) -> FilterState:
        return state._replace(memory=(state.memory, self._numbers))

    @property
    def state(self) -> FilterState:
        state = self._memory.state
        return state._replace(memory=state.memory[0])

    @state.setter
    def state(self, state: FilterState) -> None:
        self._memory.state = self._held(state)

    def _step(self, name: Hashable, function: Callable[..., tuple[FilterState, T]], *args: Data):
        """Step by ``(filter, model, state, *args) -> (state, result)``; return the result."""

        def stepped(held: FilterState, *args: Data) -> tuple[FilterState, T]:
            memory, numbers = held.memory
            state, result = function(*self._joined(numbers), held._replace(memory=memory), *args)
            return state._replace(memory=(state.memory, numbers)), result

        return self._memory.step(name, stepped, *args)

    def predict(self, u: Data) -> Prediction:
        return self._step("predict", lambda f, m, x, u: _predicted(f, m.motion, x, u), u)

    def update(self, name: str, y: Data, aux: Data) -> StepInfo:
        def updated(filter_: Filter, model: Model, *given: Data) -> Updated:
            return _updated(filter_, model.sensor(name), *given)

        return self._step(("update", name), updated, y, aux)

    def step(
        self, u: Data, y: Mapping[str, Data], aux: Mapping[str, Data], keep: Callable[[Step], T]
    ) -> tuple[T, Codes]:
        return self._step(("step", keep), partial(_stepped, keep=keep), u, y, aux)

    def look(self, question: Callable[..., T], *args: Data) -> T:
        def answered(filter_: Filter, model: Model, state: FilterState, *args: Data):
            return state, question(filter_, model, state, *args)

        return self._step(("look", question), answered, *args)


def usual() -> Name:
    """Default machine: "vm", which compiles nothing, or "jax" if there is no interpreter."""
    from robins.program import BuildError
    from robins.program.interpreter import interpreter_of_one

    try:
        interpreter_of_one()
    except BuildError:
        return "jax"
    return "vm"


def on(
    machine: Machine | str, filter_: Filter, model: Model, state: FilterState
) -> JaxStepper | ProgramStepper:
    """Place a state on a machine: "jax", "vm", "c", or a function that makes a `CompiledState`.

    Raises:
        ValueError: there is no machine of this name.
        robins.program.BuildError: there is no C compiler for "c", or no C++ compiler for "vm".
        robins.program.ProgramError: the state holds numbers that a program cannot represent.
    """
    if callable(machine):
        return ProgramStepper(filter_, model, state, machine)
    one_of("machine", machine, Name)
    if machine == "jax":
        return JaxStepper(filter_, model, state)
    # Imported here: a filter needs neither programs nor a compiler.
    from robins.program import NativeState, compiled_step, compiler, interpreted_step
    from robins.program.interpreter import interpreter_of_one

    engine = compiled_step
    if machine == "c":
        compiler()
    else:
        interpreter_of_one()
        engine = interpreted_step
    return ProgramStepper(
        filter_, model, state, partial(NativeState, engine=engine, persistent=True)
    )
