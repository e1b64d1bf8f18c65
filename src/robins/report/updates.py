"""Innovations in their three-sigma bounds, and consistency statistics in their bands.

The bands are those of the statistics of a consistent filter.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from scipy.special import gammaincinv

from robins.report import series, style
from robins.report.numbers import words
from robins.report.style import Picture
from robins.results import find


def quantile(probability: float, degrees: Any) -> np.ndarray:
    """Inverse of the chi-square distribution, for one or many degrees of freedom."""
    return np.asarray(2.0 * gammaincinv(np.asarray(degrees) / 2.0, probability))


class Band(NamedTuple):
    """Band in which a statistic of a consistent filter lies with the given probability."""

    low: np.ndarray  # (filter, time)
    high: np.ndarray
    probability: float
    expected: float


def band(array: xr.DataArray, dof: xr.DataArray | None = None) -> Band | None:
    """The band of a statistic, from its attributes; None if they do not give one.

    Args:
        array: the statistic, (filter, time).
        dof: its degrees of freedom, of the same shape, if there is such an array.
    """
    attrs = array.attrs
    probability = float(attrs.get("probability", 0.95))
    runs = int(attrs.get("runs", 1))
    if dof is not None:
        degrees = np.asarray(dof.values, float)
    elif "degrees_of_freedom" in attrs:
        degrees = np.full(array.shape, float(attrs["degrees_of_freedom"]))
    else:
        degrees = None
    if "band_low" in attrs and "band_high" in attrs:
        low, high = (np.full(array.shape, float(attrs[f"band_{s}"])) for s in ("low", "high"))
    elif degrees is not None:
        # A mean of N independent chi-square variables of n degrees is chi2(N n)/N.
        tail = (1.0 - probability) / 2.0
        safe = np.where(degrees > 0.0, degrees, np.nan)
        scale = runs * (safe if attrs.get("normalised") else 1.0)
        low, high = (quantile(p, runs * safe) / scale for p in (tail, 1.0 - tail))
    else:
        return None
    expected = np.nan
    if degrees is not None and np.isfinite(degrees).any():
        expected = 1.0 if attrs.get("normalised") else float(np.nanmean(degrees))
    return Band(low, high, probability, expected)


def inside(values: np.ndarray, limits: Band) -> np.ndarray:
    """Share of the finite epochs of each filter that lie in the band; NaN where there are none."""
    valid = np.isfinite(values) & np.isfinite(limits.high)
    hits = valid & (values >= limits.low) & (values <= limits.high)
    count = valid.sum(axis=1)
    return np.where(count > 0, hits.sum(axis=1) / np.maximum(count, 1), np.nan)


_FAR = 10.0  # ratio of an innovation to most others from which the axis is compressed
_STEEP = 15.0  # ratio of a statistic to its band from which the axis is logarithmic


@style.styled
def innovations(solution: xr.Dataset, sensor: str) -> Picture:
    """Innovations of a sensor and, below them, their normalised square."""
    data = series.required(solution, "innovation", sensor)
    sigma = series.get(solution, "innovation_sigma", sensor)
    nis = series.one(solution, "nis", sensor)
    filters = series.filters(solution)
    figure, stack, clock = series.stacked(solution, data, more=int(nis is not None))
    x = data.x / clock.seconds
    found = series.get(solution, "refused", sensor)
    refused = np.zeros(data.values.shape[:2], bool) if found is None else found.values[..., 0] > 0.0
    present = [i for i in range(len(filters)) if np.isfinite(data.values[i]).any()]
    for k, axes in enumerate(stack[: len(data.axes)]):
        shown = []
        for i in present:
            y = data.values[i, :, k]
            _points(axes, x, y, i)
            shown.append(np.abs(y))
            out = refused[i]
            if out.any():
                axes.plot(x[out], y[out], **_CROSS)
            if sigma is not None:
                reach = 3.0 * sigma.values[i, :, k]
                shown.append(np.where(np.isfinite(y), reach, np.nan))
                for sign in (-1.0, 1.0):
                    clock.plot(axes, data.x, sign * reach, **style.filter_style(i, linewidth=0.8))
        _compress(axes, shown)
        axes.axhline(0.0, color=style.GREY, linewidth=0.6, zorder=1)
    keys: list[Any] = [_dot(filters[i], i) for i in present]
    if sigma is not None:
        keys.append(style.key("±3σ expected", color=style.GREY, linewidth=0.8))
    if refused.any():
        keys.append(style.key("refused", **_CROSS))
    if nis is not None:
        limits = band(nis, series.one(solution, "nis_dof", sensor))
        shares = _statistic(stack[-1], nis, limits, filters, clock)
        stack[-1].set_ylabel("NIS")
        keys.append(style.key("chi-square band", color=style.BAND, linewidth=6.0))
        style.remark(stack[-1], shares)
    series.legend(figure, solution, keys)
    name = words(sensor)
    caption = (
        "Measured minus predicted. They should look like white noise "
        "between the lines; runs to one side show an error the filter does not model."
    )
    if any(axes.get_yscale() == "symlog" for axes in stack):
        caption += " Far from zero the scale is logarithmic."
    return Picture(f"innovation_{sensor}", f"Innovations of {name}", caption, figure)


def _compress(axes: Axes, values: list[np.ndarray]) -> None:
    """Compress the scale if a few updates, after an outage or gross errors, are far larger."""
    known = np.concatenate([v[np.isfinite(v)] for v in values]) if values else np.zeros(0)
    if known.size == 0:
        return
    usual, most = np.percentile(known, 90.0), known.max()
    if usual > 0.0 and most > _FAR * usual:
        near, far = _round_up(1.3 * usual), _round_up(most)
        # The range near zero, with nearly all of them, gets about two thirds of the height.
        axes.set_yscale("symlog", linthresh=near, linscale=2.0 * np.log10(far / near))
        ticks = [-far, -near, 0.0, near, far]
        axes.set_yticks(ticks, [f"{tick:g}".replace("-", "−") for tick in ticks])
        axes.set_yticks([], minor=True)
        axes.set_ylim(-1.3 * far, 1.3 * far)


def _round_up(value: float) -> float:
    """Next larger of 1, 2 or 5 times a power of ten."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(min(step * power for step in (1.0, 2.0, 5.0, 10.0) if step * power >= value))


_CROSS = {"linestyle": "", "marker": "x", "markersize": 4.5, "markeredgewidth": 0.9}
_CROSS |= {"color": style.TRUTH}


def _dot(name: str, i: int):
    return style.key(name, linestyle="", marker=_MARKERS[i % len(_MARKERS)], color=style.colour(i))


_MARKERS = (".", "+", "1", "2", "3", "4")


def _points(axes: Axes, x: np.ndarray, y: np.ndarray, i: int) -> None:
    x, y = series.sample(x, y)
    size, alpha = (3.0, 0.8) if len(x) <= 1500 else (2.2, 0.5)
    look: dict[str, Any] = {"markersize": size, "markeredgewidth": 0.6, "alpha": alpha}
    mark = _MARKERS[i % len(_MARKERS)]
    axes.plot(x, y, linestyle="", marker=mark, color=style.colour(i), **look)


def _is_smooth(array: xr.DataArray) -> bool:
    """True for the mean of many runs, drawn as a line; one run is drawn as points."""
    return array.attrs.get("runs", 1) > 1


def _statistic(
    axes: Axes, array: xr.DataArray, limits: Band | None, filters: list[str], clock: series.TimeUnit
) -> str:
    """Draw a statistic of each filter over its band; return the share inside."""
    values, x = np.asarray(array, float), series.x_of(array, 1) / clock.seconds
    if limits is not None:  # no degrees of freedom: nothing was used, and a zero is meaningless
        values = np.where(np.isfinite(limits.high), values, np.nan)
    joined = _is_smooth(array)
    for i in range(len(filters)):
        if joined:
            axes.plot(*series.thin(x, values[i]), **style.filter_style(i, linewidth=0.9))
        else:
            _points(axes, x, values[i], i)
    if limits is None or not np.isfinite(limits.high).any():
        return ""
    # filters whose states differ in size have bands of their own; the widest is drawn
    width = np.where(np.isfinite(limits.high), limits.high - limits.low, -np.inf).max(axis=1)
    widest = int(np.argmax(width))
    finite = np.isfinite(limits.high[widest])
    low, high = (edge[widest][finite] for edge in (limits.low, limits.high))
    step: Any = None if joined else "mid"
    axes.fill_between(x[finite], low, high, color=style.BAND, linewidth=0, zorder=0.5, step=step)
    top = np.nanmax(values) if np.isfinite(values).any() else 0.0
    if top > _STEEP * np.nanmax(limits.high):
        axes.set_yscale("log")
        floor = np.nanmin(limits.low)
        axes.set_ylim(bottom=0.3 * (floor if floor > 0.0 else 1e-2))
    elif not joined:
        axes.set_ylim(bottom=0.0)
    shares = inside(values, limits)
    told = ", ".join(
        f"{name} {100.0 * share:.1f}\u00a0%"
        for name, share in zip(filters, shares, strict=True)
        if np.isfinite(share)
    )
    return f"inside the {100.0 * limits.probability:.4g}\u00a0% band: {told}"


@style.styled
def consistency(solution: xr.Dataset, name: str) -> Picture:
    """NEES of a run, or its average over the runs of a campaign, in its chi-square band."""
    array = find(solution, "consistency")[name]
    figure, axes, clock = series.single_axes(solution, series.x_of(array, 1), name.upper())
    limits = band(array, series.one(solution, "consistency_dof", name))
    filters = series.filters(solution)
    shares = _statistic(axes, array, limits, filters, clock)
    keys = [_dot(f, i) for i, f in enumerate(filters)]
    if _is_smooth(array):
        keys = style.filter_keys(filters)
    if limits is not None:
        keys.append(style.key("chi-square band", color=style.BAND, linewidth=6.0))
        if np.isfinite(limits.expected):
            axes.axhline(limits.expected, color=style.GREY, linewidth=0.7, zorder=1)
    style.remark(axes, shares)
    series.legend(figure, solution, keys)
    runs = array.attrs.get("runs")
    caption = "Squared estimation error, normalised by the stated covariance"
    caption += f", mean of {int(runs)} runs." if runs else "."
    caption += " Above the band the filter is too sure of itself, below it too modest."
    return Picture(name, "Consistency", caption, figure)
