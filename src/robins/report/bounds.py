"""The covariance bound: a line in the figures of filters, and tables and figures of its own."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from rich.console import Group
from rich.table import Table
from rich.text import Text

from robins.report import series, style
from robins.report.numbers import show, words
from robins.report.series import Series
from robins.report.style import Picture
from robins.results import find

# Greatest remaining sigma of a component that is "seen" and "hardly seen", as a share of its
# initial sigma (without process noise) and of its sigma at the end without sensors.
SEEN, HARDLY = 0.5, 0.95
_LOOK = {"color": style.TRUTH, "linestyle": (0, (4, 2)), "linewidth": 0.8}
_NONE = {"color": style.GREY, "linestyle": (0, (1, 1)), "linewidth": 0.8}
_BEYOND = 30.0  # lines above this multiple of the bound with all sensors are cut off
_COLUMNS = 500  # columns of the information map
_FULL = 10.0  # bits at the end of the colour scale, a thousandth of the prior


_ROLES = ("bound", "bound_prior", "bound_unaided", "bound_without")


def line(solution: xr.Dataset, block: str, role: str = "bound") -> Series:
    """Bound of a block (..., time, axis), or that of the prior (axis,), one standard deviation.

    Raises:
        KeyError: the solution has no such bound.
    """
    array = find(solution, role)[block]
    x = series.x_of(array, array.ndim - 2) if array.ndim > 1 else np.zeros(0)
    values, unit = series.shown(array)
    return Series(unit, values, x, series.coordinate(solution, array.dims[-1]), array.attrs)


def comparison_bound(solution: xr.Dataset, block: str) -> Series | None:
    """The bound to draw with the filters; None if the solution has none."""
    return line(solution, block) if block in find(solution, "bound") else None


def draw(axes: Axes, bound: Series, k: int, seconds: float, times: float = 1.0) -> np.ndarray:
    """Draw a multiple of the bound of an axis with the filters; returns it."""
    y = times * bound.values[:, k]
    axes.plot(*series.thin(bound.x / seconds, y), zorder=4, **_LOOK)
    return y


def key(times: str = "") -> Line2D:
    """The entry of a legend for `draw`."""
    return style.key(f"{times}covariance bound", **_LOOK)


def blocks(solution: xr.Dataset) -> list[str]:
    """Blocks of a solution that `robins bound` made."""
    return list(find(solution, "bound_prior"))


def sensors(solution: xr.Dataset) -> list[str]:
    """Sensors whose contribution is shown; none if there is only one."""
    names = series.coordinate(solution, "sensor")
    return names if len(names) > 1 else []


@style.styled
def sigmas(solution: xr.Dataset, block: str) -> Picture:
    """The bound of a block over time, with all sensors, without each, and with none."""
    every, _, unaided, without = (line(solution, block, role) for role in _ROLES)
    names = sensors(solution)
    figure, stack, clock = series.stacked(solution, every)
    for k, axes in enumerate(stack):
        lines = [(unaided.values[:, k], _NONE)]
        for i, one in enumerate(without.values[: len(names)], 1):
            lines.append((one[:, k], style.filter_style(i)))
        lines.append((every.values[:, k], {"color": style.colour(0), "linewidth": 1.6}))
        for y, look in lines:
            clock.plot(axes, every.x, np.where(y > 0.0, y, np.nan), **look)
        _scale(axes, every.values[:, k], without.values[..., k], unaided.values[:, k])
    keys = [style.key("all sensors", color=style.colour(0), linewidth=1.6)]
    keys += [
        style.key(f"without {words(name)}", **style.filter_style(i))
        for i, name in enumerate(names, 1)
    ]
    style.legend(figure, [*keys, style.key("no sensor", **_NONE)])
    caption = (
        "One standard deviation that no filter with this model can beat. What a sensor buys is the "
        "way between the line without it and the line with all. Lines that run away leave the "
        "figure."
    )
    title = f"Covariance bound of the {words(block)}"
    return Picture(f"bound_{block}", title, caption + every.frame, figure)


def _scale(axes: Axes, every: np.ndarray, without: np.ndarray, unaided: np.ndarray) -> None:
    """Logarithmic axis of one decade or more, whose scale ignores diverging lines."""
    close = np.concatenate([every, without.ravel()])
    both = np.concatenate([close, unaided])
    low = float(np.min(both[both > 0.0], initial=np.inf))
    if not np.isfinite(low):
        return  # known exactly all the time
    top = min(float(np.max(both)), _BEYOND * max(float(np.max(every)), low))
    style.decades(axes, low, top)


@style.styled
def information(solution: xr.Dataset) -> Picture:
    """Figure of the information of the measurements on each state at the start, over time."""
    array, rank = find(solution, "information")[""], find(solution, "gramian_rank")[""]
    names = series.coordinate(solution, "state")
    time = series.x_of(array, 1)
    pick = np.unique(np.linspace(0, len(time) - 1, _COLUMNS).astype(int))
    clock = series.clock(time)
    figure, grid = style.new_figure(1, 1, 1.1 + 0.19 * len(names))
    axes = grid[0, 0]
    x, values = time[pick] / clock.seconds, np.asarray(array.values, float)[:, pick]
    look: dict[str, Any] = {"shading": "nearest", "cmap": "viridis", "rasterized": True}
    look |= {"vmin": 0.0, "vmax": _FULL}
    shown = axes.pcolormesh(x, np.arange(len(names)), np.minimum(values, _FULL), **look)
    axes.set_yticks(np.arange(len(names)), names)
    axes.invert_yaxis()
    axes.grid(visible=False)
    axes.set_xlabel(clock.label)
    figure.colorbar(shown, ax=axes, label="information [bit]", extend="max", pad=0.01)
    caption = (
        "About the state at the start, from the observability Gramian in units of the prior: each "
        "bit halves the standard deviation, process noise left aside. A row that stays dark is a "
        f"state that the sensors do not see. Rank {int(rank)} of {len(names)}."
    )
    return Picture("information", "Information by state and time", caption, figure)


def epochs(solution: xr.Dataset, times_s: Sequence[float] = ()) -> list[int]:
    """Indices of the epochs at the given times; by default at the quarters of the run.

    Raises:
        ValueError: a time is not among those of the solution.
    """
    time = np.asarray(solution["time"], float)
    first, last = float(time[0]), float(time[-1])
    step = float(np.max(np.diff(time), initial=0.0))
    for t in times_s:
        if not first - step <= t <= last + step:
            raise ValueError(f"{t:g} s is not within the run, {first:g} s to {last:g} s")
    wanted = sorted(times_s) or [first + share * (last - first) for share in (0.25, 0.5, 0.75, 1.0)]
    return [int(np.argmin(np.abs(time - t))) for t in wanted]


def metrics(solution: xr.Dataset) -> dict[str, list[float]]:
    """Final bound by block, as metrics of a summary, whose names end in their unit."""
    out = {}
    for block in blocks(solution):
        found = line(solution, block)
        unit = "mps" if found.unit == "m/s" else found.unit.replace("/", "_per_").replace("^", "")
        out["_".join(filter(None, (block, "bound", unit)))] = found.values[-1].tolist()
    return out


class BoundRow(NamedTuple):
    """Bounds of one component of the state, in the unit of figures."""

    state: str
    unit: str
    prior: float
    sigma: list[float]  # at the given times
    unaided: float  # with no sensor, at the last of them
    without: list[float]  # each sensor left out, at the last of them
    start: float  # share of the prior that is left of the start, process noise aside

    @property
    def left(self) -> float:
        """Share of the prior left; may be above one where process noise is at work."""
        return self.sigma[-1] / self.prior if self.prior > 0.0 else np.nan

    @property
    def verdict(self) -> str:
        """Verdict on its observability: "seen", "hardly seen", "not seen"; or "known" before."""
        if self.unaided == 0.0:
            return "known"
        share = np.fmax(self.sigma[-1] / self.unaided, self.start)
        return "seen" if share <= SEEN else "hardly seen" if share <= HARDLY else "not seen"


def rows(solution: xr.Dataset, at: Sequence[int]) -> list[BoundRow]:
    """One row per component, at the epochs with these numbers."""
    out, names = [], sensors(solution)
    for block in blocks(solution):
        start = np.asarray(find(solution, "bound_left")[block], float)
        every, prior, unaided, without = (line(solution, block, role) for role in _ROLES)
        for k, axis in enumerate(every.axes):
            sigma, least = every.values[list(at), k].tolist(), float(unaided.values[at[-1], k])
            others = without.values[: len(names), at[-1], k].tolist()
            known = f"{words(block)} {axis}", every.unit, float(prior.values[k])
            out.append(BoundRow(*known, sigma, least, others, float(start[k])))
    return out


_STYLES = {"seen": "green", "hardly seen": "yellow", "not seen": "red", "known": ""}


def table(solution: xr.Dataset, at: Sequence[int]) -> Group:
    """The rows as a rich renderable; `sentences` list the least observable directions."""
    time = np.asarray(solution["time"], float)
    made = Table(box=None, pad_edge=False, header_style="bold", padding=(0, 2, 0, 0))
    made.add_column("sigma at best", no_wrap=True)
    made.add_column("unit", no_wrap=True)
    last = f"{time[at[-1]]:g} s"
    for head in ("prior", *(f"{time[k]:g} s" for k in at), "of prior"):
        made.add_column(head, justify="right")
    made.add_column("verdict")
    for head in (*(f"without {words(s)}" for s in sensors(solution)), "no sensor"):
        made.add_column(head, justify="right")
    for row in rows(solution, at):
        share = "–" if np.isnan(row.left) else f"{100.0 * row.left:.3g} %"
        made.add_row(
            Text(row.state),
            Text(row.unit),
            *(_short(v) for v in (row.prior, *row.sigma)),
            share,
            Text(row.verdict, style=_STYLES[row.verdict]),
            *(_short(v) for v in (*row.without, row.unaided)),
        )
    notes = (
        f"On the right, what sigma would be at {last} without one of the sensors, and with none."
    )
    return Group(made, Text(), Text(notes))


def _short(value: float) -> str:
    return show(float(f"{value:.3g}"))


def sentences(solution: xr.Dataset) -> list[str]:
    """Sentences on the least observable directions."""
    count, rank = solution.sizes["state"], int(find(solution, "gramian_rank")[""])
    notes = [
        f"The observability Gramian has rank {rank} of {count}; the least observable directions, "
        "in units of the prior, are:"
    ]
    gramian = find(solution, "gramian")[""]
    nothing = float(gramian.attrs["nothing"])
    directions = series.coordinate(solution, "direction")
    for made_of, value in zip(directions, np.asarray(gramian), strict=True):
        weight = f"the measurements weigh {show(float(value))} times the prior"
        notes.append(f"{made_of}: {weight if value >= nothing else 'not seen'}")
    return notes


def csv(solution: xr.Dataset) -> str:
    """Bound over time in SI units, one column per component: with all sensors, and without each."""
    heads, columns = ["time_s"], [np.asarray(solution["time"], float)]
    kinds = [("bound", "bound", None), ("unaided", "bound_unaided", None)]
    kinds += [(f"without_{s}", "bound_without", i) for i, s in enumerate(sensors(solution))]
    for label, role, i in kinds:
        for block in blocks(solution):
            array = find(solution, role)[block]
            values = np.asarray(array.values if i is None else array.values[i], float)
            axes = series.coordinate(solution, f"axis_{block}")
            unit = array.attrs["units"]
            heads += [f"{label} {block} {axis} [{unit}]" for axis in axes]
            columns += list(values.T)
    lines = [",".join(heads)]
    lines += [",".join(f"{v:.9g}" for v in row) for row in zip(*columns, strict=True)]
    return "\n".join(lines) + "\n"
