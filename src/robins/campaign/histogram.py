"""Percentiles of many numbers by counting: whole numbers, which join exactly in any order.

Bins have equal ratios, 32 of them a decade, from 1e-18 to 1e18; what is below or above has a bin of
its own. A percentile is reported as the geometric middle of its bin, and so to 3.7 % at worst. Only
bins that hold something are kept, as a table (2, M): a row of increasing numbers, each of a place
and a bin, and a row of how many are there. A table grows with what differs, not with what is
counted.
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
    """The table of (runs, places) numbers, none negative or NaN."""
    keys = np.arange(values.shape[1]) * _BINS + np.searchsorted(EDGES, values, side="right")
    return np.stack(np.unique(keys, return_counts=True)).astype(np.int32)


def merged_histograms(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The table of what two tables count."""
    keys, places = np.unique(np.concatenate([a[0], b[0]]), return_inverse=True)
    counts = np.zeros(len(keys), np.int32)
    np.add.at(counts, places, np.concatenate([a[1], b[1]]))
    return np.stack([keys.astype(np.int32), counts])


def percentiles(table: np.ndarray, places: int, percents: Sequence[int]) -> np.ndarray:
    """(places, percents) the least numbers that so many percent of each place do not exceed.

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
