"""Refusal of as few samples as possible so that time strictly increases.

One principle covers all clock faults. A duplicate or a step back by a sample costs that sample; a
single stamp an hour ahead costs itself, not the hour after it; a clock set back by a second costs a
second; a recorder that restarts its clock costs the shorter of the two recordings. If two choices
refuse equally many, the earlier rows are kept.
"""

from __future__ import annotations

import dataclasses
from bisect import bisect_left
from collections.abc import Mapping
from typing import Any

import numpy as np

Rows = np.ndarray | np.bool
"""(n,) bool; NumPy's types allow a single one where rows are reduced."""


def increasing(time_ns: np.ndarray) -> np.ndarray:
    """Mask (n,) of the longest strictly increasing subsequence, the earlier rows on a tie."""
    keep = np.ones(len(time_ns), bool)
    if np.all(np.diff(time_ns) > 0):
        return keep
    # If all stamps before a row are earlier than all after, the two sides are independent.
    latest = np.maximum.accumulate(time_ns)[:-1]
    earliest = np.minimum.accumulate(time_ns[::-1])[::-1][1:]
    bounds = np.concatenate([[0], np.flatnonzero(latest < earliest) + 1, [len(time_ns)]])
    for i in np.flatnonzero(np.diff(bounds) > 1):
        span = slice(bounds[i], bounds[i + 1])
        keep[span] = _longest(time_ns[span].tolist())
    return keep


def _longest(times: list[int]) -> list[bool]:
    """Longest increasing subsequence by patience sorting (Fredman 1975), O(n log n).

    The level of a row is the length of the longest subsequence that ends with it. At one level
    times never increase with the row, so the first possible predecessor of the next chosen row is
    found by bisection.
    """
    tops: list[int] = []
    levels: list[list[int]] = []
    for row, t in enumerate(times):
        level = bisect_left(tops, t)
        tops[level : level + 1] = [t]
        if level == len(levels):
            levels.append([])
        levels[level].append(row)
    keep = [False] * len(times)
    row, t = len(times), max(times) + 1
    for rows in reversed(levels):
        before = bisect_left(rows, row)
        row = rows[bisect_left(rows, 1 - t, hi=before, key=lambda r: -times[r])]
        t = times[row]
        keep[row] = True
    return keep


def reasons(time_ns: np.ndarray, keep: np.ndarray) -> dict[str, int]:
    """Counts of rows refused as duplicate, as backward and as ahead of the following ones."""
    refused = np.flatnonzero(~keep)
    kept = np.flatnonzero(keep)
    at = np.searchsorted(kept, refused) - 1  # last kept row before each; -1: none
    before = time_ns[kept[np.maximum(at, 0)]]
    times = time_ns[refused]
    return {
        "duplicate": int(np.sum((at >= 0) & (times == before))),
        "backward": int(np.sum((at >= 0) & (times < before))),
        "ahead": int(np.sum((at < 0) | (times > before))),
    }


def refusals(
    kind: str, time_ns: np.ndarray, have: Rows, refused: Mapping[str, Rows]
) -> tuple[np.ndarray, dict[str, int]]:
    """Mask (n,) of the rows with data that are in order, and counts of refused ones by reason.

    Args:
        kind: of the table, prefix of the reasons.
        time_ns: (n,) stamps.
        have: (n,) bool, rows to choose from.
        refused: reason -> (n,) bool, rows with values refused before.
    """
    keep = np.zeros(len(time_ns), bool)
    keep[have] = increasing(time_ns[have])
    counts = {reason: int(np.count_nonzero(rows)) for reason, rows in refused.items()}
    counts |= reasons(time_ns[have], keep[have])
    return keep, {f"{kind}_{reason}": n for reason, n in counts.items()}


def rows_where(table: Any, keep: np.ndarray) -> Any:
    """A table of `robins.dataset` with the rows of a mask (n,); the same one if it keeps all."""
    if np.all(keep):
        return table
    n = len(table.time_ns)
    arrays = {
        f.name: getattr(table, f.name)[keep]
        for f in dataclasses.fields(table)
        if isinstance(getattr(table, f.name), np.ndarray) and len(getattr(table, f.name)) == n
    }
    return dataclasses.replace(table, **arrays)
