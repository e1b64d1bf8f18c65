"""Allan deviation with its confidence band and the noise processes fitted to it."""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib.axes import Axes

from robins.report import series, style
from robins.report.numbers import words
from robins.report.style import Picture
from robins.results import find

_PROCESS_LINES = ("--", "-.", ":", (0, (4, 1, 1, 1)), (0, (1, 3)))


@style.styled
def allan(solution: xr.Dataset, sensor: str) -> Picture:
    """Allan deviation of each axis of a sensor over averaging time."""
    array = find(solution, "allan")[sensor]
    value, unit = series.shown(array)
    tau = series.x_of(array, 0)
    labels = series.coordinate(solution, array.dims[1])
    figure, grid = style.new(1, len(labels), 3.5, sharex=True, sharey=True)

    def told(role: str) -> np.ndarray | None:
        found = series.one(solution, role, sensor)
        return None if found is None else series.shown(found)[0]

    low, high, fit = told("allan_low"), told("allan_high"), told("allan_fit")
    slopes, parts = told("allan_slope"), find(solution, "allan_slope").get(sensor)
    processes = [] if parts is None else series.coordinate(solution, parts.dims[0])
    for k, (axes, label) in enumerate(zip(grid[0], labels, strict=True)):
        if low is not None and high is not None:
            band = {"color": style.colour(0), "alpha": 0.22, "linewidth": 0}
            axes.fill_between(tau, low[:, k], high[:, k], **band)
        axes.plot(tau, value[:, k], color=style.colour(0), marker=".", markersize=3.5, zorder=3)
        if fit is not None:
            axes.plot(tau, fit[:, k], color=style.colour(1), linewidth=1.4)
        if slopes is not None:
            for p in range(len(processes)):
                look = {"color": style.GREY, "linestyle": _PROCESS_LINES[p % len(_PROCESS_LINES)]}
                axes.plot(tau, slopes[p, :, k], linewidth=0.9, **look)
        axes.set(xscale="log", yscale="log", title=label, xlabel="averaging time τ [s]")
        _fit_limits(axes, [value[:, k] for k in range(len(labels))], low, high)
    grid[0, 0].set_ylabel(f"Allan deviation [{unit}]")
    keys = [style.key("measured", color=style.colour(0), marker=".")]
    if low is not None:
        confidence = 100.0 * float(array.attrs.get("confidence", 0.95))
        look = {"color": style.colour(0), "alpha": 0.22, "linewidth": 6.0}
        keys.append(style.key(f"{confidence:.4g}\u00a0% confidence", **look))
    if fit is not None:
        keys.append(style.key("fit", color=style.colour(1)))
    keys += [
        style.key(name, color=style.GREY, linewidth=0.9, linestyle=line)
        for name, line in zip(processes, _PROCESS_LINES, strict=False)
    ]
    style.legend(figure, keys)
    name = words(sensor)
    caption = (
        "White noise falls with slope −1/2, bias instability is the flat part, a random walk rises "
        "with slope +1/2."
    )
    return Picture(f"allan_{sensor}", f"Allan deviation of the {name}", caption, figure)


def _fit_limits(axes: Axes, values: list[np.ndarray], low, high) -> None:
    """Limits by the measured curve: the slopes of processes that do not matter run out below."""
    shown = np.concatenate([*values, *(b.ravel() for b in (low, high) if b is not None)])
    shown = shown[np.isfinite(shown) & (shown > 0.0)]
    if shown.size:
        axes.set_ylim(0.6 * shown.min(), 1.5 * shown.max())
