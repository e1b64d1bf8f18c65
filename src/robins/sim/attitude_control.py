"""Attitude control by reaction wheels, and their desaturation by magnetorquers.

The control law is quaternion feedback with the known torques fed forward (Wie 2008, "Space Vehicle
Dynamics and Control", sec. 7.3). With theta_e the rotation vector of q_ref^-1 q, and w_e the rate
relative to the reference,

    u = J (alpha_r - wn^2 theta_e - 2 zeta wn w_e) + w x (J w + W h),

everything in body axes, where alpha_r is the derivative of the reference's rate taken in body axes.
With exact knowledge, an error about one axis obeys theta'' + 2 zeta wn theta' + wn^2 theta = 0
exactly, however the reference moves.

The wheels supply the torque that the magnetorquers do not, ``tau = pinv(W) (u - m x B)``, of least
norm; the magnetorquers' command is ``m = k (h x B)/B^2``, whose torque is -k times the component of
the wheels' momentum h across the field (Wertz 1978, sec. 19.3).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from robins import _float64  # noqa: F401
from robins.filters.belief import Number
from robins.linalg import scalars as u
from robins.rotation import conjugate, multiply, rotate, to_rotvec
from robins.sim import _arguments

_ENOUGH = 1e-6  # least determinant of W W' for unit axes that span space


class Controller(NamedTuple):
    """Plant model and gains of the controller; made and checked by `controller`."""

    inertia_b: Any  # (3, 3) kg m2
    wn: Any  # rad/s, natural frequency of the attitude loop
    zeta: Any  # its damping
    desaturation_k: Any  # 1/s


def controller(
    inertia_b: _arguments.Listed, wn: float = 0.12, zeta: float = 0.9, desaturation_k: float = 2e-3
) -> Controller:
    """Make a `Controller` after checking its numbers.

    Raises:
        ValueError: an inertia that is not of shape (3, 3) and finite, or a gain that is negative.
    """
    J = _arguments.rows("inertia_b", inertia_b, 3, 3)
    _arguments.number("inertia_b", J)
    _arguments.number("wn", wn, 0.0, above=True)
    _arguments.number("zeta", zeta, 0.0)
    _arguments.number("desaturation_k", desaturation_k, 0.0)
    gains = (jnp.asarray(x, float) for x in (wn, zeta, desaturation_k))
    return Controller(J, *gains)


def torque(
    controller: Controller,
    q_est: Float[Array, "4"],
    omega_est_b: Float[Array, "3"],
    q_ref: Float[Array, "4"],
    omega_ref_b: Float[Array, "3"],
    alpha_ref_b: Float[Array, "3"],
    wheel_momentum_b: Float[Array, "3"],
) -> Float[Array, "3"]:
    """Commanded torque on the body [N m], body axes.

    Args:
        controller: gains and inertia.
        q_est: estimated attitude, body to inertial.
        omega_est_b: estimated omega_ib_b [rad/s].
        q_ref: reference attitude, body to inertial.
        omega_ref_b: reference rate [rad/s], in the reference body axes.
        alpha_ref_b: its derivative [rad/s^2], in the reference body axes.
        wheel_momentum_b: W h, from the speeds of the wheels [N m s].
    """
    J, wn = controller.inertia_b, controller.wn
    error = multiply(conjugate(q_ref), q_est)  # from the body axes to those of the reference
    back = conjugate(error)
    omega_ref = rotate(back, omega_ref_b)
    omega_error = omega_est_b - omega_ref
    alpha_ref = rotate(back, alpha_ref_b) - jnp.cross(omega_error, omega_ref)
    wanted = alpha_ref - wn**2 * to_rotvec(error) - 2.0 * controller.zeta * wn * omega_error
    momentum = _times(J, omega_est_b) + wheel_momentum_b
    return _times(J, wanted) + jnp.cross(omega_est_b, momentum)


def allocate(pinv: Float[Array, "w 3"], torque_b: Float[Array, "3"]) -> Float[Array, "w"]:
    """Wheel torques [N m] that sum to ``torque_b``, the torque not given by magnetorquers."""
    return _times(pinv, torque_b)


def allocate_within(
    wheel_axes_b: Float[Array, "3 w"],
    pinv: Float[Array, "w 3"],
    torque_b: Float[Array, "3"],
    wheel_h: Float[Array, "w"],
    momentum_limit: Float[Array, "w"],
) -> Float[Array, "w"]:
    """`allocate`, with the share of saturated wheels redistributed to the others.

    If the others do not span three axes, the plain allocation stands, and the torque of the
    saturated wheel is missing.

    Args:
        wheel_axes_b: (3, W) unit columns.
        pinv: (W, 3) of `allocation_matrix`; a wheel with a row of zeros is not used.
        torque_b: commanded torque on the body [N m].
        wheel_h: (W,) momenta of the wheels along their axes [N m s].
        momentum_limit: (W,) greatest momentum, either way [N m s].
    """
    plain = allocate(pinv, torque_b)
    full = jnp.abs(wheel_h) >= momentum_limit * (1.0 - 1e-9)
    used = jnp.any(pinv != 0.0, axis=1)
    demanded, free = plain, used
    for _ in range(max(pinv.shape[0] - 3, 0)):  # as many as may be left out
        free = free & ~(full & (demanded * wheel_h < 0.0))  # its torque is -h'
        A = jnp.where(free[None, :], wheel_axes_b, 0.0)
        G = u.matrix(jnp.sum(A[:, None, :] * A[None, :, :], -1))
        size = u.dot(G[0], u.cross(G[1], G[2]))  # determinant
        enough = size > _ENOUGH
        safe = tuple(
            tuple(jnp.where(enough, G[i][j], float(i == j)) for j in range(3)) for i in range(3)
        )
        shared = jnp.stack(u.apply(u.symmetric_inverse(safe), u.scalars(torque_b)))
        demanded = jnp.where(enough, jnp.sum(A * shared[:, None], 0), plain)
    return jnp.where(jnp.any(free != used), demanded, plain)


def allocation_matrix(
    wheel_axes_b: _arguments.Listed, works: _arguments.Listed = 1.0
) -> np.ndarray:
    """Least-norm allocation matrix (W, 3) of a body torque to the wheels that work.

    Args:
        wheel_axes_b: (3, W) unit columns.
        works: (W,) 1, or 0 for a failed wheel, which is given no torque.

    Raises:
        ValueError: the working wheels do not span three independent axes.
    """
    axes = np.asarray(wheel_axes_b, float)
    if axes.ndim != 2 or axes.shape[0] != 3:
        raise ValueError(f"wheel_axes_b must have shape (3, W), got {axes.shape}")
    there = np.asarray(_arguments.vector("works", works, axes.shape[1], low=0.0, high=1.0))
    left = axes * there
    rank = np.linalg.matrix_rank(left, tol=1e-6) if left.size else 0
    if rank < 3:
        working = np.flatnonzero(there).tolist()
        raise ValueError(
            f"wheels {working} of {axes.shape[1]} give torque about {rank} independent axes, and "
            "three are needed: a body with fewer cannot be held by wheels alone"
        )
    return np.linalg.pinv(left) * there[:, None]  # exactly zero for a failed wheel


def desaturation_dipole(
    k: Number,
    momentum_b: Float[Array, "3"],
    field_b_t: Float[Array, "3"],
    limit_a_m2: Float[Array, "3"],
) -> Float[Array, "3"]:
    """Dipole [A m2], body axes, whose torque removes the wheels' momentum across the field.

    Beyond a limit the whole vector is scaled, so that the torque stays opposite to the momentum.
    Zero where there is no field.

    Args:
        k: desaturation gain [1/s].
        momentum_b: W h, momentum of the wheels in body axes [N m s].
        field_b_t: magnetic field [T], body axes.
        limit_a_m2: (3,) greatest dipole of each axis [A m2].
    """
    size = jnp.sum(field_b_t * field_b_t)
    there = size > 0.0
    dipole = k * jnp.cross(momentum_b, field_b_t) / jnp.where(there, size, 1.0)
    demanded = jnp.abs(dipole)
    over = demanded > limit_a_m2
    share = jnp.where(over, limit_a_m2 / jnp.where(over, demanded, 1.0), 1.0)
    return jnp.min(share) * dipole


def _times(m, v) -> Array:
    return jnp.sum(m * v[None, :], -1)
