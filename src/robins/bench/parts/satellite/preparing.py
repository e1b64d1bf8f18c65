"""The kit of a run, from the parameters of a satellite and a seed."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial

from robins.bench.parts.satellite.kit import Kit
from robins.bench.wire.schema import WHEELS
from robins.sim.rate_table import RateTable
from robins.systems.satellite.contender import Numbers, contender, surroundings
from robins.systems.satellite.course import lay_out
from robins.systems.satellite.filters import KINDS
from robins.systems.satellite.parameters import AttitudeLoop
from robins.systems.satellite.world import simulate


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
        ValueError: no such filter, more wheels than the wire carries, or what `attitude_problem`
            refuses.
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
    assert isinstance(of.case, Partial)
    numbers: Numbers = of.case.args[0]
    around, rows, vehicle = surroundings(numbers, world)
    return Kit(
        step_ns=round(given.step * 1e9),
        due=np.asarray(course.due),
        given=around,
        rows=jax.tree_util.tree_map(np.asarray, rows),
        vehicle=vehicle,
        build=KINDS[name].build,
        model=of.model,
        start=case.start,
        attitude_rad=given.believed.attitude,
        table=table,
    )
