"""Continuous turbulence of the horizontal wind: the Dryden and the von Karman spectra.

The forms are those of MIL-F-8785C, section 3.7.1. With the wave number W = w/V [rad/m], the scale
length L and the intensity sigma, the one-sided spectra along (u) and across (v) the flight are

    Dryden      u: sigma^2 (2L/pi) / (1 + (LW)^2)
                v: sigma^2 (L/pi) (1 + 3 (LW)^2) / (1 + (LW)^2)^2
    von Karman  u: sigma^2 (2L/pi) / (1 + (aLW)^2)^(5/6)
                v: sigma^2 (L/pi) (1 + 8/3 (aLW)^2) / (1 + (aLW)^2)^(11/6)          a = 1.339

whose integral over W from zero on is sigma^2. The pattern is frozen in the air and flown through
with the airspeed V (Taylor's hypothesis). Both functions give samples of these processes that are
exact at any step: no step is too long, and variance and correlation do not depend on it.

The first component is along, the second to the right of the direction given; with the direction
zero they are north and east.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.special import gamma, kv

from robins import _float64, linalg  # noqa: F401
from robins.sim import _given
from robins.sim.random import gauss_markov

# Streams folded into the key; part of the file format, as `robins.sim.random.Component` is. Zero is
# that of `robins.sim.wind.gusts`.
_ALONG, _ACROSS = 1, 2

# Scale lengths above 2000 ft of height, where both components have the same [m]
DRYDEN_LENGTH_M = 1750.0 * 0.3048
VON_KARMAN_LENGTH_M = 2500.0 * 0.3048

_A = gamma(1.0 / 3.0) / (math.sqrt(math.pi) * gamma(5.0 / 6.0))  # 1.339 unrounded
_ROUNDING = 1e-13  # of an eigenvalue, as a share of the greatest


def dryden(
    key: Array,
    count: int,
    step_s: Any,
    airspeed_m_s: Any,
    sigma_m_s: Any,
    length_m: Any = DRYDEN_LENGTH_M,
    direction_rad: Any = 0.0,
) -> Float[Array, "{count} 2"]:
    """Dryden turbulence [m/s] at 0, step, 2 step ..., in its steady state from the first on.

    The linear filters that shape white noise into these spectra are discretised exactly, each
    with its covariance over a step.

    Args:
        key: of the run, `Component.WIND` of `robins.sim.random.stream`, which may draw gusts too.
        count: samples.
        step_s: between samples.
        airspeed_m_s: V.
        sigma_m_s: intensity, a number or (2,) along, across.
        length_m: L, a number or (2,) along, across.
        direction_rad: of the flight through the turbulence, clockwise from north.

    Raises:
        ValueError: no sample, a negative sigma, or a step, airspeed or length not positive.
    """
    _check(count, step_s, airspeed_m_s, direction_rad)
    sigma = _given.vector("sigma_m_s", sigma_m_s, 2, low=0.0)
    tau = _given.vector("length_m", length_m, 2, low=0.0, above=True) / airspeed_m_s
    along = gauss_markov(jax.random.fold_in(key, _ALONG), count, 1, step_s, tau[0])[:, 0]
    across = _across(jax.random.fold_in(key, _ACROSS), count, step_s / tau[1])
    return _turned(sigma[None] * jnp.stack([along, across], 1), direction_rad)


def von_karman(
    key: Array,
    count: int,
    step_s: Any,
    airspeed_m_s: Any,
    sigma_m_s: Any,
    length_m: Any = VON_KARMAN_LENGTH_M,
    direction_rad: Any = 0.0,
) -> Float[Array, "{count} 2"]:
    """Von Karman turbulence [m/s] at 0, step, 2 step ...; arguments are those of `dryden`.

    These spectra are not rational, so no finite filter has them. White noise is shaped by FFT
    instead, round a circle at least twice as long as the record, so that the record has exactly
    its covariance and no end meets the other (circulant embedding; Dietrich & Newsam 1997). A
    longer record of the same key is another draw. Step, airspeed and length must be known when
    the run is compiled.

    Raises:
        ValueError: as `dryden`; a step, airspeed or length that is traced; or a step so short
            that nothing but rounding is between two samples.
    """
    if not _given.known(step_s, airspeed_m_s, length_m):
        raise ValueError(
            "step_s, airspeed_m_s and length_m of von Karman turbulence must be plain numbers, "
            "not traced: its spectrum is found before the run is compiled"
        )
    _check(count, step_s, airspeed_m_s, direction_rad)
    sigma = _given.vector("sigma_m_s", sigma_m_s, 2, low=0.0)
    _given.vector("length_m", length_m, 2, low=0.0, above=True)
    steps = np.broadcast_to(
        float(step_s) * float(airspeed_m_s) / (_A * np.asarray(length_m, float)), (2,)
    )

    def drawn(stream, step, across):
        root = _root_spectrum(count, float(step), across)
        size = 2 * (len(root) - 1)
        white = jax.random.normal(jax.random.fold_in(key, stream), (size,))
        return jnp.fft.irfft(jnp.fft.rfft(white) * jnp.asarray(root, complex), size)[:count]

    pair = jnp.stack([drawn(_ALONG, steps[0], False), drawn(_ACROSS, steps[1], True)], 1)
    return _turned(sigma[None] * pair, direction_rad)


def _check(count, step_s, airspeed_m_s, direction_rad):
    _given.count_of("count", count)
    _given.number("step_s", step_s, 0.0, above=True)
    _given.number("airspeed_m_s", airspeed_m_s, 0.0, above=True)
    _given.number("direction_rad", direction_rad)


def _turned(pair, direction_rad):
    """From along and to the right of a direction to north and east."""
    cos, sin = jnp.cos(direction_rad), jnp.sin(direction_rad)
    along, right = pair[:, 0], pair[:, 1]
    return jnp.stack([cos * along - sin * right, sin * along + cos * right], 1)


def _across(key, count, step):
    """White noise through (1 + sqrt(3) s) / (1 + s)^2 in the time t V/L, of unit variance."""
    # a' = -a + w, b' = a - b with w of density 1: a is 1/(1 + s) of w, b is 1/(1 + s)^2 of it
    A = jnp.array([[-1.0, 0.0], [1.0, -1.0]])
    Phi, Q = linalg.van_loan(A, jnp.diag(jnp.array([1.0, 0.0])), step)
    L, steady = linalg.cholesky(Q), linalg.cholesky(jnp.array([[0.5, 0.25], [0.25, 0.25]]))
    normal = jax.random.normal(key, (count, 2))

    def shape(x, w):
        x = jnp.sum(Phi * x[None], 1) + jnp.sum(L * w[None], 1)
        return x, x

    first = jnp.sum(steady * normal[0][None], 1)
    _, rest = jax.lax.scan(shape, first, normal[1:])
    a, b = jnp.concatenate([first[None], rest]).T
    return math.sqrt(3.0) * a + (1.0 - math.sqrt(3.0)) * b


def _correlation(x, across):
    """Of von Karman turbulence at the distance x = r/(aL): transforms of the spectra.

    Along it is f(x), proportional to x^(1/3) K_1/3(x); across it is f + x f'/2, as for every
    isotropic field free of divergence (Batchelor 1953, section 3.4).
    """
    safe = np.where(x > 0.0, x, 1.0)
    scale = 2.0 ** (2.0 / 3.0) / gamma(1.0 / 3.0)
    f = scale * np.cbrt(safe) * kv(1.0 / 3.0, safe)
    if across:
        f = f - 0.5 * scale * safe * np.cbrt(safe) * kv(2.0 / 3.0, safe)
    return np.where(x > 0.0, f, 1.0)


@lru_cache(maxsize=16)
def _root_spectrum(count: int, step: float, across: bool) -> np.ndarray:
    """Roots of the eigenvalues, from zero to the highest frequency, of a circle round the record.

    No longer circle is needed to keep them positive: along, the correlation is convex, for which
    that is a theorem (Dietrich & Newsam 1997); across, it is so for every step down to rounding.
    """
    size = 4
    while size < 2 * (count - 1):
        size *= 2
    half = _correlation(step * np.arange(size // 2 + 1), across)
    eigenvalues = np.fft.rfft(np.concatenate([half, half[-2:0:-1]])).real
    if eigenvalues.min() < _ROUNDING * eigenvalues.max():
        raise ValueError(
            f"step_s is {step:.3g} of the time in which the scale length of von Karman turbulence "
            "passes by: so short that the samples do not differ but by rounding"
        )
    return np.sqrt(eigenvalues)
