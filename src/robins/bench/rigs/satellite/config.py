"""Input of the parts of the satellite for a run: numbers only, so that it can be pickled.

The bench computes it once, and gives each process a copy; a part started by hand on another
machine computes the same.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from typing import TYPE_CHECKING, Any, NamedTuple

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

if TYPE_CHECKING:
    from robins.bench.run.setup import Setup

_BLOCK = 1024  # rows of a run that a part converts to vectors at a time


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
    attitude_rad: float  # assumed sigma of the attitude from a single star frame
    table: RateTable | None  # None: the gyro turns with the craft exactly
    machine: str = "jax"  # by which parts compute

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
        """Form of the state."""
        return ADDITIVE if self.build == "quaternion" else MULTIPLICATIVE

    @property
    def frames(self) -> tuple[int, int]:
        """Numbers of a step without a star frame, if there is one, and of a step with one."""
        return int(np.argmin(self.due)), int(np.argmax(self.due))


def prepare(setup: Setup, given: AttitudeLoop) -> SatelliteConfig:
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
    """Config of a run, with the numbers of run ``index`` of a campaign of this seed.

    Args:
        given: the satellite.
        name: of its filter.
        seed: of all noise.
        index: number of the run.
        table: rate table that turns the gyro with a lag; None: no lag.

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
    # Compiled as in a campaign of one run, for the same bits.
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
    """Compile a pure function for the parts of a run: by JAX, or as a program."""
    if config.machine == "jax":
        return jax.jit(function)
    # not needed with JAX
    from robins.program import compiled_step, interpreted_step, native

    engine = compiled_step if config.machine == "c" else interpreted_step
    made: list[Callable] = []

    def call(*args: Any) -> Any:
        if not made:
            made.append(native(function, *args, engine=engine))
        return made[0](*args)

    return call


def driven(config: SatelliteConfig, node: Callable) -> Callable:
    """Compile a node that is driven by the rows of a run.

    A row is passed as one vector: each further array argument costs compiled code more time than
    most nodes compute.

    Args:
        config: with the rows.
        node: ``(given, *args, row) -> out``, compiled separately as
            `robins.systems.satellite.nodes.react` does.

    Returns:
        ``(step, *args, begins=()) -> out``; a step beyond the last uses the row of the last, so
        that a part may compute beyond it. ``begins`` replaces the first numbers of the row.
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

    # Constants are arguments for JAX, as in `react`; in a program they are folded.
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
