"""Errors over one parameter as curves with their bounds, over two as maps."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize

from robins.report import series, style
from robins.report.numbers import words
from robins.report.style import Picture
from robins.results import find

_DECADE = 8.0  # ratio of greatest to least error from which the colours are logarithmic


def errors(solution: xr.Dataset, block: str) -> Picture:
    """Curves over one parameter, or maps over two."""
    return (maps if solution.sizes["sweep_2"] > 1 else curves)(solution, block)


def _axis(solution: xr.Dataset, dim: str) -> tuple[np.ndarray, list[str], str]:
    """Positions along a parameter axis, tick labels, and axis label; texts are evenly spaced."""
    about = solution[dim].attrs
    unit = about.get("units", "1")
    label = about["long_name"] + ("" if unit == "1" else f" [{unit}]")
    values = solution[dim].values
    if values.dtype.kind in "fiu":
        return np.asarray(values, float), [f"{x:.4g}" for x in values], label
    return np.arange(len(values)) * 1.0, [str(x) for x in values], label


def _unit(block: str, unit: str) -> str:
    return f"{words(block)} RMS [{unit}]" if unit else f"{words(block)} RMS"


@style.styled
def curves(solution: xr.Dataset, block: str) -> Picture:
    """RMS error of each filter over a parameter, with 95 % bounds, and its stated sigma."""
    arrays = [find(solution, f"sweep_{k}")[block] for k in ("rms", "low", "high", "stated")]
    (rms, unit), (low, _), (high, _), (stated, _) = map(series.shown, arrays)
    places, tick_labels, label = _axis(solution, "sweep_1")
    filters = series.filters(solution)
    figure, grid = style.new_figure(1, 1, 3.0)
    axes: Axes = grid[0, 0]
    order = np.argsort(places)
    for i in range(len(filters)):
        at = places[order]
        axes.plot(at, rms[i, order, 0], marker="o", markersize=3.5, **style.filter_style(i))
        axes.fill_between(
            at, low[i, order, 0], high[i, order, 0], color=style.colour(i), alpha=0.18, linewidth=0
        )
        axes.plot(at, stated[i, order, 0], color=style.colour(i), linestyle=":", linewidth=0.9)
    if solution["sweep_1"].dtype.kind not in "fiu":
        axes.set_xticks(list(places), tick_labels)
    finite = rms[np.isfinite(rms)]
    if finite.size and finite.min() > 0.0 and finite.max() > 30.0 * finite.min():
        axes.set_yscale("log")
    else:
        axes.set_ylim(bottom=0.0)
    axes.set(xlabel=label, ylabel=_unit(block, unit))
    keys = [*style.filter_keys(filters), style.key("stated", color=style.GREY, linestyle=":")]
    style.legend(figure, keys)
    runs = int(arrays[0].attrs["runs"])
    caption = (
        f"Length of the error over its components, RMS over {runs} runs and the epochs that "
        "count. Bands: 95 % confidence, by the spread of the runs. Dotted: the standard deviation "
        "that the filter states. All points have the same random numbers."
    )
    return Picture(f"sweep_{block}", f"{words(block)} over {label}", caption, figure)


@style.styled
def maps(solution: xr.Dataset, block: str) -> Picture:
    """RMS error of each filter over two parameters, printed in each cell."""
    array = find(solution, "sweep_rms")[block]
    rms, unit = series.shown(array)
    (_, along, label), (_, up, other) = (_axis(solution, f"sweep_{k}") for k in (1, 2))
    filters = series.filters(solution)
    each = 0.6 + 0.26 * len(up)
    figure, grid = style.panels(len(filters), 0.9, each, label, other, sharex=True, sharey=True)
    finite = rms[np.isfinite(rms)]
    low, high = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 1.0)
    wide = low > 0.0 and high > _DECADE * low
    norm: Any = LogNorm(low, high) if wide else Normalize(low, high)
    image = None
    for axes, name, values in zip(grid.flat, filters, rms, strict=False):
        image = axes.imshow(values.T, norm=norm, cmap="cividis_r", origin="lower", aspect="auto")
        for (k, j), value in np.ndenumerate(values):
            dark = np.isfinite(value) and norm(value) > 0.55
            text = f"{value:.3g}" if np.isfinite(value) else "lost"
            colour = "white" if dark else style.TRUTH
            axes.text(k, j, text, ha="center", va="center", fontsize=7.0, color=colour)
        axes.set_title(name)
        axes.grid(visible=False)
        axes.set_xticks(range(len(along)), along)
        axes.set_yticks(range(len(up)), up)
        for side in axes.spines.values():
            side.set_visible(False)
    if image is not None:
        bar = figure.colorbar(image, ax=grid, label=_unit(block, unit), shrink=0.9, pad=0.02)
        if wide:  # otherwise labels between powers of ten are written as products
            ticks = np.geomspace(low, high, 5).tolist()
            bar.set_ticks(ticks, labels=[f"{x:.3g}" for x in ticks])
            bar.minorticks_off()
    caption = (
        "Length of the error over its components, RMS over the epochs that count of "
        f"{int(array.attrs['runs'])} runs; one scale for all filters. All points have the same "
        "random numbers."
    )
    return Picture(f"sweep_{block}", f"{words(block)} over {label} and {other}", caption, figure)
