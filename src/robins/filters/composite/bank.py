"""Banks of hypotheses: hypotheses are rows, and changes between them are edges."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import ArrayLike

Hypotheses = int | slice | np.ndarray
"""One of a bank, or some."""

EVERY = slice(None)


def transitions(
    count: int,
    edges: Sequence[tuple[Hypotheses, Hypotheses, ArrayLike | Sequence[float]]],
    rest: Sequence[int] | np.ndarray | None = None,
) -> np.ndarray:
    """(count, count) probabilities of a change in one step, row i those from hypothesis i.

    Args:
        count: of the hypotheses.
        edges: from which, to which, and with what probability; of one pair the last holds.
        rest: (count,) where each goes with what is left; where not given it stays as it is.
    """
    at: Any = np.arange(count)
    left = at if rest is None else np.asarray(rest, int)
    p = np.zeros((count, count))
    for one, other, chance in edges:
        p[one, other] = chance
    p[at, left] = 0.0
    p[at, left] = 1.0 - p.sum(axis=1)
    return p
