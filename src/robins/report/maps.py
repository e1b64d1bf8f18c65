"""The track on a map grid in metres."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import xarray as xr
from matplotlib.axes import Axes

from robins.report import series, style
from robins.report.style import Picture
from robins.results import find

# WGS-84, for a map; this room does not import robins.earth.
_A, _E2 = 6378137.0, 6.69437999014e-3
_WRAPPED_M = 1e6  # no line between two samples further apart than this

# Quality of a fix as numbered by RTKLIB; marker, size and colour by its accuracy.
_RTKLIB = {1: "fix", 2: "float", 3: "SBAS", 4: "DGPS", 5: "single", 6: "PPP"}
_MARKS = (
    (".", 3.0, "#8A8A8A"),
    ("d", 3.5, "#B8860B"),
    ("^", 3.5, "#A0522D"),
    ("x", 4.0, "#7B2D8B"),
)


class Path(NamedTuple):
    """Positions on the map [m]."""

    north: np.ndarray
    east: np.ndarray


def metres(lat_rad: np.ndarray, lon_rad: np.ndarray, origin: tuple[float, float]) -> Path:
    """Map positions [m] about an origin (latitude, longitude): arcs of meridian and parallel.

    The difference in longitude is wrapped first, so a track may cross 180 degrees.
    """
    lat0, lon0 = origin
    root = math.sqrt(1.0 - _E2 * math.sin(lat0) ** 2)
    radius_n = _A * (1.0 - _E2) / root**3
    radius_e = _A / root
    turn = 2.0 * math.pi
    d_lon = np.mod(np.asarray(lon_rad) - lon0 + math.pi, turn) - math.pi
    return Path((np.asarray(lat_rad) - lat0) * radius_n, d_lon * radius_e * math.cos(lat0))


def paths(solution: xr.Dataset) -> dict[str, Path]:
    """Positions of "track" (filter, time), "reference" and "gnss", all on the same map."""
    held = {role: find(solution, role) for role in ("track", "reference", "gnss")}
    pairs = (("north_m", "east_m"), ("lat_rad", "lon_rad"))
    pair = next((pair for pair in pairs if held["track"].keys() >= {*pair}), None)
    if pair is None:
        return {}
    found = {
        role: Path(*(np.asarray(places[c].values, float) for c in pair))
        for role, places in held.items()
        if places.keys() >= {*pair}
    }
    if pair == ("north_m", "east_m"):
        return found
    lat, lon = (c.ravel() for c in found["track"])
    good = np.flatnonzero(np.isfinite(lat) & np.isfinite(lon))
    if not good.size:
        return {}
    origin = float(lat[good[0]]), float(lon[good[0]])
    return {role: metres(lat, lon, origin) for role, (lat, lon) in found.items()}


def unwrapped(path: Path) -> Path:
    """Path with a gap wherever it jumps around the globe."""
    north, east = path.north.copy(), path.east.copy()
    jump = np.hypot(np.diff(north), np.diff(east)) > _WRAPPED_M
    gap = np.concatenate([[False], jump])
    north[gap], east[gap] = np.nan, np.nan
    return Path(north, east)


@style.styled
def track(solution: xr.Dataset) -> Picture | None:
    """Map of the filters' tracks, the reference, the fixes by quality and the outages."""
    places = paths(solution)
    if not places or not np.isfinite(places["track"].north + places["track"].east).any():
        return None
    filters = series.filters(solution)
    window, aspect = _window(list(places.values()))
    figure, grid = style.new_figure(1, 1, 1.3 + 6.2 * aspect)
    axes = grid[0, 0]
    scale, unit = (1e-3, "km") if max(window[1] - window[0], 0.0) > 5000.0 else (1.0, "m")
    keys = []

    if "gnss" in places:
        keys += _fixes(axes, solution, places["gnss"], scale)
    if "reference" in places:
        look = {"color": style.TRUTH, "linewidth": 2.6, "alpha": 0.35}
        _draw(axes, unwrapped(places["reference"]), scale, **look)
        keys.append(style.key("reference", **look))
    tracks = [Path(*pair) for pair in zip(*places["track"], strict=True)]
    outage = series.outage(solution)
    # Marked on the reference track, where that is known at the same times.
    candidates = [p for p in (places.get("reference"), tracks[0]) if p is not None]
    marked = [p for p in candidates if outage and len(p.north) == len(outage[1])]
    if outage is not None and marked:
        hidden = Path(*(np.where(outage[1], c, np.nan) for c in marked[0]))
        look = {"color": "#F2CF63", "linewidth": 6.0, "alpha": 0.8}
        _draw(axes, unwrapped(hidden), scale, zorder=1.5, solid_capstyle="butt", **look)
        keys.append(style.key("outage", **look))
    for i, path in enumerate(tracks):
        _draw(axes, unwrapped(path), scale, color=style.colour(i), linestyle=style.line(i))
    whole = next(path for path in tracks if np.isfinite(path.north + path.east).any())
    keys = [*style.filter_keys(filters), *keys, *_ends(axes, whole, scale)]

    _frame(axes, window, aspect, scale, unit)
    style.legend(figure, keys)
    long = {"m": "metres", "km": "kilometres"}[unit]
    caption = f"The way travelled, north up, on a grid in {long} about an origin near the start."
    return Picture("track", "Track", caption, figure)


def _draw(axes: Axes, path: Path, scale: float, **look) -> None:
    # Thinned along both coordinates over the sample number, which keeps every corner of the track.
    number = np.arange(len(path.north)) * 1.0
    _, north, east = series.thin(number, path.north * scale, path.east * scale, points=4000)
    axes.plot(east, north, **look)


def _fixes(axes: Axes, solution: xr.Dataset, path: Path, scale: float) -> list:
    """Draw the fixes, one marker per quality."""
    quality = series.one(solution, "gnss_quality")
    if quality is None:
        look = {"linestyle": "", "marker": ".", "markersize": 3.0, "color": "#8A8A8A"}
        axes.plot(path.east * scale, path.north * scale, **look)
        return [style.key("GNSS fixes", **look)]
    values = [int(v) for v in np.atleast_1d(quality.attrs.get("flag_values", list(_RTKLIB)))]
    meanings = str(quality.attrs.get("flag_meanings", " ".join(_RTKLIB.values()))).split()
    known = dict(zip(values, meanings, strict=False))
    keys = []
    for rank, value in enumerate(np.unique(quality.values)):
        mark, size, colour = _MARKS[min(rank, len(_MARKS) - 1)]
        look = {"linestyle": "", "marker": mark, "markersize": size, "color": colour}
        here = quality.values == value
        axes.plot(path.east[here] * scale, path.north[here] * scale, **look)
        name = known.get(int(value), f"quality {int(value)}").replace("_", " ")
        keys.append(style.key(f"GNSS {name} ({int(here.sum())})", **look))
    return keys


def _ends(axes: Axes, path: Path, scale: float) -> list:
    good = np.flatnonzero(np.isfinite(path.north + path.east))
    keys = []
    for name, at, mark in (("start", good[0], "o"), ("end", good[-1], "s")):
        look = {"linestyle": "", "marker": mark, "markersize": 7.0, "markerfacecolor": "white"}
        look |= {"markeredgecolor": style.TRUTH, "markeredgewidth": 1.4}
        axes.plot(path.east[at] * scale, path.north[at] * scale, zorder=5, **look)
        keys.append(style.key(name, **look))
    return keys


def _window(places: list[Path]) -> tuple[tuple[float, float, float, float], float]:
    """Limits west, east, south, north with room for everything, and their aspect ratio."""
    parts = [np.stack([p.east.ravel(), p.north.ravel()]) for p in places]
    points = np.concatenate(parts, axis=1)
    points = points[:, np.isfinite(points).all(axis=0)]
    (west, south), (east, north) = points.min(axis=1), points.max(axis=1)
    span = max(east - west, north - south, 1.0)
    margin = 0.06 * span
    width, tall = east - west + 2 * margin, north - south + 2 * margin
    aspect = min(max(tall / width, 0.42), 0.95)
    # Grow the shorter side, for equal scales on both axes without cutting anything.
    width, tall = max(width, tall / aspect), max(tall, width * aspect)
    x, y = (west + east) / 2, (south + north) / 2
    return (x - width / 2, x + width / 2, y - tall / 2, y + tall / 2), aspect


def _frame(
    axes: Axes, window: tuple[float, float, float, float], aspect: float, scale: float, unit: str
) -> None:
    """Limits, labels, north arrow, and a scale bar in a strip of its own below the data."""
    west, east, south, north = (edge * scale for edge in window)
    width = east - west
    strip = 0.09 * width
    axes.set_xlim(west, east)
    axes.set_ylim(south - strip, north)
    axes.set_box_aspect((north - south + strip) / width)
    axes.set(xlabel=f"east [{unit}]", ylabel=f"north [{unit}]")
    length = _round(width / 5.0)
    x, y = west + 0.04 * width, south - 0.62 * strip
    axes.plot([x, x + length], [y, y], color=style.TRUTH, linewidth=3.0, solid_capstyle="butt")
    label_text = f"{length:g} {unit}"
    axes.annotate(label_text, (x + length, y), (6, 0), textcoords="offset points", va="center")
    arrow = {"arrowstyle": "-|>", "color": style.TRUTH, "linewidth": 1.2}
    x = east - 0.04 * width
    axes.annotate("", (x, south - 0.15 * strip), (x, south - 0.95 * strip), arrowprops=arrow)
    axes.annotate("N", (x, y), (-6, 0), textcoords="offset points", va="center", ha="right")


def _round(length: float) -> float:
    """Largest of 1, 2 or 5 times a power of ten that does not exceed a length."""
    power = 10.0 ** math.floor(math.log10(length))
    return max(step * power for step in (1.0, 2.0, 5.0) if step * power <= length * 1.000001)
