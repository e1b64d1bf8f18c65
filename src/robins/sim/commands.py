"""Motions from a list of manoeuvres, as a driver or a pilot would command them.

    motion = from_commands(
        Geodetic.from_degrees(55.0, 37.0, 150.0),
        [stand(20.0), accelerate(15.0, 8.0), turn(np.pi / 2, 0.3), climb(10.0, 20.0), stop(6.0)],
    )

Each manoeuvre changes speed, heading or height along a ramp whose rate rises, holds and falls
smoothly, with two continuous derivatives, so the joins are as smooth as the rest. Ground speed,
heading and height are commanded; the path follows. A ground vehicle points along its path, an
aircraft also banks.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from robins.earth import Geodetic
from robins.errors import require
from robins.sim.trajectory import (
    MotionProfile,
    Vehicle,
    along,
    from_velocity,
    knots_of,
    quaternion,
    smoothstep,
)

_EASE = 0.3  # share of a ramp in which its rate rises, and in which it falls
_STILL = 0.5  # m/s; a height is not changed below this ground speed


class Manoeuvre(NamedTuple):
    """One manoeuvre: the changes reached at its end, and a wave on top."""

    duration_s: float
    speed_mps: float | None = None  # ground speed at the end; None: as before
    turn_rad: float = 0.0  # change of heading, clockwise
    climb_m: float = 0.0  # change of height
    wave_heading_rad: float = 0.0  # amplitude of a sine in heading
    wave_height_m: float = 0.0  # amplitude of a sine in height
    wave_period_s: float = 1.0
    ease: float = _EASE  # see `_ramp`


def straight(duration_s: float) -> Manoeuvre:
    """Go on as before."""
    return Manoeuvre(duration_s)


stand = straight  # before the first `accelerate`, or after `stop`


def accelerate(to_mps: float, duration_s: float) -> Manoeuvre:
    """Reach a ground speed [m/s], faster or slower."""
    return Manoeuvre(duration_s, speed_mps=to_mps)


def stop(duration_s: float) -> Manoeuvre:
    """Brake to a standstill."""
    return accelerate(0.0, duration_s)


def turn(by_rad: float, rate_rad_s: float, ease_s: float = 1.0) -> Manoeuvre:
    """Turn by an angle, positive clockwise, at a rate that takes `ease_s` to build up."""
    if rate_rad_s <= 0.0 or ease_s <= 0.0:
        raise ValueError(
            f"turn: rate {rate_rad_s} rad/s, ease {ease_s} s; both must be positive, the sign of "
            "the turn is that of the angle"
        )
    hold = abs(by_rad) / rate_rad_s
    ease = min(ease_s, hold)
    return Manoeuvre(hold + ease, turn_rad=by_rad, ease=ease / (hold + ease) if hold else _EASE)


def climb(by_m: float, duration_s: float) -> Manoeuvre:
    """Change height; negative descends."""
    return Manoeuvre(duration_s, climb_m=by_m)


def weave(amplitude_rad: float, period_s: float, duration_s: float) -> Manoeuvre:
    """A sine in heading."""
    return Manoeuvre(duration_s, wave_heading_rad=amplitude_rad, wave_period_s=period_s)


def porpoise(amplitude_m: float, period_s: float, duration_s: float) -> Manoeuvre:
    """A sine in height."""
    return Manoeuvre(duration_s, wave_height_m=amplitude_m, wave_period_s=period_s)


def from_commands(
    start: Geodetic,
    commands: Sequence[Manoeuvre],
    heading_rad: float = 0.0,
    speed_mps: float = 0.0,
    vehicle: Vehicle = "ground",
    knots_hz: float = 20.0,
) -> MotionProfile:
    """Motion that follows commands from an initial position, heading and ground speed.

    Args:
        start: initial position.
        commands: the manoeuvres, in order.
        heading_rad: initial heading, clockwise from north.
        speed_mps: initial ground speed.
        vehicle: kind of vehicle; an aircraft banks.
        knots_hz: knot rate of the splines; ten a period of the fastest wave are enough.

    Raises:
        ValueError: a duration or period that is not positive, a negative speed, a change of height
            while standing, or a pole.
    """
    require(commands, "commands: the list is empty")
    for k, command in enumerate(commands):
        if not (command.duration_s > 0.0 and command.wave_period_s > 0.0):
            raise ValueError(f"command {k}, {command}: duration and period must be positive")
        if command.speed_mps is not None and command.speed_mps < 0.0:
            raise ValueError(f"command {k}, {command}: a ground speed is not negative")
    total = float(sum(c.duration_s for c in commands))
    t = knots_of(total, knots_hz)
    speed, heading = np.full_like(t, speed_mps), np.full_like(t, heading_rad)
    rate = np.zeros_like(t)  # vertical rate [m/s]
    begin, before = 0.0, speed_mps
    for k, c in enumerate(commands):
        done, done_rate = _ramp((t - begin) / c.duration_s, c.ease)
        wave, wave_rate = _wave(t - begin, c.duration_s, c.wave_period_s)
        after = before if c.speed_mps is None else c.speed_mps
        speed = np.maximum(speed + (after - before) * done, 0.0)
        heading += c.turn_rad * done + c.wave_heading_rad * wave
        climbing = c.climb_m * done_rate / c.duration_s + c.wave_height_m * wave_rate
        slow = (speed < _STILL) & (np.abs(climbing) > 1e-3)
        if slow.any():
            raise ValueError(
                f"command {k}, {c}: the height changes at {t[slow][0]:.2f} s, where the vehicle "
                "(nearly) stands still; accelerate first"
            )
        rate += climbing
        begin, before = begin + c.duration_s, after
    v_n = np.stack([speed * np.cos(heading), speed * np.sin(heading), -rate], -1)
    level = quaternion(np.zeros_like(t), np.zeros_like(t), heading)
    path = from_velocity(t, v_n, start, level)
    attitude = along(path.at(t), heading, np.arctan2(rate, speed), vehicle)
    return from_velocity(t, v_n, start, attitude)


def _ramp(u, ease):
    """A ramp from 0 to 1 over u in [0, 1], and its rate.

    The rate rises over the share `ease` as 10 s^3 - 15 s^4 + 6 s^5, holds, and falls as it rose.
    """
    rise, fall = np.clip(u / ease, 0.0, 1.0), np.clip((u - 1.0) / ease + 1.0, 0.0, 1.0)

    def area(s):
        return ease * s**4 * (2.5 - 3.0 * s + s**2)

    risen = area(rise) + np.maximum(u - ease, 0.0)
    fallen = area(fall) + np.maximum(u - 1.0, 0.0)
    top = 1.0 / (1.0 - ease)
    # Rounding must not overshoot: a speed of -1e-15 m/s would reverse the heading.
    return np.clip(top * (risen - fallen), 0.0, 1.0), top * (smoothstep(rise) - smoothstep(fall))


def _wave(t, duration, period):
    """A sine eased in and out over a period (or less), and its rate."""
    ease = min(period, 0.5 * duration)
    s = np.clip(np.minimum(t, duration - t) / ease, 0.0, 1.0)
    side = np.where(t < 0.5 * duration, 1.0, -1.0) / ease
    window, slope = smoothstep(s), 30.0 * s**2 * (1.0 - s) ** 2 * side
    phase = 2.0 * np.pi * t / period
    sine, cosine = np.sin(phase), np.cos(phase)
    return window * sine, slope * sine + 2.0 * np.pi / period * window * cosine
