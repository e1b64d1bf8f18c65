"""Sobol indices: figures, tables and sentences on the variance due to each parameter."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.patches import Patch
from rich.table import Table
from rich.text import Text

from robins import units
from robins.report import series, style
from robins.report.numbers import csv_of, words
from robins.report.style import Picture
from robins.results import find

_ORDERS = {"first": "first order: alone", "total": "total: with others"}
_SLICES, _FEW = 10, 8  # means over a parameter: number of slices, and least points in each
_WIDE = 0.2  # width of a confidence interval above which the ranking is doubted
_NOTHING = 1e-12  # greatest total index of a parameter without effect
_THICK = 0.36  # of a bar; two of them to a parameter


@style.styled
def budget(solution: xr.Dataset) -> Picture:
    """First-order and total indices of each block, with their 95 % bounds."""
    blocks = find(solution, "sobol_first")
    names = series.coordinate(solution, "parameter")
    each, share = 0.55 + 0.42 * len(names), "share of the variance"
    figure, grid = style.panels(len(blocks), 0.9, each, share, sharex=True, sharey=True)
    for axes, block in zip(grid.flat, blocks, strict=False):
        _bars(axes, solution, block)
        axes.set_title(words(block))
    grid[0, 0].set_yticks(range(len(names)), names)
    grid[0, 0].invert_yaxis()
    keys: list[Any] = [
        Patch(color=style.colour(k), label=text) for k, text in enumerate(_ORDERS.values())
    ]
    keys.append(style.key("95 % bounds", color=style.TRUTH, linewidth=1.2))
    style.legend(figure, keys)
    about = next(iter(blocks.values())).attrs
    caption = (
        f"Which share of the variance of the RMS error of '{about['of_filter']}' each uncertain "
        f"parameter of the world brings; {int(about['samples'])} samples of {int(about['runs'])} "
        "runs. First order: what would go if this one alone were known. Total: what would stay if "
        "all the others were. Lines: 95 % bounds by a bootstrap over points and runs."
    )
    return Picture("sensitivity", "What the variance of the error comes from", caption, figure)


@style.styled
def scatter(solution: xr.Dataset, block: str) -> Picture:
    """RMS error of the independent points over each parameter, and its mean in slices."""
    count = 2 * int(find(solution, "sobol_first")[block].attrs["samples"])
    rms, unit = series.shown(find(solution, "sobol_rms")[block])
    share = find(solution, "sobol_share")[""]
    names = series.coordinate(solution, "parameter")
    ends = _ends(solution)
    label = f"{words(block)} RMS [{unit}]" if unit else f"{words(block)} RMS"
    figure, grid = style.panels(len(names), 0.3, 2.2, y=label, sharey=True)
    slices = max(2, min(_SLICES, count // _FEW))
    for k, (axes, name) in enumerate(zip(grid.flat, names, strict=False)):
        x, y = np.asarray(share, float)[:count, k], rms[:count]
        axes.plot(x, y, ".", markersize=2.5, color=style.colour(0), alpha=0.5)
        slice_ = np.minimum((x * slices).astype(int), slices - 1)
        there = np.unique(slice_)
        means = [np.mean(y[slice_ == s]) for s in there]
        axes.plot((there + 0.5) / slices, means, color=style.colour(1), linewidth=1.8)
        axes.set_xticks([0.0, 1.0], ends[k])
        for label, side in zip(axes.get_xticklabels(), ("left", "right"), strict=True):
            label.set_horizontalalignment(side)  # within their axes
        axes.set_xlabel(name)
    point = style.key("point", color=style.colour(0), marker=".", linestyle="")
    mean = style.key("mean of a slice", color=style.colour(1), linewidth=1.8)
    style.legend(figure, [point, mean])
    caption = (
        "Each point is the RMS error over the runs, with all parameters drawn at once. How far the "
        "line goes up and down is the first order of a parameter; how far points scatter about it "
        "is what the others bring."
    )
    title = f"{words(block)} over each parameter"
    return Picture(f"sensitivity_{block}", title, caption, figure)


def table(solution: xr.Dataset) -> Table:
    """A row for each block and parameter, the greatest total first, as rich can print it."""
    made = Table(box=None, pad_edge=False, header_style="bold", padding=(0, 2, 0, 0))
    for head in ("share of", "parameter"):
        made.add_column(head, no_wrap=True)
    for head in ("first order", "95 %", "total", "95 %"):
        made.add_column(head, justify="right", no_wrap=True)
    names = series.coordinate(solution, "parameter")
    for block in find(solution, "sobol_first"):
        values = {order: _of(solution, order, block) for order in _ORDERS}
        for place, k in enumerate(np.argsort(-np.nan_to_num(values["total"][0]), kind="stable")):
            cells = [words(block) if place == 0 else "", names[k]]
            for value, low, high in (values[order][:, k] for order in _ORDERS):
                none = np.isnan(value)
                cells += [
                    "–" if none else f"{value:.2f}",
                    "" if none else f"{low:.2f} to {high:.2f}",
                ]
            made.add_row(*map(Text, cells))
    return made


def _of(solution: xr.Dataset, order: str, block: str) -> np.ndarray:
    """(3, parameters) index with its lower and its upper bound."""
    ends = ("", "_low", "_high")
    return np.stack([np.asarray(find(solution, f"sobol_{order}{e}")[block], float) for e in ends])


def _bars(axes: Axes, solution: xr.Dataset, block: str) -> None:
    """Two bars for each parameter."""
    farthest = 1.0
    for k, order in enumerate(_ORDERS):
        value, low, high = _of(solution, order, block)
        at = np.arange(len(value)) + (k - 0.5) * _THICK
        axes.barh(at, np.nan_to_num(value), _THICK, color=style.colour(k))
        axes.hlines(at, low, high, color=style.TRUTH, linewidth=1.2)
        farthest = max(farthest, float(np.max(np.nan_to_num(high), initial=0.0)))
    if not np.any(np.isfinite(find(solution, "sobol_total")[block])):
        axes.text(0.5, 0.5, "no indices", transform=axes.transAxes, ha="center", color=style.GREY)
    axes.grid(axis="y", visible=False)
    left, right = axes.get_xlim()
    axes.set_xlim(min(left, 0.0), max(right, 1.02 * farthest))


# ------------------------------------------------------------------- tables and sentences


def metrics(solution: xr.Dataset) -> dict[str, dict[str, float | list[float]]]:
    """Indices with their bounds, by parameter, as metrics of a summary."""
    out: dict[str, dict[str, float | list[float]]] = {}
    found = {(b, o): _of(solution, o, b) for b in find(solution, "sobol_first") for o in _ORDERS}
    for j, name in enumerate(series.coordinate(solution, "parameter")):
        rows = {f"{b}_{o}_order": index[:, j].tolist() for (b, o), index in found.items()}
        out[name] = {}
        for key, (value, low, high) in rows.items():
            out[name] |= {key: value, f"{key}_bounds": [low, high]}
    return out


def _ends(solution: xr.Dataset) -> list[tuple[str, str]]:
    """Both ends of each parameter, as texts."""
    texts = find(solution, "sobol_share")[""].attrs["ends"].split("; ")
    return [(low, high) for low, _, high in (text.partition(" to ") for text in texts)]


def _spread(solution: xr.Dataset) -> dict[str, tuple[float, float, str]]:
    """Mean and standard deviation of the RMS over the independent points, and their unit."""
    every = find(solution, "sobol_rms")
    samples = int(next(iter(find(solution, "sobol_first").values())).attrs["samples"])
    rms = np.stack([np.asarray(x, float)[: 2 * samples] for x in every.values()], axis=1)
    with np.errstate(invalid="ignore"):  # an infinite RMS has no spread
        pairs = np.transpose([np.mean(rms, axis=0), np.std(rms, axis=0)])
    out = {}
    for (block, x), pair in zip(every.items(), pairs, strict=True):
        unit = x.attrs.get("units", "1")
        shown = x.attrs.get("display_unit", unit)
        mean, deviation = (float(units.convert(one, unit, shown)) for one in pair)
        out[block] = mean, deviation, shown
    return out


def csv(solution: xr.Dataset, laws: Sequence[str]) -> bytes:
    """A row for each block and parameter: the RMS, the ends, the indices with their bounds.

    Args:
        solution: as of `robins.campaign.sensitivity.labelled`.
        laws: distribution of each parameter.
    """
    head = "filter block unit rms_mean rms_std parameter low high parameter_unit distribution"
    orders = [f"{o}{end}" for o in _ORDERS for end in ("", "_low", "_high")]
    rows: list[list[Any]] = [[*head.split(), *orders, "samples", "runs"]]
    names, spread = series.coordinate(solution, "parameter"), _spread(solution)
    ends = _ends(solution)
    for block, first in find(solution, "sobol_first").items():
        about = first.attrs
        counts = [int(about["samples"]), int(about["runs"])]
        mean, deviation, unit = spread[block]
        index = np.concatenate([_of(solution, order, block) for order in _ORDERS])
        for j, name in enumerate(names):
            (low, _, of), (high, _, _) = (text.partition(" ") for text in ends[j])
            values = [float(low), float(high), of, laws[j], *index[:, j].tolist()]
            own = [about["of_filter"], block, unit, mean, deviation, name]
            rows.append([*own, *values, *counts])
    return csv_of(rows)


def points(solution: xr.Dataset, drawn: Sequence[np.ndarray]) -> bytes:
    """The independent samples A and B, with the RMS of each point.

    Args:
        solution: as of `robins.campaign.sensitivity.labelled`.
        drawn: (points,) values of each parameter, in its unit.
    """
    names = series.coordinate(solution, "parameter")
    named = [(n, low.partition(" ")[2]) for n, (low, _) in zip(names, _ends(solution), strict=True)]
    columns = list(drawn)
    for block, rms in find(solution, "sobol_rms").items():
        values, unit = series.shown(rms)
        named.append((f"{block} RMS", unit))
        columns.append(values[: len(drawn[0])])
    head = [f"{name} [{unit}]" if unit not in ("", "1") else name for name, unit in named]
    return csv_of([head, *np.transpose(columns).tolist()])


def sentences(solution: xr.Dataset, laws: Sequence[str]) -> list[str]:
    """Notes on the computation and the meaning of the indices; arguments as of `csv`."""
    about = next(iter(find(solution, "sobol_first").values())).attrs
    name, samples, runs = about["of_filter"], int(about["samples"]), int(about["runs"])
    names = series.coordinate(solution, "parameter")
    told = "; ".join(
        f"{key} {law} from {low} to {high}"
        for key, law, (low, high) in zip(names, laws, _ends(solution), strict=True)
    )
    sizes = "; ".join(
        f"{block} {mean:.3g} {unit}, standard deviation {deviation:.3g}"
        for block, (mean, deviation, unit) in _spread(solution).items()
    )
    return [
        f"The world varies, '{name}' believes the scenario as written. "
        f"{(len(names) + 2) * samples} points: "
        f"{samples} samples x (2 + {len(names)} parameters), each of the same {runs} runs.",
        f"Parameters are independent: {told}. The logarithm is uniform where the ends are more "
        "than a factor of 10 apart.",
        "First order: the share of the variance of the RMS error that would go if this parameter "
        "alone were known. Total: the share that would stay if all the others were known; what it "
        "exceeds the first order by comes from acting together with others.",
        f"RMS error over the points, mean: {sizes}. Bounds are of 95 % confidence, by "
        "drawing points and runs again (bootstrap).",
    ]


def doubts(solution: xr.Dataset, follow: Sequence[bool]) -> list[str]:
    """Warnings on missing indices, on those that include the filter's start, and on unsure ranks.

    Args:
        solution: as of `robins.campaign.sensitivity.labelled`.
        follow: for each parameter, True if the filter's initial belief follows it.
    """
    names, blocks = series.coordinate(solution, "parameter"), find(solution, "sobol_total")
    name = next(iter(find(solution, "sobol_first").values())).attrs["of_filter"]
    rms = np.stack([np.asarray(x, float) for x in find(solution, "sobol_rms").values()])
    total = np.stack([np.asarray(x, float) for x in blocks.values()])
    lost = int(np.sum(~np.all(np.isfinite(rms), axis=0)))
    still = [b for b, row in zip(blocks, total, strict=True) if np.all(np.isnan(row))]
    told = []
    if lost:
        told.append(
            f"at {lost} of {rms.shape[1]} points '{name}' diverged in a "
            "run: their RMS is infinite and there are no indices; bring the ends nearer together "
            "or name another filter"
        )
    elif still:
        told.append(f"the RMS error of {', '.join(still)} does not vary, so it has no indices")
    for j, key in enumerate(names):
        if follow[j]:
            told.append(
                f"{key}: what '{name}' believes at the start follows it, since the world of "
                "this study brings the start along; its index is that of both"
            )
        if len(still) < len(blocks) and not np.any(np.nan_to_num(total[:, j]) > _NOTHING):
            told.append(f"{key}: changes no error; the simulated world does not depend on it")
    for block in blocks:
        value, low, high = _of(solution, "total", block)
        unsure = [
            (i, j)
            for i, j in itertools.pairwise(np.argsort(-value))
            if low[i] < high[j] and max(high[i] - low[i], high[j] - low[j]) > _WIDE
        ]
        if unsure:
            i, j = unsure[0]
            told.append(
                f"{block}: the bounds of {names[i]} and {names[j]} are too wide to say "
                "which counts more; take more --samples, or more --runs"
            )
    return told


def greatest(solution: xr.Dataset) -> int | None:
    """Index of the parameter with the greatest total index of any block; None: there is none."""
    total = np.stack([np.asarray(x, float) for x in find(solution, "sobol_total").values()])
    known = np.nan_to_num(total, nan=-np.inf)
    if not np.any(np.isfinite(known)):
        return None
    return int(np.unravel_index(np.argmax(known), known.shape)[1])
