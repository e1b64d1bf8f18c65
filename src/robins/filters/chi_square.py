"""Quantiles of the chi-square distribution, the limits of gates and consistency tests.

Computed by the inverse incomplete gamma function, since importing `scipy.stats` takes half a
second.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike
from scipy.special import gammaincinv

from robins.errors import require

MOST = 64  # greatest number of components in a table of limits


def chi_square(probability: ArrayLike, dof: ArrayLike) -> np.ndarray:
    """Quantile of the chi-square distribution with ``dof`` degrees of freedom."""
    return np.asarray(2.0 * gammaincinv(0.5 * np.asarray(dof, float), probability))


def limits(probability: ArrayLike, each: int = 1) -> np.ndarray:
    """(..., MOST + 1) quantiles for 0 to `MOST` components of ``each`` degrees of freedom.

    Infinity for no component; the leading axes are those of the probability.
    """
    dof = np.arange(each, each * MOST + 1, each)
    p = np.asarray(probability, float)[..., None]
    return np.concatenate([np.full((*p.shape[:-1], 1), np.inf), chi_square(p, dof)], -1)


def within(table: ArrayLike, residual: Array) -> Array:
    """Entries of a table of `limits` for 0 to m components of a residual; it shortens C code.

    Raises:
        ValueError: the measurement has more components than the table.
    """
    count = len(residual)
    require(count < np.shape(table)[0], f"a measurement of more than {MOST} components", count)
    return jnp.asarray(table)[: count + 1]


def chi2_band(dof: ArrayLike, count: int = 1, level: float = 0.95) -> np.ndarray:
    """(..., 2) two-sided band of the mean of ``count`` independent chi-square(dof) variables.

    Divide it by dof for a statistic per degree of freedom. ``level`` is the probability inside.
    """
    total = np.asarray(dof, dtype=float) * count
    tail = (1.0 - level) / 2.0
    return np.stack([chi_square(tail, total), chi_square(1.0 - tail, total)], -1) / count
