"""Gusts and turbulence, and a vehicle carried by the wind.

Horizontal vectors are north, east. `gusts` draws a wind that is held for some seconds at a time.
`move_in_wind` moves a point mass with drag linear in its velocity through the air in such a wind

    v' = -(v - wind - commanded) / tau

and `wind_motion_at` gives velocity, displacement and acceleration at any instant: both use the
closed-form solution, so the step of the wind is not an integration step. Velocity and displacement
are continuous; the acceleration jumps where the wind does.

`dryden` and `von_karman` draw continuous turbulence of the horizontal wind. The forms are those of
MIL-F-8785C, section 3.7.1. With the wave number W = w/V [rad/m], the scale length L and the
intensity sigma, the one-sided spectra along (u) and across (v) the flight are

    Dryden      u: sigma^2 (2L/pi) / (1 + (LW)^2)
                v: sigma^2 (L/pi) (1 + 3 (LW)^2) / (1 + (LW)^2)^2
    von Karman  u: sigma^2 (2L/pi) / (1 + (aLW)^2)^(5/6)
                v: sigma^2 (L/pi) (1 + 8/3 (aLW)^2) / (1 + (aLW)^2)^(11/6)          a = 1.339

whose integral over W from zero to infinity is sigma^2. The pattern is frozen in the air and flown
through with the airspeed V (Taylor's hypothesis). Both functions give samples of these processes
that are exact at any step: variance and correlation do not depend on its length.

The first component is along, the second to the right of the direction given; with the direction
zero they are north and east.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.special import gamma, kv

from robins import (
    _float64,  # noqa: F401
    linalg,
)
from robins.filters.belief import Number
from robins.filters.values import Numbers
from robins.sim import _arguments
from robins.sim.random import gauss_markov

# Stream folded into the key; part of the file format, as `robins.sim.random.Component` is. The
# next two numbers are those of `robins.sim.wind`.
_GUSTS = 0

_ROUNDING = 1e-9  # steps; an instant this close before a step belongs to it


class WindMotion(NamedTuple):
    """Motion of `move_in_wind`: the state at the beginning of each wind step, and at the end."""

    step_s: Any  # s, duration of each wind
    velocity: Any  # (M + 1, 2) m/s
    displacement: Any  # (M + 1, 2) m, zero at the start
    target: Any  # (M, 2) m/s, wind plus commanded velocity: the steady-state velocity
    tau_s: Any  # time constant


def gusts(
    key: Array,
    count: int,
    begin_s: Number,
    end_s: Number,
    every_s: Number,
    speed_m_s: tuple[Number, Number] = (5.0, 10.0),
    direction_rad: tuple[Number, Number] = (0.5 * math.pi, 0.25 * math.pi),
) -> Float[Array, "{count} 2"]:
    """Winds drawn at fixed times: ``count`` of them, each held for ``every_s``.

    The wind of step k blows from ``k every_s`` to ``(k + 1) every_s``, counted from time zero; it
    is zero where the middle of the step is not between begin and end. The draws for a step depend
    on its number alone, so other begin and end times leave the gusts between them unchanged.

    Args:
        key: of the run, `Component.WIND` of `robins.sim.random.stream`.
        count: number of steps.
        begin_s: beginning of the first gust.
        end_s: end of the last gust.
        every_s: duration of a gust.
        speed_m_s: least and greatest speed, uniformly distributed between them.
        direction_rad: direction towards which the wind blows, clockwise from north: centre and
            half width of a uniform distribution. By default east, plus or minus 45 deg.

    Raises:
        ValueError: no step, an end before the beginning, a duration of a gust that is not
            positive, speeds that are negative or not in order, a negative half width.
    """
    _arguments.count_of("count", count)
    _arguments.number("every_s", every_s, 0.0, above=True)
    _arguments.number("begin_s", begin_s)
    _arguments.number("end_s", end_s, endless=True)
    _arguments.number("speed_m_s", speed_m_s, 0.0)
    _arguments.number("direction_rad", direction_rad)
    _arguments.number("half width of direction_rad", direction_rad[1], 0.0)
    if _arguments.known(begin_s, end_s) and end_s < begin_s:
        raise ValueError(f"gusts from begin_s = {begin_s} to end_s = {end_s}: the end comes first")
    if _arguments.known(*speed_m_s) and speed_m_s[1] < speed_m_s[0]:
        raise ValueError(f"speed_m_s = {speed_m_s}: the least speed comes first")
    slowest, fastest = speed_m_s
    centre, half_width = direction_rad
    draw = jax.random.uniform(jax.random.fold_in(key, _GUSTS), (count, 2))
    speed = slowest + (fastest - slowest) * draw[:, 0]
    direction = centre + half_width * (2.0 * draw[:, 1] - 1.0)
    # The middle, because the ends of steps are subject to rounding.
    middle = (jnp.arange(count, dtype=float) + 0.5) * every_s
    speed = jnp.where((middle >= begin_s) & (middle < end_s), speed, 0.0)
    return jnp.stack([speed * jnp.cos(direction), speed * jnp.sin(direction)], 1)


def move_in_wind(
    wind: Numbers,
    step_s: Number,
    commanded_m_s: Number,
    tau_s: _arguments.Listed,
    start_m_s: Number,
) -> WindMotion:
    """Exact motion of a point mass in a piecewise constant wind.

    Args:
        wind: (M, 2) m/s; that of step k blows from ``k step_s`` to ``(k + 1) step_s``.
        step_s: duration of each wind [s].
        commanded_m_s: (2,) commanded velocity through the air.
        tau_s: time constant with which a deviation from it decays [s].
        start_m_s: (2,) velocity at time zero.

    Raises:
        ValueError: a shape that does not fit; a step or a time constant that is not positive.
    """
    if np.ndim(wind) != 2 or len(wind) < 1:
        raise ValueError(f"wind must have shape (M, 2), M at least one, got {np.shape(wind)}")
    wind = _arguments.rows("wind", wind, len(wind), 2)
    commanded = _arguments.rows("commanded_m_s", commanded_m_s, 2)
    start = _arguments.rows("start_m_s", start_m_s, 2)
    _arguments.number("step_s", step_s, 0.0, above=True)
    _arguments.number("tau_s", tau_s, 0.0, above=True)
    target = wind + commanded[None]

    def step(state, towards):
        velocity, displacement = state
        after = _after(velocity, displacement, towards, step_s, tau_s)
        return after, after

    begin = (start, jnp.zeros(2))
    _, (velocity, displacement) = jax.lax.scan(step, begin, target)
    velocity = jnp.concatenate([start[None], velocity])
    displacement = jnp.concatenate([jnp.zeros((1, 2)), displacement])
    return WindMotion(step_s, velocity, displacement, target, tau_s)


def wind_motion_at(carried: WindMotion, time_s: Number) -> tuple[Array, Array, Array]:
    """Velocity [m/s], displacement [m] and acceleration [m/s^2] at instants, each (..., 2).

    Beyond the last step its wind is held. Where two steps meet the acceleration is that of the
    later one.

    Args:
        carried: motion, from `move_in_wind`.
        time_s: (...) instants, none before zero.

    Raises:
        ValueError: a time before zero.
    """
    at, into = _step_of(time_s, carried.step_s, len(carried.target))
    towards = carried.target[at]
    state = carried.velocity[at], carried.displacement[at]
    velocity, displacement = _after(*state, towards, into[..., None], carried.tau_s)
    return velocity, displacement, (towards - velocity) / carried.tau_s


def wind_at(wind: Numbers, step_s: Number, time_s: Number) -> Array:
    """Piecewise constant wind (M, 2) at instants (...): (..., 2).

    Beyond the last step its wind is held; where two steps meet the later one applies.

    Raises:
        ValueError: a step that is not positive, or a time before zero.
    """
    _arguments.number("step_s", step_s, 0.0, above=True)
    at, _ = _step_of(time_s, step_s, len(wind))
    return jnp.asarray(wind, float)[at]


def _after(velocity, displacement, towards, time, tau):
    """Velocity and displacement after a time in constant wind; unchanged bit for bit at zero."""
    gone = -jnp.expm1(-time / tau)
    missing = towards - velocity
    return velocity + missing * gone, displacement + towards * time - missing * (tau * gone)


def _step_of(time_s: Number, step_s: Number, count: int) -> tuple[Array, Array]:
    """Index of the step that contains an instant, and the time since its start."""
    _arguments.number("time_s", time_s, 0.0)
    time = jnp.asarray(time_s, float)
    number = jnp.clip(jnp.floor(time / step_s + _ROUNDING), 0, count - 1)
    return jnp.asarray(number, int), time - number * step_s


# Streams folded into the key; part of the file format, as `robins.sim.random.Component` is. Zero is
# that of `robins.sim.wind.gusts`.
_ALONG, _ACROSS = 1, 2

# Scale lengths above 2000 ft of height, where both components have the same [m]
DRYDEN_LENGTH_M = 1750.0 * 0.3048
VON_KARMAN_LENGTH_M = 2500.0 * 0.3048

_A = gamma(1.0 / 3.0) / (math.sqrt(math.pi) * gamma(5.0 / 6.0))  # 1.339 unrounded
_LEAST_SHARE = 1e-13  # least eigenvalue accepted, as a share of the greatest


def dryden(
    key: Array,
    count: int,
    step_s: Number,
    airspeed_m_s: Number,
    sigma_m_s: _arguments.Listed,
    length_m: _arguments.Listed = DRYDEN_LENGTH_M,
    direction_rad: Number = 0.0,
) -> Float[Array, "{count} 2"]:
    """Dryden turbulence (count, 2) [m/s] at 0, step, 2 step ..., in its steady state throughout.

    The linear filters that shape white noise into these spectra are discretised exactly, each
    with its covariance over a step.

    Args:
        key: of the run, `Component.WIND` of `robins.sim.random.stream`, which may draw gusts too.
        count: number of samples.
        step_s: time between samples [s].
        airspeed_m_s: V.
        sigma_m_s: intensity, a number or (2,) along, across.
        length_m: L, a number or (2,) along, across.
        direction_rad: of the flight through the turbulence, clockwise from north.

    Raises:
        ValueError: no sample, a negative sigma, or a step, airspeed or length not positive.
    """
    _check(count, step_s, airspeed_m_s, direction_rad)
    sigma = _arguments.vector("sigma_m_s", sigma_m_s, 2, low=0.0)
    tau = _arguments.vector("length_m", length_m, 2, low=0.0, above=True) / airspeed_m_s
    along = gauss_markov(jax.random.fold_in(key, _ALONG), count, 1, step_s, tau[0])[:, 0]
    across = _across(jax.random.fold_in(key, _ACROSS), count, step_s / tau[1])
    return _rotated(sigma[None] * jnp.stack([along, across], 1), direction_rad)


def von_karman(
    key: Array,
    count: int,
    step_s: Number,
    airspeed_m_s: Number,
    sigma_m_s: _arguments.Listed,
    length_m: _arguments.Listed = VON_KARMAN_LENGTH_M,
    direction_rad: Number = 0.0,
) -> Float[Array, "{count} 2"]:
    """Von Karman turbulence [m/s] at 0, step, 2 step ...; arguments are those of `dryden`.

    These spectra are not rational, so no finite-order filter produces them. White noise is shaped
    by FFT instead, on a circle at least twice as long as the record, so that the record has exactly
    the required covariance without wrap-around (circulant embedding; Dietrich & Newsam 1997). A
    longer record of the same key is another draw. Step, airspeed and length must be known at
    compile time.

    Raises:
        ValueError: as `dryden`; a step, airspeed or length that is traced; or a step so short
            that two samples differ by rounding only.
    """
    if not _arguments.known(step_s, airspeed_m_s, length_m):
        raise ValueError(
            "step_s, airspeed_m_s and length_m of von Karman turbulence must be plain numbers, "
            "not traced: its spectrum is found before the run is compiled"
        )
    _check(count, step_s, airspeed_m_s, direction_rad)
    sigma = _arguments.vector("sigma_m_s", sigma_m_s, 2, low=0.0)
    _arguments.vector("length_m", length_m, 2, low=0.0, above=True)
    steps = np.broadcast_to(
        float(step_s) * float(airspeed_m_s) / (_A * np.asarray(length_m, float)), (2,)
    )

    def drawn(stream, step, across):
        root = _root_spectrum(count, float(step), across)
        size = 2 * (len(root) - 1)
        white = jax.random.normal(jax.random.fold_in(key, stream), (size,))
        return jnp.fft.irfft(jnp.fft.rfft(white) * jnp.asarray(root, complex), size)[:count]

    pair = jnp.stack([drawn(_ALONG, steps[0], False), drawn(_ACROSS, steps[1], True)], 1)
    return _rotated(sigma[None] * pair, direction_rad)


def _check(count, step_s, airspeed_m_s, direction_rad):
    _arguments.count_of("count", count)
    _arguments.number("step_s", step_s, 0.0, above=True)
    _arguments.number("airspeed_m_s", airspeed_m_s, 0.0, above=True)
    _arguments.number("direction_rad", direction_rad)


def _rotated(pair, direction_rad):
    """Rotate components along and to the right of a direction into north and east."""
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
    """Correlation of von Karman turbulence at the distance x = r/(aL): transforms of the spectra.

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
    """Square roots of the circulant's eigenvalues, from zero to the highest frequency.

    The circle need not be longer for positive eigenvalues: along, the correlation is convex, which
    is sufficient (Dietrich & Newsam 1997); across, they are positive for every step, to rounding.
    """
    size = 4
    while size < 2 * (count - 1):
        size *= 2
    half = _correlation(step * np.arange(size // 2 + 1), across)
    eigenvalues = np.fft.rfft(np.concatenate([half, half[-2:0:-1]])).real
    if eigenvalues.min() < _LEAST_SHARE * eigenvalues.max():
        raise ValueError(
            f"step_s is {step:.3g} of the time in which the scale length of von Karman turbulence "
            "passes by: so short that the samples do not differ but by rounding"
        )
    return np.sqrt(eigenvalues)
