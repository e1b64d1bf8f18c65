"""What a run of field vectors leaves open: the direction about which the attitude is least known.

A constant turn phi of the attitude, seen in n, moves the field that is read by B x phi, so K
vectors with an angle noise sigma bring the information

    Y = 1/sigma^2 sum_k (I - b_k b_k') ,    b_k = B_k / |B_k|

about it. Its eigenvector of the least eigenvalue is the direction; for one vector that is b, with
an eigenvalue of zero. It is what a perfect gyro would allow: a real one lets old vectors fade.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np


class Unobserved(NamedTuple):
    """The least known direction, and how well the attitude could be known at best."""

    direction_n: np.ndarray  # (3,) unit vector
    sigma_rad: float  # about it; infinite where nothing is known
    across_rad: float  # about the best known direction
    from_field_rad: float  # angle between it and the mean field
    field_turn_rad: float  # largest angle between any vector and the first


def unobserved(field_n: np.ndarray, sigma_rad: float) -> Unobserved:
    """The least known direction of a run of measured fields, and bounds for a perfect gyro.

    Args:
        field_n: (K, 3) field where it is measured, in any unit; NaN rows count for nothing.
        sigma_rad: of the direction of each vector, about each axis across it.

    Raises:
        ValueError: no vector is left, one has no direction, or sigma is not positive.
    """
    field = np.asarray(field_n, float)
    if field.ndim != 2 or field.shape[1] != 3:
        raise ValueError(f"field_n must have shape (K, 3), got {field.shape}")
    if not sigma_rad > 0.0:
        raise ValueError(f"sigma_rad must be positive, got {sigma_rad}")
    field = field[np.all(np.isfinite(field), axis=1)]
    size = np.linalg.norm(field, axis=1)
    if len(field) == 0 or np.any(size == 0.0):
        raise ValueError("a field without a direction says nothing: leave out NaN and zero vectors")
    b = field / size[:, None]
    Y = (len(b) * np.eye(3) - b.T @ b) / sigma_rad**2
    values, vectors = np.linalg.eigh(Y)
    # K vectors of one direction leave rounding of the size of eps K
    floor = 1e-12 * values[-1]
    with np.errstate(divide="ignore"):
        sigma = np.where(values > floor, 1.0 / np.sqrt(np.maximum(values, floor)), np.inf)
    mean = np.mean(b, axis=0)
    mean = mean / np.linalg.norm(mean)
    direction = vectors[:, 0] * (1.0 if vectors[:, 0] @ mean >= 0.0 else -1.0)

    def between(x: np.ndarray, y: np.ndarray) -> Any:
        return np.arctan2(np.linalg.norm(np.cross(x, y), axis=-1), np.sum(x * y, axis=-1))

    return Unobserved(
        direction_n=direction,
        sigma_rad=float(sigma[0]),
        across_rad=float(sigma[-1]),
        from_field_rad=float(between(direction, mean)),
        field_turn_rad=float(np.max(between(b, b[:1]))),
    )


def sentence(found: Unobserved) -> str:
    """The same in words."""
    north, east, down = found.direction_n
    elevation = np.degrees(np.arcsin(-down))
    azimuth = np.degrees(np.arctan2(east, north)) % 360.0
    known = (
        "nothing is known about it"
        if not np.isfinite(found.sigma_rad)
        else f"a perfect gyro would allow {np.degrees(found.sigma_rad):.2g} deg (1 sigma) about it"
    )
    return (
        f"Least observed: turns about azimuth {azimuth:.0f} deg, elevation {elevation:.0f} deg, "
        f"which is {np.degrees(found.from_field_rad):.1f} deg from the mean field; {known} and "
        f"{np.degrees(found.across_rad):.2g} deg across. The field turns by "
        f"{np.degrees(found.field_turn_rad):.1f} deg along the flight."
    )
