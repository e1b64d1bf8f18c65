"""Noise variances, for rules that estimate or weigh a noise.

An estimated noise is kept as its ratio to the nominal one, component by component: this has no
unit, and is valid for a nominal noise that changes from step to step.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array

from robins.filters.belief import Number
from robins.filters.observation import Observation
from robins.filters.values import Numbers, is_factor, is_share, number


def variance(factor: Array) -> Array:
    """Diagonal of ``factor factor'``."""
    return jnp.sum(factor**2, axis=1)


def reading_variance(o: Observation) -> Array:
    """(m,) diagonal of ``H P H' + Omega``, the part of the innovation variance due to the state."""
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
    """Notes with one scalar per component: ``name.0``, ``name.1``, ..."""
    return {f"{name}.{i}": values[i] for i in range(len(values))}


def bounded(rule: str, forgetting: Number, floor: Number, ceiling: Number) -> dict[str, Numbers]:
    """Forgetting factor and bounds of a scale with initial value 1, checked."""
    return {
        "forgetting": number(f"{rule} forgetting must lie in (0, 1]", forgetting, is_share),
        "floor": number(f"{rule} floor must lie in (0, 1]", floor, is_share),
        "ceiling": number(f"{rule} ceiling must be finite and not below 1", ceiling, is_factor),
    }
