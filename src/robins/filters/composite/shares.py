"""Shares of the information that a federated filter hands to its local filters.

A share a_ij in (0, 1) is what local filter i gets of the information about state j (or about all of
them, b_i), and shares sum to one over the filters. Four ways to choose them (Zhao, Li & Wang 2016;
Xiong et al. 2013):

    equal          b_i  = 1 / N
    trace          b_i  ~ 1 / tr P_i                        states scaled first
    diagonal       a_ij ~ 1 / P_i,jj
    observability  a_ij ~ sigma_ij,  sigma_ij^2 = (O_i' O_i)_jj,
                   O_i = [R_i^-1/2 H_i; R_i^-1/2 H_i F; ...; R_i^-1/2 H_i F^(k-1)] D

With a reset at every step and linear models shares cannot change the fused accuracy at all. They
matter where a local filter judges its measurements by its own covariance, and where it is not
reset.

In terms of O = U S V' the last is sum_l S_l^2 V_jl^2: a singular value belongs to a direction, not
to the state of the same number. D, the standard deviations of the belief, makes the states
unit-free.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from robins import linalg, manifold
from robins.errors import require
from robins.filters.belief import Belief
from robins.filters.composite.channels import Channel
from robins.filters.linearise import taylor
from robins.filters.model import Model

# Without a floor a share of zero is an infinite covariance.
FLOOR = 0.05


def floored(weights: Array) -> Array:
    """Shares from weights (N, ...): over N they sum to one, and none is below about `FLOOR`.

    Where no filter has any weight, all get the same. Shares that sum to one and lie above the floor
    come back unchanged but for rounding.
    """
    total = jnp.sum(weights, axis=0, keepdims=True)
    some = total > 0.0
    a = jnp.where(some, weights / jnp.where(some, total, 1.0), 1.0 / weights.shape[0])
    a = jnp.maximum(a, FLOOR)
    return a / jnp.sum(a, axis=0, keepdims=True)


def equal_shares(count: int) -> Array:
    """(N, 1), all the same."""
    return jnp.full((count, 1), 1.0 / count)


def trace_shares(beliefs: Sequence[Belief], sigma: Array) -> Array:
    """(N, 1), inverse to the trace of each local covariance.

    Args:
        beliefs: of the local filters.
        sigma: (n,) unit of each state, such as its fused standard deviation.
    """
    unit = jnp.where(sigma > 0.0, sigma, 1.0)
    return floored(jnp.stack([1.0 / jnp.sum((b.sigma / unit) ** 2) for b in beliefs])[:, None])


def diagonal_shares(beliefs: Sequence[Belief]) -> Array:
    """(N, n), inverse to the variance of each state in each local filter."""
    return floored(jnp.stack([1.0 / b.sigma**2 for b in beliefs]))


def observability_shares(
    model: Model,
    belief: Belief,
    channels: Sequence[Channel],
    steps: int | None = None,
    u: Any = None,
    aux: dict[str, Any] | None = None,
) -> np.ndarray:
    """(N, n) shares by how well each channel sees each state; computed once, before a run.

    A state that no channel sees is shared equally.

    Args:
        model: its motion and sensors, linearised at the belief.
        belief: about which to linearise; its standard deviations are the units of the states.
        channels: from `channel`.
        steps: number k of blocks in O_i; by default n, the dimension of the state.
        u: input of the motion for one step.
        aux: what sensors need besides the state, by sensor name.

    Raises:
        KeyError: a channel names a sensor that the model has not.
        ValueError: fewer than one step, or a sensor without noise, which sees infinitely well.
    """
    n = manifold.dim(belief.mean)
    count = n if steps is None else steps
    require(count >= 1, f"observability over {count} steps: at least one is wanted")
    way, unit = taylor(), Belief(belief.mean, linalg.identity(n))
    F = np.asarray(way.transition(unit, model.motion, u).spread)  # F times the identity
    D = np.asarray(belief.sigma)
    sees = np.zeros((len(channels), n))
    for i, one in enumerate(channels):
        for name in one.sensors:
            sensor, extra = model.sensor(name), (aux or {}).get(name)
            seen = way.observation(unit, sensor, sensor.read(belief.mean, extra), extra)
            root = linalg.tria(seen.noise)
            if not bool(jnp.all(jnp.diagonal(root) > 0.0)):
                raise ValueError(f"sensor '{name}' has components without noise: give it some")
            block = np.asarray(linalg.solve_lower(root, seen.spread))
            for _ in range(count):
                sees[i] += np.sum((block * D) ** 2, axis=0)
                block = block @ F
    return np.asarray(jax.device_get(floored(jnp.sqrt(jnp.asarray(sees)))))
