"""A probability estimated by counting, always with its confidence interval.

The interval is that of Clopper and Pearson (1934), "The use of confidence or fiducial limits
illustrated in the case of the binomial": whatever the true probability, it is inside at least as
often as the level, also for few runs and of rare events. None of 50 runs that diverged means
that up to 7 % may.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

LEVEL = 0.95


class Probability(NamedTuple):
    """Share of independent runs for which a condition holds.

    Attributes:
        share: of the runs, 0..1.
        low: lower end of the interval.
        high: upper end.
        of: number of runs.
        level: of the interval.
    """

    share: float
    low: float
    high: float
    of: int
    level: float

    @classmethod
    def among(cls, holds: np.ndarray, level: float = LEVEL) -> Probability:
        """Share of the runs (runs,) for which a condition holds.

        Raises:
            ValueError: there are none.
        """
        if not len(holds):
            raise ValueError("a share needs a run at least")
        hits, of = int(np.sum(holds)), len(holds)
        low, high = interval(np.array(hits), of, level)
        return cls(hits / of, float(low), float(high), of, level)

    @classmethod
    def read(cls, value: Any) -> Probability | None:
        """Convert a `Probability`, or its form in `summary.json`; None if the value is neither."""
        if isinstance(value, cls):
            return value
        if not isinstance(value, Mapping) or set(value) != set(cls._fields):
            return None
        return cls(**value)

    @classmethod
    def share_of(cls, value: Any) -> Any:
        """Share of a probability; any other value unchanged."""
        found = cls.read(value)
        return value if found is None else found.share


def interval(hits: np.ndarray, of: int, level: float = LEVEL) -> tuple[np.ndarray, np.ndarray]:
    """Ends of the Clopper-Pearson confidence interval.

    Args:
        hits: (...) number of runs for which the condition held, 0..of.
        of: number of runs, at least one.
        level: least probability that the interval contains the true share.

    Returns:
        (...) lower and upper ends, as quantiles of the beta distribution.
    """
    from scipy.special import betaincinv  # slow to import, and not needed to write a result

    hits = np.asarray(hits)
    tail, some, all_ = 0.5 * (1.0 - level), np.maximum(hits, 1), np.minimum(hits, of - 1)
    low = np.where(hits > 0, betaincinv(some, of - some + 1, tail), 0.0)
    high = np.where(hits < of, betaincinv(all_ + 1, of - all_, 1.0 - tail), 1.0)
    return low, high
