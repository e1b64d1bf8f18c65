"""The airship in the wind as a problem for a campaign."""

from __future__ import annotations

from functools import partial

import numpy as np
import xarray as xr

from robins.systems.airship.claims import CLAIMS, airship_metrics, published
from robins.systems.airship.contender import contender
from robins.systems.airship.model import SAR, STAR, STAR_EARLY, WIND, WIND_OF_STAR
from robins.systems.airship.parameters import Airship
from robins.systems.airship.world import lay_out, simulate
from robins.systems.judgement import judging
from robins.systems.study import Norm, Problem, SensorAxes, StateBlock

ENU = ("east", "north", "up")
BLOCKS = (
    StateBlock("attitude", slice(0, 3), "rad", "arcsec", "ENU", ENU),
    StateBlock("velocity", slice(3, 6), "m/s", "m/s", "ENU", ENU),
    StateBlock("position", slice(6, 9), "m", "m", "ENU", ENU),
)
"""What every filter of the study reports, errors being true minus estimated."""

NORMS = (Norm("horizontal", (6, 7)), Norm("velocity", (3, 4)))

_LEVEL = ("north", "east")
SENSORS = {
    SAR: SensorAxes("m or rad", "NED", (*_LEVEL, "heading", "up")),
    STAR: SensorAxes("rad", "Euler", ("pitch", "roll", "heading")),
    STAR_EARLY: SensorAxes("rad", "Euler", ("pitch", "roll", "heading")),
    WIND: SensorAxes("m/s", "NED", _LEVEL),
    WIND_OF_STAR: SensorAxes("m/s", "NED", _LEVEL),
}
_AROUND_LOSS_S = (-1.0, 100.0, 200.0, 299.0, 350.0, 500.0)  # of which figures are stated


def airship_problem(given: Airship, filters: tuple[str, ...], seed: int) -> Problem:
    """The scenario as a problem for a campaign.

    Raises:
        ValueError: the flight is too short, or a filter is unknown.
    """
    course = lay_out(given)
    windy = given.wind.gusts is not None or given.wind.turbulence is not None
    made = {name: contender(given, course, name) for name in filters}
    # an epoch that ends a span belongs to it: 200 s to 800 s are the epochs 200.0 to 800.0
    first, last = (
        int(np.searchsorted(course.epoch_s, t))
        for t in (given.counted.begin - 1e-9, given.counted.end + 1e-9)
    )
    lost = given.sar.lost[0].begin if given.sar.lost else None
    at_s = () if lost is None else tuple(lost + t for t in _AROUND_LOSS_S)
    return Problem(
        simulate=partial(simulate, given, course, seed),
        contenders={name: c._replace(facts=published(name, windy)) for name, c in made.items()},
        epoch_s=course.epoch_s,
        blocks=BLOCKS,
        sensors=SENSORS,
        context=xr.Dataset(),
        metrics=partial(airship_metrics, course.epoch_s, at_s),
        claims=judging(CLAIMS, given.claims),
        count_from=first,
        count_to=last,
        norms=NORMS,
        bound_of="product",
    )
