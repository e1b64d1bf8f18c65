"""Comments on the fields of a header: units, frames and axes, as far as the problem knows them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise

import jax
import numpy as np
from jax.tree_util import KeyPath
from jax.typing import ArrayLike

from robins import manifold
from robins.export.library import identifier, symbol
from robins.export.runs import Arguments
from robins.filters import Belief
from robins.manifold import State
from robins.rotation import BodyRotation, Rotation
from robins.systems.study import Problem, SensorAxes

MEAN = ".belief.mean"  # of a state
_SIDES = {
    Rotation: "exp(phi x) estimate, phi in the axes that it maps to",
    BodyRotation: "estimate exp(phi x), phi in the axes that it maps from",
}
_OUTPUTS = {
    "nis": "normalised innovation squared",
    "dof": "number of components used",
    "used": "1 where used",
}
Axis = tuple[str, str, str]  # block, "[unit], frame", axis


def tangent_axes(problem: Problem, reported: ArrayLike | None, n: int) -> list[Axis | None]:
    """Axes of the n components of the error; None for those not reported by themselves.

    Where the reported axes turn with time, a component must be reported so at all epochs.
    """
    rows = np.eye(n) if reported is None else np.asarray(reported)
    if rows.ndim == 3:
        rows = np.where(np.all(rows == rows[0], axis=(0, 2))[:, None], rows[0], 0.0)
    found: list[Axis | None] = [None] * n
    for block in problem.blocks:
        for row, axis in zip(rows[block.where], block.axes, strict=True):
            at = np.flatnonzero(row)
            if len(at) == 1 and abs(row[at[0]]) == 1.0:
                sign = "" if row[at[0]] > 0 else "minus "
                found[at[0]] = block.name, f"[{block.units}], {block.frame}", sign + axis
    return found


def _pieces(axes: list[Axis | None]) -> Iterator[tuple[int, int, Axis, list[str]]]:
    """Consecutive components of one block: first, last, axis of the first, names of the axes."""
    ends = [k for k in range(1, len(axes)) if (axes[k] or "")[:2] != (axes[k - 1] or "")[:2]]
    for first, end in pairwise([0, *ends, len(axes)]):
        some = [axis for axis in axes[first:end] if axis is not None]
        if some:
            yield first, end - 1, some[0], [axis[2] for axis in some]


def components(axes: list[Axis | None]) -> list[str]:
    """Comment on the factor of the covariance, in lines."""
    lines = [
        "factor is lower triangular, covariance P = factor factor' of the error, whose rows are"
    ]
    for first, last, (name, unit_text, _), names in _pieces(axes):
        rows = f"{first}" if first == last else f"{first} to {last}"
        lines.append(f"  {rows}: {name} {unit_text}: {', '.join(names)}")
    if len(lines) == 1:
        lines = [lines[0].replace(", whose rows are", "")]
    elif None in axes:
        lines.append("  the others: what the model adds to them")
    return lines


def attitude_lines(mean: State) -> list[str]:
    """Comment on the quaternions of a mean: their convention, and the side of their error."""
    leaves = jax.tree_util.tree_leaves(mean, is_leaf=lambda part: isinstance(part, Rotation))
    if not any(isinstance(leaf, Rotation) for leaf in leaves):
        return []
    elements = jax.tree_util.tree_leaves(mean, is_leaf=manifold.is_element)
    sides = {_SIDES[type(element)] for element in elements if type(element) in _SIDES}
    maps = "q_nb maps coordinates in b (body) to coordinates in n"
    errors = [f"Error phi of an attitude: true = {side}." for side in sides]
    return [f"Quaternions: Hamilton, scalar first; {maps}.", *(errors if len(errors) == 1 else [])]


def field_notes(
    problem: Problem,
    axes: list[Axis | None],
    state: State,
    given: Arguments,
    suspects: Sequence[str] = (),
) -> dict[tuple[str, str], str]:
    """Units and axes by struct and field: of the means in a state, of readings and innovations.

    A belief inside the state, such as a member's, is of the same components if its mean has the
    same structure.
    """
    notes = {
        ("state", "current"): "the last prediction was taken",
        ("reset_belief", "factor"): "above the diagonal not looked at",
    }
    mean = state.belief.mean
    for root in _mean_paths(state):
        for name, first, last, own in tangent_fields(mean, root):
            if text := _joined_note(own, _components_text(axes[first:last], first)):
                notes["state", name] = text
                if root == MEAN:
                    notes["reset_belief", name] = text
    for entry, arguments in given.items():
        sensor = problem.sensors.get(entry.removeprefix("update_"))
        if sensor is not None:
            name = symbol(entry)
            for field, first, last, own in tangent_fields(arguments[0], ""):
                notes[f"{name}_reading", field] = _joined_note(own, _read(sensor, first, last))
            notes[f"{name}_result", "innovation"] = _read(sensor, 0, len(sensor.axes))
            deviation = f"{sensor.units}: its standard deviation; NaN where not used"
            notes[f"{name}_result", "sigma"] = deviation
            notes |= {(f"{name}_result", field): text for field, text in _OUTPUTS.items()}
            if suspects:
                notes[f"{name}_result", "wrong"] = (
                    f"probability of being wrong: {', '.join(suspects)}"
                )
    return {**notes, **problem.fields}


def _mean_paths(state: State) -> Iterator[str]:
    """Paths of the means in a state that have the structure of the state's own mean."""
    parts = jax.tree_util.tree_flatten_with_path(state, is_leaf=lambda x: isinstance(x, Belief))[0]
    own = jax.tree_util.tree_structure(state.belief.mean)
    for path, part in parts:
        if isinstance(part, Belief) and jax.tree_util.tree_structure(part.mean) == own:
            yield f"{jax.tree_util.keystr(path)}.mean"


def _read(sensor: SensorAxes, first: int, last: int) -> str:
    """Note on some components of a reading; an axis may give its own unit in brackets."""
    axes = sensor.axes[first:last]
    units = dict.fromkeys(axis.partition("[")[2].rstrip("]") or sensor.units for axis in axes)
    return f"{', '.join(units)}, {sensor.frame}: {', '.join(axes)}"


def _joined_note(own: str | None, unit_text: str) -> str:
    """Note of a field: its own text, or that of its error."""
    if own is None:
        return unit_text
    text, _, error = own.partition("; error: ")
    return f"{text}; error: {unit_text}" if error and unit_text else text


Place = tuple[str, int, int, str | None]


def tangent_fields(tree: State, root: str) -> Iterator[Place]:
    """Fields of a point: name, first and end of their components of the error, and units.

    The units are None where they equal those of the error: for arrays, and for an element without
    others, such as `Angle`.
    """
    at = 0
    flat = jax.tree_util.tree_flatten_with_path(tree, is_leaf=manifold.is_element)[0]
    for path, leaf in flat:
        end = at + manifold.dim(leaf)
        for inner, own in _inner(leaf):
            yield identifier(f"{root}{jax.tree_util.keystr((*path, *inner))}"), at, end, own
        at = end


def _inner(leaf: State) -> Iterator[tuple[KeyPath, str | None]]:
    """Paths of the arrays in a leaf, and their own units."""
    if not manifold.is_element(leaf):
        yield (), None
        return
    own = getattr(leaf, "units", {})
    parts = jax.tree_util.tree_flatten_with_path(
        leaf, is_leaf=lambda part: part is not leaf and manifold.is_element(part)
    )[0]
    additive = not own and len(parts) == 1 and np.size(parts[0][1]) == leaf.dim
    for path, part in parts:
        if manifold.is_element(part):
            for inner, text in _inner(part):
                yield (*path, *inner), "" if text is None else text.partition("; error: ")[0]
        else:
            yield path, None if additive else own.get(getattr(path[-1], "name", ""), "")


def _components_text(axes: list[Axis | None], at: int) -> str:
    """Note on the components of a field of the mean, counted from 0 within the field."""
    pieces = list(_pieces(axes))
    texts = []
    for first, last, (name, unit_text, _), names in pieces:
        where = "" if len(pieces) == 1 and last - first + 1 == len(axes) else f"{first} to {last}: "
        texts.append(f"{where}{name} {unit_text}: {', '.join(names)}")
    return "; ".join(texts)
