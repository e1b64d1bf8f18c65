"""A rigid spacecraft with reaction wheels and magnetorquers.

With J the inertia, the columns of W the axes of the wheels, h their momenta along these and w the
rate omega_ib_b, the total angular momentum in body axes is J w + W h, and

    J w' = T + W tau - w x (J w + W h),    h' = -tau,    q' = 1/2 q (0, w),
    T = 3 mu/r^5 (r_b x J r_b) + (m_residual + m) x B_b + disturbance

(Wertz 1978, "Spacecraft Attitude Determination and Control", sec. 16.2 and 17.1). The state is not
w but the total angular momentum in *inertial* axes, H = R(q) (J w + W h), of which

    H' = R(q) T,    w = J^-1 (R(q)^T H - W h):

the wheel torque cancels, so that the wheels cannot change H, not even by rounding.

A step turns by Cayley's map, q = q0 (1, g)/sqrt(1 + g^2), whose rate is a polynomial,
``g' = (w + g x w + g (g w))/2``; (g, H) is integrated by the classical Runge-Kutta method of order
four (a Munthe-Kaas method: Hairer, Lubich & Wanner 2006, "Geometric Numerical Integration", sec.
IV.8). So |q| = 1 without a projection, and the order is four in q and in H, with position, field
and commands constant over a step. The rotation in a step must be much less than half a turn.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from robins import _float64  # noqa: F401
from robins.earth.wgs84 import GM
from robins.errors import require
from robins.filters.belief import Number
from robins.linalg import scalars as u
from robins.rotation import conjugate, rotate
from robins.sim import _arguments


class Spacecraft(NamedTuple):
    """Parameters of a spacecraft; made and checked by `spacecraft`."""

    inertia_b: Any  # (3, 3) kg m2, of the whole craft, wheels at rest included
    wheel_axes_b: Any  # (3, W) unit columns
    wheel_torque_limit: Any  # (W,) N m
    wheel_momentum_limit: Any  # (W,) N m s
    dipole_limit_a_m2: Any  # (3,) of the magnetorquers
    residual_dipole_b: Any  # (3,) A m2, of everything else on board
    wheel_works: Any  # (W,) 1, or 0 for a failed wheel


class CraftState(NamedTuple):
    """State of motion: attitude, angular momentum of the craft, momenta of the wheels."""

    q_ib: Any  # (4,) body to inertial, scalar first
    momentum_i: Any  # (3,) N m s, total angular momentum in inertial axes
    wheel_h: Any  # (W,) N m s, momenta of the wheels along their axes


def spacecraft(
    inertia_b: _arguments.Listed,
    wheel_axes_b: _arguments.Listed,
    wheel_torque_limit: _arguments.Listed,
    wheel_momentum_limit: _arguments.Listed,
    dipole_limit_a_m2: _arguments.Listed,
    residual_dipole_b: _arguments.Listed = 0.0,
    wheel_works: _arguments.Listed = 1.0,
) -> Spacecraft:
    """Make a `Spacecraft` after checking its numbers; one number stands for all wheels or axes.

    Args:
        inertia_b: (3, 3) moments of inertia [kg m2].
        wheel_axes_b: (3, W) unit columns; W = 0 for a craft without wheels.
        wheel_torque_limit: (W,) greatest torque of a wheel, either way [N m].
        wheel_momentum_limit: (W,) greatest momentum of a wheel, either way [N m s].
        dipole_limit_a_m2: (3,) greatest dipole of the magnetorquer of each axis, either way.
        residual_dipole_b: (3,) dipole of everything else on board [A m2].
        wheel_works: (W,) 1, or 0 for a wheel that gives no torque.

    Raises:
        ValueError: no rigid body has this inertia, an axis is not of unit length, a number is out
            of its range, or a shape is wrong.
    """
    axes = np.asarray(wheel_axes_b, float)
    if axes.ndim != 2 or axes.shape[0] != 3:
        raise ValueError(
            f"wheel_axes_b has shape {axes.shape}: it must be (3, W), a column for each wheel"
        )
    length = np.sqrt(np.sum(axes**2, 0))
    for k in np.flatnonzero(~(np.abs(length - 1.0) <= 1e-9)):
        raise ValueError(
            f"wheel_axes_b: the column of wheel {k}, {axes[:, k]}, has length {length[k]:.9g}; "
            "axes have length one"
        )
    wheels = axes.shape[1]
    works = _arguments.vector("wheel_works", wheel_works, wheels, low=0.0, high=1.0)
    if not np.all(np.isin(works, (0.0, 1.0))):
        raise ValueError(f"wheel_works must be 0 or 1 for each wheel, got {wheel_works}")
    return Spacecraft(
        jnp.asarray(_inertia(inertia_b)),
        jnp.asarray(axes),
        _arguments.vector("wheel_torque_limit", wheel_torque_limit, wheels, low=0.0),
        _arguments.vector("wheel_momentum_limit", wheel_momentum_limit, wheels, low=0.0),
        _arguments.vector("dipole_limit_a_m2", dipole_limit_a_m2, 3, low=0.0),
        _arguments.vector("residual_dipole_b", residual_dipole_b, 3),
        works,
    )


def _inertia(inertia_b: Number) -> np.ndarray:
    J = np.asarray(inertia_b, float)
    if J.shape != (3, 3) or not np.all(np.isfinite(J)):
        raise ValueError(f"inertia_b must be a finite matrix (3, 3), got\n{J}")
    if not np.allclose(J, J.T, rtol=0.0, atol=1e-12 * np.max(np.abs(J))):
        raise ValueError(f"inertia_b must be symmetric, got\n{J}")
    J = 0.5 * (J + J.T)
    low, middle, high = moments = np.linalg.eigvalsh(J)
    require(low > 0.0, f"inertia_b must be positive definite; its principal moments: {moments}")
    if low + middle < high * (1.0 - 1e-12):
        raise ValueError(
            f"inertia_b has principal moments {moments}: in a rigid body none is greater than the "
            "sum of the others; are the products of inertia of the right sign?"
        )
    return J


def craft_state(
    craft: Spacecraft,
    q_ib: _arguments.Listed,
    omega_b: _arguments.Listed,
    wheel_h: _arguments.Listed = 0.0,
) -> CraftState:
    """State with a given attitude, rate omega_ib_b [rad/s] and momenta of the wheels [N m s].

    Raises:
        ValueError: shapes that do not fit, or a quaternion that is not of unit length.
    """
    q, omega = _arguments.unit_quaternion("q_ib", q_ib), _arguments.rows("omega_b", omega_b, 3)
    _arguments.number("omega_b", omega)
    h = _arguments.vector("wheel_h", wheel_h, craft.wheel_axes_b.shape[1])
    total = _times(craft.inertia_b, omega) + wheel_momentum_b(craft, h)
    return CraftState(q, rotate(q, total), h)


def wheel_momentum_b(craft: Spacecraft, wheel_h: Float[Array, "w"]) -> Float[Array, "3"]:
    """W h, the momentum of all wheels in body axes [N m s]."""
    return _times(craft.wheel_axes_b, wheel_h)


def rate_b(craft: Spacecraft, state: CraftState) -> Float[Array, "3"]:
    """The rate omega_ib_b [rad/s]."""
    total = rotate(conjugate(state.q_ib), state.momentum_i)
    left = u.scalars(total - wheel_momentum_b(craft, state.wheel_h))
    return jnp.stack(u.apply(u.symmetric_inverse(u.matrix(craft.inertia_b)), left))


def gravity_gradient(J: u.Matrix, r: u.Three) -> u.Three:
    """Gravity-gradient torque [N m] on a body of inertia J at r from the Earth's centre, body axes.

    3 mu/r^5 (r x J r), for a body small compared with its distance (Wertz 1978, eq. 17-31). Zero
    at r = 0, which stands for no Earth.
    """
    sq = u.dot(r, r)
    none = sq == 0.0
    safe = jnp.where(none, 1.0, sq)
    strength = jnp.where(none, 0.0, 3.0 * GM / (safe * safe * jnp.sqrt(safe)))
    return u.times(strength, u.cross(r, u.apply(J, r)))


def advance(
    craft: Spacecraft,
    state: CraftState,
    wheel_torque: Float[Array, "w"],
    dipole_b: Float[Array, "3"],
    r_i_m: Float[Array, "3"],
    field_i_t: Float[Array, "3"],
    disturbance_b: Float[Array, "3"],
    dt_s: Number,
) -> CraftState:
    """Advance the state by one step.

    A wheel gives no more than its torque limit, none if it has failed, and none towards a momentum
    limit it has reached; it reaches the limit exactly, by the constant torque that brings it there
    in this step. The magnetorquers give no more than their limit in each axis.

    Args:
        craft: parameters.
        state: state at the beginning of the step.
        wheel_torque: (W,) commanded torque of the wheels on the body, constant over the step [N m].
        dipole_b: (3,) commanded dipole of the magnetorquers, constant over the step [A m2].
        r_i_m: (3,) position from the Earth's centre [m], inertial axes, at or near the middle of
            the step. Zeros: no gravity gradient.
        field_i_t: (3,) magnetic field there [T], inertial axes.
        disturbance_b: (3,) any other torque [N m], body axes.
        dt_s: length of the step [s].
    """
    acts = wheel_torque, dipole_b, r_i_m, field_i_t, disturbance_b
    turn = dynamics(craft, state, *acts, dt_s)
    return CraftState(kinematics(state.q_ib, turn.gibbs_b), turn.momentum_i, turn.wheel_h)


class TurnDynamics(NamedTuple):
    """Result of `dynamics` over a step."""

    gibbs_b: Any  # (3,) tangent of half the turn along its axis, body axes, as three scalars
    momentum_i: Any  # (3,) N m s, total angular momentum after it, inertial axes
    wheel_h: Any  # (W,) N m s, momenta of the wheels after it


def dynamics(
    craft: Spacecraft,
    state: CraftState,
    wheel_torque: Float[Array, "w"],
    dipole_b: Float[Array, "3"],
    r_i_m: Float[Array, "3"],
    field_i_t: Float[Array, "3"],
    disturbance_b: Float[Array, "3"],
    dt_s: Number,
) -> TurnDynamics:
    """First half of `advance`, with the same arguments: the turn and the momenta of a step.

    `kinematics` is the other half. The torques of a step depend on the attitude at its beginning
    and on the turn since, so the attitude after it is not needed here.
    """
    h0, h1 = state.wheel_h, wheel_momenta_after(craft, state.wheel_h, wheel_torque, dt_s)
    W = u.matrix(craft.wheel_axes_b)
    held, gained = u.apply(W, u.scalars(h0)), u.apply(W, u.scalars(h1 - h0))
    J = u.matrix(craft.inertia_b)
    J_inv = u.symmetric_inverse(J)
    limit = craft.dipole_limit_a_m2
    dipole = u.scalars(craft.residual_dipole_b + jnp.clip(dipole_b, -limit, limit))
    other = u.scalars(disturbance_b)

    # Within the step all components are in axes 0, the body axes at its beginning.
    C = u.dcm(u.scalars(state.q_ib))
    to_0 = u.transposed(C)
    total, place, field = u.behind_barrier(
        *(u.apply(to_0, u.scalars(v)) for v in (state.momentum_i, r_i_m, field_i_t))
    )

    def slope(y, share):
        """Rates of (g, H - H0) in axes 0, a share of the step after its beginning."""
        g, added = y[:3], y[3:]
        momentum, r_b, field_b = u.behind_barrier(
            *(_rotated(g, v, -1.0) for v in (u.plus(total, added), place, field))
        )
        wheels = u.plus(held, u.times(share, gained))
        torque = u.plus(gravity_gradient(J, r_b), u.cross(dipole, field_b), other)
        omega, torque = u.behind_barrier(u.apply(J_inv, u.minus(momentum, wheels)), torque)
        along = u.plus(omega, u.cross(g, omega), u.times(u.dot(g, omega), g))
        (rate,) = u.behind_barrier((*u.times(0.5, along), *_rotated(g, torque, 1.0)))
        return rate

    k1 = slope((0.0,) * 6, 0.0)
    k2 = slope(u.times(0.5 * dt_s, k1), 0.5)
    k3 = slope(u.times(0.5 * dt_s, k2), 0.5)
    k4 = slope(u.times(dt_s, k3), 1.0)
    step = u.times(dt_s / 6.0, u.plus(k1, u.times(2.0, u.plus(k2, k3)), k4))
    return TurnDynamics(step[:3], state.momentum_i + jnp.stack(u.apply(C, step[3:])), h1)


def kinematics(q_ib: Float[Array, "4"], gibbs_b: Iterable[Array]) -> Float[Array, "4"]:
    """Attitude after a turn, from that before it.

    Args:
        q_ib: before, body to inertial, scalar first.
        gibbs_b: (3,) of the turn, as `TurnDynamics` has it.
    """
    q = jnp.stack(u.product(u.scalars(q_ib), (1.0, *gibbs_b)))
    return q / jnp.sqrt(jnp.sum(q * q))


def wheel_torques(craft: Spacecraft, wheel_torque: Float[Array, "w"]) -> Float[Array, "w"]:
    """Wheel torques [N m] for a command within the torque limits; momentum limits not applied."""
    most = craft.wheel_torque_limit
    return craft.wheel_works * jnp.clip(wheel_torque, -most, most)


def wheel_momenta_after(
    craft: Spacecraft, wheel_h: Float[Array, "w"], wheel_torque: Float[Array, "w"], dt_s: Number
) -> Float[Array, "w"]:
    """Momenta of the wheels [N m s] after a step under a commanded torque [N m]."""
    # A wheel whose initial momentum is above its limit may slow down, but does not jump to it.
    room = jnp.maximum(craft.wheel_momentum_limit, jnp.abs(wheel_h))
    return jnp.clip(wheel_h - dt_s * wheel_torques(craft, wheel_torque), -room, room)


def _rotated(g: u.Three, v: u.Three, sign: float) -> u.Three:
    """``R(q) v``, or its inverse for a sign of -1, of the quaternion (1, g)/sqrt(1 + g^2)."""
    across = u.times(sign, u.cross(g, v))
    twice = 2.0 / (1.0 + u.dot(g, g))
    return u.plus(v, u.times(twice, u.plus(across, u.times(sign, u.cross(g, across)))))


def _times(m, v) -> Array:
    return jnp.sum(m * v[None, :], -1)
