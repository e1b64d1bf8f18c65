r"""Distributed filters: locals that each have the whole prior, and the fusion of their estimates.

Zhao, Gao, Ding & Wei (J. National University of Defense Technology 39(2), 2017, eq. 51) fuse two
full filters as if they were independent:

    P_g = (P_1^-1 + P_2^-1)^-1        x_g = P_g (P_1^-1 x_1 + P_2^-1 x_2)

and feed x_g back to the navigation state. The paper does not define how the local filters continue;
the three possibilities are the values of ``feedback``:

    own    each continues from its own mean and covariance: error states shifted by -x_g
    mean   each takes the fused mean, and keeps its covariance: error states set to zero
    full   each takes the fused mean and covariance: all information counted again at every step

Locals with the same prior and process noise are not independent, so even the first is somewhat
overconfident. The federated filter (`federated`) divides both among the locals and is not;
covariance intersection is consistent whatever the correlation.

States that only one local estimates (wind errors that only its sensors observe) cannot be fused:
with ``common=n`` the first n tangent components are fused, from the marginals of all locals, and
the rest follows from the estimate of the first local.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Literal

import jax.numpy as jnp
from jaxtyping import Array

from robins.errors import require
from robins.filters.belief import Belief
from robins.filters.checks import one_of
from robins.filters.composite.channels import (
    Channel,
    JoinedFilter,
    JoinedPrediction,
    disagree,
    owners,
)
from robins.filters.composite.fusion import (
    Criterion,
    check_criterion,
    common_information_sum,
    information_sum,
    intersection_weights,
)
from robins.filters.kalman import Filter, FilterState
from robins.filters.model import Data, Motion
from robins.filters.values import Numbers, kind, number, value

Feedback = Literal["own", "mean", "full"]

FULL = (
    "feedback='full' gives every local filter the information of all, to be counted again at the "
    "next fusion: the covariance shrinks without bound (NEES of 1e7 was measured); use 'own', or "
    "the federated filter"
)


@value
class DistributedFilter(JoinedFilter):
    """Filter made by `distributed` or `intersecting`: each local has the whole prior and noise."""

    criterion: Criterion | Numbers | None  # or (channels,) weights; None: as if independent
    feedback: Feedback = kind()
    common: int | None = kind(default=None)  # number of the components that all locals estimate

    def first_shares(self, belief: Belief) -> Array:
        n = belief.factor.shape[0]
        if self.common is not None and n < self.common:
            raise ValueError(f"distributed: {self.common} components are common, the state has {n}")
        return jnp.ones((len(self.channels), 1))

    def apart(self, beliefs: Sequence[Belief], i: int) -> Array:
        return disagree(beliefs, i, self.common)

    def fuse(self, beliefs: Sequence[Belief]) -> Belief:
        if self.criterion is not None:
            return information_sum(beliefs, intersection_weights(beliefs, self.criterion))
        if self.common is not None:
            return common_information_sum(beliefs, common=self.common)
        return information_sum(beliefs)

    def divided(self, belief: Belief, shares: Array) -> list[Belief]:
        return [belief] * len(self.channels)

    def fed_back(self, state: FilterState) -> list[FilterState]:
        """States of the local filters at the start of a step, after the feedback."""
        members, fused = state.memory.members, state.belief
        if self.feedback == "own":
            return list(members)
        full = self.feedback == "full"
        return [
            c.filter.reset(m, fused if full else Belief(fused.mean, m.belief.factor))
            for c, m in zip(self.channels, members, strict=True)
        ]

    def moved(self, state: FilterState, motion: Motion, u: Data) -> JoinedPrediction:
        motions = [motion] * len(self.channels)
        return self.predict_separately(self.fed_back(state), motions, u, state.memory.shares)


def distributed(
    channels: Sequence[Channel], feedback: Feedback = "own", common: int | None = None
) -> Filter:
    """Local filters with the whole prior and process noise, fused by an information sum (51).

    The belief of its state is the fused one. Locals share their prior and process noise, but (51)
    assumes them independent: expect too small a covariance; `federated` is the consistent filter.
    The `StepInfo` of an update is that of the sensor's local filter.

    A local covariance that is singular (a hard constraint, a measurement without noise) has no
    inverse. The step is not taken, with `Code.NOT_FINITE`, and at its end a run raises a ValueError
    that states the remedy; the covariance is not regularised.

    Args:
        channels: from `channel`; every sensor of the model belongs to exactly one.
        feedback: "own", "mean" or "full" (module docstring).
        common: number of leading tangent components that are fused by (51); all by default. The
            others belong to the first channel, and follow from its conditional distribution given
            the common ones (`common_information_sum`). All locals have the same state, so the other
            channels carry those components as well, but their estimates of them are not used.

    Raises:
        ValueError: a sensor is in two channels, the feedback is unknown, or no component is common;
            at `init`, a sensor has no channel, or the state has fewer components than are common.
    """
    one_of("feedback", feedback, Feedback)
    if feedback == "full":
        warnings.warn(FULL, UserWarning, stacklevel=2)
    if common is not None:
        require(common >= 1, "distributed: at least one component must be common", common)
    owners(channels)
    return DistributedFilter(tuple(channels), "distributed", None, feedback, common)


def intersecting(
    channels: Sequence[Channel],
    criterion: Criterion | Sequence[float] = "trace",
    feedback: Feedback = "own",
) -> Filter:
    """Local filters with the whole prior and process noise, fused by covariance intersection.

    It is consistent whatever the correlation of the locals, at the price of a larger covariance
    than that of independent fusion (Julier & Uhlmann 1997).

    Args:
        channels: from `channel`; every sensor of the model belongs to exactly one.
        criterion: "trace", "det", or (N,) weights; see `covariance_intersection`.
        feedback: "own" or "mean"; "full" makes all locals equal, which loses information but stays
            consistent.

    Raises:
        ValueError: as `distributed`, or the criterion is none of these.
    """
    one_of("feedback", feedback, Feedback)
    check_criterion(criterion, len(channels))
    owners(channels)
    given = criterion if isinstance(criterion, str) else number("weights must be real", criterion)
    return DistributedFilter(tuple(channels), "intersecting", given, feedback)
