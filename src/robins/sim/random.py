"""Random streams that depend on their name only, not on the order of draws.

A stream is named by three numbers: the seed of the campaign, the run, and the component that
draws. Both generators below are counter-based (Threefry and Philox; Salmon et al., "Parallel
random numbers: as easy as 1, 2, 3", SC 2011), so the stream of run 137 is the same alone, in a
batch, on any number of workers and in any order, and an added sensor draws from a stream of its
own and leaves the noise of the others unchanged.

The numbers of `Component` are part of the file format: a result folder that states its seed can
be reproduced only while they stay. Add at the end, never renumber, never reuse.

`gauss_markov` is the first-order Gauss-Markov process at the instants of a sensor: steady, and
exact at any step. Its correlation falls as ``exp(-|t|/tau)``. Sampled at equal steps h it is

    x(k+1) = e^(-h/tau) x(k) + sqrt(1 - e^(-2h/tau)) n(k)

with no approximation (Brown & Hwang 2012, section 5.4), so its statistics do not depend on h.
"""

from __future__ import annotations

import operator
from enum import IntEnum
from typing import Any, SupportsIndex

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from robins import _float64  # noqa: F401
from robins.filters.belief import Number
from robins.sim import _arguments

UNITS_OF_A_KIND = 256  # stride between the stream numbers of two sensors of one kind


class Component(IntEnum):
    """Component that draws; a second or third sensor of a kind is `unit(component, index)`."""

    INITIAL_STATE = 0  # true initial state and the errors of the initial estimate
    IMU = 1  # errors of an inertial measurement unit
    GNSS = 2  # errors, outliers and losses of a GNSS receiver
    TRAJECTORY = 3  # random motion of the vehicle
    WIND = 4  # gusts and turbulence
    FLEXURE = 5  # wing or structure between two IMUs
    BAROMETER = 6
    MAGNETOMETER = 7
    AIR_DATA = 8
    STAR_SENSOR = 9
    SAR = 10
    ODOMETER = 11
    FAULT = 12  # time and kind of a fault
    LINK = 13  # losses and delays between a sensor and the computer
    FILTER = 14  # draws by a filter, e.g. a particle filter
    SENSOR = 15  # a sensor of any other kind, by its index among those of a model


def unit(component: Component, index: SupportsIndex) -> int:
    """Component number of the sensor ``index`` of a kind; index 0 is the component itself.

    Raises:
        ValueError: index is not in 0 .. 2^24 - 1.
    """
    return int(component) + UNITS_OF_A_KIND * _bounded("index", index, 2**24)


def stream(seed: SupportsIndex, run: Any, component: SupportsIndex) -> Array:
    """JAX key of one component in one run, ``fold_in(fold_in(key(seed), run), component)``.

    The generator is named (Threefry 2x32), not left to JAX's settings. ``run`` may be traced:
    ``vmap(lambda run: stream(seed, run, Component.IMU))(runs)`` gives the keys of a batch.

    Args:
        seed: of the campaign, 0 .. 2^63 - 1.
        run: number of the run, 0 .. 2^32 - 1.
        component: a `Component`, or a number from `unit`.

    Raises:
        ValueError: a number known at call time is not an integer or out of its range.
    """
    key = jax.random.key(_bounded("seed", seed, 2**63), impl="threefry2x32")
    if not isinstance(run, jax.Array):
        run = _bounded("run", run, 2**32)
    return jax.random.fold_in(jax.random.fold_in(key, run), _bounded("component", component, 2**32))


def _bounded(name: str, value: Any, limit: int) -> int:
    wrong = f"{name} must be an integer from 0 to {limit - 1}, got {value!r}"
    try:
        number = operator.index(value)
    except TypeError:
        raise ValueError(wrong) from None
    if isinstance(value, bool) or not 0 <= number < limit:
        raise ValueError(wrong)
    return number


def gauss_markov(
    key: Array, count: int, width: int, step_s: Number, tau_s: _arguments.Listed
) -> Float[Array, "{count} {width}"]:
    """Independent processes of unit variance, started in their steady state.

    The normal numbers drawn do not depend on step or correlation time.

    Args:
        key: of the stream.
        count: number of samples, at 0, h, 2h ...
        width: number of processes.
        step_s: h [s].
        tau_s: correlation time [s], one or ``width`` of them; infinity: constants.

    Raises:
        ValueError: no sample, a step or a correlation time that is not positive.
    """
    _arguments.count_of("count", count)
    _arguments.number("step_s", step_s, 0.0, above=True)
    tau = _arguments.vector("tau_s", tau_s, width, low=0.0, above=True, endless=True)
    normal = jax.random.normal(key, (count, width))
    x = step_s / tau
    fade, drive = jnp.exp(-x), jnp.sqrt(-jnp.expm1(-2.0 * x))

    def step(before, number):
        now = fade * before + drive * number
        return now, now

    _, rest = jax.lax.scan(step, normal[0], normal[1:])
    return jnp.concatenate([normal[:1], rest])
