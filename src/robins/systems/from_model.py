"""A study without model mismatch: the world is drawn from the model of its filters.

For a first system. The true state at the start is drawn from the belief, and then

    x+ = retract(f(x), L w),    y = retract(h(x), R v),    w, v ~ N(0, I)

with L and R the factors of the model's noise. A correct filter is then consistent: its errors
are as large as its sigmas, and its NEES and NIS lie in their bands. Replace parts of the study by
`dataclasses.replace` as the system grows: `simulate` when the world text from the model, `view`
when the report needs axes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, TypeVar

import jax
import numpy as np
from jaxtyping import Array

from robins import manifold, units
from robins.errors import require
from robins.filters import Belief, Filter, Model, Sensor
from robins.manifold import State
from robins.sim.random import Component, stream, unit
from robins.systems.judgement import Claim
from robins.systems.study import Case, Contender, Scenario, SensorAxes, StateBlock, Study, View

ParametersT = TypeVar("ParametersT", bound=Scenario)
Faults = Callable[[Array, Mapping[str, Any]], Mapping[str, Any]]


Believed = tuple[Model, Belief]  # what all runs share; the belief is that at the start


def study_from_model(
    model: Model | Callable[[ParametersT], Model],
    start: Belief | Callable[[ParametersT], Belief],
    filters: Mapping[str, Filter],
    steps: int,
    *,
    step_s: float = 1.0,
    states: Mapping[str, str] | None = None,
    readings: Mapping[str, str] | None = None,
    faults: Faults | None = None,
    claims: Mapping[str, Claim] | None = None,
    parameters: type[ParametersT] | None = None,
) -> Study[ParametersT, Believed, Case]:
    """A study whose runs are drawn from a model and estimated by filters that assume it.

    Args:
        model: motion and sensors, without inputs; or a function of the parameters.
        start: mean and covariance at time zero; or a function of the parameters.
        filters: by name; all run where none is named.
        steps: number of steps E of a run, each with a reading of every sensor.
        step_s: time of a step [s], for figures.
        states: name -> SI unit of each component of the error, in order; "x0", ... without unit
            where not given.
        readings: sensor -> SI unit of its readings; without unit where not given.
        faults: (key, readings by sensor with leading axis E) -> readings as they come: outliers,
            or NaN where one is missing. Pure; draws come from the key.
        claims: by id, checked after a campaign.
        parameters: subclass of `Scenario`, the argument of `model` and `start` where they are
            functions.

    Raises:
        ValueError: there is no step, or no filter; raised when runs are laid out: states or
            readings are named that the model does not have, or `check` finds what does not fit.
    """
    require(steps > 0, "a study needs a step at least", steps)
    require(filters, "a study needs a filter at least")

    def lay_out(given: ParametersT) -> Believed:
        made = model if isinstance(model, Model) else model(given)
        belief = start if isinstance(start, Belief) else start(given)
        check(made, belief, states or {}, readings or {})
        return made, belief

    def simulate(given: ParametersT, course: Believed, seed: int, run: Array) -> Case:
        truth, y = draw_run(*course, steps, partial(stream, seed, run))
        if faults is not None:
            y = faults(stream(seed, run, Component.FAULT), y)
        return Case(course[1], u=None, y=y, aux={}, truth=truth)

    def contender(given: ParametersT, course: Believed, name: str) -> Contender[Case]:
        return Contender(filters[name], course[0])

    def view(given: ParametersT, course: Believed) -> View:
        epoch_s = step_s * np.arange(1, steps + 1)
        return View(epoch_s, blocks(course[1], states), axes(course[0], readings or {}))

    chosen: Any = Scenario if parameters is None else parameters
    return Study(chosen, tuple(filters), simulate, contender, view, lay_out, claims or {})


def check(
    model: Model, start: Belief, states: Mapping[str, str], readings: Mapping[str, str]
) -> None:
    """Refuse sizes that do not fit (`tried`) and unknown units, before anything is drawn.

    Raises:
        ValueError: as `tried` and `require_units` raise it.
    """
    jax.eval_shape(partial(tried, model), start.mean)
    require_units("states", states)
    require_units("readings", readings)


def tried(model: Model, x: State) -> None:
    """Take one step from x, and read each sensor there, to find what does not fit.

    Raises:
        ValueError: a step, a reading or a noise does not have the size that it should have.
    """
    model.motion.moved(x, None)
    model.motion.noise_factor(x, None)
    for sensor in model.sensors:
        name, size = sensor.name, manifold.dim(sensor.reading(x, None))
        text = f"sensor '{name}' reads {size} numbers, and its noise (or dim=) is of {sensor.dim}"
        require(size == sensor.dim, text)
        sensor.noise_factor(x, None)


def require_units(of: str, named: Mapping[str, str]) -> None:
    """Refuse an unknown unit, by the name whose unit it is.

    Raises:
        UnitError: a unit is not one of `robins.units.UNITS`.
    """
    for name, symbol in named.items():
        try:
            units.unit(symbol)
        except units.UnitError as error:
            fix = "write one of the SI such as 'm', 'm/s' or 'rad', or '1' for none"
            raise units.UnitError(error.what, f"{of}[{name!r}]", fix) from None


def draw_run(
    model: Model, start: Belief, count: int, key: Callable[[int], Array]
) -> tuple[State, dict[str, State]]:
    """True states and readings by sensor of a run, leading axis E.

    Args:
        model: motion and sensors.
        start: of the true state before the first step.
        count: number of steps E.
        key: component -> key of its stream, see `robins.sim.random.stream`.
    """
    motion = model.motion

    def spread(x: State, factor: Array, key: Array) -> State:
        return manifold.retract(x, factor @ jax.random.normal(key, factor.shape[1:]))

    def move(x: State, key: Array) -> tuple[State, State]:
        x = spread(motion.moved(x, None), motion.noise_factor(x, None), key)
        return x, x

    first = spread(start.mean, start.factor, key(Component.INITIAL_STATE))
    _, truth = jax.lax.scan(move, first, jax.random.split(key(Component.TRAJECTORY), count))

    def read(sensor: Sensor, x: State, key: Array) -> State:
        return spread(sensor.reading(x, None), sensor.noise_factor(x, None), key)

    keys = [jax.random.split(key(unit(Component.SENSOR, k)), count) for k in range(len(model.dims))]
    pairs = zip(model.sensors, keys, strict=True)
    return truth, {s.name: jax.vmap(partial(read, s))(truth, k) for s, k in pairs}


def blocks(start: Belief, states: Mapping[str, str] | None) -> list[StateBlock]:
    """State block of each component of the error.

    Raises:
        ValueError: the number of names text from that of components.
    """
    n = start.factor.shape[-1]
    named = dict.fromkeys((f"x{k}" for k in range(n)), "1") if states is None else states
    require(len(named) == n, f"states names {', '.join(named)}; the error has {n} components")
    return [
        StateBlock(name, slice(k, k + 1), of, of, "state", (name,))
        for k, (name, of) in enumerate(named.items())
    ]


def axes(model: Model, readings: Mapping[str, str]) -> dict[str, SensorAxes]:
    """Units and names of the components of each sensor.

    Raises:
        ValueError: a sensor is named that the model does not have.
    """
    known = model.dims
    unknown = ", ".join(set(readings) - set(known))
    require(not unknown, f"readings names {unknown}; the model has {', '.join(known)}")
    return {
        name: SensorAxes(
            readings.get(name, "1"),
            "sensor",
            (name,) if dim == 1 else tuple(f"{name} {k}" for k in range(dim)),
        )
        for name, dim in known.items()
    }
