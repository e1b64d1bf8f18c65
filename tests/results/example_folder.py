"""A result to write, read and damage."""

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from robins.results import variable


def a_summary(**changes):
    return {
        "scenario": "walk/street",
        "seed": 7,
        "runs": 1,
        "filters": {"kalman": {"horizontal_rms_m": 0.03}},
        "claims": [],
        "counts": {"nan": 2},
        "seconds": 1.5,
    } | changes


def a_solution(scale=1.0):
    rng = np.random.default_rng(0)
    error = scale * rng.normal(size=(2, 50, 3))
    error[0, 3, 1] = np.nan
    axes = ["roll", "pitch", "heading"]
    return xr.Dataset(
        {
            "error_attitude": variable(
                ("filter", "time", "axis_attitude"),
                error,
                "rad",
                "attitude error",
                frame="NED",
                display_unit="deg",
            ),
            "outage": variable("time", np.arange(50) > 40, "1", "aids withheld"),
            "count": variable((), np.int64(2**40 + 1), "1", "number of samples"),
        },
        coords={
            "filter": ["kalman", "robust – ü"],
            "axis_attitude": axes,
            "time": variable("time", np.linspace(0.1, 5.0, 50), "s", "time"),
        },
    )


def a_figure():
    figure = Figure()
    figure.subplots().plot([1, 2, 3])
    return figure


def names(path):
    """Everything a writer could leave behind, hidden folders included."""
    return sorted(p.name for p in path.iterdir())
