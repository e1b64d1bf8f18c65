"""Flexure between two inertial units: a wing that vibrates, and bends under load.

Three small angles lambda of the slave's mounting relative to the master's. Each axis is an
independent damped oscillator driven by noise (second-order Gauss-Markov),

    l'' + 2 zeta wn l' + wn^2 l = q,      wn = 2.146 / tau

the model of transfer alignment since Kain & Cloutier (1989), there with zeta = 1, where its
correlation falls to 1/e at tau. Its stationary covariance is sigma^2 diag(1, wn^2) for every zeta.
Bending is quasi-static: radians per g of load factor above one, that of level flight.

An angle that is white from sample to sample (flutter above the sampling rate) has no rate that a
gyro could sense; it belongs in the noise of the attitude matching, not here.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from robins import _float64, linalg  # noqa: F401
from robins.errors import require

_WN_TAU = 2.146  # (1 + x) exp(-x) = 1/e


class Flexure(NamedTuple):
    """Motion of a structure, by axis."""

    sigma_rad: Any  # (3,) stationary standard deviation; 0: stiff
    tau_s: Any  # (3,) correlation time
    damping: Any = 1.0  # zeta
    tail_dof: float | None = None  # above 2: driven by Student's t of the same variance
    bending_rad_g: Any = (0.0, 0.0, 0.0)  # (3,) angle per g of load factor above one


def transition(
    sigma: ArrayLike, tau_s: ArrayLike, damping: ArrayLike, dt_s: ArrayLike
) -> tuple[Float[Array, "2 2"], Float[Array, "2 2"]]:
    """Exact step of (angle, rate) of one axis: Phi, and the factor L of Q = L L'.

    Args:
        sigma: standard deviation of the angle, in any unit; the rate is in that unit per second.
        tau_s: correlation time [s], positive.
        damping: zeta, positive.
        dt_s: step [s].
    """
    sigma, tau, zeta, dt = (jnp.asarray(x, float) for x in (sigma, tau_s, damping, dt_s))
    wn = _WN_TAU / tau
    # in the time wn t and the state (l, l'/wn), whose covariance is sigma^2 I
    zero, one = jnp.zeros(()), jnp.ones(())
    A = jnp.stack([jnp.stack([zero, one]), jnp.stack([-one, -2.0 * zeta])])
    Qc = jnp.stack([jnp.zeros(2), jnp.stack([zero, 4.0 * zeta])])
    Phi, Q = linalg.van_loan(A, Qc, wn * dt)
    scale = jnp.stack([one, wn])
    L = sigma * scale[:, None] * linalg.cholesky(Q)
    return Phi * scale[:, None] / scale[None], L


def swing(flexure: Flexure, dt_s: ArrayLike) -> tuple[Float[Array, "6 6"], Float[Array, "6 6"]]:
    """Exact step of the angles and then the rates of all axes: Phi and the factor L of Q = L L'."""
    given = (flexure.sigma_rad, flexure.tau_s, flexure.damping)
    three = [jnp.broadcast_to(jnp.asarray(x, float), 3) for x in given]
    axes = jax.vmap(partial(transition, dt_s=dt_s))(*three)
    Phi, L = (jnp.einsum("aij,ab->iajb", x, jnp.eye(3)).reshape(6, 6) for x in axes)
    return Phi, L


def stationary_sigma(flexure: Flexure) -> np.ndarray:
    """Standard deviations (6,) of the angles and then the rates, without correlations."""
    given = (flexure.sigma_rad, flexure.tau_s)
    sigma, tau = (np.broadcast_to(np.asarray(x, float), 3) for x in given)
    return np.concatenate([sigma, sigma * _WN_TAU / tau])


def simulate_flexure(
    model: Flexure,
    key: Array,
    dt_s: float,
    count: int,
    load_factor: Float[Array, "_"] | None = None,
) -> tuple[Array, Array]:
    """Angles and their rates at 0, dt, ... count dt; pure, for any number of runs under `vmap`.

    The vibration starts in its stationary state.

    Args:
        model: the structure.
        key: of the run, from `robins.sim.random.stream`.
        dt_s: step [s].
        count: number of steps.
        load_factor: (count + 1,) specific force over g; by default one, as in level flight.

    Returns:
        (count + 1, 3) rad and (count + 1, 3) rad/s.

    Raises:
        ValueError: no step, degrees of freedom of 2 or fewer, or a load factor of another length.
    """
    _check(model, count, load_factor)
    sigma, tau, bending = (jnp.asarray(x, float) for x in (model[0], model[1], model[4]))
    Phi, L = jax.vmap(partial(transition, damping=model.damping, dt_s=dt_s))(sigma, tau)
    begin, drive, tail = jax.random.split(key, 3)
    first = jax.random.normal(begin, (3, 2)) * sigma[:, None]
    first = first * jnp.stack([jnp.ones(3), _WN_TAU / tau], 1)
    normal = jax.random.normal(drive, (count, 3, 2))
    if model.tail_dof is not None:
        dof = float(model.tail_dof)
        power = jax.random.chisquare(tail, dof, (count, 3))
        normal = normal * jnp.sqrt((dof - 2.0) / power)[..., None]

    def step(x, w):
        x = jnp.sum(Phi * x[:, None], 2) + jnp.sum(L * w[:, None], 2)
        return x, x

    _, rest = jax.lax.scan(step, first, normal)
    swing = jnp.concatenate([first[None], rest])
    angle, rate = swing[..., 0], swing[..., 1]
    if load_factor is not None:
        load = jnp.asarray(load_factor, float)
        angle = angle + (load - 1.0)[:, None] * bending[None]
        slope = jnp.asarray(jnp.gradient(load, dt_s))
        rate = rate + slope[:, None] * bending[None]
    return angle, rate


def _check(model: Flexure, count: int, load_factor: ArrayLike | None) -> None:
    require(count >= 1, f"flexure: count is {count}; at least one step is wanted")
    if model.tail_dof is not None and not model.tail_dof > 2.0:
        raise ValueError(
            f"flexure: tail_dof is {model.tail_dof}; Student's t has a variance above 2 only"
        )
    if load_factor is not None and jnp.shape(load_factor) != (count + 1,):
        raise ValueError(
            f"flexure: load_factor has shape {jnp.shape(load_factor)}, {count} steps need "
            f"({count + 1},)"
        )
