"""Lateness of the steps of a bench, where they had deadlines."""

from __future__ import annotations

import numpy as np
import xarray as xr

from robins.report import style
from robins.report.style import Picture
from robins.results import find


@style.styled
def lateness(solution: xr.Dataset) -> Picture:
    """Histogram of lateness, with bins that widen as it grows."""
    roles = ("lateness_steps", "lateness_edge")
    counts, edges = (np.asarray(find(solution, role)[""], float) for role in roles)
    figure, grid = style.new_figure(1, 1, 2.6)
    axes = grid[0, 0]
    names = [f"< {_time(edges[0])}", *map(_time, edges)]
    last = max(int(np.flatnonzero(counts)[-1]), 1)
    at = np.arange(last + 1)
    axes.bar(at, counts[: last + 1], color=style.colour(0), width=0.9, align="edge")
    for x, count in zip(at, counts, strict=False):
        if count:
            axes.text(x + 0.45, count, f"{count:.0f}", ha="center", va="bottom", fontsize=7)
    axes.set_xticks(at, names[: last + 1], rotation=45, ha="right")
    axes.set(yscale="log", ylabel="steps", xlabel="from this late on")
    axes.set_xlim(0, last + 1)
    axes.set_ylim(0.5, 2.0 * np.max(counts))
    caption = f"{counts.sum():.0f} steps; how long after its deadline each began."
    return Picture("lateness", "Lateness of the steps", caption, figure)


def _time(us: float) -> str:
    for unit, size in (("s", 1e6), ("ms", 1e3)):
        if us >= size:
            return f"{us / size:g} {unit}"
    return f"{us:g} µs"
