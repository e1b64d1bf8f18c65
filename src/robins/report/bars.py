"""The filters side by side: one small chart for each metric."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from robins.report import numbers, style
from robins.report.style import Picture

_MOST = 12  # charts of one figure
_COLUMNS = 3


def metrics(filters: Mapping[str, Mapping[str, Any]]) -> dict[str, list[float | int | None]]:
    """Metrics that are one number in at least two filters, by name, in the filters' order."""
    names = dict.fromkeys(name for values in filters.values() for name in values)
    found = {}
    for name in names:
        row = [values.get(name) for values in filters.values()]
        plain = [v if _is_number(v) else None for v in row]
        if sum(v is not None for v in plain) >= 2:
            found[name] = plain
    return found


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


@style.styled
def comparison(summary: Mapping[str, Any]) -> Picture | None:
    """Bars of every metric the filters share; None if there is nothing to compare."""
    filters = list(summary["filters"])
    found = dict(list(metrics(summary["filters"]).items())[:_MOST])
    if not found:
        return None
    columns = min(_COLUMNS, len(found))
    rows = -(-len(found) // columns)
    figure, grid = style.new(rows, columns, 0.5 + rows * (0.5 + 0.24 * len(filters)))
    engine: Any = figure.get_layout_engine()
    engine.set(wspace=0.07, hspace=0.06)  # else the last number of one touches the first of another
    places = range(len(filters))
    for axes, (name, values) in zip(grid.flat, found.items(), strict=False):
        for i, value in enumerate(values):
            axes.barh(i, value or 0.0, 0.66, color=style.colour(i))
            axes.annotate(
                numbers.show(value),
                (max(value or 0.0, 0.0), i),
                (4, 0),
                textcoords="offset points",
                va="center",
                fontsize=8.0,
            )
        present = [v for v in values if v is not None]
        low, high = min(0.0, *present), max(0.0, *present)
        axes.set_xlim(low * 1.1, (high or 1.0) * 1.45)  # room for the numbers behind the bars
        axes.set_ylim(len(filters) - 0.5, -0.5)
        axes.set_yticks(list(places), filters)
        axes.tick_params(axis="y", length=0)
        axes.grid(axis="y", visible=False)
        axes.locator_params(axis="x", nbins=3)
        axes.spines["left"].set_visible(False)
        axes.set_title(str(numbers.label(name)))
    for number, axes in enumerate(grid.flat):
        if number % columns:
            axes.set_yticklabels([])
        if number >= len(found):
            axes.set_visible(False)
    caption = "The filters on the same data. Each chart has its own scale, which begins at zero."
    return Picture("comparison", "Comparison of the filters", caption, figure)
