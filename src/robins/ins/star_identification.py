"""Identification of stars without a prior attitude (lost in space).

The angle between two stars does not depend on the attitude, so it can be looked up. `index_pairs`
makes the table of all pairs of a catalogue that fit into a field of view, sorted by angle.
`identify` looks up the angles of a triangle of directions, keeps the triangles of stars with these
angles and the same handedness, and checks the other directions: a fourth star where the triangle
predicts it makes a pyramid (Mortari, Samaan, Bruccoleri & Junkins 2004). The order of triangles is
theirs; it drops a false star after one attempt, where nested loops would try it repeatedly.

The false-identification probability is bounded. With p the probability that some star lies by
chance within the tolerance of a direction, m of n other directions agree by chance with probability
P(Binomial(n, p) >= m); times the number of triangles tried so far that is `chance`, and the stars
are named only if it is below a limit. So four bright and sparse stars are enough, four faint and
dense ones are not. A direction that matches two stars, or a star that matches two directions, is
not named. All in NumPy.

A sensor with an attitude need not search the sky again: the last attitude, propagated by the gyros,
predicts the direction of each star of the catalogue. `track_stars` assigns to a direction the star
within a tolerance of it, unless a second star or a second direction matches too. It is pure JAX and
of fixed size, for use inside a loop.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from numpy.typing import ArrayLike
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation
from scipy.special import bdtrc

from robins import _float64  # noqa: F401
from robins.earth.stars import StarIndex, Stars, near, refuse_non_unit
from robins.errors import require
from robins.filters.belief import Number
from robins.ins.vector_attitude import checked_sigma
from robins.rotation import rotate

_WIDE = 4.0
"""Sigmas of a tolerance: one angle in 16 000 is beyond them, one direction in 3 000."""

_CROWDED = 3.0
"""Density of stars over its mean, as near the Milky Way."""

_MOST_TRIANGLES = 400
# least height of a triangle, twice its area over its longest side [rad]; less is ill-conditioned
_LEAST_SIDES = 0.03


class PairIndex(NamedTuple):
    """A catalogue of N stars and the P pairs of them that fit into a field of view."""

    unit_i: np.ndarray  # (N, 3) directions, inertial axes
    magnitude: np.ndarray  # (N,)
    identifier: np.ndarray  # (N,) int
    first: np.ndarray  # (P,) int, index of a star in the catalogue
    second: np.ndarray  # (P,) int, index of the other
    angle_rad: np.ndarray  # (P,) between them, ascending
    tree: Any  # search tree for the star nearest to a direction


class Identification(NamedTuple):
    """Identified stars, or the reason for none."""

    star: np.ndarray  # (n,) int, index in the catalogue; -1: not named
    identifier: np.ndarray  # (n,) int, catalogue number; -1: not named
    q_ib: np.ndarray  # (4,) attitude from them, scalar first; NaN: none
    named: int  # number of named directions
    chance: float  # bound of the probability that they agree by chance; 1: nothing agreed
    triangles: int  # number tried
    refusal: str  # reason for no names; empty if there are


def index_pairs(stars: Stars, field_rad: float) -> PairIndex:
    """Make the table of pairs; once per catalogue, a fraction of a second for 4559 stars.

    Args:
        stars: those that a camera detects, from `robins.earth.stars`. Many more, or fewer, than it
            detects make identification slower or impossible.
        field_rad: largest angle between two stars in its field of view [rad].

    Raises:
        ValueError: fewer than four stars, directions not of unit length, a field not above zero or
            over 90 deg.
    """
    field = float(field_rad)
    require(0.0 < field <= np.pi / 2.0, "field_rad must be above 0 and at most pi/2", field_rad)
    unit = np.asarray(stars.unit_i, float)
    if unit.ndim != 2 or unit.shape[1] != 3 or len(unit) < 4:
        raise ValueError(f"unit_i must have shape (N, 3), N four at least, got {unit.shape}")
    refuse_non_unit(unit)
    tree = KDTree(unit)
    pairs = tree.query_pairs(2.0 * np.sin(field / 2.0), output_type="ndarray")
    require(len(pairs), f"no two stars are within the field of {np.degrees(field):g} deg")
    angle = _angle(unit[pairs[:, 0]], unit[pairs[:, 1]])
    order = np.argsort(angle, kind="stable")
    magnitude, identifier = np.asarray(stars.magnitude, float), np.asarray(stars.identifier, int)
    first, second = pairs[order].T
    return PairIndex(unit, magnitude, identifier, first, second, angle[order], tree)


def pairs_between(
    index: PairIndex, low_rad: float, high_rad: float
) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of stars with an angle from low to high, as two arrays of catalogue indices."""
    first = np.searchsorted(index.angle_rad, low_rad, side="left")
    rows = slice(first, np.searchsorted(index.angle_rad, high_rad, side="right"))
    return index.first[rows], index.second[rows]


def identify(
    index: PairIndex,
    vectors_b: ArrayLike,
    sigma_rad: ArrayLike | float,
    magnitude: ArrayLike | None = None,
    magnitude_tolerance: float = 1.0,
    most_chance: float = 1e-6,
) -> Identification:
    """Identify the stars of an image.

    Args:
        index: from `index_pairs`.
        vectors_b: (n, 3) directions, unit vectors in body axes; NaN: missing. They may include
            false ones.
        sigma_rad: of each of the two angles of a direction [rad], a number or (n,).
        magnitude: (n,) as measured; None: not used.
        magnitude_tolerance: largest difference from the magnitude in the catalogue.
        most_chance: limit of the probability that the stars agree by chance.

    Returns:
        The names, or the reason for none. Too few stars, or none that agree, are not an error.

    Raises:
        ValueError: shapes that do not fit together, directions not of unit length (to 1e-3), a
            sigma, tolerance or limit that is not positive.
    """
    b, sigma, light = _checked(vectors_b, sigma_rad, magnitude, magnitude_tolerance, most_chance)
    there = np.flatnonzero(~np.isnan(b[:, 0]))
    none = np.full(len(b), -1)
    nothing = Identification(none, none.copy(), np.full(4, np.nan), 0, 1.0, 0, "nothing was tried")
    if len(there) < 4:
        return nothing._replace(refusal=f"{len(there)} stars are seen; a pyramid has four")
    image = _Image(b[there], sigma[there], None if light is None else light[there])
    density = _CROWDED * len(index.unit_i) / (4.0 * np.pi)  # stars per steradian
    tried = tests_made = 0
    best = 1.0
    for corners in _triangles(len(there)):
        if tried == _MOST_TRIANGLES:
            break
        if _height(image.b[list(corners)]) < _LEAST_SIDES:
            continue
        tried += 1
        for stars in _candidates(index, image, corners, magnitude_tolerance):
            tests_made += 1
            found = _confirmed(index, image, corners, stars, magnitude_tolerance)
            if found is None:
                continue
            star, rotation, tolerance = found
            others = len(there) - 3
            p = -np.expm1(-density * np.pi * np.mean(tolerance**2))
            agreed = int(np.sum(star >= 0)) - 3
            chance = float(tests_made * bdtrc(agreed - 1, others, p)) if agreed > 0 else 1.0
            best = min(best, chance)
            if chance < most_chance:
                return _named(index, len(b), there, star, rotation, chance, tried)
    reason = "no triangle of stars is confirmed by a fourth one"
    if best < 1.0:
        reason = f"too few stars agree: chance {best:.1g} is not below {most_chance:g}"
    return nothing._replace(triangles=tried, chance=best, refusal=reason)


class _Image(NamedTuple):
    b: np.ndarray  # (n, 3)
    sigma: np.ndarray  # (n,)
    magnitude: np.ndarray | None  # (n,)


def _triangles(n: int) -> Iterator[tuple[int, int, int]]:
    """Triples of n indices, ordered so that each index is soon absent from several in a row."""
    for second in range(1, n - 1):
        for third in range(1, n - second):
            for i in range(n - second - third):
                yield i, i + second, i + second + third


def _candidates(index: PairIndex, image: _Image, corners, magnitude_tolerance) -> np.ndarray:
    """Triples of stars (T, 3) with the angles of three directions and their handedness."""
    i, j, k = corners
    tables = []
    for other in (j, k):
        angle = _angle(image.b[i], image.b[other])
        tolerance = _WIDE * np.hypot(image.sigma[i], image.sigma[other])
        first, second = pairs_between(index, angle - tolerance, angle + tolerance)
        both = np.concatenate([first, second]), np.concatenate([second, first])
        if image.magnitude is not None:
            fits = _alike(index, both[0], image.magnitude[i], magnitude_tolerance)
            fits &= _alike(index, both[1], image.magnitude[other], magnitude_tolerance)
            both = both[0][fits], both[1][fits]
        tables.append(both)
    (start, second), (again, third) = tables
    # join the tables on their first star
    order = np.argsort(again, kind="stable")
    again, third = again[order], third[order]
    low = np.searchsorted(again, start, side="left")
    count = np.searchsorted(again, start, side="right") - low
    ends = np.cumsum(count)
    rows = np.arange(count.sum()) + np.repeat(low - ends + count, count)
    triple = np.stack([np.repeat(start, count), np.repeat(second, count), third[rows]], 1)
    a, b, c = (index.unit_i[triple[:, m]] for m in range(3))
    tolerance = _WIDE * np.hypot(image.sigma[j], image.sigma[k])
    fits = np.abs(_angle(b, c) - _angle(image.b[j], image.b[k])) < tolerance
    hand = np.linalg.det(image.b[list(corners)])
    a, b, c, triple = (x[fits] for x in (a, b, c, triple))
    return triple[np.sign(np.sum(a * np.cross(b, c), 1)) == np.sign(hand)]


def _confirmed(index: PairIndex, image: _Image, corners, stars, magnitude_tolerance):
    """Star of each direction, rotation and tolerances, by the attitude of a triangle; else None."""
    star = np.full(len(image.b), -1)
    star[list(corners)] = stars
    rotation, tolerance = Rotation.identity(), image.sigma
    for _ in range(4):
        used = np.flatnonzero(star >= 0)
        weight = 1.0 / image.sigma[used] ** 2
        rotation = Rotation.align_vectors(index.unit_i[star[used]], image.b[used], weight)[0]
        b = image.b[used]
        information = weight.sum() * np.eye(3) - (weight[:, None] * b).T @ b
        covariance = np.linalg.inv(information)
        # variance of the predicted direction, across it
        spread = np.trace(covariance) - np.einsum("ni,ij,nj->n", image.b, covariance, image.b)
        tolerance = _WIDE * np.sqrt(image.sigma**2 + spread)
        before, star = star, _nearest(index, image, rotation, tolerance, magnitude_tolerance)
        if np.sum(star >= 0) < 4:
            return None
        if np.array_equal(before, star):
            break
    if not np.array_equal(star[list(corners)], stars):
        return None
    return star, rotation, tolerance


def _nearest(index: PairIndex, image: _Image, rotation, tolerance, magnitude_tolerance):
    """The only star near each direction, if it is near no other direction; else -1."""
    chord = 2.0 * np.sin(tolerance / 2.0)
    distance, star = index.tree.query(rotation.apply(image.b), k=2)
    close = distance < chord[:, None]
    if image.magnitude is not None:
        for m in range(2):
            close[:, m] &= _alike(index, star[:, m], image.magnitude, magnitude_tolerance)
    only = np.where(close[:, 0] != close[:, 1], np.where(close[:, 0], star[:, 0], star[:, 1]), -1)
    claimed = np.bincount(star[close], minlength=len(index.unit_i))
    return np.where((only >= 0) & (claimed[only] == 1), only, -1)


def _named(index, n, there, star, rotation, chance, tried) -> Identification:
    whole = np.full(n, -1)
    whole[there] = star
    identifier = np.where(whole >= 0, index.identifier[whole], -1)
    q_ib = rotation.as_quat(canonical=True, scalar_first=True)
    return Identification(whole, identifier, q_ib, int(np.sum(star >= 0)), chance, tried, "")


def _alike(index: PairIndex, star, magnitude, tolerance):
    return np.abs(index.magnitude[star] - magnitude) <= tolerance


def _angle(a: np.ndarray, b: np.ndarray) -> Any:
    """Angle between unit vectors [rad], accurate for small angles too."""
    return 2.0 * np.arcsin(np.minimum(0.5 * np.linalg.norm(a - b, axis=-1), 1.0))


def _height(b: np.ndarray) -> float:
    """Least height of a triangle, twice its area over its longest side."""
    sides = b[[1, 2, 0]] - b
    return float(np.linalg.norm(np.cross(sides[0], sides[1])) / np.linalg.norm(sides, axis=1).max())


def _checked(vectors_b, sigma_rad, magnitude, magnitude_tolerance, most_chance):
    b = np.asarray(vectors_b, float)
    require(b.ndim == 2 and b.shape[1] == 3, "vectors_b must have shape (n, 3)", b.shape)
    b = np.where(np.isnan(b).any(1, keepdims=True), np.nan, b)
    sigma = checked_sigma(sigma_rad, ~np.isnan(b[:, 0]), vectors_b=b)
    light = None if magnitude is None else np.asarray(magnitude, float)
    if light is not None and light.shape != (len(b),):
        raise ValueError(f"magnitude must have shape ({len(b)},), got {light.shape}")
    require(magnitude_tolerance > 0.0, "magnitude_tolerance must be positive", magnitude_tolerance)
    require(0.0 < most_chance < 1.0, "most_chance must be between 0 and 1", most_chance)
    return b, np.broadcast_to(sigma, (len(b),)), light


def track_stars(
    index: StarIndex,
    vectors_b: Float[Array, "n 3"],
    q_ib: Float[Array, "4"],
    boresight_b: Float[Array, "3"],
    tolerance_rad: Number,
) -> Int[Array, "n"]:
    """Match directions with stars of the catalogue.

    Args:
        index: of the catalogue, its reach half the field of view at least, plus the error of q_ib.
        vectors_b: measured directions, unit vectors in body axes; NaN: none.
        q_ib: predicted attitude, body to inertial, scalar first.
        boresight_b: boresight, unit vector in body axes.
        tolerance_rad: largest angle of a match, some sigmas of the noise and of q_ib [rad]. It
            should be well below the separation of neighbouring stars.

    Returns:
        Index (n,) of each star in the catalogue; -1: none, or ambiguous.
    """
    unit = jnp.asarray(index.unit_i)
    members = near(index, rotate(q_ib, boresight_b))
    there = ~jnp.isnan(vectors_b[:, 0])
    seen = rotate(q_ib, jnp.where(there[:, None], vectors_b, 0.0))
    cosine = jnp.einsum("ni,ki->nk", seen, unit[members])  # zero where no direction was measured
    close = (cosine > jnp.cos(jnp.asarray(tolerance_rad, float))) & (members >= 0)[None, :]
    alone = (jnp.sum(close, 1) == 1) & ~jnp.any(close & (jnp.sum(close, 0) > 1)[None, :], 1)
    return jnp.where(alone, members[jnp.argmax(close, 1)], -1)
