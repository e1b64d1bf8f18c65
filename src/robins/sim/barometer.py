"""A barometric altimeter: height with white noise, and a bias that is constant or drifts slowly."""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from robins import _float64  # noqa: F401
from robins.sim import _given
from robins.sim.gauss_markov import gauss_markov

# Streams folded into the key; part of the file format, as `robins.sim.random.Component` is.
_WHITE, _BIAS = 0, 1


def observe_height(
    key: Array,
    height_m: Any,
    sigma_m: Any,
    present: Any,
    bias_sigma_m: Any = 0.0,
    bias_tau_s: Any = math.inf,
    step_s: Any = None,
) -> Float[Array, "epochs"]:
    """Measured height [m].

    The bias is a first-order Gauss-Markov process in its steady state: the change of the pressure
    at the ground since it was last set. The white noise is the same with and without it.

    Args:
        key: of the run, `Component.BAROMETER` of `robins.sim.random.stream`.
        height_m: (E,) true height.
        sigma_m: standard deviation of the white noise.
        present: (E,) bool, whether there is a sample; NaN where not.
        bias_sigma_m: standard deviation of the bias.
        bias_tau_s: its correlation time; infinity: constant over the run.
        step_s: between epochs; needed where the bias is not constant.

    Raises:
        ValueError: shapes that do not fit together, a negative sigma, a correlation time or a step
            that is not positive, or a correlation time without a step.
    """
    there = _given.presence(present)
    count = len(there)
    height = _given.rows("height_m", height_m, count)
    _given.number("sigma_m", sigma_m, 0.0)
    _given.number("bias_sigma_m", bias_sigma_m, 0.0)
    _given.number("bias_tau_s", bias_tau_s, 0.0, above=True, endless=True)
    if step_s is None:
        if not (_given.known(bias_tau_s) and math.isinf(bias_tau_s)):
            raise ValueError(f"bias_tau_s = {bias_tau_s} wants step_s, the time between epochs")
        step_s = 1.0  # of no consequence to a constant
    white = jax.random.normal(jax.random.fold_in(key, _WHITE), (count,))
    bias = gauss_markov(jax.random.fold_in(key, _BIAS), count, 1, step_s, bias_tau_s)[:, 0]
    measured = height + sigma_m * white + bias_sigma_m * bias
    return jnp.where(there, measured, jnp.nan)
