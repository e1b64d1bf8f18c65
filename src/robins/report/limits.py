"""Curves of shares: runs within a limit, and how much of its gamma a worst-case filter has used."""

from __future__ import annotations

import numpy as np
import xarray as xr

from robins.report import series, style
from robins.report.numbers import words
from robins.report.style import Picture
from robins.results import find

# rule: its local bound, and what that must stay below
_WORST_CASE = {"h_infinity": "gamma", "adaptive_h_infinity": "xi"}


@style.styled
def within(solution: xr.Dataset, limit: str) -> Picture:
    """Share of the runs of a campaign whose error is within a limit, over time."""
    data = series.get(solution, "within", limit)
    assert data is not None
    filters = series.filters(solution)
    figure, grid = style.new(1, 1, 2.8)
    axes, clock = grid[0, 0], series.clock(data.x)
    for i in range(len(filters)):
        x, y = series.thin(data.x / clock.seconds, data.values[i, :, 0])
        axes.plot(x, y, color=style.colour(i), linestyle=style.line(i))
    axes.margins(x=0.0)
    axes.set(xlabel=clock.label, ylabel="share of the runs", ylim=(-0.02, 1.02))
    style.legend(figure, style.filter_keys(filters))
    runs = data.attrs.get("runs")
    caption = "Share of the runs whose largest component is within the limit"
    caption += f", of {int(runs)}." if runs else "."
    title = data.attrs["long_name"]
    return Picture(f"within_{limit}", title[:1].upper() + title[1:], caption, figure)


def _used(solution: xr.Dataset) -> xr.DataArray | None:
    """Local bound over gamma (filter, time), NaN for other filters; None if all are other."""
    notes, ratio = find(solution, "note"), None
    for rule, below in _WORST_CASE.items():
        bound, gamma = (notes.get(f"{rule}_{kind}") for kind in ("bound", below))
        if bound is None or gamma is None:
            continue
        part = bound / gamma
        ratio = part if ratio is None else ratio.fillna(part)
    return ratio


@style.styled
def worst_case(solution: xr.Dataset) -> Picture | None:
    """How near each H-infinity filter comes to not existing; None if there is none."""
    ratio = _used(solution)
    if ratio is None:
        return None
    filters = series.filters(solution)
    time, ratio = series.x_of(ratio, 1), ratio.values
    shown = [i for i in range(len(filters)) if np.isfinite(ratio[i]).any()]
    if not shown:
        return None
    figure, grid = style.new(1, 1, 2.8)
    axes, clock = grid[0, 0], series.clock(time)
    for i in shown:
        x, y = series.thin(time / clock.seconds, ratio[i])
        axes.plot(x, y, color=style.colour(i), linestyle=style.line(i))
    axes.axhline(1.0, color=style.TRUTH, linewidth=0.8)
    axes.margins(x=0.0)
    top = max(1.1, 1.1 * float(np.nanmax(ratio[shown])))
    axes.set(xlabel=clock.label, ylabel="local bound / gamma", ylim=(-0.02, top))
    keys = style.filter_keys(filters)
    limit = style.key("the filter exists below", color=style.TRUTH, linewidth=0.8)
    style.legend(figure, [*(keys[i] for i in shown), limit])
    caption = (
        "Root of the largest eigenvalue of L P L' over gamma (xi of the adaptive filter), first "
        "run. The filter exists below one; near zero it is the Kalman filter. Margin: one less "
        "the square."
    )
    return Picture("worst_case", "H-infinity: bound and gamma", caption, figure)


def bound_names(solution: xr.Dataset) -> list[str]:
    """Filters that state bounds, not standard deviations."""
    flags = series.one(solution, "bounds")
    if flags is None:
        return []
    return [name for name, flag in zip(series.filters(solution), flags.values, strict=True) if flag]


def bound_note(solution: xr.Dataset) -> str:
    """What must be said of them beside an envelope; empty where there is none."""
    named = bound_names(solution)
    if not named:
        return ""
    return (
        f" Of {', '.join(words(n) for n in named)} the envelope is the root of P of an H-infinity "
        "filter: a bound, not a covariance; it promises no share inside."
    )
