"""Sobol indices: what each uncertain parameter adds to the variance of the error."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.patches import Patch

from robins.report import series, style
from robins.report.numbers import words
from robins.report.style import Picture
from robins.results import find

_COLUMNS = 3  # blocks beside each other
_ORDERS = {"first": "first order: alone", "total": "total: with others"}
_THICK = 0.36  # of a bar; two of them to a parameter


@style.styled
def budget(solution: xr.Dataset) -> Picture:
    """First-order and total indices of each block, with their 95 % bounds."""
    blocks = find(solution, "sobol_first")
    names = series.coordinate(solution, "parameter")
    columns = min(_COLUMNS, len(blocks))
    rows = -(-len(blocks) // columns)
    height = 0.9 + rows * (0.55 + 0.42 * len(names))
    figure, grid = style.new(rows, columns, height, sharex=True, sharey=True)
    for number, axes in enumerate(grid.flat):
        axes.set_visible(number < len(blocks))
    for number, (axes, block) in enumerate(zip(grid.flat, blocks, strict=False)):
        _bars(axes, solution, block)
        axes.set_title(words(block))
        if number + columns >= len(blocks):
            axes.set_xlabel("share of the variance")
            axes.tick_params(labelbottom=True)
    grid[0, 0].set_yticks(range(len(names)), names)
    grid[0, 0].invert_yaxis()
    keys: list[Any] = [
        Patch(color=style.colour(k), label=text) for k, text in enumerate(_ORDERS.values())
    ]
    keys.append(style.key("95 % bounds", color=style.TRUTH, linewidth=1.2))
    style.legend(figure, keys)
    about = next(iter(blocks.values())).attrs
    caption = (
        f"Which share of the variance of the RMS error of '{about['of_filter']}' each uncertain "
        f"parameter of the world brings; {int(about['samples'])} samples of {int(about['runs'])} "
        "runs. First order: what would go if this one alone were known. Total: what would stay if "
        "all the others were. Lines: 95 % bounds by a bootstrap over points and runs."
    )
    return Picture("sensitivity", "What the variance of the error comes from", caption, figure)


def _bars(axes: Axes, solution: xr.Dataset, block: str) -> None:
    """Two bars for each parameter."""
    farthest = 1.0
    for k, order in enumerate(_ORDERS):
        value, low, high = (
            np.asarray(find(solution, f"sobol_{order}{end}")[block], float)
            for end in ("", "_low", "_high")
        )
        at = np.arange(len(value)) + (k - 0.5) * _THICK
        axes.barh(at, np.nan_to_num(value), _THICK, color=style.colour(k))
        axes.hlines(at, low, high, color=style.TRUTH, linewidth=1.2)
        farthest = max(farthest, float(np.max(np.nan_to_num(high), initial=0.0)))
    if not np.any(np.isfinite(find(solution, "sobol_total")[block])):
        axes.text(0.5, 0.5, "no indices", transform=axes.transAxes, ha="center", color=style.GREY)
    axes.grid(axis="y", visible=False)
    left, right = axes.get_xlim()
    axes.set_xlim(min(left, 0.0), max(right, 1.02 * farthest))
