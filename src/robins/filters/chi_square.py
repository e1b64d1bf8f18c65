"""Quantiles of the chi-square distribution, the limits of gates and consistency tests.

By the inverse of the incomplete gamma function alone: the statistics package takes half a second
to import, which every process of a test bench would wait for.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import ArrayLike
from scipy.special import gammaincinv


def chi_square(probability: Any, dof: Any) -> np.ndarray:
    """The number that a chi-square variable of ``dof`` is below with this probability."""
    return np.asarray(2.0 * gammaincinv(0.5 * np.asarray(dof, float), probability))


def quantiles(probability: Any, most: int, each: int = 1) -> np.ndarray:
    """(most + 1,) of 0, 1, ..., most times ``each`` degrees; without a component infinity."""
    dof = np.arange(each, each * most + 1, each)
    return np.concatenate([[np.inf], chi_square(probability, dof)])


def chi2_band(dof: ArrayLike, count: int = 1, level: float = 0.95) -> np.ndarray:
    """Band that the mean of ``count`` independent chi-square(dof) numbers is in, at this level.

    Returns:
        (..., 2) lower and upper bound; divide by dof for a normalised statistic.
    """
    total = np.asarray(dof, dtype=float) * count
    tail = (1.0 - level) / 2.0
    return np.stack([chi_square(tail, total), chi_square(1.0 - tail, total)], -1) / count
