"""Output of an error-free IMU, in two senses.

`true_increments` integrates the true angular rate and specific force of a smooth motion by
quadrature. A mechanisation fed with them shows its discretisation error.

`ideal_increments` is the exact inversion of the mechanisation: the samples from which it returns a
given sampled trajectory, whatever its own discretisation. Sensor errors added to them are then the
only errors.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from robins.dataset import ImuTable, Trajectory
from robins.errors import require
from robins.ins.frames import swap
from robins.ins.increments import Increments, from_imu
from robins.ins.mechanise import Nav, nav_at, refuse_polar, step, step_each
from robins.linalg.library import Real
from robins.rotation import conjugate, multiply, rotate, to_rotvec
from robins.sim.trajectory import MotionProfile

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(5)


def true_increments(motion: MotionProfile, time_ns: np.ndarray) -> ImuTable:
    """Integrals of omega_ib_b [rad] and f_b [m/s] over (time[k-1], time[k]], FRD.

    Five Gauss-Legendre points an interval: errors far below rounding at the rates of an IMU. The
    interval that ends at the first time is as long as the next one; the splines reach that far
    back.
    """
    t = np.asarray(time_ns) * 1e-9
    dt = np.diff(t)
    dt = np.append(dt[:1], dt)
    nodes = (t - 0.5 * dt)[:, None] + 0.5 * dt[:, None] * _NODES
    gyro, accel = (
        0.5 * dt[:, None] * np.einsum("nkj,k->nj", x.reshape(*nodes.shape, 3), _WEIGHTS)
        for x in motion.at(nodes.reshape(-1)).rates()
    )
    return ImuTable(np.asarray(time_ns, np.int64), gyro, accel, "increment")


def ideal_increments(
    trajectory: Trajectory, tolerance: float = 1e-12, iterations: int = 50
) -> ImuTable:
    """The increment table from which `from_imu` and `mechanise` return a trajectory.

    Attitude and velocity at the samples of the trajectory are met to rounding. Position follows
    from the mechanisation and differs from the given one only by its discretisation. Every interval
    is stepped from its true start; the residuals of attitude and velocity at its end are resolved
    in body axes and added to its sample, until nothing changes. Body axes are those of the
    trajectory. The row of the first time repeats the second.

    Args:
        trajectory: sampled at the rate of the IMU, two rows at least.
        tolerance: size of a correction at which the iteration stops [rad and m/s].
        iterations: greatest number of corrections.

    Raises:
        ValueError: the trajectory is too short or near a pole, its time does not increase, or the
            body turns too far within a sample.
    """
    require(len(trajectory) >= 2, f"{len(trajectory)} row(s): an increment needs two")
    refuse_polar(trajectory.lat_rad)
    before, after = (nav_at(trajectory, rows, np) for rows in (slice(-1), slice(1, None)))
    n = len(trajectory) - 1
    gyro, accel, size = np.zeros((n, 3)), np.zeros((n, 3)), np.inf
    for _ in range(iterations):
        imu = ImuTable(
            trajectory.time_ns, _doubled(gyro), _doubled(accel), "increment", source="trajectory"
        )
        increments = from_imu(imu)[0]
        turn, push = _miss(before, after, step_each(before, increments))
        gyro, accel = gyro + turn, accel + push
        size = max(np.abs(turn).max(), np.abs(push).max())
        if size < tolerance:
            break
    else:
        raise ValueError(
            f"the inversion has not settled after {iterations} rounds (last change {size:.1e}): "
            "the body turns too far between two rows of the trajectory; sample it more densely"
        )
    gyro, accel = _doubled(gyro), _doubled(accel)
    if trajectory.body == "RFU":
        gyro, accel = swap(gyro), swap(accel)
    return ImuTable(trajectory.time_ns, gyro, accel, "increment", trajectory.body)


def increments_between(before: Nav, after: Nav, dt_s: Float[Array, "n"]) -> Increments:
    """Ideal increments that lead from each state to the next; pure JAX, so it batches.

    The inversion of one step of the mechanisation by three rounds of correction: attitude and
    velocity are met to 1e-12 for a rotation of half a degree a step, to 1e-11 for four degrees.
    `ideal_increments` does this for a whole trajectory, checks it, and returns an IMU table.

    Args:
        before: N states in NED/FRD, leading axis.
        after: the states `dt_s` later; their positions are not met.
        dt_s: (N,) intervals [s].
    """

    def nearer(_, increments: Increments) -> Increments:
        turn, push = _miss(before, after, jax.vmap(step)(before, increments))
        return increments._replace(theta=increments.theta + turn, dv=increments.dv + push)

    zero = jnp.zeros((*dt_s.shape, 3))
    return jax.lax.fori_loop(0, 3, nearer, Increments(dt_s, zero, zero))


def _doubled(a: np.ndarray) -> np.ndarray:
    return np.concatenate([a[:1], a])


def _miss(before: Nav, after: Nav, reached: Nav) -> tuple[Float[Real, "n 3"], Float[Real, "n 3"]]:
    """Residual rotation [rad] and velocity [m/s] of each step, body axes."""
    turn = to_rotvec(multiply(conjugate(reached.q_nb.wxyz), after.q_nb.wxyz))
    return turn, rotate(conjugate(before.q_nb.wxyz), after.v_n - reached.v_n)
