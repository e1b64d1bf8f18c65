"""Filters in closed loop: the estimate controls the vehicle.

The next measurement then depends on the filter, so vehicle, controller, sensors and filter step
together, in one scan.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike

from robins.errors import require
from robins.filters.belief import Belief, Code
from robins.filters.kalman import WRONG, Filter, FilterState, Updated
from robins.filters.model import Data, Model, Sensor
from robins.filters.run import Keep, Step, check_names, everything, nothing, report_run
from robins.filters.tally import Tally
from robins.filters.values import as_data, is_known, on_device
from robins.manifold import State

T = TypeVar("T")
_Carry = tuple[FilterState, Data, Tally]  # Data: the world


class Reading(NamedTuple):
    """Output of the world in one step."""

    u: Data  # input of the filter's motion
    y: Mapping[str, Data]  # measurements at the end of the step by sensor; NaN is missing
    truth: State  # true state at the end of the step, of the structure of the filter's
    aux: Mapping[str, Data] = {}
    rows: Array | None = None  # (r, n), reported error = rows @ tangent error; None: identity
    outputs: Data = ()  # further outputs of the world to keep, such as the pointing error


class Loop(NamedTuple):
    """World around a filter: vehicle, controller and sensors.

    Attributes:
        react: ``(world, belief, row) -> (world, Reading)``, pure: one step of the world, given the
            belief at its beginning. Bind data with ``jax.tree_util.Partial``.
        world: its state before the first step, a pytree of arrays.
        rows: external inputs of the steps, a pytree with leading axis T.
        due: (T,) bool by sensor, True where there can be a measurement; by default everywhere.
            Elsewhere the update is skipped. If it is batched, both branches are computed.
    """

    react: Callable[[Data, Belief, Data], tuple[Data, Reading]]
    world: Data
    rows: Data
    due: Mapping[str, ArrayLike] = {}


def _no_measurement(
    filter_: Filter, sensor: Sensor, state: FilterState, y: Data, aux: Data
) -> Updated:
    """Unchanged state, and the information of an update without a measurement."""
    like = jax.eval_shape(lambda s, z, a: filter_.update(s, sensor, z, a)[1], state, y, aux)
    blank = jax.tree_util.tree_map(lambda x: jnp.zeros(x.shape, x.dtype), like)
    m = sensor.dim
    notes = blank.notes | ({WRONG: filter_.suspicions(state)} if filter_.suspects else {})
    return state, blank._replace(
        innovation=jnp.full(m, jnp.nan),
        factor=jnp.eye(m),
        code=jnp.asarray(int(Code.MISSING)),
        notes=notes,
    )


@partial(jax.jit, static_argnames=("keep",))
def _scan(
    filter_: Filter, model: Model, state: FilterState, loop: Loop, keep: Keep
) -> ClosedLoopRun:
    def body(carry: _Carry, given: tuple[Data, Data]) -> tuple[_Carry, tuple[Data, Reading]]:
        state, world, tally = carry
        row, due = given
        world, reading = loop.react(world, state.belief, row)
        check_names(model, reading.y)
        state, prediction = _unfused(filter_.predict, state, model.motion, reading.u)
        info = {}
        for sensor in model.sensors:
            if sensor.name in reading.y:
                args = (state, reading.y[sensor.name], reading.aux.get(sensor.name))
                taken = partial(_update, filter_, sensor)
                if sensor.name in due:
                    spared = partial(_no_measurement, filter_, sensor)
                    state, info[sensor.name] = jax.lax.cond(due[sensor.name], taken, spared, *args)
                else:
                    state, info[sensor.name] = taken(*args)
        step = Step(prediction, state.belief, info)
        return (state, world, tally.add_step(prediction.code, info)), (keep(step), reading)

    (state, world, tally), (steps, readings) = jax.lax.scan(
        body, (state, loop.world, Tally.blank(tuple(model.dims))), (loop.rows, dict(loop.due))
    )
    return ClosedLoopRun(steps, readings, state, world, tally)


def _update(filter_: Filter, sensor: Sensor, state: FilterState, y: Data, aux: Data) -> Updated:
    return _unfused(filter_.update, state, sensor, y, aux)


def _unfused(step: Callable[..., T], *args: Data) -> T:
    """Call a step of the filter without fusing it with the world, as `OnlineFilter` compiles it.

    The results are then bit-identical to those of separate programs for filter and world.
    """
    leaves, shape = jax.tree_util.tree_flatten(args)
    barrier = jax.lax.optimization_barrier
    return barrier(step(*shape.unflatten(barrier(leaves))))


class ClosedLoopRun(NamedTuple):
    """Result of a closed-loop run; steps and readings have a leading axis of T steps."""

    steps: Data  # result of `keep` for each `robins.filters.Step`
    readings: Reading
    final: FilterState
    world: Data  # final state of the world
    tally: Tally  # outcomes of all steps, whatever was kept


def run_closed(
    filter_: Filter,
    model: Model,
    start: Belief | FilterState,
    loop: Loop,
    keep: Keep = everything,
    time_s: ArrayLike | None = None,
) -> ClosedLoopRun:
    """Run a filter in closed loop.

    In each step the world reacts to the belief, then the filter predicts with the input of the
    reading and updates with each sensor. With the readings as its data, `run` gives the same
    estimates, to rounding. Other arguments, errors and warnings are those of `run`.

    Raises:
        ValueError: ``due`` or a reading names no sensor of the model, or ``due`` is not as long as
            the rows.
    """
    steps = {jnp.shape(x)[0] for x in jax.tree_util.tree_leaves((loop.rows, loop.due))}
    require(len(steps) == 1, "rows and due of a loop must have one length", sorted(steps))
    check_names(model, loop.due)
    state = filter_.init(start, model.dims) if isinstance(start, Belief) else start
    state, *arrays = on_device((state, loop.world, loop.rows, loop.due))
    loop = Loop(as_data(loop.react), *arrays)
    closed = _scan(filter_, model, state, loop, keep)

    def again(other: Filter) -> FilterState:
        return _scan(other, model, state, loop, nothing).final

    report_run(filter_, state, closed.final, closed.tally, again, time_s)
    if keep is everything and is_known(closed.tally):
        tally = closed.tally.with_innovations(closed.steps.info, closed.readings.y)
        closed = closed._replace(tally=tally)
    return closed
