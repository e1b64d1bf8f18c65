"""Percentiles of many numbers by histograms, whose counts merge exactly in any order.

Bins are logarithmic, 32 a decade from 1e-18 to 1e18, with one more bin below and one above. A
percentile is reported as the geometric middle of its bin, with an error of 3.7 % at worst. Only
occupied bins are kept, as a table (2, M): a row of increasing keys, each of a place and a bin, and
a row of their counts. A table grows with the number of occupied bins, not of runs.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

A_DECADE = 32
EDGES = 10.0 ** (np.arange(-18 * A_DECADE, 18 * A_DECADE + 1) / A_DECADE)
WORST = 10.0 ** (0.5 / A_DECADE) - 1.0  # largest relative error of a percentile
_BINS = len(EDGES) + 1
# Value reported of a bin: zero below all edges, infinity above them.
_TOLD = np.concatenate([[0.0], np.sqrt(EDGES[:-1] * EDGES[1:]), [np.inf]])


def histogram_of(values: np.ndarray) -> np.ndarray:
    """Table of numbers (runs, places), none negative or NaN."""
    keys = np.arange(values.shape[1]) * _BINS + np.searchsorted(EDGES, values, side="right")
    return np.stack(np.unique(keys, return_counts=True)).astype(np.int32)


def merged_histograms(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Table of the counts of two tables together."""
    keys, places = np.unique(np.concatenate([a[0], b[0]]), return_inverse=True)
    counts = np.zeros(len(keys), np.int32)
    np.add.at(counts, places, np.concatenate([a[1], b[1]]))
    return np.stack([keys.astype(np.int32), counts])


def percentiles(table: np.ndarray, places: int, percents: Sequence[int]) -> np.ndarray:
    """(places, percents) percentiles: least numbers that so many percent do not exceed.

    Args:
        table: of at least one number at each place.
        places: how many there are.
        percents: whole, 1..100.
    """
    counts = np.zeros((places, _BINS), np.int64)
    counts[np.divmod(table[0], _BINS)] = table[1]
    below = np.cumsum(counts, axis=1)
    rank = -(-below[:, -1:] * np.asarray(percents) // 100)
    return _TOLD[np.argmax(below[:, :, None] >= rank[:, None, :], axis=1)]
