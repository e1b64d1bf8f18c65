"""Wind that comes in gusts, and a vehicle that it carries.

Horizontal vectors are north, east. `gusts` draws a wind that is held for some seconds at a time.
`carry` moves a point mass, whose drag is linear in its velocity through the air, in such a wind

    v' = -(v - wind - commanded) / tau

and `carried_at` reads velocity, displacement and acceleration at any instant: both are the solution
in closed form, so the step of the wind is no step of integration. Velocity and displacement are
continuous; the acceleration jumps where the wind does.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from robins import _float64  # noqa: F401
from robins.sim import _given

# Stream folded into the key; part of the file format, as `robins.sim.random.Component` is. The
# next two numbers are those of `robins.sim.turbulence`.
_GUSTS = 0

_ROUNDING = 1e-9  # steps; an instant this short of the next step belongs to it


class Carried(NamedTuple):
    """A motion from `carry`: the state where each step of the wind begins, and at the end."""

    step_s: Any  # for how long each wind is held
    velocity: Any  # (M + 1, 2) m/s
    displacement: Any  # (M + 1, 2) m, zero at the start
    target: Any  # (M, 2) m/s, wind plus commanded velocity: where the velocity tends to
    tau_s: Any  # time constant


def gusts(
    key: Array,
    count: int,
    begin_s: Any,
    end_s: Any,
    every_s: Any,
    speed_m_s: tuple[Any, Any] = (5.0, 10.0),
    direction_rad: tuple[Any, Any] = (0.5 * math.pi, 0.25 * math.pi),
) -> Float[Array, "{count} 2"]:
    """Winds drawn anew at fixed times: ``count`` of them, each held for ``every_s``.

    The wind of step k blows from ``k every_s`` to ``(k + 1) every_s``, counted from time zero; it
    is zero where the middle of the step is not between begin and end. What is drawn for a step
    depends on its number alone, so other times of begin and end leave the gusts between them as
    they were.

    Args:
        key: of the run, `Component.WIND` of `robins.sim.random.stream`.
        count: number of steps.
        begin_s: the first gust.
        end_s: the calm after the last.
        every_s: for how long a gust is held.
        speed_m_s: least and greatest speed, evenly distributed between them.
        direction_rad: where the wind blows to, clockwise from north: the centre, and how far to
            either side of it, evenly distributed. By default east, give or take 45 deg.

    Raises:
        ValueError: no step, an end before the beginning, a time that a gust is held that is not
            positive, speeds that are negative or not in order, a negative half width.
    """
    _given.count_of("count", count)
    _given.number("every_s", every_s, 0.0, above=True)
    _given.number("begin_s", begin_s)
    _given.number("end_s", end_s, endless=True)
    _given.number("speed_m_s", speed_m_s, 0.0)
    _given.number("direction_rad", direction_rad)
    _given.number("half width of direction_rad", direction_rad[1], 0.0)
    if _given.known(begin_s, end_s) and end_s < begin_s:
        raise ValueError(f"gusts from begin_s = {begin_s} to end_s = {end_s}: the end comes first")
    if _given.known(*speed_m_s) and speed_m_s[1] < speed_m_s[0]:
        raise ValueError(f"speed_m_s = {speed_m_s}: the least speed comes first")
    slowest, fastest = speed_m_s
    centre, half_width = direction_rad
    draw = jax.random.uniform(jax.random.fold_in(key, _GUSTS), (count, 2))
    speed = slowest + (fastest - slowest) * draw[:, 0]
    direction = centre + half_width * (2.0 * draw[:, 1] - 1.0)
    # The middle, for the ends of steps are subject to rounding.
    middle = (jnp.arange(count, dtype=float) + 0.5) * every_s
    speed = jnp.where((middle >= begin_s) & (middle < end_s), speed, 0.0)
    return jnp.stack([speed * jnp.cos(direction), speed * jnp.sin(direction)], 1)


def carry(wind: Any, step_s: Any, commanded_m_s: Any, tau_s: Any, start_m_s: Any) -> Carried:
    """The motion of a point mass in a wind that is held over steps, exact.

    Args:
        wind: (M, 2) m/s; that of step k blows from ``k step_s`` to ``(k + 1) step_s``.
        step_s: for how long each is held.
        commanded_m_s: (2,) velocity through the air that its engines keep up.
        tau_s: time in which a difference to it fades to 1/e.
        start_m_s: (2,) velocity at time zero.

    Raises:
        ValueError: a shape that does not fit; a step or a time constant that is not positive.
    """
    if np.ndim(wind) != 2 or len(wind) < 1:
        raise ValueError(f"wind must have shape (M, 2), M at least one, got {np.shape(wind)}")
    wind = _given.rows("wind", wind, len(wind), 2)
    commanded = _given.rows("commanded_m_s", commanded_m_s, 2)
    start = _given.rows("start_m_s", start_m_s, 2)
    _given.number("step_s", step_s, 0.0, above=True)
    _given.number("tau_s", tau_s, 0.0, above=True)
    target = wind + commanded[None]

    def step(state, towards):
        velocity, displacement = state
        after = _after(velocity, displacement, towards, step_s, tau_s)
        return after, after

    begin = (start, jnp.zeros(2))
    _, (velocity, displacement) = jax.lax.scan(step, begin, target)
    velocity = jnp.concatenate([start[None], velocity])
    displacement = jnp.concatenate([jnp.zeros((1, 2)), displacement])
    return Carried(step_s, velocity, displacement, target, tau_s)


def carried_at(carried: Carried, time_s: Any) -> tuple[Array, Array, Array]:
    """Velocity [m/s], displacement [m] and acceleration [m/s^2] at instants, each (..., 2).

    Beyond the last step its wind is held. Where two steps meet the acceleration is that of the
    later one.

    Args:
        carried: from `carry`.
        time_s: (...) from zero on.

    Raises:
        ValueError: a time before zero.
    """
    at, into = _step_of(time_s, carried.step_s, len(carried.target))
    towards = carried.target[at]
    state = carried.velocity[at], carried.displacement[at]
    velocity, displacement = _after(*state, towards, into[..., None], carried.tau_s)
    return velocity, displacement, (towards - velocity) / carried.tau_s


def wind_at(wind: Any, step_s: Any, time_s: Any) -> Array:
    """The wind of (M, 2) that blows at instants (...), each step held: (..., 2).

    Beyond the last step its wind is held; where two steps meet the later one counts.

    Raises:
        ValueError: a step that is not positive, or a time before zero.
    """
    _given.number("step_s", step_s, 0.0, above=True)
    at, _ = _step_of(time_s, step_s, len(wind))
    return jnp.asarray(wind, float)[at]


def _after(velocity, displacement, towards, time, tau):
    """Velocity and displacement a time after, with the wind held; unchanged bit for bit at zero."""
    gone = -jnp.expm1(-time / tau)
    missing = towards - velocity
    return velocity + missing * gone, displacement + towards * time - missing * (tau * gone)


def _step_of(time_s: Any, step_s: Any, count: int) -> tuple[Array, Array]:
    """Number of the step an instant is in, and the time since it began."""
    _given.number("time_s", time_s, 0.0)
    time = jnp.asarray(time_s, float)
    number = jnp.clip(jnp.floor(time / step_s + _ROUNDING), 0, count - 1)
    return jnp.asarray(number, int), time - number * step_s
