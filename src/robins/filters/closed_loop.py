"""A filter in closed loop: its estimate controls the vehicle.

`run` goes over measurements that are there beforehand. Where a controller acts on the estimate,
what is measured next depends on the filter, so vehicle, controller, sensors and filter step
together, in one scan.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import ArrayLike

from robins.errors import require
from robins.filters.belief import Belief, Code, StepInfo
from robins.filters.kalman import Filter, FilterState
from robins.filters.model import Data, Model, Sensor
from robins.filters.run import Step, check_names, everything, is_traced, nothing
from robins.filters.tally import Tally, warn_not_taken
from robins.filters.values import as_data


class Reading(NamedTuple):
    """What the world answers in a step."""

    u: Data  # input of the filter's motion
    y: Mapping[str, Any]  # measurements at the end of the step by sensor; NaN is missing
    truth: Any  # true state at the end of the step, of the structure of the filter's
    aux: Mapping[str, Any] = {}
    rows: Any = None  # (r, n) reported = rows @ tangent error; None: all of it
    outputs: Any = ()  # what else is to be kept of the world, such as the pointing error


class Loop(NamedTuple):
    """The world around a filter.

    Attributes:
        react: ``(world, belief, row) -> (world, Reading)``, pure: how the world goes on through one
            step when this is believed at its beginning. Data belongs into a
            ``jax.tree_util.Partial``.
        world: its state before the first step, a pytree of arrays.
        rows: what drives the steps from outside, a pytree with leading axis T.
        due: (T,) bool by sensor, when there can be a measurement. Where there cannot, the update is
            not computed at all, which is most of the time of a slow sensor; sensors that are not
            named are always due. Keep it out of what is batched, or both ways are computed.
    """

    react: Callable[[Any, Belief, Any], tuple[Any, Reading]]
    world: Any
    rows: Any
    due: Mapping[str, Any] = {}


def _without(filter_: Filter, sensor: Sensor, state: FilterState, y: Data, aux: Data):
    """The state as it is, and the information of an update that had nothing to use."""
    like = jax.eval_shape(lambda s, z, a: filter_.update(s, sensor, z, a)[1], state, y, aux)
    blank: StepInfo = jax.tree_util.tree_map(lambda x: jnp.zeros(x.shape, x.dtype), like)
    m = sensor.dim
    return state, blank._replace(
        innovation=jnp.full(m, jnp.nan), factor=jnp.eye(m), code=jnp.asarray(int(Code.MISSING))
    )


@partial(jax.jit, static_argnames=("keep",))
def _scan(filter_, model, state, loop: Loop, keep):
    def body(carry, given):
        state, world, tally = carry
        row, due = given
        world, reading = loop.react(world, state.belief, row)
        check_names(model, reading.y)
        state, prediction = _apart(filter_.predict, state, model.motion, reading.u)
        info = {}
        for sensor in model.sensors:
            if sensor.name in reading.y:
                args = (state, reading.y[sensor.name], reading.aux.get(sensor.name))
                taken = partial(_update, filter_, sensor)
                if sensor.name in due:
                    spared = partial(_without, filter_, sensor)
                    state, info[sensor.name] = jax.lax.cond(due[sensor.name], taken, spared, *args)
                else:
                    state, info[sensor.name] = taken(*args)
        step = Step(prediction, state.belief, info)
        return (state, world, tally.and_step(prediction.code, info)), (keep(step), reading)

    (state, world, tally), (steps, readings) = jax.lax.scan(
        body, (state, loop.world, Tally.blank(tuple(model.dims))), (loop.rows, dict(loop.due))
    )
    return steps, readings, state, world, tally


def _update(filter_: Filter, sensor: Sensor, state: FilterState, y: Data, aux: Data):
    return _apart(filter_.update, state, sensor, y, aux)


def _apart(step: Callable, *args: Any) -> Any:
    """A step of the filter as `OnlineFilter` compiles it, not fused with the world around it.

    So a loop has the same bits here and where filter and world are programs of their own.
    """
    leaves, shape = jax.tree_util.tree_flatten(args)
    settled = jax.lax.optimization_barrier
    return settled(step(*shape.unflatten(settled(leaves))))


class Closed(NamedTuple):
    """A run in closed loop; steps and readings have a leading axis of T steps."""

    steps: Any  # what `keep` chose of each `robins.filters.Step`
    readings: Reading  # what the world answered, truth and outputs included
    final: FilterState
    world: Any  # state of the world at the end
    tally: Tally  # how the steps went, whatever was kept of them


def run_closed(
    filter_: Filter,
    model: Model,
    start: Belief | FilterState,
    loop: Loop,
    keep: Callable[[Step], Any] = everything,
    time_s: ArrayLike | None = None,
) -> Closed:
    """Run a filter in a loop: for each step the world reacts to what is believed, then the filter
    predicts with what the world answered and updates with each sensor.

    With the readings as its data, `run` gives the same estimates, to rounding.

    Args:
        filter_: from `kalman` and its kin.
        model: the motion and the sensors.
        start: belief before the first step, or a state of the filter.
        loop: the world.
        keep: what to keep of each step.

        time_s: (T,) time of each step [s], which errors then name.

    Raises:
        Exception: what a rule has to report, as in `robins.filters.run`.
        ValueError: ``due`` or a reading names no sensor of the model, or ``due`` is not as long as
            the rows.

    Warns:
        StepWarning: as in `robins.filters.run`.
    """
    steps = {jnp.shape(x)[0] for x in jax.tree_util.tree_leaves((loop.rows, loop.due))}
    require(len(steps) == 1, "rows and due of a loop must have one length", sorted(steps))
    check_names(model, loop.due)
    state = filter_.init(start, model.dims) if isinstance(start, Belief) else start
    as_arrays = partial(jax.tree_util.tree_map, jnp.asarray)
    state, world, rows, due = (as_arrays(x) for x in (state, loop.world, loop.rows, loop.due))
    loop = Loop(as_data(loop.react), world, rows, due)
    closed = Closed(*_scan(filter_, model, state, loop, keep))
    if not is_traced(closed.final):

        def again(other: Filter) -> FilterState:
            return _scan(other, model, state, loop, nothing)[2]

        filter_.report(state, closed.final, again, time_s)
    if not is_traced(closed.tally):
        warn_not_taken(closed.tally)
        if keep is everything:
            tally = closed.tally.looking(closed.steps.info, closed.readings.y)
            closed = closed._replace(tally=tally)
    return closed
