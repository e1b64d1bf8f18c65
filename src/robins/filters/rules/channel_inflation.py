"""Modelling errors treated as process noise."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike

from robins.errors import require
from robins.filters.belief import Belief, Number
from robins.filters.linearise import Transition
from robins.filters.model import Given
from robins.filters.observation import Observation
from robins.filters.rule import Memory, Rule
from robins.filters.values import Numbers, finite_leaf, is_known, kind, number, value
from robins.manifold import State


@value
class ChannelInflation(Rule):
    """Rule of `channel_inflation`: Q + lambda B B'."""

    size: Numbers  # () lambda
    B: Numbers | Callable[[State], ArrayLike]  # (n, q), or a function of the mean
    acts: bool = kind()  # lambda is not 0

    name = "channel_inflation"

    def rows(self, mean: State, n: int) -> Array:
        """(n, q) B at a mean of n components."""
        given = jnp.asarray(self.B(mean) if callable(self.B) else self.B, float)
        fits = given.ndim == 2 and given.shape[0] == n
        require(fits, f"channel_inflation B is {given.shape}, the state needs ({n}, q)")
        return given

    def init(self, belief: Belief, dims: Mapping[str, int]) -> Memory:
        self.rows(belief.mean, belief.factor.shape[0])
        return ()

    def process(self, memory: Memory, transition: Transition):
        if not self.acts:
            return memory, transition
        channel = jnp.sqrt(self.size) * self.rows(transition.mean, transition.spread.shape[0])
        noise = jnp.concatenate([transition.noise, channel], axis=1)
        return memory, transition._replace(noise=noise)

    def before(self, memory: Memory, prior: Belief, o: Observation):
        return memory, prior, o.noted(self.name, lambda_=jnp.asarray(self.size))


def channel_inflation(lambda_: Number, B: Given | Callable[[State], ArrayLike]) -> Rule:
    """Process noise Q + lambda B B' for a modelling error that enters the state through B.

    Fictitious noise (Jazwinski 1970, ch. 8) whose size can be derived: with the lambda of a
    `robins.filters.synthesis.riccati` design the steady gain is that of the design, whose true
    H-infinity norm from the modelling error to the estimation error is gamma. Initial transients,
    outages and a varying motion are treated as in the Kalman filter; the bound is proved for the
    steady state only. A modelling error that also enters the measurement (Dn of a plant) is not
    covered.

    Notes: ``channel_inflation.lambda``. lambda = 0 is the Kalman filter, bit for bit.

    Args:
        lambda_: variance of the error, as white noise per step, where the noise w of the plant has
            unit covariance; not negative.
        B: (n, q) matrix in the tangent space of the state, over one prediction, or ``mean -> ``
            such a matrix; the mean is the predicted one.

    Raises:
        ValueError: lambda is negative or not finite, B is not a matrix or not finite; at `init`, B
            has another number of rows than the state has components.
    """
    negative = "channel_inflation lambda must be a number from 0 on"
    size = number(negative, lambda_, lambda x: (x >= 0.0) & (x < np.inf))
    channel = B if callable(B) else finite_leaf("channel_inflation B", B)
    if not callable(channel):
        shape = channel.shape
        require(len(shape) == 2, f"channel_inflation B has shape {shape}, (n, q) is wanted")
    return ChannelInflation(size, channel, acts=not is_known(size) or bool(np.any(size)))
