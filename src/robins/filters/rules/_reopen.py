"""Make a prior doubt what it sees, and nothing else."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array

from robins import linalg
from robins.filters.belief import Belief
from robins.filters.observation import Observation


def reopened(due: Array, prior: Belief, o: Observation, doubted: Array, root: Array) -> Belief:
    r"""The prior with a covariance D added to what some components see, where that is due.

        P' = P + G D G',   G = P H' (H P H')^-1,   so that H G = I and H P' H' = H P H' + D,

    H being the rows of those components. The state's other directions follow as far as they are
    correlated with those seen and stay as certain as they were otherwise. What is known exactly
    cannot be doubted: its column of G is 0.

    Args:
        due: () bool; without it the prior stands.
        prior: the belief.
        o: the measurement as this belief sees it.
        doubted: (m,) bool, the components.
        root: (m, k) root of D; its other rows do not count.
    """

    def wider() -> Belief:
        spread = jnp.where(doubted[:, None], o.spread, 0.0)
        solid, _ = linalg.guard(spread, o.size)
        G_root = prior.factor @ (spread.T @ linalg.solve_spd(solid, root))
        return prior._replace(factor=linalg.tria(prior.factor, G_root))

    return jax.lax.cond(due, wider, lambda: Belief(*prior))
