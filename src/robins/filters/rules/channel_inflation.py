"""Treat a modelling error as process noise."""

from __future__ import annotations

import math
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array

from robins.errors import require
from robins.filters.belief import Belief, Number
from robins.filters.checks import finite_numbers
from robins.filters.linearise import Transition
from robins.filters.observation import Observation
from robins.filters.rule import Rule, hooks
from robins.manifold import State


def channel_inflation(lambda_: Number, B: Any) -> Rule:
    """Process noise Q + lambda B B', B being the way by which a modelling error enters the state.

    Fictitious noise (Jazwinski 1970, ch. 8) with a size that can be derived: with the lambda of a
    `robins.filters.synthesis.riccati` design the steady gain is the design's, whose true
    H-infinity norm from the modelling error to the estimate is gamma. As the covariance goes on by
    itself, start, outages and a motion that changes are treated as the Kalman filter treats them.
    The bound is proved for the steady state only.

    The error enters through the motion: a channel that is in the measurement too (Dn of a plant)
    is not covered.

    Notes: ``channel_inflation.lambda``. lambda = 0 is the Kalman filter, bit for bit.

    Args:
        lambda_: spectral size of the error where w has unit covariance, not negative.
        B: (n, q) matrix in the tangent space of the state, over one prediction, or ``mean -> ``
            such a matrix; the mean is the predicted one.

    Raises:
        ValueError: lambda is negative or not finite, B is no matrix or not finite; when the filter
            is run, B has another number of rows than the state has components.
    """
    finite = 0.0 <= lambda_ < math.inf
    require(finite, "channel_inflation lambda must be a number from 0 on", lambda_)
    fixed = None if callable(B) else jnp.asarray(finite_numbers("channel_inflation B", B))
    shape = (0, 0) if fixed is None else fixed.shape
    require(len(shape) == 2, f"channel_inflation B has shape {shape}, (n, q) is wanted")
    share = math.sqrt(lambda_)

    def rows(mean: State, n: int) -> Array:
        given = jnp.asarray(B(mean), float) if fixed is None else fixed
        fits = given.ndim == 2 and given.shape[0] == n
        require(fits, f"channel_inflation B is {given.shape}, the state needs ({n}, q)")
        return given

    def init(belief: Belief, dims):
        rows(belief.mean, belief.factor.shape[0])
        return ()

    def process(memory, transition: Transition):
        if share == 0.0:
            return memory, transition
        channel = share * rows(transition.mean, transition.spread.shape[0])
        noise = jnp.concatenate([transition.noise, channel], axis=1)
        return memory, transition._replace(noise=noise)

    def before(memory, prior: Belief, o: Observation):
        return memory, prior, o.noted("channel_inflation", lambda_=jnp.asarray(float(lambda_)))

    return hooks(init=init, process=process, before=before, name="channel_inflation")
