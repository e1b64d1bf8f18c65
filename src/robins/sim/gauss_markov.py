"""The first-order Gauss-Markov process at the instants of a sensor: steady, and exact at any step.

Its correlation falls as ``exp(-|t|/tau)``. Sampled at equal steps h it is

    x(k+1) = e^(-h/tau) x(k) + sqrt(1 - e^(-2h/tau)) n(k)

with no approximation (Brown & Hwang 2012, section 5.4), so its statistics do not depend on h.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from robins import _float64  # noqa: F401
from robins.sim import _given


def gauss_markov(
    key: Array, count: int, width: int, step_s: Any, tau_s: Any
) -> Float[Array, "{count} {width}"]:
    """Independent processes of unit variance, begun in their steady state.

    The normal numbers drawn do not depend on step or correlation time.

    Args:
        key: of the stream.
        count: samples, at 0, h, 2h ...
        width: processes.
        step_s: h [s].
        tau_s: correlation time [s], one or ``width`` of them; infinity makes constants.

    Raises:
        ValueError: no sample, a step or a correlation time that is not positive.
    """
    _given.count_of("count", count)
    _given.number("step_s", step_s, 0.0, above=True)
    tau = _given.vector("tau_s", tau_s, width, low=0.0, above=True, endless=True)
    normal = jax.random.normal(key, (count, width))
    x = step_s / tau
    fade, drive = jnp.exp(-x), jnp.sqrt(-jnp.expm1(-2.0 * x))

    def step(before, number):
        now = fade * before + drive * number
        return now, now

    _, rest = jax.lax.scan(step, normal[0], normal[1:])
    return jnp.concatenate([normal[:1], rest])
