"""Style of figures: one style, colours that the colour-blind can distinguish, nothing global."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Sequence
from functools import wraps
from typing import Any, NamedTuple

import numpy as np
from matplotlib import style
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

WIDTH = 7.2  # inches; at 9 points the text of a figure is as large as that of the page around it

# Okabe and Ito (2008): distinct with every kind of colour vision. The line styles carry the same
# distinction onto paper without colours.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
LINES = ("-", "--", "-.", (0, (1, 1)))
TINTED = 4  # filters whose tints can be distinguished
_COLUMNS = 3  # panels side by side
_ROWS = 2  # rows of a legend that fit every figure
_REMARK = 100  # characters in a line of a remark
TRUTH = "#222222"
GREY = "#6B6B6B"
OUTAGE = "#FBE9B0"
BAND = "#DDE7EE"

_SETTINGS = {
    "font.size": 9.0,
    "font.sans-serif": ["DejaVu Sans", "Verdana", "sans-serif"],  # repeated by every text of an SVG
    "axes.titlesize": 9.0,
    "axes.titlelocation": "left",
    "axes.labelsize": 9.0,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": GREY,
    "axes.formatter.limits": (-4, 5),
    "grid.color": "#E3E3E3",
    "grid.linewidth": 0.6,
    "xtick.color": GREY,
    "ytick.color": GREY,
    "xtick.labelcolor": TRUTH,
    "ytick.labelcolor": TRUTH,
    "lines.linewidth": 1.2,
    "lines.solid_joinstyle": "round",
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "legend.handlelength": 2.2,
    "svg.fonttype": "none",  # text stays text: smaller, searchable, read out by screen readers
    "svg.hashsalt": "robins",  # same figure, same file
}


class Picture(NamedTuple):
    """A figure with its name, title and caption."""

    name: str  # of its file
    title: str
    caption: str  # reading aid for the figure
    figure: Figure


def styled(draw: Callable) -> Callable:
    """Decorator: draw in the style of robins, then restore the user's settings."""

    @wraps(draw)
    def drawn(*args: Any, **kwargs: Any) -> Any:
        with style.context(["default", _SETTINGS]):
            return draw(*args, **kwargs)

    return drawn


def new_figure(
    rows: int = 1, columns: int = 1, height: float = 2.6, **kwargs: Any
) -> tuple[Figure, np.ndarray]:
    """A figure without pyplot, and its axes as an array of rows and columns; height in inches."""
    figure = Figure(figsize=(WIDTH, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.subplots(rows, columns, squeeze=False, **kwargs)


def panels(
    count: int,
    base: float,
    each: float,
    x: str = "",
    y: str = "",
    *,
    sharex: bool = False,
    sharey: bool = False,
) -> tuple[Figure, np.ndarray]:
    """Figure with this many axes, three per row; unused ones are hidden.

    Args:
        count: of the axes.
        base: height without rows, in inches.
        each: height of a row.
        x: label of the lowest axes of each column.
        y: label of the first axes of each row.
        sharex: all axes have one scale along x.
        sharey: likewise along y.
    """
    columns = min(_COLUMNS, count)
    rows = -(-count // columns)
    figure, grid = new_figure(rows, columns, base + rows * each, sharex=sharex, sharey=sharey)
    for number, axes in enumerate(grid.flat):
        axes.set_visible(number < count)
        if number % columns == 0:
            axes.set_ylabel(y)
        if number + columns >= count:
            axes.set_xlabel(x)
            axes.tick_params(labelbottom=True)
    return figure, grid


def colour(index: int) -> str:
    """Colour of the filter or axis of that number."""
    return COLOURS[index % len(COLOURS)]


def dark(index: int) -> tuple[float, float, float]:
    """A dark shade of that colour, for lines on top of those in the colour itself."""
    red, green, blue = to_rgb(colour(index))
    return 0.45 * red, 0.45 * green, 0.45 * blue


def line(index: int) -> Any:
    """Line style of the filter or axis of that number."""
    return LINES[index % len(LINES)]


def filter_style(index: int, **more: Any) -> dict[str, Any]:
    """Colour and line style of the filter or axis of that number, and more properties of a line."""
    return {"color": colour(index), "linestyle": line(index), **more}


def key(label: str, **line_properties: Any) -> Line2D:
    """An entry of a legend."""
    return Line2D([], [], label=label, **line_properties)


def filter_keys(filters: Sequence[str]) -> list[Line2D]:
    """Entries for the filters, in their colours."""
    return [key(name, **filter_style(i)) for i, name in enumerate(filters)]


def outage_key() -> Patch:
    """The entry for shaded outages."""
    return Patch(color=OUTAGE, label="outage")


def remark(axes: Axes, text: str) -> None:
    """Small grey text above the axes; several lines make the figure taller."""
    lines = textwrap.wrap(text, _REMARK, break_on_hyphens=False)
    axes.set_title("\n".join(lines), fontsize=8.5, color=GREY)
    figure = axes.get_figure(root=True)
    if figure is not None and len(lines) > 1:
        width, height = figure.get_size_inches()
        figure.set_size_inches(width, height + 0.14 * (len(lines) - 1))


def legend(figure: Figure, keys: Sequence[Any]) -> None:
    """One legend above all axes, where no data are; it reads row by row.

    A legend of many rows makes the figure taller, so that the axes keep their height.
    """
    if not keys:
        return
    widths = np.array([len(key.get_label()) * 0.066 + 0.55 for key in keys])  # inches
    columns = max(1, min(len(keys), int((WIDTH - 0.3) / widths.max())))
    if len(keys) > _ROWS * columns:  # many entries: each column as wide as its own need
        fits = (n for n in range(len(keys), 0, -1) if _width(widths, n) < WIDTH - 0.3)
        columns = next(fits, 1)
    rows = -(-len(keys) // columns)
    columns = -(-len(keys) // rows)  # avoids a last row of one entry
    if rows > _ROWS:
        width, height = figure.get_size_inches()
        figure.set_size_inches(width, height + 0.19 * (rows - _ROWS))
    ordered = [key for column in range(columns) for key in keys[column::columns]]
    figure.legend(handles=ordered, loc="outside upper center", ncols=columns)


def _width(widths: np.ndarray, columns: int) -> float:
    """Width of a legend of so many columns, each as wide as its widest entry."""
    return sum(widths[column::columns].max() for column in range(columns))


def decades(axes: Axes, low: float, top: float) -> None:
    """A logarithmic axis upwards of one decade or more, in plain numbers, that holds low to top."""
    axes.set_yscale("log")
    axes.set_ylim(min(0.8 * low, top / 10.0), 1.25 * top)
    few = top < 100.0 * low
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if few else (1.0,)))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())


def shade(axes: Axes, x: np.ndarray, mask: np.ndarray, tint: str = OUTAGE) -> None:
    """Shade where the mask holds."""
    edges = np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8))
    last = len(x) - 1
    for begin, end in zip(np.flatnonzero(edges == 1), np.flatnonzero(edges == -1), strict=True):
        axes.axvspan(x[begin], x[min(end, last)], color=tint, linewidth=0, zorder=0)
