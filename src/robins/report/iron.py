"""Magnetic field as measured and as calibrated: its size over time, its place on the sphere."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import xarray as xr

from robins import units
from robins.report import series, style
from robins.report.style import Picture
from robins.results import find

_DOTS = 3000  # of a cloud; more only make it darker
_PLANES = ((0, 1), (0, 2), (1, 2))
_NAMES = ("measured", "calibrated")
_LOOKS = ({"color": style.colour(1)}, {"color": style.colour(0)})


class _Field(NamedTuple):
    values: list[np.ndarray]  # measured and calibrated (time, axis), in the display unit
    strength: float
    unit: str
    time: np.ndarray
    axes: list[str]


def _field(solution: xr.Dataset) -> _Field:
    before, after = (find(solution, f"field_{name}")[""] for name in _NAMES)
    values, unit = [series.shown(array)[0] for array in (before, after)], series.shown(after)[1]
    strength = float(units.convert(after.attrs["strength"], after.attrs["units"], unit))
    axes = series.coordinate(solution, before.dims[1])
    return _Field(values, strength, unit, series.x_of(before, 0), axes)


@style.styled
def size(solution: xr.Dataset) -> Picture:
    """Size of the field over time, before and after."""
    values, strength, unit, time, _ = _field(solution)
    figure, grid = style.new(height=2.8)
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
    figure, grid = style.new(1, 3, 3.1)
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
