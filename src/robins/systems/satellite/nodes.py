"""The parts of the loop, each a pure function of what reaches it.

    belief, gyro --acm--> torque, dipole --plant--> attitude --gyro, star--> samples

Each is what a process of the test bench runs, and `react` strings them together for a run inside
one program.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from robins import linalg
from robins.filters import Belief, Reading
from robins.rotation import BodyRotation, conjugate, from_rotvec, multiply, rotate, to_rotvec
from robins.sim.attitude_control import Controller, allocate_within, desaturation_dipole, torque
from robins.sim.gyro import read_gyro
from robins.sim.spacecraft import CraftState, Spacecraft, advance, rate_b, wheel_momentum_b
from robins.sim.star_sensor import measure_attitude, read_star
from robins.systems.satellite.course import Lens, Step

STAR = "star"
UNIT = 1e-3  # that the length of a quaternion may be off by


class Command(NamedTuple):
    """What control asks of the actuators."""

    wheel_torque: Array  # (W,) N m
    dipole_b: Array  # (3,) A m^2


class Given(NamedTuple):
    """Numbers of the loop that stay the same."""

    craft: Spacecraft
    control: Controller
    pinv: Array  # (W, 3)
    step_s: Array  # ()
    quantum_rad: Array  # () of the gyro
    gyro_matrix: Array  # (3, 3)
    star_key: Array
    lens: Lens | None = None  # where the star sensor is a camera


class Row(NamedTuple):
    """What drives a step from outside."""

    course: Step
    gyro_angle: Array  # (3,) rad
    gyro_bias: Array  # (3,) rad/s
    star_error: Array  # (3,) rad


class Frame(NamedTuple):
    """What the star sensor reports."""

    q_ib: Array  # (4,); NaN without a frame
    factor: Array | None  # (3, 3) of its covariance [rad], body axes, where it says one
    seen_q_ib: Array  # (4,) for the next time


class Vehicle(NamedTuple):
    """State of the vehicle with its gyro."""

    craft: CraftState
    residue: Array  # (3,) rad, what the gyro has not reported yet
    theta: Array  # (3,) rad, what it reported last
    star_q_ib: Array  # (4,) what the star sensor saw last


def acm(given: Given, q_ib: Array, bias: Array, theta: Array, wheel_h: Array, row: Step) -> Command:
    """Attitude control: from the estimate, the last sample of the gyro and the wheels' speeds.

    The rate is that of the gyro less the estimated bias; the field is that of its model, turned
    into body axes by the estimate.
    """
    held = wheel_momentum_b(given.craft, wheel_h)
    field_b = rotate(conjugate(q_ib), row.field_i_t)
    omega = theta / given.step_s - bias
    wanted = torque(
        given.control, q_ib, omega, row.ref_q_ib, row.ref_omega_b, row.ref_alpha_b, held
    )
    k, limit = given.control.desaturation_k, given.craft.dipole_limit_a_m2
    dipole = desaturation_dipole(k, held, field_b, limit)
    left = wanted - jnp.cross(dipole, field_b)
    most = given.craft.wheel_momentum_limit
    wheels = allocate_within(given.craft.wheel_axes_b, given.pinv, left, wheel_h, most)
    return Command(wheels, dipole)


def plant(given: Given, state: CraftState, command: Command, row: Step) -> CraftState:
    """The craft one step on."""
    return advance(
        given.craft._replace(wheel_works=row.wheel_works),
        state,
        command.wheel_torque,
        command.dipole_b,
        row.r_i_m,
        row.field_i_t,
        row.disturbance_b,
        given.step_s,
    )


def gyro(given: Given, before: Array, after: Array, residue: Array, row: Row):
    """What the gyro reports of a turn (3,), and what is left for the next sample."""
    turned = to_rotvec(multiply(conjugate(before), after))
    return read_gyro(turned, row.gyro_angle, given.gyro_matrix, residue, given.quantum_rad)


def star(given: Given, q_ib: Array, expected_q_ib: Array, before: Array, row: Row) -> Frame:
    """What the star sensor reports at the end of a step."""
    says = row.course.star
    if given.lens is None:
        now, factor = read_star(q_ib, row.star_error), None
    else:
        looks = partial(_looks, given.lens, given.star_key)
        now, factor = jax.lax.cond(
            says.seen, looks, _shut, q_ib, expected_q_ib, row.star_error, row.course.number
        )
    now = multiply(now, from_rotvec(says.turn))
    now = jnp.where(says.seen & ~says.stuck, now, before)
    return Frame(jnp.where(says.seen, says.factor * now, jnp.nan), factor, now)


def _looks(lens: Lens, star_key: Array, q_ib: Array, expected_q_ib: Array, error: Array, number):
    """Attitude from an image, and the factor of its covariance; NaN where too few stars are."""
    key = jax.random.fold_in(star_key, number)
    q, P, _ = measure_attitude(
        key, lens.sky, q_ib, lens.camera, error, expected_q_ib, lens.match_rad
    )
    solved = jnp.all(jnp.isfinite(P))
    return q, linalg.cholesky(jnp.where(solved, P, jnp.eye(3)))


def _shut(q_ib: Array, expected_q_ib: Array, error: Array, number: Array):
    return jnp.full(4, jnp.nan), jnp.eye(3)


def believable(q_ib: Array) -> BodyRotation:
    """An attitude as a measurement; one that is no unit quaternion is taken for missing."""
    off = jnp.abs(jnp.sum(q_ib * q_ib) - 1.0)
    return BodyRotation(jnp.where(off <= 2.0 * UNIT, q_ib, jnp.nan))


def pointing_error(q_ref_ib: Array, q_ib: Array) -> Array:
    """Rotation vector from where the craft should point to where it does, reference axes."""
    return to_rotvec(multiply(conjugate(q_ref_ib), q_ib))


def begin(given: Given, craft: CraftState) -> Vehicle:
    """The vehicle before its first step; its gyro has reported the rate that it has."""
    theta = given.step_s * rate_b(given.craft, craft)
    return Vehicle(craft, jnp.zeros(3), theta, craft.q_ib)


class Kind(NamedTuple):
    """How a filter's state is read and its truth is written."""

    attitude: Callable[[Any], Array]  # mean -> q_ib
    bias: Callable[[Any], Array]
    state: Callable[[Array, Array], Any]  # q_ib, bias -> state
    rows: Callable[[Array], Any]  # q_ib -> rows that are reported, or None


def react(kind: Kind, given: Given, v: Vehicle, belief: Belief, row: Row):
    """The loop one step on: control acts on what is believed, sensors see what comes of it."""
    q, bias = kind.attitude(belief.mean), kind.bias(belief.mean)
    command = acm(given, q, bias, v.theta, v.craft.wheel_h, row.course)
    craft = plant(given, v.craft, command, row.course)
    theta, residue = gyro(given, v.craft.q_ib, craft.q_ib, v.residue, row)
    expected = multiply(q, from_rotvec(theta - given.step_s * bias))
    frame = star(given, craft.q_ib, expected, v.star_q_ib, row)
    outputs = {
        "pointing": pointing_error(row.course.ref_end_q_ib, craft.q_ib),
        "wheel_momentum": craft.wheel_h,
    }
    reading = Reading(
        u=theta,
        y={STAR: believable(frame.q_ib)},
        aux={} if frame.factor is None else {STAR: frame.factor},
        truth=kind.state(craft.q_ib, row.gyro_bias),
        rows=kind.rows(craft.q_ib),
        outputs=outputs,
    )
    return Vehicle(craft, residue, theta, frame.seen_q_ib), reading
