"""Target attitudes of a spacecraft, with their exact rates and angular accelerations.

A reference is a motion of reference axes d, to which the body axes b are to be brought: q_id, and
omega_id and its derivative in the axes d. Turning about one axis after another keeps all three
exact, for with q_ie = q_id exp(a x) about a fixed unit axis x of d,

    omega_ie = R' omega_id + a' x,    alpha_ie = R' alpha_id - a' x  x  R' omega_id + a'' x.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from robins import _float64  # noqa: F401
from robins.filters.belief import Number
from robins.filters.values import Numbers
from robins.rotation import conjugate, from_dcm, from_rotvec, multiply, normalise, rotate
from robins.sim import _arguments
from robins.sim.orbit import OrbitStates


class Reference(NamedTuple):
    """Reference attitude, rate and angular acceleration at each epoch."""

    q_ib: Any  # (E, 4) reference body to inertial, scalar first, without jumps of sign
    omega_b: Any  # (E, 3) rate relative to inertial [rad/s], in the reference body axes
    alpha_b: Any  # (E, 3) its derivative [rad/s^2], in the reference body axes


@jax.jit
def nadir(orbit: OrbitStates) -> Reference:
    """Nadir-pointing reference: x forward, y against the orbit normal, z to the Earth's centre.

    The rate is that of any two-body orbit, -|r x v|/r^2 about y.
    """
    r, v = orbit.r_i_m, orbit.v_i_m_s
    r_sq = jnp.sum(r * r, -1)
    normal = jnp.cross(r, v)
    area = jnp.sqrt(jnp.sum(normal * normal, -1))
    z = -r / jnp.sqrt(r_sq)[:, None]
    y = -normal / area[:, None]
    q = from_dcm(jnp.stack([jnp.cross(y, z), y, z], -1))
    none = jnp.zeros_like(area)
    rate = -area / r_sq
    change = -2.0 * rate * jnp.sum(r * v, -1) / r_sq
    return Reference(
        _without_jumps(q), jnp.stack([none, rate, none], -1), jnp.stack([none, change, none], -1)
    )


def inertial(q_ib: _arguments.Listed, time_s: Numbers) -> Reference:
    """Inertially fixed reference: one attitude at all times.

    Raises:
        ValueError: not a unit quaternion.
    """
    still = jnp.zeros((len(time_s), 3))
    q = _arguments.unit_quaternion("q_ib", q_ib)
    return Reference(jnp.tile(q, (len(time_s), 1)), still, still)


def slews(
    base: Reference,
    amplitude_rad: _arguments.Listed,
    period_s: _arguments.Listed,
    time_s: Number,
    phase_rad: Number = 0.0,
    fade_in_s: float = 0.0,
) -> Reference:
    """Sinusoidal turns about x, then the new y, then the new z, on top of a reference.

    The angles are ``amplitude sin(2 pi t/period + phase)``, t from the first epoch. With
    ``fade_in_s`` they start at zero, and so do their first two derivatives: they are multiplied by
    the polynomial 10 s^3 - 15 s^4 + 6 s^5, s = t/fade_in up to 1.

    Args:
        base: reference to which the turns are added.
        amplitude_rad: (3,) or one number.
        period_s: (3,) or one number, positive.
        time_s: (E,) times of the epochs of the base.
        phase_rad: (3,) or one number.
        fade_in_s: duration of the fade-in; 0: full amplitude and rate from the first epoch.

    Raises:
        ValueError: a number is out of range, or the times do not fit the base.
    """
    amplitude = _arguments.vector("amplitude_rad", amplitude_rad, 3)
    period = _arguments.vector("period_s", period_s, 3, low=0.0, above=True)
    phase = _arguments.vector("phase_rad", phase_rad, 3)
    _arguments.number("fade_in_s", fade_in_s, 0.0)
    time = _arguments.rows("time_s", time_s, base.q_ib.shape[0])
    _arguments.number("time_s", time)
    return _slewing(base, amplitude, period, time - time[0], phase, float(fade_in_s))


@functools.partial(jax.jit, static_argnums=5)
def _slewing(base: Reference, amplitude, period, time, phase, fade_in_s: float) -> Reference:
    t = time[:, None]
    turns = (2.0 * jnp.pi / period)[None]
    sin, cos = jnp.sin(turns * t + phase[None]), jnp.cos(turns * t + phase[None])
    s, s1, s2 = _fade_in(t, fade_in_s)
    angle = s * sin
    rate = s1 * sin + s * turns * cos
    acceleration = s2 * sin + 2.0 * s1 * turns * cos - s * turns**2 * sin
    for k in range(3):
        axis = amplitude[k] * jnp.eye(3)[k][None]
        base = _rotated(base, *(x[:, k : k + 1] * axis for x in (angle, rate, acceleration)))
    return base


PEAK_RATE = 15.0 / 8.0
"""Peak rate of a rest-to-rest turn, at half-way, times its duration, over its angle."""
PEAK_ACCELERATION = 10.0 / 3.0**0.5
"""Its peak acceleration times its duration squared, over its angle."""


@jax.jit
def handover_reference(
    base: Reference,
    turn_rad: Array,
    rate_rad_s: Array,
    length_s: Number,
    time_s: Array,
) -> Reference:
    """Reference with the transition to it from another: a turn about one axis, rest to rest.

    The turn decays by 1 - s, s the polynomial 10 x^3 - 15 x^4 + 6 x^5, x = t/length (an
    eigenaxis slew, Wie 2008, sec. 7.3, by the quintic of Craig 2005, "Introduction to Robotics",
    sec. 7.3). The initial relative rate is absorbed by a second turn about its axis, by
    length (x - 6 x^3 + 8 x^4 - 3 x^5) times the rate, whose slope is 1 at the start and which is
    zero at the end. So attitude and rate are continuous, and after the transition the base is left.

    Args:
        base: the reference to reach, E epochs.
        turn_rad: (3,) rotation vector from it to the other one, at time 0.
        rate_rad_s: (3,) rate of the other one relative to it then, in the axes of the other one.
        length_s: duration of the transition [s], positive.
        time_s: (E,) time since its beginning [s].
    """
    t = time_s[:, None]
    s, s1, s2 = _from_rest_to_rest(t, length_s)
    x = jnp.clip(t / length_s, 0.0, 1.0)
    on = length_s * x * (1.0 - x**2 * (6.0 - x * (8.0 - 3.0 * x)))
    on1 = 1.0 - x**2 * (18.0 - x * (32.0 - 15.0 * x))
    on2 = -x * (36.0 - x * (96.0 - 60.0 * x)) / length_s
    base = _rotated(base, *(share * turn_rad[None] for share in (1.0 - s, -s1, -s2)))
    return _rotated(base, *(share * rate_rad_s[None] for share in (on, on1, on2)))


def _fade_in(t: Array, length_s: float) -> tuple[Number, Number, Number]:
    """A factor that grows from 0 to 1, and its first two derivatives."""
    if length_s == 0.0:
        return 1.0, 0.0, 0.0
    return _from_rest_to_rest(t, length_s)


def _from_rest_to_rest(t: Array, length_s: Number) -> tuple[Array, Array, Array]:
    """Rise from 0 to 1 over a duration, its first two derivatives 0 at both ends."""
    x = jnp.clip(t / length_s, 0.0, 1.0)
    return (
        x**3 * (10.0 - 15.0 * x + 6.0 * x**2),
        30.0 * x**2 * (1.0 - x) ** 2 / length_s,
        60.0 * x * (1.0 - x) * (1.0 - 2.0 * x) / length_s**2,
    )


def _rotated(base: Reference, angle: Array, rate: Array, acceleration: Array) -> Reference:
    """Reference followed by a turn about a fixed axis; all three (E, 3) along it."""
    turn = from_rotvec(angle)
    back = conjugate(turn)
    omega = rotate(back, base.omega_b)
    return Reference(
        normalise(multiply(base.q_ib, turn)),
        omega + rate,
        rotate(back, base.alpha_b) - jnp.cross(rate, omega) + acceleration,
    )


def _without_jumps(q: Float[Array, "epochs 4"]) -> Float[Array, "epochs 4"]:
    """Quaternions with the signs that keep each one closest to its predecessor."""
    jumps: Bool[Array, " steps"] = jnp.sum(q[1:] * q[:-1], -1) < 0.0
    sign = jnp.cumprod(jnp.where(jumps, -1.0, 1.0))
    return jnp.concatenate([q[:1], sign[:, None] * q[1:]])
