"""The rocket as problems for a campaign: with magnetic attitude, and with the field vector."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import xarray as xr

from robins.results import array
from robins.systems.judgement import judging
from robins.systems.rocket.angle_contender import angle_contender, sight_of
from robins.systems.rocket.angles import GYRO, MAGNETIC
from robins.systems.rocket.claims import CLAIMS
from robins.systems.rocket.field import FIELD, SNAPSHOT
from robins.systems.rocket.field_contender import field_contender
from robins.systems.rocket.metrics import angle_metrics, field_metrics
from robins.systems.rocket.parameters import FieldVector, Flight, MagneticAttitude
from robins.systems.rocket.unobserved import sentence, unobserved
from robins.systems.rocket.world import Course, lay_out, simulate
from robins.systems.study import Norm, Problem, SensorAxes, StateBlock
from robins.systems.tables import block_array

BODY = ("x", "y", "z")
EULER = ("roll", "pitch", "yaw")
ANGLES = SensorAxes("rad", "launch NED", EULER, "deg")
ACROSS = Norm("across_field", (4, 5))

ANGLE_BLOCKS = (
    StateBlock("attitude", slice(0, 3), "rad", "deg", "launch NED", EULER),
    StateBlock("rate", slice(3, 6), "rad/s", "deg/s", "FRD", ("p", "q", "r")),
)
FIELD_BLOCKS = (
    StateBlock("attitude", slice(0, 3), "rad", "deg", "FRD", BODY),
    StateBlock("field_attitude", slice(3, 6), "rad", "deg", "field", ("about", "level", "upright")),
    StateBlock("gyro_bias", slice(6, 9), "rad/s", "deg/h", "FRD", BODY),
)


def angle_problem(given: MagneticAttitude, filters: tuple[str, ...], seed: int) -> Problem:
    """Test-bed A as a problem for a campaign.

    Raises:
        ValueError: the flight ends on the ground or leaves the life of the magnetic model, or a
            filter is unknown.
    """
    course, sight = lay_out(given), sight_of(given, filters)
    rate = SensorAxes("rad/s", "FRD", ("p", "q", "r"), "deg/s")
    return _problem(
        given,
        course,
        seed,
        contenders={name: angle_contender(given, name, sight) for name in filters},
        blocks=ANGLE_BLOCKS,
        sensors={GYRO: rate if given.gyro_reads == "rate" else ANGLES, MAGNETIC: ANGLES},
        metrics=partial(angle_metrics, course),
    )


def field_problem(given: FieldVector, filters: tuple[str, ...], seed: int) -> Problem:
    """Test-bed B as a problem for a campaign.

    Raises:
        ValueError: the flight ends on the ground or leaves the life of the magnetic model, or a
            filter is unknown.
    """
    course = lay_out(given)
    return _problem(
        given,
        course,
        seed,
        contenders={name: field_contender(given, course, name) for name in filters},
        blocks=FIELD_BLOCKS,
        sensors={name: SensorAxes("T", "FRD", BODY, "uT") for name in (FIELD, SNAPSHOT)},
        metrics=partial(field_metrics, course),
        norms=(ACROSS,),
    )


def _problem(given: Flight, course: Course, seed: int, **own: Any) -> Problem:
    """What the two studies share."""
    measured = np.where(course.seen[:, None], course.field_n, np.nan)
    notes = []
    if np.any(course.seen):
        notes.append(sentence(unobserved(measured, given.magnetometer.noise)))
    return Problem(
        simulate=partial(simulate, given, course, seed),
        epoch_s=course.time_s,
        context=_context(course),
        claims=judging(CLAIMS, given.claims),
        count_from=int(np.searchsorted(course.time_s, given.counted_from + 1e-9)),
        windows=course.bursts,
        notes=notes,
        **own,
    )


def _context(course: Course) -> xr.Dataset:
    """The path and the field, for figures."""
    height = array("context", course.alt_m, "height", unit="m", display_unit="km")
    axes = ("north", "east", "down")
    block = StateBlock("field_n", slice(0, 3), "T", "uT", "launch NED", axes)
    about = {"long_name": "geomagnetic field", "dims": "time axis_field_n"}
    field = block_array("context", block, course.field_n, **about)
    return xr.Dataset(height | field)
