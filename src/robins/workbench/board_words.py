"""What a header says of its fields: units, frames and axes, as far as the problem knows them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import pairwise
from typing import Any

import jax
import numpy as np

from robins import manifold
from robins.program.library import identifier
from robins.systems.study import Problem

Axis = tuple[str, str, str]  # block, "[unit], frame", axis


def tangent_axes(problem: Problem, reported: Any, n: int) -> list[Axis | None]:
    """What each of n components of the error is, where it is reported by itself."""
    rows = np.eye(n) if reported is None else np.asarray(reported)
    found: list[Axis | None] = [None] * n
    for block in problem.blocks:
        for row, axis in zip(rows[block.where], block.axes, strict=True):
            at = np.flatnonzero(row)
            if len(at) == 1 and abs(row[at[0]]) == 1.0:
                sign = "" if row[at[0]] > 0 else "minus "
                found[at[0]] = block.name, f"[{block.units}], {block.frame}", sign + axis
    return found


def _pieces(axes: list[Axis | None]) -> Iterator[tuple[int, int, Axis, list[str]]]:
    """First and last of components of one block that follow each other, and their axes."""
    ends = [k for k in range(1, len(axes)) if (axes[k] or "")[:2] != (axes[k - 1] or "")[:2]]
    for first, end in pairwise([0, *ends, len(axes)]):
        some = [axis for axis in axes[first:end] if axis is not None]
        if some:
            yield first, end - 1, some[0], [axis[2] for axis in some]


def components(axes: list[Axis | None]) -> list[str]:
    """Lines on the factor of the covariance."""
    lines = [
        "factor is lower triangular, covariance P = factor factor' of the error, whose rows are"
    ]
    for first, last, (name, told, _), names in _pieces(axes):
        rows = f"{first}" if first == last else f"{first} to {last}"
        lines.append(f"  {rows}: {name} {told}: {', '.join(names)}")
    if len(lines) == 1:
        lines = [lines[0].replace(", whose rows are", "")]
    elif None in axes:
        lines.append("  the others: what the model adds to them")
    return lines


def field_notes(
    problem: Problem, axes: list[Axis | None], mean: Any, given: Mapping[str, Any]
) -> dict[tuple[str, str], str]:
    """Units and axes of the mean, of readings and of innovations, by struct and field."""
    notes = {
        ("state", "current"): "the last prediction was taken",
        ("reset_belief", "factor"): "above the diagonal not looked at",
    }
    for name, first, last in mean_fields(mean):
        whole = "unit quaternion, scalar first; error: " if name.endswith("wxyz") else ""
        if told := _told(axes[first:last], first):
            notes["state", name] = notes["reset_belief", name] = whole + told
    for entry in given:
        sensor = problem.sensors.get(entry.removeprefix("update_"))
        if sensor is not None:
            told = f"{sensor.units}, {sensor.frame}: {', '.join(sensor.axes)}"
            notes[f"{entry}_reading", "value"] = told
            notes[f"{entry}_result", "innovation"] = told
            deviation = f"{sensor.units}: its standard deviation; NaN where not used"
            notes[f"{entry}_result", "sigma"] = deviation
    return {**notes, **problem.fields}


def mean_fields(mean: Any) -> Iterator[tuple[str, int, int]]:
    """Fields of a mean, and the first and the end of their components of the error."""
    at = 0
    flat = jax.tree_util.tree_flatten_with_path(mean, is_leaf=manifold.is_element)[0]
    for path, leaf in flat:
        end = at + manifold.dim(leaf)
        for inner, _ in jax.tree_util.tree_flatten_with_path(leaf)[0]:
            yield identifier(f".belief.mean{jax.tree_util.keystr((*path, *inner))}"), at, end
        at = end


def _told(axes: list[Axis | None], at: int) -> str:
    """The components of a field of the mean, counted from its own 0."""
    pieces = list(_pieces(axes))
    texts = []
    for first, last, (name, told, _), names in pieces:
        where = "" if len(pieces) == 1 and last - first + 1 == len(axes) else f"{first} to {last}: "
        texts.append(f"{where}{name} {told}: {', '.join(names)}")
    return "; ".join(texts)
