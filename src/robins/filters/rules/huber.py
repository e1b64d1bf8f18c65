"""Huber weight: a larger noise for a measurement whose innovation is too large to be chance."""

from __future__ import annotations

import numpy as np

from robins.filters.belief import Belief, Number
from robins.filters.chi_square import MOST, limits, within
from robins.filters.observation import Observation, normalised
from robins.filters.rule import Memory, Rule
from robins.filters.rules._robust import PATIENCE, scale_to_quantile, weighed, with_recovery
from robins.filters.values import Numbers, is_share, number, value


@value
class Huber(Rule):
    """Rule of `huber`: s R with r' (H P H' + s R)^-1 r = k^2 where the NIS exceeds k^2."""

    limit: Numbers  # (MOST + 1,) k^2 by the number of components used

    name = "huber"

    def before(self, memory: Memory, prior: Belief, o: Observation):
        seen = normalised(o)
        s = scale_to_quantile(o, within(self.limit, o.residual)[seen.dof], seen)
        o, weight = weighed(o, s)
        return memory, prior, o.noted("huber", weight=weight)


def huber(
    probability: Number = 0.999, threshold: Number | None = None, patience: int | None = PATIENCE
) -> Rule:
    r"""Huber weight on the joint Mahalanobis distance of a measurement (Chang 2014, sec. 3).

    Where the NIS exceeds k^2, the measurement covariance R becomes s R with

        r' (H P H' + s R)^-1 r = k^2,   k^2 = the chi-square quantile of the components present,

    solved exactly (Chang iterates his eq. 23, s <- s NIS(s) / k^2). One weight for the whole
    measurement keeps the correlations of its noise. The correction is proportional to k^2 / |r| for
    large r, so it decreases as the innovation grows.

    Notes: ``huber.weight``, 1 / s, 0 if refused (1e-12 or less), and ``huber.recovered``.
    Components without noise of their own keep their weight. The Kalman filter is ``probability=1``
    or ``threshold=inf``.

    Args:
        probability: share of correct measurements that keep their weight, in (0, 1].
        threshold: k > 0, in standard deviations, for any number of components; None takes it from
            the probability.
        patience: measurements in a row with a weight below 1e-2 before one is used
            (`robins.filters.rules._robust.with_recovery`); None never recovers.

    Raises:
        ValueError: an argument is out of its range.
    """
    limit = limits(number("huber probability must lie in (0, 1]", probability, is_share))
    if threshold is not None:
        k = number("huber threshold must be positive", threshold, lambda k: k > 0.0)
        limit = k[..., None] ** 2 * np.ones(MOST + 1)
    return with_recovery(Huber(limit), patience)
