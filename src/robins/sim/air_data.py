"""Air data: velocity through the air along three axes, the error of a wind estimate, and barometric
height with white noise and a bias that is constant or drifts slowly.

Velocity and wind are drawn with unit deviation and then scaled, so another sigma draws the same
numbers; each has its own stream, so both may have the same key.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from robins import _float64  # noqa: F401
from robins.filters.belief import Number
from robins.sim import _arguments
from robins.sim.random import gauss_markov

# Streams folded into the key; part of the file format, as `robins.sim.random.Component` is.
_AIR, _WIND = 0, 1


def observe_air(
    key: Array, v_air_b: _arguments.Listed, sigma_m_s: _arguments.Listed, present: _arguments.Listed
) -> Float[Array, "epochs 3"]:
    """Velocity through the air as measured, with white noise on each axis [m/s].

    Args:
        key: of the run, `Component.AIR_DATA` of `robins.sim.random.stream`.
        v_air_b: (E, 3) true velocity through the air, body axes.
        sigma_m_s: standard deviation, a number or one for each axis.
        present: (E,) bool, True where there is a sample; NaN elsewhere.

    Raises:
        ValueError: shapes that do not fit together, or a negative sigma.
    """
    there = _arguments.presence(present)
    count = len(there)
    true = _arguments.rows("v_air_b", v_air_b, count, 3)
    sigma = _arguments.vector("sigma_m_s", sigma_m_s, 3, low=0.0)
    measured = true + sigma[None] * jax.random.normal(jax.random.fold_in(key, _AIR), (count, 3))
    return jnp.where(there[:, None], measured, jnp.nan)


def wind_estimate_error(
    key: Array, count: int, step_s: Number, sigma_m_s: _arguments.Listed, tau_s: _arguments.Listed
) -> Float[Array, "{count} 2"]:
    """Error of a wind estimate (E, 2) [m/s], symmetric, so of either sign convention.

    A first-order Gauss-Markov process on each of north and east, in its steady state from the first
    sample on and exact at any step.

    Args:
        key: of the run, `Component.AIR_DATA` of `robins.sim.random.stream`.
        count: E, samples at 0, step, 2 step ...
        step_s: time between samples [s].
        sigma_m_s: standard deviation, a number or (2,).
        tau_s: correlation time; infinity: constant over the run.

    Raises:
        ValueError: no sample, a negative sigma, a step or correlation time that is not positive.
    """
    sigma = _arguments.vector("sigma_m_s", sigma_m_s, 2, low=0.0)
    return sigma[None] * gauss_markov(jax.random.fold_in(key, _WIND), count, 2, step_s, tau_s)


# Streams folded into the key; part of the file format, as `robins.sim.random.Component` is.
_WHITE, _BIAS = 0, 1


def observe_height(
    key: Array,
    height_m: Number,
    sigma_m: Number,
    present: _arguments.Listed,
    bias_sigma_m: Number = 0.0,
    bias_tau_s: Number = math.inf,
    step_s: _arguments.Listed | None = None,
) -> Float[Array, "epochs"]:
    """Measured height [m].

    The bias is a first-order Gauss-Markov process in its steady state: the change of the pressure
    at the ground since it was last set. The white noise is the same with and without it.

    Args:
        key: of the run, `Component.BAROMETER` of `robins.sim.random.stream`.
        height_m: (E,) true height.
        sigma_m: standard deviation of the white noise.
        present: (E,) bool, True where there is a sample; NaN elsewhere.
        bias_sigma_m: standard deviation of the bias.
        bias_tau_s: its correlation time; infinity: constant over the run.
        step_s: between epochs; needed where the bias is not constant.

    Raises:
        ValueError: shapes that do not fit together, a negative sigma, a correlation time or a step
            that is not positive, or a correlation time without a step.
    """
    there = _arguments.presence(present)
    count = len(there)
    height = _arguments.rows("height_m", height_m, count)
    _arguments.number("sigma_m", sigma_m, 0.0)
    _arguments.number("bias_sigma_m", bias_sigma_m, 0.0)
    _arguments.number("bias_tau_s", bias_tau_s, 0.0, above=True, endless=True)
    if step_s is None:
        if not (_arguments.known(bias_tau_s) and math.isinf(bias_tau_s)):
            raise ValueError(f"bias_tau_s = {bias_tau_s} wants step_s, the time between epochs")
        step_s = 1.0  # not used by a constant bias
    white = jax.random.normal(jax.random.fold_in(key, _WHITE), (count,))
    bias = gauss_markov(jax.random.fold_in(key, _BIAS), count, 1, step_s, bias_tau_s)[:, 0]
    measured = height + sigma_m * white + bias_sigma_m * bias
    return jnp.where(there, measured, jnp.nan)
