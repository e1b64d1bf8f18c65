"""Disturbances of sensors beyond white noise: heavy tails, outliers, steps of noise and of drift.

Pure JAX; keys come from `robins.sim.random.stream`. Noise is drawn with unit standard deviation, to
be scaled, and a disturbance that is switched off leaves the numbers of the rest as they were.
"""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from robins import _float64  # noqa: F401
from robins.errors import require
from robins.filters.belief import Number
from robins.sim import _arguments


def outlier_factor(
    key: Array, shape: Sequence[int], share: Number, factor: Number
) -> Float[Array, "..."]:
    """``factor`` for a share of the samples, drawn one by one, and 1 for the rest.

    Normal noise times this is the contaminated normal distribution (Tukey 1960; Huber & Ronchetti
    2009, section 1.1), of variance ``1 + share (factor^2 - 1)``.

    Raises:
        ValueError: a share beyond 0 to 1, or a negative factor.
    """
    if _arguments.known(share):
        require(0.0 <= share <= 1.0, f"share is {share}; it must be from 0 to 1")
    if _arguments.known(factor):
        require(factor >= 0.0, f"factor is {factor}; it must not be negative")
    struck = jax.random.uniform(key, tuple(shape)) < share
    return jnp.where(struck, jnp.asarray(factor, float), 1.0)


def student_t(key: Array, shape: Sequence[int], dof: float) -> Float[Array, "..."]:
    """Student-t noise scaled to unit standard deviation.

    Raises:
        ValueError: two degrees of freedom or fewer, for which the variance is infinite.
    """
    require(dof > 2.0, f"dof is {dof}; Student's t has a variance only above 2")
    return jax.random.t(key, float(dof), tuple(shape)) * (1.0 - 2.0 / dof) ** 0.5


def window_factor(
    time_s: Float[Array, "*n"], begin_s: ArrayLike, end_s: ArrayLike, factor: ArrayLike
) -> Float[Array, "*n"]:
    """``factor`` from begin (included) to end (not), else 1: noise that steps up and down."""
    inside = (time_s >= begin_s) & (time_s < end_s)
    return jnp.where(inside, jnp.asarray(factor, float), 1.0)


def drift_step(
    begin_s: Float[Array, "n"], dt_s: Float[Array, "n"], at_s: ArrayLike, size: Float[Array, "3"]
) -> tuple[Float[Array, "n 3"], Float[Array, "n 3"]]:
    """A bias that appears at a time: its value at the end of each interval, and its integral.

    Args:
        begin_s: (n,) start of each interval [s].
        dt_s: (n,) its length [s].
        at_s: time from which the bias acts, that instant included [s].
        size: (3,) the bias.
    """
    end = begin_s + dt_s
    present = jnp.where(end >= at_s, 1.0, 0.0)
    time = jnp.clip(end - at_s, 0.0, dt_s)
    return present[:, None] * size[None], time[:, None] * size[None]
