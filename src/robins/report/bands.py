"""Where consistency statistics lie if a filter knows its own accuracy."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from scipy.special import gammaincinv


def quantile(probability: float, degrees: Any) -> np.ndarray:
    """Inverse of the chi-square distribution, for one or many degrees of freedom."""
    return np.asarray(2.0 * gammaincinv(np.asarray(degrees) / 2.0, probability))


class Band(NamedTuple):
    """Where a statistic of a consistent filter lies with the given probability."""

    low: np.ndarray  # (filter, time)
    high: np.ndarray
    probability: float
    expected: float


def band(array: xr.DataArray, dof: xr.DataArray | None = None) -> Band | None:
    """The band of a statistic, from its attributes; None if they do not give one.

    Args:
        array: the statistic, (filter, time).
        dof: its degrees of freedom, of the same shape, if there is such an array.
    """
    attrs = array.attrs
    probability = float(attrs.get("probability", 0.95))
    runs = int(attrs.get("runs", 1))
    if dof is not None:
        degrees = np.asarray(dof.values, float)
    elif "degrees_of_freedom" in attrs:
        degrees = np.full(array.shape, float(attrs["degrees_of_freedom"]))
    else:
        degrees = None
    if "band_low" in attrs and "band_high" in attrs:
        low, high = (np.full(array.shape, float(attrs[f"band_{s}"])) for s in ("low", "high"))
    elif degrees is not None:
        # A mean of N independent chi-square variables of n degrees is chi2(N n)/N.
        tail = (1.0 - probability) / 2.0
        safe = np.where(degrees > 0.0, degrees, np.nan)
        scale = runs * (safe if attrs.get("normalised") else 1.0)
        low, high = (quantile(p, runs * safe) / scale for p in (tail, 1.0 - tail))
    else:
        return None
    expected = np.nan
    if degrees is not None and np.isfinite(degrees).any():
        expected = 1.0 if attrs.get("normalised") else float(np.nanmean(degrees))
    return Band(low, high, probability, expected)


def inside(values: np.ndarray, limits: Band) -> np.ndarray:
    """Share of the finite epochs of each filter that lie in the band; NaN where there are none."""
    valid = np.isfinite(values) & np.isfinite(limits.high)
    hits = valid & (values >= limits.low) & (values <= limits.high)
    count = valid.sum(axis=1)
    return np.where(count > 0, hits.sum(axis=1) / np.maximum(count, 1), np.nan)
