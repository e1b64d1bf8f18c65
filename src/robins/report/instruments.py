"""Instruments: Allan deviation with the fitted noise terms, calibrated magnetic field."""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib.axes import Axes

from robins import units
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
    figure, grid = style.new_figure(1, len(labels), 3.5, sharex=True, sharey=True)

    def curve_of(role: str) -> np.ndarray | None:
        found = series.one(solution, role, sensor)
        return None if found is None else series.shown(found)[0]

    low, high, fit = curve_of("allan_low"), curve_of("allan_high"), curve_of("allan_fit")
    slopes, parts = curve_of("allan_slope"), find(solution, "allan_slope").get(sensor)
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
    """Axis limits from the measured curve; slopes of negligible processes may leave them below."""
    shown = np.concatenate([*values, *(b.ravel() for b in (low, high) if b is not None)])
    shown = shown[np.isfinite(shown) & (shown > 0.0)]
    if shown.size:
        axes.set_ylim(0.6 * shown.min(), 1.5 * shown.max())


_DOTS = 3000  # points of a cloud; more only make it darker
_PLANES = ((0, 1), (0, 2), (1, 2))
_NAMES = ("measured", "calibrated")
_LOOKS = ({"color": style.colour(1)}, {"color": style.colour(0)})


def _field(
    solution: xr.Dataset,
) -> tuple[list[np.ndarray], float, str, np.ndarray, list[str]]:
    """Field measured and calibrated (time, axis), its size, their unit, times, names of axes."""
    before, after = (find(solution, f"field_{name}")[""] for name in _NAMES)
    values, unit = [series.shown(array)[0] for array in (before, after)], series.shown(after)[1]
    strength = float(units.convert(after.attrs["strength"], after.attrs["units"], unit))
    axes = series.coordinate(solution, before.dims[1])
    return values, strength, unit, series.x_of(before, 0), axes


@style.styled
def size(solution: xr.Dataset) -> Picture:
    """Size of the field over time, before and after."""
    values, strength, unit, time, _ = _field(solution)
    figure, grid = style.new_figure(height=2.8)
    axes = grid[0, 0]
    every = -(-len(time) // _DOTS)
    for field, look in zip(values, _LOOKS, strict=True):
        axes.plot(time[::every], np.linalg.norm(field, axis=1)[::every], linewidth=0.8, **look)
    axes.axhline(strength, color=style.TRUTH, linewidth=0.9, linestyle="--")
    axes.set(xlabel="time [s]", ylabel=f"size of the field [{unit}]")
    style.legend(figure, [*_keys(linewidth=1.2), _of_the_field("its size as found")])
    caption = (
        "Turned in one place, a calibrated sensor reads the same size everywhere. What is left is "
        "noise if it is even; steps and slopes are iron nearby."
    )
    return Picture("field_size", "Size of the magnetic field", caption, figure)


@style.styled
def planes(solution: xr.Dataset) -> Picture:
    """The samples seen along each axis of the sensor, before and after."""
    values, strength, unit, _, labels = _field(solution)
    figure, grid = style.new_figure(1, 3, 3.1)
    every = -(-len(values[0]) // _DOTS)
    around = np.linspace(0.0, 2.0 * np.pi, 181)
    for axes, (i, j) in zip(grid[0], _PLANES, strict=True):
        for field, look in zip(values, _LOOKS, strict=True):
            dots = {"linestyle": "", "marker": ".", "markersize": 1.6, "alpha": 0.5}
            axes.plot(field[::every, i], field[::every, j], **dots, **look)
        circle = strength * np.cos(around), strength * np.sin(around)
        axes.plot(*circle, color=style.TRUTH, linewidth=0.9, linestyle="--")
        axes.set(xlabel=f"{labels[i]} [{unit}]", ylabel=f"{labels[j]} [{unit}]")
        axes.set_aspect("equal", adjustable="datalim")
    style.legend(figure, [*_keys(linestyle="", marker="o"), _of_the_field("sphere, in outline")])
    caption = (
        "Hard iron moves the cloud away from the middle, soft iron stretches it. Calibrated, it "
        "fills the circle; a part that is empty was never pointed at the field."
    )
    return Picture("field_planes", "Magnetic field along the axes of the sensor", caption, figure)


def _keys(**look) -> list:
    return [
        style.key(name, **colours, **look) for name, colours in zip(_NAMES, _LOOKS, strict=True)
    ]


def _of_the_field(label: str):
    return style.key(label, color=style.TRUTH, linewidth=0.9, linestyle="--")
