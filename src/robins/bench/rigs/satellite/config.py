"""Input of the parts of the satellite before a run: numbers only, so that it can be sent.

The bench computes it once, and hands each process a copy; a part started by hand on another
machine computes the same.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial
from jaxtyping import Array

from robins import _float64  # noqa: F401
from robins.bench.rigs.satellite.messages import WHEELS
from robins.filters import Belief, Filter, Model
from robins.filters.kalman import FilterState
from robins.scenario import ScenarioError
from robins.sim.rate_table import RateTable
from robins.systems.satellite.model import ADDITIVE, MULTIPLICATIVE, Build, make_filter
from robins.systems.satellite.nodes import (
    LoopConstants,
    StateForm,
    StepInputs,
    VehicleState,
    compiled_alone,
)
from robins.systems.satellite.parameters import AttitudeLoop

_BLOCK = 1024  # rows of a run that a part has as vectors at a time


class SatelliteConfig(NamedTuple):
    """Complete input of a run of the satellite; E steps."""

    step_ns: int
    due: np.ndarray  # (E,) bool, whether a step ends with a star frame
    given: LoopConstants
    rows: StepInputs  # leading axis E, NumPy
    vehicle: VehicleState  # before the first step
    build: Build
    model: Model
    start: Belief | FilterState
    attitude_rad: float  # believed of an attitude from a single star frame
    table: RateTable | None  # None: it goes with the craft exactly
    machine: str = "jax"  # that parts compute by

    @property
    def filter(self) -> Filter:
        """The filter of the attitude determination."""
        return make_filter(self.build)

    @property
    def belief(self) -> Belief:
        """Belief of the filter before the first step."""
        return self.start.belief if isinstance(self.start, FilterState) else self.start

    @property
    def form(self) -> StateForm:
        """Form of its state."""
        return ADDITIVE if self.build == "quaternion" else MULTIPLICATIVE

    @property
    def frames(self) -> tuple[int, int]:
        """A step without a star frame, if there is one, and one with."""
        return int(np.argmin(self.due)), int(np.argmax(self.due))


def prepare(setup: Any, given: AttitudeLoop) -> SatelliteConfig:
    """The config of a run of the bench.

    Raises:
        ScenarioError: the filter has no place in a program of C.
    """
    from robins.systems.satellite.study import FILTERS  # as below: no process of a part needs it

    if setup.machine != "jax" and (why := FILTERS[setup.filter].on_host):
        what = f"filter '{setup.filter}' cannot be a program: {why}"
        fix = f'leave machine = "{setup.machine}" out, or choose another filter'
        raise ScenarioError([f"machine: {what}; {fix}"])
    table = None if setup.table is None else setup.table.table()
    return satellite_config(given, setup.filter, setup.seed, table=table)._replace(
        machine=setup.machine
    )


def satellite_config(
    given: AttitudeLoop, name: str, seed: int, index: int = 0, table: RateTable | None = None
) -> SatelliteConfig:
    """The config of a run: the same numbers that run ``index`` of a campaign of this seed has.

    Args:
        given: the satellite.
        name: of its filter.
        seed: of all noise.
        index: number of the run.
        table: what carries the gyro, if it lags.

    Raises:
        ValueError: no such filter, more wheels than the wire carries, or what the study refuses.
    """
    from robins.systems.satellite.study import FILTERS, contender
    from robins.systems.satellite.world import lay_out, simulate

    if (wheels := len(given.wheels.axes)) > WHEELS:
        raise ValueError(
            f"wheels.axes: the wire carries {WHEELS} wheels, this craft has {wheels}: leave some "
            "out, or run it without the bench"
        )
    course = lay_out(given)
    of = contender(given, course, name)
    # Compiled as in a campaign of one run, whose bits the bench is to have.
    world = jax.jit(lambda k: simulate(given, course, seed, k))(jnp.asarray(index))
    case = of.case(world)
    loop = case.loop
    assert loop is not None
    assert isinstance(loop.react, Partial)
    return SatelliteConfig(
        step_ns=round(given.step * 1e9),
        due=np.asarray(course.due),
        given=loop.react.args[0],
        rows=jax.tree_util.tree_map(np.asarray, loop.rows),
        vehicle=loop.world,
        build=FILTERS[name].build,
        model=of.model,
        start=case.start,
        attitude_rad=given.believed.attitude,
        table=table,
    )


def compiled(config: SatelliteConfig, function: Callable) -> Callable:
    """A pure function as the parts of a run compute it: by JAX, or as a program."""
    if config.machine == "jax":
        return jax.jit(function)
    # what runs by JAX does not need it
    from robins.program import compiled_step, interpreted_step, native

    engine = compiled_step if config.machine == "c" else interpreted_step
    made: list[Callable] = []

    def call(*args: Any) -> Any:
        if not made:
            made.append(native(function, *args, engine=engine))
        return made[0](*args)

    return call


def driven(config: SatelliteConfig, node: Callable) -> Callable:
    """A node compiled, driven by the rows of a run.

    A row travels as one vector: to be given an array more costs compiled code more than most nodes
    compute.

    Args:
        config: with the rows.
        node: ``(given, *args, row) -> out``, kept apart as `robins.systems.satellite.nodes.react`
            does.

    Returns:
        ``(step, *args, begins=()) -> out``; a step beyond the last has the row of the last, so that
        a part may compute beyond it. ``begins`` takes the place of the first numbers of the row.
    """
    columns, shape = jax.tree_util.tree_flatten(config.rows)
    steps = len(config.due)
    ends = np.cumsum([x[0].size for x in columns])

    def run(given: LoopConstants, numbers: Array, *args: Any):
        pieces = zip(jnp.split(numbers, ends[:-1]), columns, strict=True)
        row = shape.unflatten([p.reshape(x.shape[1:]).astype(x.dtype) for p, x in pieces])
        return compiled_alone(node, given, *args, row)

    @lru_cache(maxsize=1)
    def block(number: int) -> np.ndarray:
        some = [x[number * _BLOCK : (number + 1) * _BLOCK] for x in columns]
        return np.concatenate([x.reshape(len(x), -1).astype(float) for x in some], axis=1)

    # JAX is given what stays the same, as `react` is; in a program it is folded.
    by_jax = config.machine == "jax"
    call = (
        partial(jax.jit(run), config.given)
        if by_jax
        else compiled(config, partial(run, config.given))
    )

    def at(step: int, *args: Any, begins: Sequence[float] | np.ndarray = ()):
        number, row = divmod(min(step, steps - 1), _BLOCK)
        numbers = block(number)[row]
        if len(begins):
            numbers = np.concatenate([begins, numbers[len(begins) :]])
        return call(numbers, *args)

    return at
