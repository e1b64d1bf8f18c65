"""A spinning body free in space: spin, coning and their slow decay, under small random torques.

The body is symmetric about x_b, with moments of inertia Ix about it and It across. Its rates
omega_ib_b = (p, q, r) obey

    p' = -e2 p,    q' = e1 p r - e3 q,    r' = -e1 p q - e3 r,    each with white torque added,

with e1 = 1 - Ix/It. In axes d that turn about x_b at -e1 p relative to the body, the coupling
vanishes: q and r only decay and diffuse there, and omega_id_d = (p Ix/It, q_d, r_d) is the angular
momentum over It. So p with its integral, then q_d and r_d with theirs, are drawn from their joint
distribution at the end of a step, whatever its length, and the attitude turns by

    exp(int omega_id_d dt) exp(x_b e1 int p dt).

Without damping and torque this is the free precession in closed form.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from robins import _float64  # noqa: F401
from robins.filters.belief import Number
from robins.rotation import from_euler, from_rotvec, multiply, normalise
from robins.sim import _arguments


class FreeBody(NamedTuple):
    """A body symmetric about its x axis."""

    e1: Any  # 1 - Ix/It: from -1 (a disc) to below 1 (a rod)
    e2: Any  # 1/s, decay of the spin about x
    e3: Any  # 1/s, decay of the rates across


def free_body(
    key: Array, body: FreeBody, q0_nb: Any, omega0_b: Any, dt_s: Any, steps: int, torque_noise: Any
) -> tuple[Float[Array, "epochs 4"], Float[Array, "epochs 3"]]:
    """Attitude and rates at 0, dt, 2 dt ...; pure JAX, so it maps over keys.

    The rates have their exact distribution at any step. So has the attitude without torque, but
    for terms of the fifth order in dt that vanish with e2 - e3. With torque, the attitude within a
    step given the rates at both its ends is drawn to leading order, as a turn of
    ``torque_noise sqrt(dt^3/12)``. The normal numbers do not depend on step, body or torque.

    Args:
        key: of the run, `Component.TRAJECTORY` of `robins.sim.random.stream`.
        body: its three coefficients.
        q0_nb: (4,) attitude at 0, body to an inertial frame n, scalar first.
        omega0_b: (3,) rates at 0 [rad/s], body axes.
        dt_s: step [s].
        steps: number of steps.
        torque_noise: white torque over inertia, one sigma [rad/s/sqrt(s)], the same on each axis.

    Returns:
        q_nb (steps + 1, 4) and omega_ib_b (steps + 1, 3) [rad/s].

    Raises:
        ValueError: shapes that do not fit, or a number out of its range.
    """
    _arguments.count_of("steps", steps)
    _arguments.number("dt_s", dt_s, 0.0, above=True)
    _arguments.number("torque_noise", torque_noise, 0.0)
    _refuse_impossible(body)
    q0, omega0 = _arguments.rows("q0_nb", q0_nb, 4), _arguments.rows("omega0_b", omega0_b, 3)
    _arguments.number("q0_nb must be a unit quaternion: its length", jnp.sqrt(q0 @ q0), 0.99, 1.01)
    _arguments.number("omega0_b", omega0)
    q0 = normalise(q0)
    e1, e2, e3, dt, noise = (jnp.asarray(x, float) for x in (*body, dt_s, torque_noise))

    rate = jnp.stack([e2, e3, e3])
    fade = jnp.exp(-rate * dt)
    # Given both ends, the integral of a decaying process is their mean times this times dt.
    between = 2.0 * _mean_decay(rate * dt) / (1.0 + fade) * dt
    spread = noise * jnp.sqrt(dt * _mean_decay(2.0 * rate * dt))
    bridge = noise * jnp.sqrt(dt**3 / 12.0)
    inertia = jnp.ones(3).at[0].set(1.0 - e1)
    normal = jax.random.normal(key, (steps, 2, 3))

    def step(state, numbers):
        q, omega = state
        # From here to the last line: components in axes d, which start the step along the body's.
        end = fade * omega + spread * numbers[0]
        turned = between * 0.5 * (omega + end) + bridge * numbers[1]
        swing = dt**2 / 12.0 * jnp.cross(inertia * omega, inertia * end)
        spun = e1 * turned[0]
        about_x = jnp.stack([spun, jnp.zeros_like(spun), jnp.zeros_like(spun)])
        q = multiply(multiply(q, from_rotvec(inertia * turned + swing)), from_rotvec(about_x))
        sin, cos = jnp.sin(spun), jnp.cos(spun)
        omega = jnp.stack([end[0], cos * end[1] + sin * end[2], cos * end[2] - sin * end[1]])
        return (normalise(q), omega), (q, omega)

    _, (q, omega) = jax.lax.scan(step, (q0, omega0), normal)
    return (normalise(jnp.concatenate([q0[None], q])), jnp.concatenate([omega0[None], omega]))


def coning_start(
    spin_rad_s: Number,
    cone_half_angle_rad: Number,
    momentum_elevation_rad: Number,
    momentum_azimuth_rad: Number,
    body: FreeBody,
    phase_rad: Number = 0.0,
) -> tuple[Float[Array, "4"], Float[Array, "3"]]:
    """Attitude q_nb and rates of a body whose x axis cones about its angular momentum.

    Args:
        spin_rad_s: p, the rate about x_b [rad/s].
        cone_half_angle_rad: between x_b and the angular momentum.
        momentum_elevation_rad: of the angular momentum above the horizon.
        momentum_azimuth_rad: of the angular momentum, clockwise from north.
        body: its coefficients; only e1 is used.
        phase_rad: coning phase of x_b, clockwise seen along the angular momentum; zero at the
            top of the cone.

    Raises:
        ValueError: a spin that is not positive, a cone of a right angle or more, or a number out
            of its range.
    """
    quarter = 0.5 * np.pi
    _arguments.number("spin_rad_s", spin_rad_s, 0.0, above=True)
    _arguments.number("cone_half_angle_rad", cone_half_angle_rad, 0.0, 0.999 * quarter)
    _arguments.number("momentum_elevation_rad", momentum_elevation_rad, -quarter, quarter)
    _arguments.number("momentum_azimuth_rad", momentum_azimuth_rad)
    _arguments.number("phase_rad", phase_rad)
    _refuse_impossible(body)
    spin, cone, phase, e1 = (
        jnp.asarray(x, float) for x in (spin_rad_s, cone_half_angle_rad, phase_rad, body.e1)
    )
    q_nh = from_euler(phase, momentum_elevation_rad, momentum_azimuth_rad)
    # The angular momentum, along x of h, then has the components (cos, 0, sin) of the cone in b.
    q_nb = multiply(q_nh, from_euler(0.0, cone, 0.0))
    across = (1.0 - e1) * spin * jnp.tan(cone)
    return q_nb, jnp.stack([spin, jnp.zeros_like(spin), across])


def _mean_decay(x):
    """``(1 - exp(-x))/x``, the mean of exp(-x t) for t from 0 to 1, smooth at zero."""
    small = x < 1e-3
    safe = jnp.where(small, 1.0, x)
    # Dropped: x^5/720.
    series = 1.0 - x / 2.0 * (1.0 - x / 3.0 * (1.0 - x / 4.0 * (1.0 - x / 5.0)))
    return jnp.where(small, series, -jnp.expm1(-safe) / safe)


def _refuse_impossible(body: FreeBody) -> None:
    _arguments.number("e1", body.e1, -1.0, np.nextafter(1.0, 0.0))
    _arguments.number("e2", body.e2, 0.0)
    _arguments.number("e3", body.e3, 0.0)
