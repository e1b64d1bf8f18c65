"""Consistency of a filter: chi-square tests of errors and innovations.

NEES is e' P^-1 e (chi-square with n degrees of freedom if the filter is consistent), NIS the same
for an innovation. Sums over independent runs are chi-square too, so the band of an average over N
runs is that of chi-square with N n degrees of freedom, divided by N (Bar-Shalom, Li & Kirubarajan
2001, sec. 5.4).
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from robins import linalg, manifold
from robins.errors import require
from robins.filters.belief import Belief, StepInfo
from robins.filters.chi_square import chi2_band, chi_square
from robins.filters.consistency_limits import LEVEL
from robins.manifold import State


def nees(belief: Belief, truth: State) -> Float[Array, ""]:
    """Normalised estimation error squared of one belief; batch with `jax.vmap`.

    Directions without uncertainty (a known constant) are left out.
    """
    return normalised_sq(manifold.local(belief.mean, truth), belief.factor)


def normalised_sq(error: Float[Array, "r"], factor: Float[Array, "r n"]) -> Float[Array, ""]:
    """Normalised squared error e' (S S')^-1 e of r components, S being their factor rows."""
    solid, _ = linalg.guard(factor)
    return jnp.sum(linalg.solve_lower(solid, error[:, None]) ** 2)


class Verdict(NamedTuple):
    """Value of a statistic, and its band for a consistent filter."""

    value: float
    low: float
    high: float

    @property
    def inside(self) -> bool:
        """True if the value is in its band."""
        return bool(self.low <= self.value <= self.high)


def _require_level(level: float) -> None:
    require(0.0 < level < 1.0, "level must be a share between 0 and 1", level)


def grand_mean_nis(nis: np.ndarray, dof: np.ndarray, level: float = LEVEL) -> Verdict:
    """Mean NIS per degree of freedom, over all runs and times.

    Innovations of a consistent filter are white, so the sum of NIS over time is chi-square too;
    this is the sharpest single test of R and Q. Steps without measurement (dof = 0) do not count;
    an infinite NIS, that of a contradiction, does. `level` is the probability of the two-sided
    band.

    Raises:
        ValueError: the shapes differ, or the level is not between 0 and 1.
    """
    nis, dof = np.asarray(nis, dtype=float), np.asarray(dof)
    _require_level(level)
    require(np.all(dof >= 0), "degrees of freedom must be zero or more", np.min(dof, initial=0))
    require(nis.shape == dof.shape, f"nis is of shape {nis.shape}, dof of {dof.shape}: they differ")
    total = float(np.sum(dof))
    if total == 0.0:
        return Verdict(np.nan, np.nan, np.nan)
    low, high = chi2_band(total, 1, level) / total
    counts = (dof > 0) | np.isinf(nis)
    return Verdict(float(np.sum(nis[counts]) / total), float(low), float(high))


def anees(values: np.ndarray, n: int, level: float = LEVEL) -> tuple[np.ndarray, np.ndarray, float]:
    """Average NEES over runs at each epoch, normalised by the state dimension n.

    Args:
        values: (runs, T) NEES.
        n: state dimension.
        level: probability of the two-sided band.

    Returns:
        (T,) averages, their band (2,), and the share of epochs inside the band.

    Raises:
        ValueError: the values are not (runs, T), there is none, or n or the level is out of range.
    """
    values = np.asarray(values, dtype=float)
    require(
        values.ndim == 2 and values.size,
        "anees takes values of one run or more a row, one epoch or more a column",
        values.shape,
    )
    require(n >= 1, "n, the number of states, must be 1 or more", n)
    _require_level(level)
    mean = np.mean(values, axis=0) / n
    band = chi2_band(n, values.shape[0], level) / n
    inside = (mean >= band[0]) & (mean <= band[1])
    return mean, band, float(np.mean(inside))


def whitened_innovations(info: StepInfo) -> Float[Array, "t m"]:
    """(T, m) innovations of a sensor, whitened by their predicted covariance; NaN where not used.

    They are uncorrelated if the filter is consistent.
    """

    def one(residual: Array, factor: Array, used: Array) -> Array:
        white = linalg.solve_lower(factor, jnp.where(used, residual, 0.0)[:, None])[:, 0]
        return jnp.where(used, white, jnp.nan)

    return jax.vmap(one)(info.innovation, info.factor, info.used)


def whiteness(series: np.ndarray, lags: int = 20, level: float = LEVEL) -> Verdict:
    """Ljung-Box test for autocorrelation of a series (Ljung & Box 1978).

    Args:
        series: (T,) whitened innovations of one component; NaN steps are left out of the products.
        lags: number of autocorrelations.
        level: probability of the one-sided bound.

    Raises:
        ValueError: the series is not (T,), has fewer than three samples per lag or is constant, or
            lags or level is out of range.
    """
    x = np.asarray(series, dtype=float)
    require(x.ndim == 1, "whiteness takes one series, (T,)", x.shape)
    require(lags >= 1, "lags must be 1 or more", lags)
    _require_level(level)
    here = np.isfinite(x)
    count = int(np.sum(here))
    require(not count < 3 * lags, f"whiteness over {lags} lags wants {3 * lags} samples", count)
    require(np.ptp(x[here]) != 0.0, "whiteness of a series that never changes")
    x = x / np.max(np.abs(x[here]))  # so that no square overflows
    x = np.where(here, x - np.mean(x[here]), 0.0)
    power = np.sum(x**2) / count
    total = 0.0
    for lag in range(1, lags + 1):
        pairs = int(np.sum(here[lag:] & here[:-lag]))
        if pairs > 0:
            r = np.sum(x[lag:] * x[:-lag]) / (count * power)
            total += count * (count + 2) * r**2 / pairs
    return Verdict(float(total), 0.0, float(chi_square(level, lags)))
