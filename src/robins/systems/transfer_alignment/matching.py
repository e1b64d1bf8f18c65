"""The study "attitude-matching": one bank turn, any number of runs, one truth for all filters.

The truth is made of full rotations at a fine step: the slave's true attitude is the master's, bent
by the flexure and turned by the mounting; ideal gyro increments follow from it exactly, so that
gyros feel the flexure; with drift and noise they carry the slave's computed attitude, in the
navigation frame that the master's rate turns. Filters see only Z, from the skew part of the product
of the two attitudes. All filters work in radians and differ in what they are told: an H-infinity
filter "in degrees" with R = I and L = I is one with R = (1 deg)^2 and gamma in degrees.
"""

from __future__ import annotations

import math
import warnings
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from jaxtyping import Array

from robins import rotation, units
from robins.results import array
from robins.sim.flexure import Flexure, simulate_flexure
from robins.sim.random import Component, stream, unit
from robins.systems.judgement import judging
from robins.systems.study import Limit, Problem, SensorAxes, StateBlock
from robins.systems.transfer_alignment.attitude_matching import ATTITUDE
from robins.systems.transfer_alignment.bank_turn import (
    BankTurn,
    attitude_enu,
    load_factor,
    rate_in_enu,
    roll_rad,
)
from robins.systems.transfer_alignment.matching_claims import CLAIMS, matching_metrics
from robins.systems.transfer_alignment.matching_filters import World, contenders
from robins.systems.transfer_alignment.matching_parameters import Manoeuvre, Matching

ENU = ("east", "north", "up")
RFU = ("right", "forward", "up")
BLOCKS = (
    StateBlock("attitude", slice(0, 3), "rad", "arcmin", "ENU", ENU),
    StateBlock("gyro_bias", slice(3, 6), "rad/s", "deg/h", "RFU", RFU),
    StateBlock("mounting", slice(6, 9), "rad", "arcmin", "RFU", RFU),
)
SENSORS = {ATTITUDE: SensorAxes("rad", "ENU", ENU)}
LIMITS = (Limit("5_arcmin", "attitude", units.parse("5 arcmin", "angle")),)
LARGEST_RAD = units.parse("5 deg", "angle")  # of an error that a linear model may take


class Course(NamedTuple):
    """What all runs share; N steps of the truth, E updates."""

    step_s: float
    q_mn: np.ndarray  # (N + 1, 4) master to n
    turned_n: np.ndarray  # (N, 4) exp(omega_in dt), by how much n turns in a step
    load: np.ndarray  # (N + 1,) load factor
    q_nominal: np.ndarray  # (4,) slave to master, as drawn
    at: np.ndarray  # (E,) step at each update
    epoch_s: np.ndarray  # (E,)
    heard: np.ndarray  # (E,) bool, the master's attitude arrives


class Sizes(NamedTuple):
    """How large what a run draws is; data, so that scenarios share what was compiled."""

    attitude_error: np.ndarray  # (3,) rad, E N U
    gyro_bias: np.ndarray  # (3,) rad/s
    mounting: np.ndarray  # (3,) rad
    random_signs: np.ndarray  # () bool, of these three
    gyro_noise: np.ndarray  # () rad/sqrt(s)
    master_noise: np.ndarray  # () rad
    flutter: np.ndarray  # () rad
    flexure: Flexure


def sizes_of(given: Matching) -> Sizes:
    """From the parameters."""
    f, three = given.flexure, partial(np.asarray, dtype=float)
    return Sizes(
        attitude_error=three(given.slave.attitude_error),
        gyro_bias=three(given.slave.gyro_bias),
        mounting=three(given.mounting.error),
        random_signs=np.asarray(given.signs == "random"),
        gyro_noise=np.asarray(given.slave.gyro_noise),
        master_noise=np.asarray(given.master.attitude_noise),
        flutter=np.asarray(f.flutter),
        flexure=Flexure(
            three(f.sigma), three(f.time), three(f.damping), bending_rad_g=three(f.bending)
        ),
    )


def turn_of(m: Manoeuvre) -> BankTurn:
    """The manoeuvre."""
    return BankTurn(m.speed, m.acceleration, m.roll_time, m.turn_time, m.latitude, m.heading)


def updates_of(given: Matching) -> tuple[int, int]:
    """Number of updates of a run, and of steps of the truth in each.

    Raises:
        ValueError: the step does not divide the period, or no update would count.
    """
    every = round(given.period / given.step)
    if every < 1 or abs(every * given.step - given.period) > 1e-9 * given.period:
        raise ValueError(
            f"period = {given.period:g} s must be a whole number of truth steps of {given.step:g} s"
        )
    count = int(given.manoeuvre.duration / given.period + 1e-9)
    if count < 1 or count * given.period < given.settle - 1e-9:
        raise ValueError(
            f"settle = {given.settle:g} s leaves nothing to count of a run of "
            f"{count * given.period:g} s: shorten it or lengthen manoeuvre.duration"
        )
    return count, every


def lay_out(given: Matching) -> Course:
    """Everything that does not depend on a run, in NumPy.

    Raises:
        ValueError: see `updates_of`.
    """
    turn = turn_of(given.manoeuvre)
    count, every = updates_of(given)
    time_s = given.step * np.arange(count * every + 1)
    omega = rate_in_enu(turn, time_s[:-1] + 0.5 * given.step)
    at = every * np.arange(1, count + 1)
    heard = np.ones(count, bool)
    if given.master.outage is not None:
        begin, end = given.master.outage
        heard = (time_s[at] < begin - 1e-9) | (time_s[at] > end + 1e-9)
    return Course(
        step_s=given.step,
        q_mn=np.asarray(rotation.from_dcm(jnp.asarray(attitude_enu(turn, time_s)))),
        turned_n=np.asarray(rotation.from_rotvec(jnp.asarray(omega * given.step))),
        load=load_factor(turn, time_s),
        q_nominal=np.asarray(rotation.from_rotvec(jnp.asarray(given.mounting.nominal))),
        at=at,
        epoch_s=given.period * np.arange(1, count + 1),
        heard=heard,
    )


def simulate(course: Course, sizes: Sizes, seed: int, index: Array) -> World:
    """One run, from its number; pure."""
    key = partial(stream, seed, index)
    c, s = (jax.tree_util.tree_map(jnp.asarray, x) for x in (course, sizes))
    steps, dt = len(course.turned_n), course.step_s
    swing, flutter = (jax.random.fold_in(key(Component.FLEXURE), part) for part in range(2))
    angle, rate = simulate_flexure(s.flexure, swing, dt, steps, c.load)
    phi0, bias, mu = _initial(s, key(Component.INITIAL_STATE))

    seat = rotation.multiply(c.q_nominal, rotation.from_rotvec(mu))
    q_sn = rotation.multiply(c.q_mn, rotation.multiply(rotation.from_rotvec(angle), seat))
    # C(k+1) = exp(-omega_in dt) C(k) exp(theta), solved for what ideal gyros report
    unturned = rotation.multiply(c.turned_n, q_sn[1:])
    theta = rotation.to_rotvec(rotation.multiply(rotation.conjugate(q_sn[:-1]), unturned))
    walk = s.gyro_noise * math.sqrt(dt) * jax.random.normal(key(Component.IMU), theta.shape)
    turned_s = rotation.from_rotvec(theta + (bias * dt)[None] + walk)

    def carry(q, turned):
        n, b = turned
        q = rotation.normalise(rotation.multiply(rotation.conjugate(n), rotation.multiply(q, b)))
        return q, q

    first = rotation.multiply(rotation.from_rotvec(-phi0), q_sn[0])
    _, computed = jax.lax.scan(carry, first, (c.turned_n, turned_s))
    # C_hat = exp(-phi x) C: the whole rotation
    error = rotation.multiply(computed[c.at - 1], rotation.conjugate(q_sn[c.at]))

    # Flutter turns the slave at the update, and its gyros follow: its computed attitude has it too.
    shape = (len(course.at), 3)
    shaken = rotation.from_rotvec(s.flutter * jax.random.normal(flutter, shape))
    bent = rotation.multiply(shaken, rotation.from_rotvec(angle[c.at]))
    true_s = rotation.multiply(c.q_mn[c.at], rotation.multiply(bent, seat))
    phi_m = s.master_noise * jax.random.normal(key(unit(Component.IMU, 1)), shape)
    seen_m = rotation.multiply(rotation.from_rotvec(-phi_m), c.q_mn[c.at])
    seen_s = rotation.multiply(error, true_s)
    z = matched(seen_m, c.q_nominal, seen_s)
    return World(
        measured=jnp.where(c.heard[:, None], z, jnp.nan),
        phi=-rotation.to_rotvec(error),
        gyro_bias=bias,
        mounting=mu,
        flexure=angle[c.at],
        flexure_rate=rate[c.at],
    )


def matched(q_mn: Array, q_nominal: Array, q_sn: Array) -> Array:
    """Z, (..., 3) rad: vee of the skew part of C_mn C_nominal C_sn' (Gu & Qin 2005, eq. 6)."""
    product = rotation.multiply(rotation.multiply(q_mn, q_nominal), rotation.conjugate(q_sn))
    M = rotation.to_dcm(product)
    pairs = ((2, 1), (0, 2), (1, 0))
    return jnp.stack([0.5 * (M[..., i, j] - M[..., j, i]) for i, j in pairs], -1)


def _initial(s: Sizes, key: Array) -> tuple[Array, Array, Array]:
    """Attitude error, drift and mounting error of a run."""
    values = jnp.stack([s.attitude_error, s.gyro_bias, s.mounting])
    drawn = jax.random.rademacher(key, values.shape, float)
    values = jnp.where(s.random_signs, drawn, 1.0) * values
    return values[0], values[1], values[2]


def too_large(given: Matching) -> list[str]:
    """Errors beyond 5 deg, for which the linear model of the filters does not hold."""
    sizes = sizes_of(given)
    bend = np.abs(sizes.flexure.bending_rad_g) * (np.sqrt(10.0) - 1.0)
    named = {
        "slave.attitude_error": sizes.attitude_error,
        "mounting.error": sizes.mounting,
        "flexure": 3.0 * np.asarray(sizes.flexure.sigma_rad) + bend,
    }
    return [
        f"{name} reaches {np.degrees(np.linalg.norm(value)):.1f} deg"
        for name, value in named.items()
        if np.linalg.norm(value) > LARGEST_RAD
    ]


def matching_problem(given: Matching, filters: tuple[str, ...], seed: int) -> Problem:
    """The scenario as a problem for a campaign.

    Raises:
        ValueError: the times do not fit together, or a filter is unknown.
    """
    if large := too_large(given):
        warnings.warn(
            f"{', '.join(large)}: the filters' model is linear in these angles and good below "
            "5 deg; expect biased estimates",
            stacklevel=2,
        )
    course, sizes = lay_out(given), sizes_of(given)
    turn = turn_of(given.manoeuvre)
    count_from = int(np.searchsorted(course.epoch_s, given.settle - 1e-9))
    return Problem(
        simulate=partial(simulate, course, sizes, seed),
        contenders=contenders(given, turn, sizes.flexure, course.heard, course.epoch_s, filters),
        epoch_s=course.epoch_s,
        blocks=BLOCKS,
        sensors=SENSORS,
        context=xr.Dataset(
            array("context", roll_rad(turn, course.epoch_s), "roll", unit="rad")
            | array("context", course.load[course.at], "load_factor", unit="1")
            | array("outage", (~course.heard).astype(np.int8), long_name="no attitude")
        ),
        metrics=matching_metrics,
        claims=judging(CLAIMS, given.claims),
        count_from=count_from,
        limits=LIMITS,
    )
