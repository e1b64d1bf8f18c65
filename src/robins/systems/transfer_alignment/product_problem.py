"""The study "product": a slave on an aircraft, a ship or a vehicle, aligned closed loop.

The truth of a run is drawn from what the filter "product" is told: initial errors, biases, noise,
mounting error and flexure, from the sigmas of the scenario. So a right filter is consistent.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Annotated, Any, Literal

import numpy as np
import pydantic
import xarray as xr

from robins import units
from robins.scenario import Quantity, default
from robins.systems.judgement import judging
from robins.systems.parts import Names
from robins.systems.study import Limit, Problem, Scenario
from robins.systems.tables import place_arrays
from robins.systems.transfer_alignment.pair import simulate_pair
from robins.systems.transfer_alignment.pair_answer import BLOCKS, SENSORS
from robins.systems.transfer_alignment.pair_course import Course, lay_out
from robins.systems.transfer_alignment.pair_parameters import PairParameters
from robins.systems.transfer_alignment.product import ATTITUDE, POSITION, VELOCITY, ProductState
from robins.systems.transfer_alignment.product_claims import (
    CLAIMS,
    FIVE_ARCMIN,
    product_metrics,
)
from robins.systems.transfer_alignment.product_filters import (
    Believed,
    product_contender,
)

_REPORTED = tuple(block for block in BLOCKS if block.name != "flexure")


class Product(Scenario, PairParameters):
    """A pair to be aligned by filters of the product model."""

    system: Literal["transfer-alignment"] = "transfer-alignment"
    study: Literal["product"] = "product"
    title: str = "Transfer alignment, closed loop"
    filters: Names = ("kf", "product")
    believed: Believed = pydantic.Field(default_factory=Believed)
    # figures pooled over time count from here, when the manoeuvre has shown what there is to see
    settle: Annotated[float, Quantity("time", least="0 s")] = default("0 s")


def product_problem(given: Product, filters: tuple[str, ...], seed: int) -> Problem:
    """The scenario as a problem for a campaign.

    Raises:
        ValueError: the pair cannot be laid out, nothing is left to count, or a filter is unknown.
    """
    course = lay_out(given)
    count_from = int(np.searchsorted(course.epoch_s, given.settle))
    if count_from == len(course.epoch_s):
        raise ValueError(
            f"settle = {given.settle:g} s leaves nothing to count of a run of "
            f"{course.epoch_s[-1]:g} s: shorten it or lengthen the manoeuvre"
        )
    contenders = {
        name: product_contender(given, name, given.believed, [b.name for b in _REPORTED])
        for name in filters
    }
    used = (ATTITUDE, VELOCITY, *((POSITION,) if given.believed.position else ()))
    return Problem(
        simulate=partial(simulate_pair, given, course, seed),
        contenders=contenders,
        epoch_s=course.epoch_s,
        blocks=_REPORTED,
        sensors={name: SENSORS[name] for name in used},
        context=_context(course),
        metrics=product_metrics,
        claims=judging(CLAIMS),
        shown=_tracks,
        count_from=count_from,
        limits=(Limit(FIVE_ARCMIN, "attitude", units.parse("5 arcmin", "angle")),),
        notes=("The pair is simulated; --master and --slave align a recorded one.",),
    )


def _tracks(means: Mapping[str, ProductState]) -> dict[str, Any]:
    """Where each filter thought the slave was in the first run."""

    def of(field: str) -> np.ndarray:
        return np.stack([np.asarray(getattr(m.ins.position, field)) for m in means.values()])

    return place_arrays("track", map(of, ("lat", "lon", "alt")))


def _context(course: Course) -> xr.Dataset:
    """The true path of the slave, for figures."""
    p = course.path.position
    return xr.Dataset(place_arrays("reference", (p.lat, p.lon, p.alt), "true {}"))
