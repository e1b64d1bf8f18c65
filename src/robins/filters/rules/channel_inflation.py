"""Take a modelling error for noise."""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from robins.errors import require
from robins.filters.belief import Belief, Number
from robins.filters.checks import finite_numbers
from robins.filters.linearise import Transition
from robins.filters.observation import Observation
from robins.filters.rule import Rule


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
    if not 0.0 <= lambda_ < math.inf:
        raise ValueError(f"channel_inflation lambda must be a number from 0 on, got {lambda_}")
    fixed = None if callable(B) else _matrix(B)
    share = math.sqrt(lambda_)

    def init(belief: Belief, dims):
        _rows(B(belief.mean) if fixed is None else fixed, belief.factor.shape[0])
        return ()

    def process(memory, transition: Transition):
        if share == 0.0:
            return memory, transition
        given = B(transition.mean) if fixed is None else fixed
        channel = share * _rows(given, transition.spread.shape[0])
        noise = jnp.concatenate([transition.noise, channel], axis=1)
        return memory, transition._replace(noise=noise)

    def before(memory, prior: Belief, o: Observation):
        return memory, prior, o.noted("channel_inflation", lambda_=jnp.asarray(float(lambda_)))

    return Rule(init=init, process=process, before=before, name="channel_inflation")


def _matrix(B: Any) -> Array:
    numbers = finite_numbers("channel_inflation B", B)
    require(numbers.ndim == 2, f"channel_inflation B has shape {numbers.shape}, (n, q) is wanted")
    return jax.device_put(numbers)


def _rows(B: Any, n: int) -> Array:
    B = jnp.asarray(B, float)
    if B.ndim != 2 or B.shape[0] != n:
        raise ValueError(f"channel_inflation B is {B.shape}, the state needs ({n}, q)")
    return B
