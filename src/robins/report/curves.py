"""Curves over time: errors in their envelopes, estimates, campaign statistics, height.

Two show shares: runs within a limit, and the local bound of an H-infinity filter over its gamma.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes

from robins.report import bounds, series, style
from robins.report.numbers import words
from robins.report.series import Series
from robins.report.style import Picture
from robins.report.updates import quantile
from robins.results import find
from robins.results.probability import LEVEL, interval

# rule: its local bound, and the upper limit of that
_WORST_CASE = {"h_infinity": "gamma", "adaptive_h_infinity": "xi"}


@style.styled
def within(solution: xr.Dataset, limit: str) -> Picture:
    """Share of the runs of a campaign whose error is within a limit, over time."""
    data = series.required(solution, "within", limit)
    filters = series.filters(solution)
    runs = int(data.attrs.get("runs", 0))
    tinted = runs > 1 and len(filters) <= style.TINTED
    figure, axes, clock = series.single_axes(solution, data.x, "share of the runs")
    for i in range(len(filters)):
        share = data.values[i, :, 0]
        clock.plot(axes, data.x, share, **style.filter_style(i))
        if tinted:
            low, high = interval(np.rint(share * runs), runs)
            x, low, high = series.thin(data.x / clock.seconds, low, high)
            axes.fill_between(x, low, high, color=style.colour(i), alpha=0.15, linewidth=0)
    axes.set(ylim=(-0.02, 1.02))
    style.legend(figure, style.filter_keys(filters))
    caption = "Share of the runs whose largest component is within the limit"
    caption += f", of {runs}." if runs else "."
    if tinted:
        caption += f" Tint: {100 * LEVEL:.0f}\u00a0% interval of the probability (Clopper-Pearson)."
    title = data.attrs["long_name"]
    return Picture(f"within_{limit}", title[:1].upper() + title[1:], caption, figure)


def _used(solution: xr.Dataset) -> xr.DataArray | None:
    """Local bound over gamma (filter, time), NaN for filters without one; None if no filter has
    one.
    """
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
    """Existence margin of each H-infinity filter over time; None if there is none."""
    ratio = _used(solution)
    if ratio is None:
        return None
    filters = series.filters(solution)
    time, ratio = series.x_of(ratio, 1), ratio.values
    shown = [i for i in range(len(filters)) if np.isfinite(ratio[i]).any()]
    if not shown:
        return None
    figure, axes, clock = series.single_axes(solution, time, "local bound / gamma")
    for i in shown:
        clock.plot(axes, time, ratio[i], **style.filter_style(i))
    axes.axhline(1.0, color=style.TRUTH, linewidth=0.8)
    axes.set(ylim=(-0.02, max(1.1, 1.1 * float(np.nanmax(ratio[shown])))))
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
    """Remark on H-infinity filters under an envelope; empty where there is none."""
    named = bound_names(solution)
    if not named:
        return ""
    return (
        f" Of {', '.join(words(n) for n in named)} the envelope is the root of P of an H-infinity "
        "filter: a bound, not a covariance; it promises no share inside."
    )


_START = 0.2  # of the time axis
_BEYOND = 4.0  # a stated sigma this many times any error does not set the scale
_STEEP = 3.0  # a start this many times higher than the rest is cut off, with a remark


def _scale(
    axes: Axes, x: np.ndarray, lines: list[np.ndarray], errors: np.ndarray, centred: bool = True
) -> None:
    """Scale to the time after the start if values at the start are far larger, with a remark.

    Only the start is cut off: a later divergence must stay visible. A stated sigma far above all
    errors leaves the figure.
    """
    kept = _in_scale(lines, errors)
    values = np.abs(np.stack(kept))
    values = np.where(np.isfinite(values), values, 0.0)
    after = x > x[:1] + _START * (x[-1:] - x[:1])
    most, later = values.max(initial=0.0), values[:, after].max(initial=0.0)
    steep = later > 0.0 and most >= _STEEP * later
    if steep or len(kept) < len(lines):
        top = 1.25 * (later if steep else most) or 1.0
        bottom = -0.02 * top if steep else 0.0
        axes.set_ylim(-top if centred else bottom, top)
    elif not centred:
        axes.set_ylim(bottom=0.0)
    if steep:
        box = {"facecolor": "white", "edgecolor": style.GREY, "linewidth": 0.5, "pad": 2.0}
        look: dict[str, Any] = {"va": "top", "fontsize": 8.0, "color": style.TRUTH, "zorder": 6}
        text, place = f"starts at {most:.3g}", (0.006, 0.95)
        axes.annotate(text, place, xycoords="axes fraction", bbox=box, **look)


def _in_scale(lines: list[np.ndarray], errors: np.ndarray) -> list[np.ndarray]:
    """Lines that the scale must include: a stated sigma far above all errors is not among them."""
    most = _BEYOND * np.abs(errors[np.isfinite(errors)]).max(initial=0.0)

    def usual(line: np.ndarray) -> float:
        known = np.abs(line[np.isfinite(line)])
        return float(np.median(known)) if known.size else 0.0

    kept = [line for line in lines if usual(line) <= most]
    return kept or lines


def _or_bound(solution: xr.Dataset) -> str:
    return "; of H-infinity a bound, not a covariance" if bound_names(solution) else ""


@style.styled
def errors(solution: xr.Dataset, block: str) -> Picture:
    """Estimation errors of a block of the state, in the stated three-sigma envelopes."""
    error = series.required(solution, "error", block)
    sigma = series.get(solution, "sigma", block)
    best = bounds.comparison_bound(solution, block)
    filters = series.filters(solution)
    figure, stack, clock = series.stacked(solution, error)
    for k, axes in enumerate(stack):
        lines = []
        for i in range(len(filters)):
            clock.plot(axes, error.x, error.values[i, :, k], **style.filter_style(i))
            lines.append(error.values[i, :, k])
            if sigma is not None:
                _envelope(axes, sigma, i, k, clock, len(filters))
                lines.append(3.0 * sigma.values[i, :, k])
        if best is not None:
            lines += [bounds.draw(axes, best, k, clock.seconds, times) for times in (3.0, -3.0)]
        axes.axhline(0.0, color=style.GREY, linewidth=0.6, zorder=1)
        _scale(axes, error.x, lines, error.values[:, :, k])
    label = f"±3σ stated{_or_bound(solution)}"
    more = [style.key(label, color=style.GREY, linewidth=0.8)] if sigma is not None else []
    more += [bounds.key("±3σ ")] if best is not None else []
    series.legend(figure, solution, [*style.filter_keys(filters), *more])
    name = words(block)
    caption = error.attrs.get("comment", "True minus estimated.")
    if sigma is not None:
        caption += (
            " A filter that knows its own accuracy keeps 99.7\u00a0% of it between the thin lines."
        )
        caption += bound_note(solution)
    caption += error.frame
    return Picture(f"error_{block}", f"Error of the {name}", caption, figure)


def _envelope(
    axes: Axes,
    sigma: Series,
    i: int,
    k: int,
    clock: series.TimeUnit,
    count: int,
    centre: float | np.ndarray = 0.0,
) -> None:
    """Draw plus and minus three sigma about a centre."""
    reach = 3.0 * sigma.values[i, :, k]
    x, low, high = series.thin(sigma.x / clock.seconds, centre - reach, centre + reach)
    for bound in (low, high):
        axes.plot(x, bound, **style.filter_style(i, linewidth=0.6))
    if count <= 2:  # more would hide each other
        axes.fill_between(x, low, high, color=style.colour(i), alpha=0.10, linewidth=0)


@style.styled
def estimates(solution: xr.Dataset, block: str, role: str = "estimate") -> Picture:
    """Estimates of a block of the state in their three-sigma envelopes: biases, or a path without
    truth.
    """
    found = series.required(solution, role, block)
    sigma = series.get(solution, "sigma", block)
    filters = series.filters(solution)
    figure, stack, clock = series.stacked(solution, found)
    turn = {"rad": 2.0 * np.pi, "deg": 360.0}.get(found.unit)
    for k, axes in enumerate(stack):
        for i in range(len(filters)):
            y = _with_gaps(found.values[i, :, k], turn)
            clock.plot(axes, found.x, y, **style.filter_style(i))
            # The envelope of a wrapping angle would be drawn across the wrap.
            if sigma is not None and turn is None:
                _envelope(axes, sigma, i, k, clock, len(filters), centre=y)
        if turn is None and sigma is not None:
            _window(axes, found.values[:, :, k], 3.0 * sigma.values[:, :, k])
    thin_lines = sigma is not None and turn is None
    more = [style.key("±3σ stated", color=style.GREY, linewidth=0.8)] if thin_lines else []
    series.legend(figure, solution, [*style.filter_keys(filters), *more])
    name = words(block)
    caption = "Thin lines: three stated standard deviations to either side." if thin_lines else ""
    caption += found.attrs.get("comment", "") + found.frame
    if block == "euler" and series.one(solution, "sigma", "attitude") is not None:
        caption += " Stated sigmas, about the navigation axes: sigma_attitude of solution.nc."
    title = f"Estimated {name}" if role == "estimate" else name.capitalize()
    return Picture(f"{role}_{block}", title, caption.strip(), figure)


def values(solution: xr.Dataset, name: str) -> Picture:
    """Figure of true values with their estimates."""
    return estimates(solution, name, "value")


def _with_gaps(y: np.ndarray, turn: float | None) -> np.ndarray:
    """Values with gaps where an angle wraps, so that no line is drawn across the figure."""
    if turn is None:
        return y
    y = y.copy()
    y[1:][np.abs(np.diff(y)) > 0.75 * turn] = np.nan
    return y


def _window(axes: Axes, values: np.ndarray, reach: np.ndarray) -> None:
    """Axis limits that include the estimates and the usual extent of the envelope."""
    if not np.isfinite(values).any() or not np.isfinite(reach).any():
        return
    usual = np.nanpercentile(reach, 70.0)
    low, high = np.nanmin(values), np.nanmax(values)
    low, high = low - 1.3 * usual, high + 1.3 * usual
    now = axes.get_ylim()
    if high > low and (now[1] - now[0]) > 3.0 * (high - low):
        axes.set_ylim(low, high)


@style.styled
def campaign(solution: xr.Dataset, block: str) -> Picture:
    """Scatter of the runs of a campaign against the sigma the filters state."""
    rms = series.required(solution, "rms", block)
    stated = series.get(solution, "mean_sigma", block)
    best = bounds.comparison_bound(solution, block)
    filters = series.filters(solution)
    few = len(filters) <= style.TINTED
    mean = series.get(solution, "mean_error", block) if few else None
    runs = int(rms.attrs.get("runs", 0))
    figure, stack, clock = series.stacked(solution, rms)
    for k, axes in enumerate(stack):
        lines = []
        for i in range(len(filters)):
            clock.plot(axes, rms.x, rms.values[i, :, k], **style.filter_style(i))
            lines.append(rms.values[i, :, k])
            if stated is not None:
                x, y = series.thin(stated.x / clock.seconds, stated.values[i, :, k], points=600)
                axes.plot(x, y, color=style.dark(i), linewidth=0.9, zorder=3)
                if runs and few:
                    # The mean square of N errors of variance sigma^2 is sigma^2 chi2(N)/N.
                    low, high = (np.sqrt(quantile(p, runs) / runs) for p in (0.025, 0.975))
                    band = {"color": style.colour(i), "alpha": 0.15, "linewidth": 0}
                    axes.fill_between(x, low * y, high * y, **band)
                lines.append(stated.values[i, :, k])
            if mean is not None:
                x, y = series.thin(mean.x / clock.seconds, np.abs(mean.values[i, :, k]), points=600)
                axes.plot(x, y, color=style.colour(i), linestyle=":", linewidth=0.8, zorder=2)
        if best is not None:
            lines.append(bounds.draw(axes, best, k, clock.seconds))
        _scale(axes, rms.x, lines, rms.values[:, :, k], centred=False)
    label = f"σ stated{_or_bound(solution)}"
    more = [style.key(label, color=style.GREY, linewidth=0.8)] if stated is not None else []
    dots = {"color": style.GREY, "linestyle": ":", "linewidth": 0.8}
    if stated is not None and few and runs:
        tint = {"color": style.GREY, "alpha": 0.15, "linewidth": 8.0}
        more += [style.key("95\u00a0% of the RMS if σ is true", **tint)]
    more += [style.key("|mean error|", **dots)] if mean is not None else []
    more += [bounds.key()] if best is not None else []
    series.legend(figure, solution, [*style.filter_keys(filters), *more])
    name = words(block)
    caption = f"Root mean square error of the {name} over {runs or 'all'} runs."
    if stated is not None and runs:
        if few:
            caption += " If the stated sigma (thin) is true, the line stays in the tint"
            caption += " 95\u00a0% of the time."
        else:
            caption += " Thin lines: the stated sigma."
        caption += bound_note(solution)
    if mean is not None and runs:
        share = 100.0 * 1.96 / np.sqrt(runs)
        caption += f" Of a filter without bias the mean error (dotted) is below {share:.0f}\u00a0%"
        caption += " of the line 95\u00a0% of the time."
    if best is not None:
        caption += " No filter with this model can come below the covariance bound."
    caption += rms.frame
    return Picture(f"rms_{block}", f"Scatter of the {name} over the runs", caption, figure)


@style.styled
def height(solution: xr.Dataset) -> Picture | None:
    """Height over time, with the fixes and the reference; None if no filter estimates it."""
    filters = series.filters(solution)
    data = series.get(solution, "track", "alt_m")
    if data is None:
        return None
    figure, axes, clock = series.single_axes(solution, data.x, "height [m]", 2.7)
    more = []
    fixes, truth = (series.one(solution, role, "alt_m") for role in ("gnss", "reference"))
    if fixes is not None:
        look = {"linestyle": "", "marker": ".", "markersize": 3.0, "color": style.GREY}
        axes.plot(series.x_of(fixes, 0) / clock.seconds, fixes.values, **look)
        more.append(style.key("GNSS fixes", **look))
    if truth is not None:
        look = {"color": style.TRUTH, "linewidth": 2.4, "alpha": 0.35}
        clock.plot(axes, series.x_of(truth, 0), np.asarray(truth, float), **look)
        more.append(style.key("reference", **look))
    for i in range(len(filters)):
        clock.plot(axes, data.x, data.values[i, :, 0], **style.filter_style(i))
    series.legend(figure, solution, [*style.filter_keys(filters), *more])
    return Picture("height", "Height profile", "Height above the WGS-84 ellipsoid.", figure)
