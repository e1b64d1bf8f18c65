"""Quantiles of the chi-square distribution, the limits of gates and consistency tests.

By the inverse of the incomplete gamma function alone: the statistics package takes half a second
to import, which every process of a test bench would wait for.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike
from scipy.special import gammaincinv

from robins.errors import require

MOST = 64  # components of a measurement that a table of limits reaches to


def chi_square(probability: Any, dof: Any) -> np.ndarray:
    """The number that a chi-square variable of ``dof`` is below with this probability."""
    return np.asarray(2.0 * gammaincinv(0.5 * np.asarray(dof, float), probability))


def limits(probability: Any, each: int = 1) -> np.ndarray:
    """Quantiles by the number of components, for a rule to keep.

    Args:
        probability: one, or a batch of them.
        each: degrees of freedom of a component.

    Returns:
        (..., MOST + 1) of 0, 1, ..., `MOST` times ``each`` degrees; without a component infinity.
    """
    dof = np.arange(each, each * MOST + 1, each)
    p = np.asarray(probability, float)[..., None]
    return np.concatenate([np.full((*p.shape[:-1], 1), np.inf), chi_square(p, dof)], -1)


def within(table: Any, residual: Any) -> Any:
    """The part of a table of `limits` that a measurement can reach; uncut it costs code in C.

    Raises:
        ValueError: the measurement has more components than the table.
    """
    count = len(residual)
    require(count < len(table), f"a measurement of more than {MOST} components", count)
    return jnp.asarray(table)[: count + 1]


def chi2_band(dof: ArrayLike, count: int = 1, level: float = 0.95) -> np.ndarray:
    """Band that the mean of ``count`` independent chi-square(dof) numbers is in, at this level.

    Returns:
        (..., 2) lower and upper bound; divide by dof for a normalised statistic.
    """
    total = np.asarray(dof, dtype=float) * count
    tail = (1.0 - level) / 2.0
    return np.stack([chi_square(tail, total), chi_square(1.0 - tail, total)], -1) / count
