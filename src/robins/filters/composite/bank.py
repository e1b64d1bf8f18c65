"""Banks of hypotheses: each row is one, with what it holds for wrong; edges are changes."""

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
"""One of a bank, or some."""

EVERY = slice(None)


@value
class HypothesisRow:
    """A hypothesis."""

    numbers: Data  # of its mode
    # names of instruments, or "motion", that are wrong where it holds
    wrong: tuple[str, ...] = kind(default=())


def stacked(rows: Sequence[HypothesisRow]) -> Data:
    """The numbers of all rows, with a leading axis of hypotheses."""
    return jax.tree_util.tree_map(lambda *x: np.stack(x), *(row.numbers for row in rows))


def bank(
    make: Callable[[Data], Filter | Mode],
    rows: Sequence[HypothesisRow],
    change: Numbers,
    start: ArrayLike | None = None,
    likeliest: bool = False,
) -> Filter:
    """An interacting multiple model over hypotheses that differ in numbers.

    Args:
        make: makes a mode of the numbers of a row (`ModeFamily`).
        rows: the hypotheses; the names in them are the `Filter.suspects`.
        change: (rows, rows) probabilities of a change in one step, by `transitions`.
        start: (rows,) probabilities at the start; by default those that last under `change`.
        likeliest: as of `imm`.
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
    """(count, count) probabilities of a change in one step, row i those from hypothesis i.

    Args:
        count: number of hypotheses.
        edges: from, to, probability; of a pair named twice the last holds.
        rest: (count,) where each goes with the probability that is left; by default it stays.
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
    """Probabilities of a change between modes of these scales: up to none quieter, back to quieter.

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
