"""The satellite as a problem for a campaign."""

from __future__ import annotations

from functools import partial

import numpy as np
import xarray as xr

from robins.results import array
from robins.systems.judgement import judging
from robins.systems.satellite.claims import CLAIMS
from robins.systems.satellite.contender import contender
from robins.systems.satellite.course import Course, lay_out
from robins.systems.satellite.metrics import attitude_metrics
from robins.systems.satellite.nodes import STAR
from robins.systems.satellite.parameters import AttitudeLoop
from robins.systems.satellite.world import simulate
from robins.systems.study import Norm, Output, Problem, SensorAxes, StateBlock

AXES = ("x", "y", "z (boresight)")
BLOCKS = (
    StateBlock("attitude", slice(0, 3), "rad", "arcsec", "body", AXES),
    StateBlock("gyro_bias", slice(3, 6), "rad/s", "arcsec/s", "body", AXES),
)


def attitude_problem(given: AttitudeLoop, filters: tuple[str, ...], seed: int) -> Problem:
    """The closed loop with each of the filters.

    Raises:
        ValueError: a craft that cannot be, too few wheels, a filter that is unknown, a design that
            does not exist, or one by LMI without the extra "lmi".
        ImportError: the Hipparcos catalogue without the extra "stars".
    """
    course = lay_out(given)
    counted = int(np.searchsorted(course.time_s, given.counted_from + 1e-9))
    return Problem(
        simulate=partial(simulate, given, course, seed),
        contenders={name: contender(given, course, name) for name in filters},
        epoch_s=course.time_s,
        blocks=BLOCKS,
        sensors={STAR: SensorAxes("rad", "body", AXES, "arcsec")},
        context=_context(course),
        metrics=attitude_metrics,
        claims=judging(CLAIMS, given.claims),
        count_from=counted,
        outputs=_outputs(given),
        norms=(Norm("attitude", (0, 1, 2)),),
        windows=(slice(counted, len(course.time_s)),),
    )


def _outputs(given: AttitudeLoop) -> tuple[Output, ...]:
    wheels = tuple(f"wheel {i}" for i in range(len(given.wheels.axes)))
    return (
        Output(
            "pointing",
            "rad",
            "arcsec",
            "reference",
            ("x", "y", "z"),
            "Where the craft points against where it should.",
            is_error=True,
        ),
        Output(
            "wheel_momentum",
            "N m s",
            "N m s",
            "wheel axes",
            wheels,
            f"Momentum of the wheels, first run; each holds {given.wheels.momentum:g} N m s.",
        ),
    )


def _context(course: Course) -> xr.Dataset:
    """When the star sensor is lost."""
    lost = (course.due & ~np.asarray(course.steps.star.seen)).astype(np.int8)
    return xr.Dataset(array("outage", lost, long_name="star sensor lost") if np.any(lost) else {})
