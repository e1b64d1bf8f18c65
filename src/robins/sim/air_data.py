"""Air data of three axes, and the error of what is taken for the wind.

Both are drawn with unit deviation and scaled, so another sigma leaves the numbers as they were, and
from streams of their own, so both may have the same key.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from robins import _float64  # noqa: F401
from robins.sim import _given
from robins.sim.gauss_markov import gauss_markov

# Streams folded into the key; part of the file format, as `robins.sim.random.Component` is.
_AIR, _WIND = 0, 1


def observe_air(key: Array, v_air_b: Any, sigma_m_s: Any, present: Any) -> Float[Array, "epochs 3"]:
    """Velocity through the air as measured, with white noise on each axis [m/s].

    Args:
        key: of the run, `Component.AIR_DATA` of `robins.sim.random.stream`.
        v_air_b: (E, 3) true velocity through the air, body axes.
        sigma_m_s: standard deviation, a number or one for each axis.
        present: (E,) bool, whether there is a sample; NaN where not.

    Raises:
        ValueError: shapes that do not fit together, or a negative sigma.
    """
    there = _given.presence(present)
    count = len(there)
    true = _given.rows("v_air_b", v_air_b, count, 3)
    sigma = _given.vector("sigma_m_s", sigma_m_s, 3, low=0.0)
    measured = true + sigma[None] * jax.random.normal(jax.random.fold_in(key, _AIR), (count, 3))
    return jnp.where(there[:, None], measured, jnp.nan)


def wind_estimate_error(
    key: Array, count: int, step_s: Any, sigma_m_s: Any, tau_s: Any
) -> Float[Array, "{count} 2"]:
    """Error of an estimate of the wind, true less estimated or the reverse, for it has no sign.

    A first-order Gauss-Markov process on each of north and east, in its steady state from the first
    sample on and exact at any step.

    Args:
        key: of the run, `Component.AIR_DATA` of `robins.sim.random.stream`.
        count: samples, at 0, step, 2 step ...
        step_s: between samples.
        sigma_m_s: standard deviation, a number or (2,).
        tau_s: correlation time; infinity: constant over the run.

    Raises:
        ValueError: no sample, a negative sigma, a step or correlation time that is not positive.
    """
    sigma = _given.vector("sigma_m_s", sigma_m_s, 2, low=0.0)
    return sigma[None] * gauss_markov(jax.random.fold_in(key, _WIND), count, 2, step_s, tau_s)
