"""Noise by its variances: what the rules that learn or weigh a noise have in common.

A learnt noise is kept as a ratio to the nominal one, component by component. Units then do not
matter, and a nominal noise that changes from step to step stays what it is: the nominal one.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from robins.filters.belief import Number
from robins.filters.observation import Observation
from robins.filters.values import Numbers, number


def variance(factor: Array) -> Array:
    """Diagonal of ``factor factor'``."""
    return jnp.sum(factor**2, axis=1)


def reading_variance(o: Observation) -> Array:
    """(m,) diagonal of ``H P H' + Omega``: the share of the state in the innovation."""
    total = variance(o.spread) + variance(o.excess)
    return total if o.deficit is None else total - o.deficit**2


def ratio(a: Array, b: Array) -> Array:
    """``a / b``; 0 where b is 0, with finite gradients."""
    some = b > 0.0
    return jnp.where(some, a, 0.0) / jnp.where(some, b, 1.0)


def scaled(factor: Array, scale: Array) -> Array:
    """Factor of a covariance whose variances are multiplied by a scale; correlations stay."""
    return factor * jnp.sqrt(scale)[:, None]


def numbered(name: str, values: Array) -> dict[str, Array]:
    """Notes of one scalar a component: ``name.0``, ``name.1``, ..."""
    return {f"{name}.{i}": values[i] for i in range(len(values))}


def bounded(rule: str, forgetting: Number, floor: Number, ceiling: Number) -> dict[str, Numbers]:
    """The share that is kept from sample to sample, and the bounds of a scale that begins at 1.

    Raises:
        ValueError: one is not of its range.
    """
    share, above = lambda x: (x > 0.0) & (x <= 1.0), lambda x: (x >= 1.0) & (x < np.inf)
    return {
        "forgetting": number(f"{rule} forgetting must lie in (0, 1]", forgetting, share),
        "floor": number(f"{rule} floor must lie in (0, 1]", floor, share),
        "ceiling": number(f"{rule} ceiling must be finite and not below 1", ceiling, above),
    }
