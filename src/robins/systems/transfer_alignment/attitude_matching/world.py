"""The truth of an attitude matching run, one for all filters.

It uses full rotations at a fine step: the slave's true attitude is the master's, rotated by flexure
and mounting; ideal gyro increments follow from it exactly, so the gyros sense the flexure; with
drift and noise they propagate the slave's computed attitude, in the navigation frame with the
master's rate. Filters receive only Z, from the skew part of the product of the two attitudes.
"""

from __future__ import annotations

import math
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from robins import rotation
from robins.sim.flexure import Flexure, simulate_flexure
from robins.sim.random import Component, stream, unit
from robins.systems.parts import refuse_unsettled, warn_of_large_angles
from robins.systems.transfer_alignment.attitude_matching.model import (
    attitude_enu,
    load_factor,
    rate_in_enu,
)
from robins.systems.transfer_alignment.attitude_matching.parameters import AttitudeMatching


class MatchingCourse(NamedTuple):
    """Data common to all runs; N steps of the truth, E updates."""

    q_nm: np.ndarray  # (N + 1, 4) master to n
    turned_n: np.ndarray  # (N, 4) exp(omega_in dt), rotation of n in a step
    load: np.ndarray  # (N + 1,) load factor
    q_nominal: np.ndarray  # (4,) slave to master, as drawn
    at: np.ndarray  # (E,) step at each update
    epoch_s: np.ndarray  # (E,)
    received: np.ndarray  # (E,) bool, True where the master's attitude arrives


class MatchingWorld(NamedTuple):
    """One run."""

    measured: Any  # (E, 3) rad, Z; NaN where missing
    state: Any  # (E, 15) the true [phi, eps, mu, lambda, lambda']


def lay_out(given: AttitudeMatching) -> MatchingCourse:
    """Set up, in NumPy, everything that does not depend on the run.

    Warns where errors will outgrow the linear model.

    Raises:
        ValueError: the step does not divide the period, or no update falls after `settle`.
    """
    turn, every = given.manoeuvre, round(given.period / given.step)
    count = int(turn.duration / given.period + 1e-9)
    if min(every, count) < 1 or abs(every * given.step - given.period) > 1e-9 * given.period:
        raise ValueError(
            f"period = {given.period:g} s must be a whole number of truth steps of {given.step:g} "
            "s, and no longer than the run"
        )
    refuse_unsettled("settle", given.settle, count * given.period)
    bend = np.abs(given.flexure.bending) * (np.max(load_factor(turn, turn.roll_time)) - 1.0)
    warn_of_large_angles(
        {
            "slave.attitude_error": float(np.linalg.norm(given.slave.attitude_error)),
            "mounting.error": float(np.linalg.norm(given.mounting.error)),
            "flexure": float(np.linalg.norm(3.0 * np.asarray(given.flexure.sigma) + bend)),
        }
    )
    time_s = given.step * np.arange(count * every + 1)
    omega = rate_in_enu(turn, time_s[:-1] + 0.5 * given.step)
    at = every * np.arange(1, count + 1)
    received = np.ones(count, bool)
    if given.master.outage is not None:
        begin, end = given.master.outage
        received = (time_s[at] < begin - 1e-9) | (time_s[at] > end + 1e-9)
    return MatchingCourse(
        q_nm=np.asarray(rotation.from_dcm(jnp.asarray(attitude_enu(turn, time_s)))),
        turned_n=np.asarray(rotation.from_rotvec(jnp.asarray(omega * given.step))),
        load=load_factor(turn, time_s),
        q_nominal=np.asarray(rotation.from_rotvec(jnp.asarray(given.mounting.nominal))),
        at=at,
        epoch_s=given.period * np.arange(1, count + 1),
        received=received,
    )


def simulate(
    given: AttitudeMatching, course: MatchingCourse, seed: int, index: Array
) -> MatchingWorld:
    """One run, from its number; pure."""
    key = partial(stream, seed, index)
    c = jax.tree_util.tree_map(jnp.asarray, course)
    steps, dt = len(course.turned_n), given.step
    sizes = (given.slave.attitude_error, given.slave.gyro_bias, given.mounting.error)
    errors = jnp.stack([jnp.asarray(size) for size in sizes])
    if given.signs == "random":
        drawn = jax.random.rademacher(key(Component.INITIAL_STATE), errors.shape, float)
        errors = drawn * errors
    phi0, eps, mu = errors
    swing, flutter = (jax.random.fold_in(key(Component.FLEXURE), part) for part in range(2))
    f = given.flexure
    structure = Flexure(
        jnp.asarray(f.sigma), jnp.asarray(f.time), f.damping, bending_rad_g=jnp.asarray(f.bending)
    )
    angle, rate = simulate_flexure(structure, swing, dt, steps, c.load)

    # (1): the slave's mounting, and its attitude relative to the master's
    seat = rotation.multiply(c.q_nominal, rotation.from_rotvec(mu))
    q_ns = rotation.multiply(c.q_nm, rotation.multiply(rotation.from_rotvec(angle), seat))
    # C(k+1) = exp(-omega_in dt) C(k) exp(theta), solved for the increments of ideal gyros
    unturned = rotation.multiply(c.turned_n, q_ns[1:])
    theta = rotation.to_rotvec(rotation.multiply(rotation.conjugate(q_ns[:-1]), unturned))
    noise = jax.random.normal(key(Component.IMU), theta.shape)
    walk = given.slave.gyro_noise * math.sqrt(dt) * noise
    turned_s = rotation.from_rotvec(theta + (eps * dt)[None] + walk)

    def carry(q, turned):
        n, b = turned
        q = rotation.normalise(rotation.multiply(rotation.conjugate(n), rotation.multiply(q, b)))
        return q, q

    first = rotation.multiply(rotation.from_rotvec(-phi0), q_ns[0])
    _, computed = jax.lax.scan(carry, first, (c.turned_n, turned_s))
    # (2): the whole rotation
    error = rotation.multiply(computed[c.at - 1], rotation.conjugate(q_ns[c.at]))

    # Flutter rotates the slave at the update; its gyros sense it, so its computed attitude has it.
    shape = (len(course.at), 3)
    shaken = rotation.from_rotvec(f.flutter * jax.random.normal(flutter, shape))
    bent = rotation.multiply(shaken, rotation.from_rotvec(angle[c.at]))
    true_s = rotation.multiply(c.q_nm[c.at], rotation.multiply(bent, seat))
    noise = jax.random.normal(key(unit(Component.IMU, 1)), shape)
    phi_m = given.master.attitude_noise * noise
    seen_m = rotation.multiply(rotation.from_rotvec(-phi_m), c.q_nm[c.at])
    Z = matched(seen_m, c.q_nominal, rotation.multiply(error, true_s))
    constant = (jnp.broadcast_to(x, shape) for x in (eps, mu))
    phi = -rotation.to_rotvec(error)
    return MatchingWorld(
        measured=jnp.where(c.received[:, None], Z, jnp.nan),
        state=jnp.concatenate([phi, *constant, angle[c.at], rate[c.at]], axis=1),
    )


def matched(q_nm: Array, q_nominal: Array, q_ns: Array) -> Array:
    """Z, (..., 3) rad: vee of the skew part of C_nm C_nominal C_ns', eq. (6)."""
    product = rotation.multiply(rotation.multiply(q_nm, q_nominal), rotation.conjugate(q_ns))
    M = rotation.to_dcm(product)
    pairs = ((2, 1), (0, 2), (1, 0))
    return jnp.stack([0.5 * (M[..., i, j] - M[..., j, i]) for i, j in pairs], -1)
