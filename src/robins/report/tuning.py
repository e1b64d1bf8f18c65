"""Figures of tuning: factors with their intervals, and objectives of the held-out parts."""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib.axes import Axes

from robins.report import style
from robins.report.style import Picture


@style.styled
def tuning(solution: xr.Dataset) -> Picture:
    """Figure with the factor on each parameter (left) and the objective of each part (right)."""
    names = [str(name) for name in solution["parameter"].values]
    figure, grid = style.new_figure(1, 2, max(2.6, 1.4 + 0.3 * len(names)))
    _factors(grid[0, 0], names, solution)
    before, after = (solution[f"judged_{name}"].values for name in ("before", "after"))
    about = solution["judged_before"].attrs
    _parts(grid[0, 1], before, after, about)
    style.legend(
        figure,
        [
            style.key("as written", color=style.GREY, marker="o", linestyle="none"),
            style.key("tuned", color=style.colour(0), marker="o", linestyle="none"),
        ],
    )
    caption = (
        "Left: the factor that was found on each parameter, with its 95 % interval; one is as "
        f"written. Right: what tuning makes small ({about['comment']}), of each of the "
        f"{len(before)} {about['parts']} that were held out; lower is better."
    )
    return Picture("tuning", "Tuned, and judged on data held out", caption, figure)


def _factors(axes: Axes, names: list[str], solution: xr.Dataset) -> None:
    found, low, high = (solution[f"tuned_{name}"].values for name in ("factor", "low", "high"))
    rows = np.arange(len(names))[::-1]
    axes.axvline(1.0, color=style.GREY, linewidth=0.9)
    axes.hlines(rows, low, high, color=style.colour(0), linewidth=1.6)
    axes.plot(found, rows, "o", color=style.colour(0), markersize=4.5)
    axes.set_xscale("log")
    reach = 1.15 * np.exp(np.max(np.abs(np.log([*low, *high]))))
    ticks = [x for x in _TICKS if 1.0 / reach <= x <= reach]
    axes.set_xlim(1.0 / reach, reach)
    if len(ticks) <= _MOST_TICKS:
        axes.set_xticks(ticks, [f"{x:g}" for x in ticks])
        axes.minorticks_off()
    axes.set_yticks(rows, names)
    axes.set_ylim(-0.6, len(names) - 0.4)
    axes.set(xlabel="factor", title="Parameters")


_TICKS = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)
_MOST_TICKS = 5


def _parts(axes: Axes, before: np.ndarray, after: np.ndarray, about: dict[str, str]) -> None:
    order = np.argsort(before)
    places = np.arange(len(before))
    was, now = before[order], after[order]
    axes.vlines(places, was, now, color=style.GREY, linewidth=0.8)
    axes.plot(places, was, "o", color=style.GREY, markersize=4.0)
    axes.plot(places, now, "o", color=style.colour(0), markersize=4.0)
    axes.set_xticks([])
    axes.set(xlabel=f"{about['parts']} held out, in order", ylabel=about["label"], title="Judged")
