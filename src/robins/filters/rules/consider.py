"""Considered states, uncertain but not estimated: the Schmidt filter."""

from __future__ import annotations

from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np

from robins import linalg, manifold
from robins.errors import require
from robins.filters.belief import Belief, StepInfo
from robins.filters.model import Given
from robins.filters.observation import Observation
from robins.filters.rule import Memory, Rule
from robins.filters.values import kind, value


@value
class Consider(Rule):
    """Rule of `consider`: K_c = (I - M) K, P+ = P_best + (M K) S_y (M K)'."""

    states: tuple[int, ...] = kind()  # indices of the considered states
    size: int | None = kind()  # size of a given mask

    name = "consider"

    def held(self, n: int) -> np.ndarray:
        """(n,) bool, diagonal of M for a state of n components."""
        fits = self.size in (None, n)
        require(fits, f"consider mask is ({self.size},), the state needs ({n},)")
        last = max(self.states, default=-1)
        require(last < n, f"consider has state {last}, the last one is {n - 1}")
        mask = np.zeros(n, bool)
        mask[list(self.states)] = True
        return mask

    def init(self, belief: Belief, dims: Mapping[str, int]) -> Memory:
        self.held(belief.factor.shape[0])
        return ()

    def after(self, memory: Memory, posterior: Belief, info: StepInfo, o: Observation):
        held = self.held(posterior.factor.shape[0])
        if not np.any(held):
            return memory, posterior, info.noted(self.name, withheld=jnp.zeros(()))
        some = jnp.any(info.used)
        column = jnp.asarray(held)[:, None]
        columns = jnp.where(column, info.gain @ info.factor, 0.0)
        factor = jnp.where(some, linalg.tria(posterior.factor, columns), posterior.factor)
        move = manifold.local(o.prior.mean, posterior.mean)
        mean = manifold.retract(o.prior.mean, jnp.where(held, 0.0, move))
        sigma = o.prior.sigma
        share = jnp.where(held & (sigma > 0.0), jnp.abs(move), 0.0)
        withheld = jnp.max(share / jnp.where(sigma > 0.0, sigma, 1.0))
        info = info._replace(gain=jnp.where(column, 0.0, info.gain))
        return memory, Belief(mean, factor), info.noted(self.name, withheld=withheld)


def consider(states: Given) -> Rule:
    """Schmidt filter: considered states keep their mean, and their uncertainty is accounted for.

    The gain of the considered states p is set to zero (Schmidt 1966; Zanetti & D'Souza 2012,
    sec. III); the covariance is that of a gain that is not optimal,

        K_c = (I - M) K,   P+ = (I - K_c H) P (I - K_c H)' + K_c R K_c'
                              = P_best + (M K) S_y (M K)',         M = diag(1 on p, else 0)

    S_y the innovation covariance: the last term is added as columns next to the factor. So P_pp
    stays as predicted and nothing is subtracted. Use it for states that are weakly observed and
    wrongly modelled (a scale factor, a lever arm): their uncertainty counts, but they do not absorb
    model errors.

    Put it first: corrections of considered states by `after` of earlier rules are undone.
    `StepInfo.gain` becomes K_c.

    Notes: ``consider.withheld``, the greatest correction withheld from a considered state, in its
    standard deviations. Without considered states it is the Kalman filter, bit for bit.

    Args:
        states: indices of tangent components, or an (n,) mask of booleans.

    Raises:
        ValueError: an index is negative, repeated or no integer; at `init`, sizes do not fit.
    """
    given = np.asarray(states)
    given = given if given.size else np.zeros(0, int)
    indices = given.dtype.kind in "iu" and not np.any(given < 0)
    sound = given.dtype == bool or (indices and len(np.unique(given)) == given.size)
    require(
        given.ndim == 1 and sound,
        "consider states must be different indices, counted from 0, or a mask of booleans",
        states,
    )
    if given.dtype == bool:
        return Consider(tuple(np.flatnonzero(given).tolist()), given.size)
    return Consider(tuple(given.tolist()), None)
