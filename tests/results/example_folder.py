"""A result to write, read and damage."""

import numpy as np
import xarray as xr

from robins.results import ResultWriter, array, variable


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
    shown = {"unit": "rad", "frame": "NED", "axes": axes, "display_unit": "deg"}
    count = array("context", np.int64(2**40 + 1), "count", unit="1", dims="")
    return xr.Dataset(
        array("error", error, "attitude", **shown) | array("outage", np.arange(50) > 40) | count,
        coords={
            "filter": ["kalman", "robust – ü"],
            "time": variable("time", np.linspace(0.1, 5.0, 50), "s", "time"),
        },
    )


def write(path, values, dataset=None, files=None):
    """Write a whole result at once; files by name."""
    with ResultWriter(path) as writer:
        writer.save_summary(values)
        if dataset is not None:
            writer.save_solution(dataset)
        for name, content in (files or {}).items():
            writer.save_file(name, content)


def names(path):
    """Everything a writer could leave behind, hidden folders included."""
    return sorted(p.name for p in path.iterdir())
