"""The kit of a run, from the parameters of a satellite and a seed."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial

from robins.bench.rigs.satellite.kit import Kit
from robins.bench.rigs.satellite.messages import WHEELS
from robins.scenario import ScenarioError
from robins.sim.rate_table import RateTable
from robins.systems.satellite.parameters import AttitudeLoop
from robins.systems.satellite.study import FILTERS, contender
from robins.systems.satellite.world import lay_out, simulate


def prepare(setup: Any, given: AttitudeLoop) -> Kit:
    """The kit of a run of the bench.

    Raises:
        ScenarioError: the filter has no place in a program of C.
    """
    if setup.machine != "jax" and (why := FILTERS[setup.filter].on_host):
        what = f"filter '{setup.filter}' cannot be a program: {why}"
        fix = f'leave machine = "{setup.machine}" out, or choose another filter'
        raise ScenarioError([f"machine: {what}; {fix}"])
    table = None if setup.table is None else setup.table.table()
    return kit_for(given, setup.filter, setup.seed, table=table)._replace(machine=setup.machine)


def kit_for(
    given: AttitudeLoop, name: str, seed: int, index: int = 0, table: RateTable | None = None
) -> Kit:
    """The kit of a run: the same numbers that run ``index`` of a campaign of this seed has.

    Args:
        given: the satellite.
        name: of its filter.
        seed: of all noise.
        index: number of the run.
        table: what carries the gyro, if it lags.

    Raises:
        ValueError: no such filter, more wheels than the wire carries, or what the study refuses.
    """
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
    return Kit(
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
