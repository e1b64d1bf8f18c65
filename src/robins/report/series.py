"""Arrays of a solution over time, by the roles and dimensions that `robins.results` lists."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from robins import units
from robins.report import style
from robins.results import find

_POINTS = 1200  # points of a line; more than a figure has pixels


class TimeUnit(NamedTuple):
    """A unit for a time axis."""

    seconds: float
    label: str

    def plot(self, axes: Axes, x: np.ndarray, y: np.ndarray, **look: Any) -> None:
        """Draw a line over time [s], thinned to the resolution of the figure."""
        axes.plot(*thin(x / self.seconds, y), **look)

    def shade(self, axes: Axes, solution: xr.Dataset) -> None:
        """Shade the outages."""
        if (found := outage(solution)) is not None:
            style.shade(axes, found[0] / self.seconds, found[1])


class Series(NamedTuple):
    """An array over filters, time and perhaps axes, or a bound, in the unit of figures."""

    unit: str
    values: np.ndarray  # (filter, time, axis)
    x: np.ndarray  # (time,) s
    axes: list[str]
    attrs: dict[str, Any]

    @property
    def frame(self) -> str:
        """Sentence on the frame, for the end of a caption; empty where there is none."""
        frame = self.attrs.get("frame", "")
        return f" Frame: {frame}." if frame else ""


def one(solution: xr.Dataset, role: str, of: str = "") -> xr.DataArray | None:
    """The array of a role and, if given, of a block or sensor; None if there is none."""
    return find(solution, role).get(of)


def shown(array: xr.DataArray) -> tuple[np.ndarray, str]:
    """Values in the unit of figures, and that unit; empty for pure numbers."""
    unit = array.attrs.get("units", "1")
    display = array.attrs.get("display_unit", unit)
    values = np.asarray(array.values, float)
    if display != unit:
        values = np.asarray(units.convert(values, unit, display))
    return values, "" if display == "1" else display


def get(solution: xr.Dataset, role: str, of: str = "") -> Series | None:
    """The array of a role as a `Series`, in the unit of figures; None if there is none."""
    return required(solution, role, of) if of in find(solution, role) else None


def required(solution: xr.Dataset, role: str, of: str = "") -> Series:
    """The array of a role as a `Series`, in the unit of figures.

    Raises:
        KeyError: there is none.
    """
    array = find(solution, role)[of]
    values, unit = shown(array)
    axes = coordinate(solution, array.dims[2]) if array.ndim > 2 else [""]
    values = values if array.ndim > 2 else values[..., None]
    return Series(unit, values, x_of(array, 1), axes, array.attrs)


def x_of(array: xr.DataArray, place: int) -> np.ndarray:
    """Coordinate along the dimension of that index; numbers from 0 where there is none."""
    dim = array.dims[place]
    found = array.coords.get(dim)
    return np.arange(array.shape[place]) * 1.0 if found is None else np.asarray(found, float)


def coordinate(solution: xr.Dataset, dim) -> list[str]:
    """Labels along a dimension; numbers from 1 where it has none."""
    if dim in solution.coords:
        return [str(label) for label in solution[dim].values]
    return [str(i + 1) for i in range(solution.sizes[dim])]


def filters(solution: xr.Dataset) -> list[str]:
    """Names of the filters."""
    return coordinate(solution, "filter") if "filter" in solution.sizes else []


def clock(*times: np.ndarray) -> TimeUnit:
    """The unit in which a time axis has short numbers."""
    longest = max((np.nanmax(np.abs(t)) for t in times if np.isfinite(t).any()), default=0.0)
    if longest > 3 * 3600:
        return TimeUnit(3600.0, "time since start [h]")
    if longest > 1200:
        return TimeUnit(60.0, "time since start [min]")
    return TimeUnit(1.0, "time since start [s]")


def single_axes(
    solution: xr.Dataset, x: np.ndarray, label: str, height: float = 2.8
) -> tuple[Figure, Axes, TimeUnit]:
    """Figure with a single plot over time, outages shaded."""
    figure, grid = style.new_figure(1, 1, height)
    axes, unit = grid[0, 0], clock(x)
    unit.shade(axes, solution)
    axes.margins(x=0.0)
    axes.set(xlabel=unit.label, ylabel=label)
    return figure, axes, unit


def stacked(
    solution: xr.Dataset, data: Series, more: int = 0
) -> tuple[Figure, np.ndarray, TimeUnit]:
    """Figure with a plot over time for each component, outages shaded.

    ``more`` pairs are added below. Components of different units state their own.
    """
    rows = len(data.axes) + more
    figure, grid = style.new_figure(rows, 1, 0.9 + 1.35 * rows, sharex=True)
    stack, time = grid[:, 0], clock(data.x)
    for one in stack:
        time.shade(one, solution)
        one.margins(x=0.0)
    for one, label in zip(stack, data.axes, strict=False):
        one.set_ylabel(f"{label} [{data.unit}]" if data.unit and "[" not in label else label)
    stack[-1].set_xlabel(time.label)
    figure.align_ylabels()
    return figure, stack, time


def legend(figure: Figure, solution: xr.Dataset, keys: Sequence[Line2D | Patch]) -> None:
    """One legend above all axes, with the outages where there are any."""
    style.legend(figure, [*keys, style.outage_key()] if outage(solution) else keys)


def outage(solution: xr.Dataset) -> tuple[np.ndarray, np.ndarray] | None:
    """Times and mask of withheld aiding; None where there is none."""
    array = one(solution, "outage")
    if array is None or not np.any(array.values):
        return None
    return x_of(array, 0), np.asarray(array.values) != 0


def thin(x: np.ndarray, *ys: np.ndarray, points: int = _POINTS) -> tuple[np.ndarray, ...]:
    """Fewer points of lines that share their x, without losing an extreme of any of them.

    The lines are cut into bins; the points of the minimum and maximum in each bin are kept.
    """
    n = len(x)
    if n <= points:
        return x, *ys
    bins = max(points // (2 * len(ys)), 1)
    size = -(-n // bins)
    keep = {0, n - 1}
    padded = bins * size - n
    for y in ys:
        whole = np.append(y, np.full(padded, np.nan)).reshape(bins, size)
        start = np.arange(bins) * size
        for fill, pick in ((np.inf, np.argmin), (-np.inf, np.argmax)):
            at = start + pick(np.where(np.isnan(whole), fill, whole), axis=1)
            keep.update(at[at < n].tolist())
        # A gap must stay a gap: keep one of the missing points of each bin.
        holes = np.isnan(whole)
        at = (start + np.argmax(holes, axis=1))[holes.any(axis=1)]
        keep.update(at[at < n].tolist())
    index = np.array(sorted(keep))
    return x[index], *(y[index] for y in ys)


def sample(x: np.ndarray, y: np.ndarray, points: int = 4000) -> tuple[np.ndarray, np.ndarray]:
    """Fewer points of a cloud: evenly thinned, with all outlying ones kept."""
    if len(x) <= points:
        return x, y
    keep = np.zeros(len(x), bool)
    keep[:: -(-len(x) // points)] = True
    finite = np.isfinite(y)
    if finite.any():
        low, high = np.percentile(y[finite], (0.5, 99.5))
        keep |= finite & ((y < low) | (y > high))
    return x[keep], y[keep]
