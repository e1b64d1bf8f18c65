"""Quantiles of the chi-square distribution, which decide what is too far off to be true.

By the inverse of the incomplete gamma function alone: the statistics package takes half a second
to import, which every process of a test bench would wait for.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.special import gammaincinv


def chi_square(probability: Any, dof: Any) -> np.ndarray:
    """The number that a chi-square variable of ``dof`` is below with this probability."""
    return np.asarray(2.0 * gammaincinv(0.5 * np.asarray(dof, float), probability))


def limits(probability: Any, most: int, each: int = 1) -> np.ndarray:
    """(most + 1,) quantiles of 0, 1, ..., most times ``each`` degrees; no component is never too
    much.
    """
    dof = np.arange(each, each * most + 1, each)
    return np.concatenate([[np.inf], chi_square(probability, dof)])
