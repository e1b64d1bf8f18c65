"""The parts of the loop, each a pure function of its inputs.

    belief, gyro --acm--> command --actuators--> torque, dipole --plant--> motion --gyro, star-->

Each is the task of a process of the test bench, and `react` chains them for a run inside one
program. There they are `compiled_alone`: otherwise XLA would fuse the end of one with the
beginning of the next, and round differently from a process that runs one of them alone.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree

from robins import linalg
from robins.earth.stars import StarIndex
from robins.filters import Belief, Reading
from robins.rotation import BodyRotation, conjugate, from_rotvec, multiply, rotate, to_rotvec
from robins.sim.attitude_control import Controller, allocate_within, desaturation_dipole, torque
from robins.sim.gyro import read_gyro
from robins.sim.spacecraft import (
    CraftState,
    Spacecraft,
    advance,
    rate_b,
    wheel_momenta_after,
    wheel_momentum_b,
    wheel_torques,
)
from robins.sim.star_sensor import StarCamera, measure_attitude, read_star

STAR = "star"  # the sensor
NO_GAIN = "lmi_step.failed"  # note of a frame: no new gain was accepted, the last one is kept
UNIT = 1e-3  # tolerance of the length of a quaternion


class StarSensorFault(NamedTuple):
    """Faults of the star sensor at the end of a step, besides noise."""

    seen: Array  # () bool, True if there is a frame
    stuck: Array  # () bool, True if it repeats the last one
    turn: Array  # (3,) rad, rotation vector in sensor axes
    factor: Array  # () of the components of the quaternion: 1, -1, or wrong


class NoiseFreeInputs(NamedTuple):
    """External inputs of a step; with leading axis E in a course."""

    ref_q_ib: Array  # (4,) reference attitude at its beginning
    ref_omega_b: Array  # (3,) its rate
    ref_alpha_b: Array  # (3,) and angular acceleration
    ref_end_q_ib: Array  # (4,) reference attitude at its end
    r_i_m: Array  # (3,) position in the middle of it [m]
    field_i_t: Array  # (3,) magnetic field there [T]
    disturbance_b: Array  # (3,) N m
    wheel_works: Array  # (W,) 1, or 0 for a wheel that gives no torque
    star: StarSensorFault
    number: Array  # () of the step, from 0


class CameraOptics(NamedTuple):
    """The camera of a star sensor, and its star identification."""

    camera: StarCamera
    sky: StarIndex
    match_rad: Array  # () greatest angle of a match between a star and its predicted direction


class ActuatorCommand(NamedTuple):
    """Command of control to the actuators."""

    wheel_torque: Array  # (W,) N m
    dipole_b: Array  # (3,) A m^2


class Actuation(NamedTuple):
    """Output of the actuators."""

    wheel_torque: Array  # (W,) N m
    dipole_b: Array  # (3,) A m^2
    wheel_h: Array  # (W,) N m s, momenta of the wheels after it, from their speeds


class LoopConstants(NamedTuple):
    """Constants of the loop within a run; gyro errors and star noise are drawn for the run."""

    craft: Spacecraft
    control: Controller
    pinv: Array  # (W, 3)
    step_s: Array  # ()
    quantum_rad: Array  # () of the gyro
    lens: CameraOptics | None = None  # where the star sensor is a camera
    gyro_matrix: Any = None  # (3, 3) scale factor errors and misalignments, of a run
    star_key: Any = None  # key of a camera's images in a run


class StepInputs(NamedTuple):
    """External inputs of a step, with the noise of a run."""

    course: NoiseFreeInputs
    gyro_angle: Array  # (3,) rad
    gyro_bias: Array  # (3,) rad/s
    star_error: Array  # (3,) rad


class StarFrame(NamedTuple):
    """Report of the star sensor."""

    q_ib: Array  # (4,); NaN without a frame
    factor: Array | None  # (3, 3) of its covariance [rad], body axes, where it reports one
    stars: Array | None  # () used, where it is a camera
    seen_q_ib: Array  # (4,) for the next frame


class VehicleState(NamedTuple):
    """State of the vehicle with its gyro."""

    craft: CraftState
    residue: Array  # (3,) rad, angle not yet reported by the gyro
    theta: Array  # (3,) rad, its last report
    star_q_ib: Array  # (4,) last attitude of the star sensor


def acm(
    given: LoopConstants,
    q_ib: Array,
    bias: Array,
    theta: Array,
    wheel_h: Array,
    row: NoiseFreeInputs,
) -> ActuatorCommand:
    """Attitude control from the estimate, the last gyro sample and the wheel momenta.

    The rate is that of the gyro less the estimated bias; the field is that of its model, resolved
    in body axes by the estimate.
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
    return ActuatorCommand(wheels, dipole)


def actuators(
    given: LoopConstants, wheel_h: Array, command: ActuatorCommand, row: NoiseFreeInputs
) -> Actuation:
    """Part of a command that wheels and magnetorquers can give."""
    craft = given.craft._replace(wheel_works=row.wheel_works)
    limit = craft.dipole_limit_a_m2
    return Actuation(
        wheel_torque=wheel_torques(craft, command.wheel_torque),
        dipole_b=jnp.clip(command.dipole_b, -limit, limit),
        wheel_h=wheel_momenta_after(craft, wheel_h, command.wheel_torque, given.step_s),
    )


def plant(
    given: LoopConstants, state: CraftState, given_by: Actuation, row: NoiseFreeInputs
) -> CraftState:
    """State of the craft one step later."""
    return advance(
        given.craft,
        state,
        given_by.wheel_torque,
        given_by.dipole_b,
        row.r_i_m,
        row.field_i_t,
        row.disturbance_b,
        given.step_s,
    )


def gyro(given: LoopConstants, before: Array, after: Array, residue: Array, row: StepInputs):
    """Reported gyro angle (3,) [rad] of a step, and the residue for the next sample."""
    turned = to_rotvec(multiply(conjugate(before), after))
    return read_gyro(turned, row.gyro_angle, given.gyro_matrix, residue, given.quantum_rad)


def expected_attitude(given: LoopConstants, q_ib: Array, bias: Array, theta: Array) -> Array:
    """Predicted attitude for star identification, from the estimate one step before."""
    return multiply(q_ib, from_rotvec(theta - given.step_s * bias))


def star(
    given: LoopConstants, q_ib: Array, expected_q_ib: Array, before: Array, row: StepInputs
) -> StarFrame:
    """Frame of the star sensor at the end of a step."""
    if given.lens is None:
        return star_frame(row, before, read_star(q_ib, row.star_error))
    looks = partial(_attitude_from_image, given.lens, given.star_key)
    found = jax.lax.cond(
        row.course.star.seen,
        looks,
        closed_shutter,
        q_ib,
        expected_q_ib,
        row.star_error,
        row.course.number,
    )
    return star_frame(row, before, *found)


def star_frame(
    row: StepInputs,
    before: Array,
    q_ib: Array,
    factor: Array | None = None,
    stars: Array | None = None,
) -> StarFrame:
    """Frame of the star sensor from its measured attitude."""
    effect = row.course.star
    now = multiply(q_ib, from_rotvec(effect.turn))
    now = jnp.where(effect.seen & ~effect.stuck, now, before)
    return StarFrame(jnp.where(effect.seen, effect.factor * now, jnp.nan), factor, stars, now)


def _attitude_from_image(
    lens: CameraOptics, star_key: Array, q_ib: Array, expected_q_ib: Array, error: Array, number
):
    """Attitude from an image, the factor of its covariance, stars; NaN where these are too few."""
    key = jax.random.fold_in(star_key, number)
    return solved_attitude(
        *measure_attitude(key, lens.sky, q_ib, lens.camera, error, expected_q_ib, lens.match_rad)
    )


def solved_attitude(q_ib: Array, covariance: Array, stars: Array) -> tuple[Array, Array, Array]:
    """A measured attitude with the factor of its covariance; the identity where there is none."""
    there = jnp.all(jnp.isfinite(covariance))
    return q_ib, linalg.cholesky(jnp.where(there, covariance, jnp.eye(3))), stars


def closed_shutter(*_: PyTree) -> tuple[Array, Array, Array]:
    """Result of a camera with its shutter closed."""
    return jnp.full(4, jnp.nan), jnp.eye(3), jnp.asarray(0)


def plausible_attitude(q_ib: Array) -> BodyRotation:
    """An attitude as a measurement; one that is not a unit quaternion counts as missing."""
    off = jnp.abs(jnp.sum(q_ib * q_ib) - 1.0)
    return BodyRotation(jnp.where(off <= 2.0 * UNIT, q_ib, jnp.nan))


def pointing_error(q_ref_ib: Array, q_ib: Array) -> Array:
    """Rotation vector [rad] from the reference attitude to the true one, reference axes."""
    return to_rotvec(multiply(conjugate(q_ref_ib), q_ib))


def begin(given: LoopConstants, craft: CraftState) -> VehicleState:
    """The vehicle before its first step; its gyro has already reported the initial rate."""
    theta = given.step_s * rate_b(given.craft, craft)
    return VehicleState(craft, jnp.zeros(3), theta, craft.q_ib)


class StateForm(NamedTuple):
    """Access to a filter's attitude, and its state made from the truth."""

    attitude: Callable[[Any], Array]  # mean -> q_ib
    bias: Callable[[Any], Array]
    state: Callable[[Array, Array], Any]  # q_ib, bias -> state
    rows: Callable[[Array], Any]  # q_ib -> rows that are reported, or None


def compiled_alone(node: Callable, *args: PyTree) -> PyTree:
    """Run a node as if compiled alone, so that it gives the same bits as in its own process."""
    settled = jax.lax.optimization_barrier
    return settled(node(*settled(args)))


_MOVES, _LOOKS = partial(compiled_alone, plant), partial(compiled_alone, star)


def react(
    form: StateForm,
    given: LoopConstants,
    v: VehicleState,
    belief: Belief,
    row: StepInputs,
    move: Callable = _MOVES,
    look: Callable = _LOOKS,
):
    """Advance the loop by a step: control acts on the estimate, sensors observe the result.

    Args:
        form: access to the state of the filter.
        given: constants of the loop.
        v: the vehicle at the beginning of the step.
        belief: the filter's, at the same time.
        row: external inputs of the step.
        move: the plant, or equivalent nodes compiled separately.
        look: the star sensor, or equivalent nodes compiled separately.
    """
    q, bias = compiled_alone(form.attitude, belief.mean), form.bias(belief.mean)
    command = compiled_alone(acm, given, q, bias, v.theta, v.craft.wheel_h, row.course)
    acts = compiled_alone(actuators, given, v.craft.wheel_h, command, row.course)
    craft = move(given, v.craft, acts, row.course)
    theta, residue = compiled_alone(gyro, given, v.craft.q_ib, craft.q_ib, v.residue, row)
    looks = compiled_alone(expected_attitude, given, q, bias, theta)
    frame = look(given, craft.q_ib, looks, v.star_q_ib, row)
    outputs = {
        "pointing": pointing_error(row.course.ref_end_q_ib, craft.q_ib),
        "wheel_momentum": craft.wheel_h,
    }
    reading = Reading(
        u=theta,
        y={STAR: plausible_attitude(frame.q_ib)},
        aux={} if frame.factor is None else {STAR: frame.factor},
        truth=form.state(craft.q_ib, row.gyro_bias),
        rows=form.rows(craft.q_ib),
        outputs=outputs,
    )
    return VehicleState(craft, residue, theta, frame.seen_q_ib), reading
