"""Study "city": report of the filters, and claims."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr

from robins.systems.gnss import filters, world
from robins.systems.gnss.model import POSITION, sensor_axes
from robins.systems.gnss.parameters import City
from robins.systems.gnss.world import GnssCourse
from robins.systems.judgement import Claim, Metric, Metrics, consistency, nees_claim, ratio
from robins.systems.study import Contender, Norm, Study, View
from robins.systems.tables import place_arrays, track_arrays

HORIZONTAL = "horizontal"


def contender(city: City, course: GnssCourse, name: str) -> Contender:
    """A filter with its model, by name."""
    return filters.contender(city, course.place, course.member, name)


def view(city: City, course: GnssCourse) -> View:
    """Report of position errors, the true path, and the track of each filter in the first run."""
    place = course.place
    p = place.geodetic(course.position)
    return View(
        epoch_s=course.epoch_s,
        blocks=(POSITION,),
        sensors=sensor_axes(course.satellites),
        metrics=_metrics,
        context=xr.Dataset(place_arrays("reference", (p.lat, p.lon, p.alt), "true {}")),
        shown=lambda means: track_arrays(place.geodetic(m.position) for m in means.values()),
        count_from=int(np.searchsorted(course.epoch_s, city.settle)),
        norms=(Norm(HORIZONTAL, (0, 1)),),
    )


def _metrics(statistics: Any) -> dict[str, Metric]:
    """Horizontal mean and RMS over runs and epochs, vertical RMS, consistency."""
    square = statistics.pooled_rms**2
    return {
        "horizontal_mean_m": float(np.mean(statistics.norm(HORIZONTAL)[:, 0])),
        "horizontal_rms_m": float(np.sqrt(square[0] + square[1])),
        "vertical_rms_m": float(np.sqrt(square[2])),
        **consistency(statistics),
        "diverged_runs": statistics.diverged,
    }


def _best_other(metrics: Metrics) -> float:
    others = [m["horizontal_mean_m"] for name, m in metrics.items() if name != "delays"]
    return metrics["delays"]["horizontal_mean_m"] / min(others)


CLAIMS = {
    "halves": Claim(
        "A delay state for each satellite makes the mean horizontal error at most half of that of "
        "least squares; value: their ratio",
        ("delays", "ls"),
        ratio("delays", "ls", "horizontal_mean_m"),
        (0.0, 0.5),
    ),
    "best": Claim(
        "Delay states err less than robust weights on white noise; value: their mean horizontal "
        "error over that of the best other filter",
        ("delays", "huber", "student-t", "switchable"),
        _best_other,
        (0.0, 1.0),
    ),
    "honest": nees_claim(
        "The position of the filter with delay states errs no more than it says: the mean NEES "
        "over its three components stays below 1.3 of what it should be",
        "delays",
        "position",
        (0.0, 1.3),
    ),
}

# smoothers are listed so that a campaign that requests one gets an error pointing to the replay
CITY = Study(City, filters.NAMES, world.simulate, contender, view, world.lay_out, CLAIMS)
