"""Raise the noise of a measurement whose innovation is too large to be chance."""

from __future__ import annotations

import jax.numpy as jnp

from robins.errors import require
from robins.filters.belief import Belief, Number
from robins.filters.chi_square import quantiles
from robins.filters.observation import Observation, normalised
from robins.filters.rule import Rule
from robins.filters.rules._robust import PATIENCE, opening, scale_to_quantile, weighed


def huber(
    probability: Number = 0.999,
    threshold: Number | None = None,
    patience: int | None = PATIENCE,
) -> Rule:
    r"""Huber weight on the joint Mahalanobis distance of a measurement (Chang 2014, sec. 3).

    Where the NIS exceeds k^2, the measurement covariance R becomes s R with

        r' (H P H' + s R)^-1 r = k^2,   k^2 = the chi-square quantile of the components present,

    solved exactly (Chang iterates his eq. 23, s <- s NIS(s) / k^2). One weight for the whole
    measurement: correlated noise stays what it is, and no unit enters. The state is pulled by about
    k^2 / |r| at the most: the further off a measurement is, the less it moves the state.

    A weight of 1e-12 or less is a refusal. After ``patience`` measurements with hardly any weight
    the next one is believed (`robins.filters.rules._robust.opening`).

    Notes: ``huber.weight``, 1 / s, 0 if refused, and ``huber.recovered``. Components without noise
    of their own cannot be weighed down. The Kalman filter is ``probability=1`` or
    ``threshold=inf``.

    Args:
        probability: share of right measurements that keep their weight, in (0, 1].
        threshold: k, in standard deviations, whatever the number of components; None takes it from
            the probability.
        patience: measurements in a row with a weight below 1e-2; None never recovers.

    Raises:
        ValueError: the probability is not in (0, 1], the threshold not positive, or patience is
            negative.
    """
    require(0.0 < probability <= 1.0, "huber probability must lie in (0, 1]", probability)
    require(threshold is None or threshold > 0.0, "huber threshold must be positive", threshold)

    def before(memory, prior: Belief, o: Observation):
        seen = normalised(o)
        if threshold is None:
            limit = jnp.asarray(quantiles(probability, len(o.residual)))[seen.dof]
        else:
            limit = float(threshold) ** 2
        s = scale_to_quantile(o, limit, seen)
        o, weight = weighed(o, s)
        return memory, prior, o.noted("huber", weight=weight)

    return opening(Rule(before=before, name="huber"), patience)
