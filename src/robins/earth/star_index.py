"""The stars near a direction, found at once: a sky cut into cells that know their stars.

The sky is the surface of a cube, each face of n by n cells of equal angles. Each cell lists every
star within a reach of any point in it, so whichever way a camera looks, the stars in its field are
among those of one cell, and the list has the same length for all. That is what compiled code
can search inside a loop.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.spatial import KDTree

from robins import _float64  # noqa: F401
from robins.earth.star_catalogue import Stars

_MOST_CELLS = 64  # along an edge
_ROUNDING = 1e-9  # rad, for directions on the border of two cells


class StarIndex(NamedTuple):
    """A catalogue of N stars, brightest first, and the lists of its cells."""

    unit_i: Any  # (N, 3) directions, inertial axes
    magnitude: Any  # (N,)
    identifier: Any  # (N,) int
    members: Any  # (6 n n, K) int, stars of each cell, brightest first; -1: none
    reach_rad: Any  # () each list is complete to this angle from any direction in its cell


def index_stars(stars: Stars, reach_rad: float) -> StarIndex:
    """Sort a catalogue into cells.

    Args:
        stars: the catalogue.
        reach_rad: of a list, half the field of view of a camera or more [rad].

    Raises:
        ValueError: a reach not above zero or over 45 deg; no star; directions not of unit length.
    """
    reach = float(reach_rad)
    if not 0.0 < reach <= np.pi / 4.0:
        raise ValueError(f"reach_rad must be above 0 and at most pi/4, got {reach_rad}")
    unit = np.asarray(stars.unit_i, float)
    if unit.ndim != 2 or unit.shape[1] != 3 or not len(unit):
        raise ValueError(f"unit_i must have shape (N, 3), N at least one, got {unit.shape}")
    off = np.flatnonzero(~(np.abs(np.linalg.norm(unit, axis=1) - 1.0) < 1e-9))
    if off.size:
        raise ValueError(f"unit_i[{off[0]}] is {unit[off[0]]}: directions must be unit vectors")
    order = np.argsort(stars.magnitude, kind="stable")
    unit = unit[order]

    n = int(min(_MOST_CELLS, np.ceil(np.pi / reach)))
    corners = _cube_points(np.arange(n + 1.0), n)  # (6, n + 1, n + 1, 3)
    middles = _cube_points(np.arange(n) + 0.5, n).reshape(-1, 3)
    # A cell is a convex polygon on the sphere: none of it is farther from its middle than a corner.
    four = np.stack([corners[:, i : i + n, j : j + n] for i in (0, 1) for j in (0, 1)], 3)
    nearest = np.einsum("cki,ci->ck", four.reshape(-1, 4, 3), middles).min(1)
    angle = np.arccos(nearest) + reach + _ROUNDING
    lists = KDTree(unit).query_ball_point(middles, 2.0 * np.sin(angle / 2.0))
    members = np.full((len(lists), max(1, *map(len, lists))), -1)
    for row, found in zip(members, lists, strict=True):
        row[: len(found)] = np.sort(found)
    return StarIndex(
        unit,
        np.asarray(stars.magnitude, float)[order],
        np.asarray(stars.identifier, int)[order],
        members,
        np.asarray(reach),
    )


def near(index: StarIndex, direction_i: Float[Array, "3"]) -> Int[Array, "k"]:
    """Stars, by their place in the catalogue, among which are all within reach of a direction.

    Args:
        index: of the catalogue.
        direction_i: unit vector, inertial axes.

    Returns:
        (K,) int, brightest first; -1: none.
    """
    members = jnp.asarray(index.members)
    n = round((members.shape[0] / 6) ** 0.5)
    size = jnp.abs(direction_i)
    axis = jnp.argmax(size)
    main = direction_i[axis]
    face = 2 * axis + jnp.where(main < 0.0, 1, 0)
    angles = [jnp.arctan(direction_i[(axis + k) % 3] / size[axis]) for k in (1, 2)]
    steps = [jnp.floor((angle * 2.0 / np.pi + 0.5) * n) for angle in angles]
    cell = [jnp.clip(step, 0.0, n - 1.0).astype(int) for step in steps]
    return members[(face * n + cell[0]) * n + cell[1]]


def _cube_points(steps: np.ndarray, n: int) -> np.ndarray:
    """Unit vectors (6, S, S, 3) at steps of a cell along both edges of each face."""
    along = np.tan((steps / n - 0.5) * np.pi / 2.0)
    first, second = np.meshgrid(along, along, indexing="ij")
    points = np.empty((6, *first.shape, 3))
    for face in range(6):
        axis = face // 2
        points[face, ..., axis] = 1.0 if face % 2 == 0 else -1.0
        points[face, ..., (axis + 1) % 3] = first
        points[face, ..., (axis + 2) % 3] = second
    return points / np.linalg.norm(points, axis=-1, keepdims=True)
