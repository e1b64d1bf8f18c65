"""Filters side by side by their metrics; designs by the cost of a bound on the worst case."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr

from robins.report import numbers, series, style
from robins.report.numbers import Summary, Values
from robins.report.style import Picture
from robins.results import Probability, find

_MOST = 12  # charts of one figure
_NO_ERRORS = ("nis_", "refused_", "rest_share", "log_likelihood")  # no comparison by themselves


def metrics(filters: Mapping[str, Values]) -> dict[str, list[float | int | None]]:
    """Metrics that are one number in at least two filters, by name, in the filters' order."""
    names = dict.fromkeys(name for values in filters.values() for name in values)
    found = {}
    for name in names:
        row = [values.get(name) for values in filters.values()]
        plain = [v if _is_number(v) else None for v in map(Probability.share_of, row)]
        if sum(v is not None for v in plain) >= 2:
            found[name] = plain
    return found


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


@style.styled
def comparison(summary: Summary) -> Picture | None:
    """Bars of every metric the filters share; None if none is an error."""
    filters = list(summary["filters"])
    found = dict(list(metrics(summary["filters"]).items())[:_MOST])
    if all(name.startswith(_NO_ERRORS) for name in found):
        return None
    figure, grid = style.panels(len(found), 0.5, 0.5 + 0.24 * len(filters))
    engine: Any = figure.get_layout_engine()
    engine.set(wspace=0.07, hspace=0.06)  # otherwise tick labels of adjacent axes touch
    places, uncertain = range(len(filters)), False
    for axes, (name, values) in zip(grid.flat, found.items(), strict=False):
        chances = [Probability.read(of.get(name)) for of in summary["filters"].values()]
        ends = [value or 0.0 for value in values]
        for i, value in enumerate(values):
            axes.barh(i, ends[i], 0.66, color=style.colour(i))
            if (chance := chances[i]) is not None:
                axes.plot([chance.low, chance.high], [i, i], color=style.TRUTH, linewidth=1.0)
                ends[i], uncertain = chance.high, True
            look: dict[str, Any] = {"textcoords": "offset points", "va": "center", "fontsize": 8.0}
            axes.annotate(numbers.show(value), (max(ends[i], 0.0), i), (4, 0), **look)
        low, high = min(0.0, *ends), max(0.0, *ends)
        axes.set_xlim(low * 1.1, (high or 1.0) * 1.45)  # room for the numbers behind the bars
        axes.set_ylim(len(filters) - 0.5, -0.5)
        axes.set_yticks(list(places), filters)
        axes.tick_params(axis="y", length=0)
        axes.grid(axis="y", visible=False)
        axes.locator_params(axis="x", nbins=3)
        axes.spines["left"].set_visible(False)
        axes.set_title(str(numbers.label(name)))
    for axes in grid[:, 1:].flat:
        axes.set_yticklabels([])
    caption = "The filters on the same data. Each chart has its own scale, which begins at zero."
    if uncertain:
        caption += " A line over a bar is the 95\u00a0% interval of a probability."
    return Picture("comparison", "Comparison of the filters", caption, figure)


_ROLES = ("trade_off_h2", "trade_off_hinf", "kalman_h2", "kalman_hinf")
# Variants of a method share a colour; retuned ones are dashed.
_LOOKS: dict[str, dict[str, Any]] = {
    "riccati": {"color": style.colour(0), "marker": "o", "markersize": 6.5, "zorder": 4},
    "closed-form": {"color": style.colour(3), "marker": "x", "linestyle": ":", "zorder": 5},
    "lmi-common": {"color": style.colour(1), "marker": "s"},
    "lmi-slack": {"color": style.colour(2), "marker": "D"},
    "retuned-common": {"color": style.colour(1), "marker": "s", "linestyle": "--"},
    "retuned-slack": {"color": style.colour(2), "marker": "D", "linestyle": "--"},
    "full-order": {"color": style.colour(5), "marker": "+", "linestyle": ":", "markersize": 7.0},
}
_KALMAN = {"color": style.TRUTH, "marker": "*", "markersize": 11.0, "linestyle": "", "zorder": 6}
_LEAST = {"color": style.GREY, "linewidth": 0.9, "linestyle": (0, (1, 2))}


@style.styled
def trade_off(solution: xr.Dataset) -> Picture:
    """Line through the designs of each method, and their distance from the best for a gamma."""
    h2, hinf, kalman_h2, kalman_hinf = (find(solution, role)[""] for role in _ROLES)
    gamma = series.x_of(h2, 1)
    value, reached = np.asarray(h2.values, float), np.asarray(hinf.values, float)
    best = np.fmin.reduce(value, axis=0)
    figure, grid = style.new_figure(2, height=5.6, sharex=True, height_ratios=(3, 2))
    above, below = grid[:, 0]
    keys = []
    for k, name in enumerate(series.coordinate(solution, h2.dims[0])):
        if not np.isfinite(value[k]).any():
            continue
        look = {"markersize": 4.0, "markerfacecolor": "none", "markeredgewidth": 1.1}
        look |= _LOOKS.get(name, {"color": style.colour(k), "marker": "."})
        order = np.argsort(reached[k])
        above.plot(reached[k][order], value[k][order], **look)
        below.plot(gamma, 100.0 * (value[k] / best - 1.0), **look)
        keys.append(style.key(name, **look))
    above.plot(kalman_hinf.item(), kalman_h2.item(), **_KALMAN)
    keys.append(style.key("Kalman filter", **_KALMAN))
    least = float(hinf.attrs.get("least", np.nan))
    if least > 0.0:
        above.axvline(least, **_LEAST)
        below.axvline(least, **_LEAST)
        keys.append(style.key(f"least of {hinf.attrs['least_of']}", **_LEAST))
    unit = hinf.attrs["units"]
    above.set(ylabel=_label("H2 norm", h2.attrs["units"]), title="over the true H∞ norm")
    below.set(ylabel="above the best [%]", title="over the requested gamma")
    below.set(xlabel=_label("H∞ norm from the modelling error to the estimate", unit))
    style.legend(figure, keys)
    caption = (
        "True norms. Above, left is safer against the modelling error and down is less noise; a "
        "method that ends has no gain for what is further left. Below, what is lost to the best "
        "method for that gamma: designs by LMI that are not retuned prove more than was requested."
    )
    return Picture("trade_off", "What a bound on the worst case costs", caption, figure)


def _label(text: str, unit: str) -> str:
    return text if unit == "1" else f"{text} [{unit}]"
