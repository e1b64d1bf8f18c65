"""Sobol indices: what each uncertain parameter adds to the variance of the error."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.patches import Patch
from rich.table import Table
from rich.text import Text

from robins.report import series, style
from robins.report.numbers import words
from robins.report.style import Picture
from robins.results import find

_COLUMNS = 3  # blocks side by side
_ORDERS = {"first": "first order: alone", "total": "total: with others"}
_SLICES, _FEW = 10, 8  # of the means over a parameter: how many, and points in each at least
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


@style.styled
def scatter(solution: xr.Dataset, block: str) -> Picture:
    """RMS error of the independent points over each parameter, and its mean in slices."""
    count = 2 * int(find(solution, "sobol_first")[block].attrs["samples"])
    rms, unit = series.shown(find(solution, "sobol_rms")[block])
    share = find(solution, "sobol_share")[""]
    names = series.coordinate(solution, "parameter")
    ends = [text.split(" to ") for text in share.attrs["ends"].split("; ")]
    columns = min(_COLUMNS, len(names))
    rows = -(-len(names) // columns)
    figure, grid = style.new(rows, columns, 0.3 + 2.2 * rows, sharey=True)
    for number, axes in enumerate(grid.flat):
        axes.set_visible(number < len(names))
        if number % columns == 0:
            axes.set_ylabel(f"{words(block)} RMS [{unit}]" if unit else f"{words(block)} RMS")
    slices = max(2, min(_SLICES, count // _FEW))
    for k, (axes, name) in enumerate(zip(grid.flat, names, strict=False)):
        x, y = np.asarray(share, float)[:count, k], rms[:count]
        axes.plot(x, y, ".", markersize=2.5, color=style.colour(0), alpha=0.5)
        slice_ = np.minimum((x * slices).astype(int), slices - 1)
        there = np.unique(slice_)
        means = [np.mean(y[slice_ == s]) for s in there]
        axes.plot((there + 0.5) / slices, means, color=style.colour(1), linewidth=1.8)
        axes.set_xticks([0.0, 1.0], ends[k])
        for label, side in zip(axes.get_xticklabels(), ("left", "right"), strict=True):
            label.set_horizontalalignment(side)  # within their axes
        axes.set_xlabel(name)
    style.legend(
        figure,
        [
            style.key("point", color=style.colour(0), marker=".", linestyle=""),
            style.key("mean of a slice", color=style.colour(1), linewidth=1.8),
        ],
    )
    caption = (
        "Each point is the RMS error over the runs, with all parameters drawn at once. How far the "
        "line goes up and down is the first order of a parameter; how far points scatter about it "
        "is what the others bring."
    )
    title = f"{words(block)} over each parameter"
    return Picture(f"sensitivity_{block}", title, caption, figure)


def table(solution: xr.Dataset) -> Table:
    """A row for each block and parameter, the greatest total first, as rich can print it."""
    made = Table(box=None, pad_edge=False, header_style="bold", padding=(0, 2, 0, 0))
    for head in ("share of", "parameter"):
        made.add_column(head, no_wrap=True)
    for head in ("first order", "95 %", "total", "95 %"):
        made.add_column(head, justify="right", no_wrap=True)
    names = series.coordinate(solution, "parameter")
    for block in find(solution, "sobol_first"):
        values = {order: _of(solution, order, block) for order in _ORDERS}
        for place, k in enumerate(np.argsort(-np.nan_to_num(values["total"][0]), kind="stable")):
            cells = [words(block) if place == 0 else "", names[k]]
            for value, low, high in (values[order][:, k] for order in _ORDERS):
                none = np.isnan(value)
                cells += [
                    "–" if none else f"{value:.2f}",
                    "" if none else f"{low:.2f} to {high:.2f}",
                ]
            made.add_row(*map(Text, cells))
    return made


def _of(solution: xr.Dataset, order: str, block: str) -> np.ndarray:
    """(3, parameters) index with its lower and its upper bound."""
    ends = ("", "_low", "_high")
    return np.stack([np.asarray(find(solution, f"sobol_{order}{e}")[block], float) for e in ends])


def _bars(axes: Axes, solution: xr.Dataset, block: str) -> None:
    """Two bars for each parameter."""
    farthest = 1.0
    for k, order in enumerate(_ORDERS):
        value, low, high = _of(solution, order, block)
        at = np.arange(len(value)) + (k - 0.5) * _THICK
        axes.barh(at, np.nan_to_num(value), _THICK, color=style.colour(k))
        axes.hlines(at, low, high, color=style.TRUTH, linewidth=1.2)
        farthest = max(farthest, float(np.max(np.nan_to_num(high), initial=0.0)))
    if not np.any(np.isfinite(find(solution, "sobol_total")[block])):
        axes.text(0.5, 0.5, "no indices", transform=axes.transAxes, ha="center", color=style.GREY)
    axes.grid(axis="y", visible=False)
    left, right = axes.get_xlim()
    axes.set_xlim(min(left, 0.0), max(right, 1.02 * farthest))
