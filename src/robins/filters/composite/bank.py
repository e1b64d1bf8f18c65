"""Banks of filters: one row per hypothesis, with its faulty instruments; edges are transitions."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import jax
import numpy as np
from jaxtyping import ArrayLike

from robins.filters.composite.imm import Mode, ModeFamily, imm
from robins.filters.kalman import Filter
from robins.filters.model import Data
from robins.filters.values import Numbers, kind, value

Hypotheses = int | slice | Sequence[int] | np.ndarray
"""Indices of one hypothesis of a bank, or of several."""

EVERY = slice(None)


@value
class HypothesisRow:
    """Hypothesis of a bank."""

    numbers: Data  # of its mode
    # names of instruments, or "motion", that are faulty under it
    wrong: tuple[str, ...] = kind(default=())


def stacked(rows: Sequence[HypothesisRow]) -> Data:
    """Numbers of all rows, with a leading axis of hypotheses."""
    return jax.tree_util.tree_map(lambda *x: np.stack(x), *(row.numbers for row in rows))


def bank(
    make: Callable[[Data], Filter | Mode],
    rows: Sequence[HypothesisRow],
    change: Numbers,
    start: ArrayLike | None = None,
    likeliest: bool = False,
) -> Filter:
    """Interacting multiple model over hypotheses that differ in numbers.

    Args:
        make: function from the numbers of a row to a mode (`ModeFamily`).
        rows: the hypotheses; their names of instruments are the `Filter.suspects`.
        change: (rows, rows) transition probabilities per step, from `transitions`.
        start: (rows,) initial probabilities; by default the stationary ones of `change`.
        likeliest: as in `imm`.
    """
    names = dict.fromkeys(name for row in rows for name in row.wrong)
    wrong = {name: [i for i, row in enumerate(rows) if name in row.wrong] for name in names}
    first = stationary(np.asarray(change)) if start is None else start
    return imm(ModeFamily(make, stacked(rows)), change, first, likeliest, wrong)


def transitions(
    count: int,
    edges: Sequence[tuple[Hypotheses, Hypotheses, ArrayLike | Sequence[float]]],
    rest: Sequence[int] | np.ndarray | None = None,
) -> np.ndarray:
    """(count, count) transition probabilities per step, row i those from hypothesis i.

    Args:
        count: number of hypotheses.
        edges: (from, to, probability); later edges replace earlier ones of the same pair.
        rest: (count,) hypothesis that receives the remaining probability of each row; by default
            the row's own.
    """
    at = np.arange(count)
    left = at if rest is None else np.asarray(rest, int)
    p = np.zeros((count, count))
    for one, other, chance in edges:
        p[one, other] = chance
    p[at, left] = 0.0
    p[at, left] = 1.0 - p.sum(axis=1)
    return p


def scale_transitions(scales: Sequence[float | int], up: float, back: float) -> np.ndarray:
    """(n, n) transition probabilities: ``back`` to each smaller scale, ``up`` to each other one.

    The diagonal is left to `transitions`.
    """
    s = np.asarray(scales, float)
    return np.where(s[None] < s[:, None], back, up)


def stationary(change: np.ndarray) -> np.ndarray:
    """(count,) stationary probabilities of `transitions`."""
    count = len(change)
    A = np.vstack([change.T - np.eye(count), np.ones(count)])
    found, *_ = np.linalg.lstsq(A, np.append(np.zeros(count), 1.0))
    found = np.maximum(found, 0.0)
    return found / found.sum()
