"""Draw the picture of the README's first screen, a track through an outage of GNSS with its bound.

python docs/pictures/outage.py [RESULT of `robins run ins-gnss/drive --filters ekf`]
"""

import sys
from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection
from matplotlib.patches import Patch

from robins import results
from robins.report import maps, style
from robins.results import find
from robins.workbench import run

TARGET = Path(__file__).with_name("outage.png")
ENLARGED = 20.0  # errors of a metre beside a way of a kilometre
AROUND = 45  # steps shown before and after the outage
BOUND = "#BFD9EA"


def mark_bounds(axes: Axes, places: np.ndarray, sigmas: np.ndarray) -> None:
    """Fill ellipses of three sigmas about the places; both (T, 2), east and north, metres."""
    width, height = (2.0 * 3.0 * sigmas).T
    ellipses = EllipseCollection(
        width, height, 0.0, units="xy", offsets=places, transOffset=axes.transData, color=BOUND
    )
    axes.add_collection(ellipses)


@style.styled
def draw(solution: xr.Dataset) -> None:
    """Draw the true path, the estimate and its bound around the outage."""
    hidden = np.asarray(solution["outage"].values) != 0
    first, last = np.flatnonzero(hidden)[[0, -1]]
    part = slice(first - AROUND, last + AROUND)
    truth = np.stack(maps.paths(solution)["reference"])[::-1, part].T
    error, sigma = (
        ENLARGED * find(solution, role)["position"].values[0, part, 1::-1]
        for role in ("error", "sigma")
    )
    figure, grid = style.new_figure()
    figure.set_size_inches(5.6, 3.5)  # beside the live page, of the same shape
    axes = grid[0, 0]
    fine = np.linspace(0.0, len(truth) - 1.0, 40 * len(truth))
    at, wide = (
        np.stack([np.interp(fine, np.arange(len(truth)), column) for column in array.T], axis=1)
        for array in (truth, sigma)
    )
    mark_bounds(axes, at, wide)
    gap = np.where(hidden[part, None], truth, np.nan)
    axes.plot(*gap.T, color="#F2CF63", linewidth=5.0, solid_capstyle="butt")
    axes.plot(*truth.T, color=style.TRUTH, linewidth=0.9)
    axes.plot(*(truth + error).T, color=style.colour(0), linewidth=1.6)
    axes.set(xlabel="east [m]", ylabel="north [m]")
    axes.set_aspect("equal", adjustable="datalim")
    axes.update_datalim([*(truth - sigma), *(truth + sigma)])
    axes.autoscale_view()
    keys = [
        style.key("true path", color=style.TRUTH, linewidth=0.9),
        style.key("no GNSS, 30 s", color="#F2CF63", linewidth=5.0),
        style.key("estimate, error x 20", color=style.colour(0), linewidth=1.6),
        Patch(color=BOUND, label="its bound of 3 sigma x 20"),
    ]
    axes.legend(handles=keys, loc="best")
    figure.savefig(TARGET, dpi=200)


if __name__ == "__main__":
    if len(sys.argv) > 1:
        draw(results.read(sys.argv[1]).solution)
    else:
        draw(run("ins-gnss/drive", filters=["ekf"]).solution)
