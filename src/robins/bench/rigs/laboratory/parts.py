"""Parts of the laboratory that the rig of the satellite lacks, and its run in one program.

The equations are those of the satellite, cut in two. `robins.sim.spacecraft.advance` is `dynamics`
and then `kinematics`; `robins.sim.star_sensor.measure_attitude` is `visible_stars`, `expose` and
`solve`. On the bench each is compiled by itself, and `inside` keeps them apart in the same way, so
in lock-step a run over lines has the bits of `inside`. These are also the bits of the satellite's
own rig, unless its stars have a common error: there it turns the camera, and here the star
directions shown to the camera, which is equal to rounding.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from robins.bench.evaluation import OperatorEvent
from robins.bench.parts.station import Inputs, Part
from robins.bench.rigs.laboratory import STARS
from robins.bench.rigs.satellite import computers, judging
from robins.bench.rigs.satellite import config as satellite
from robins.bench.rigs.satellite.config import SatelliteConfig, driven
from robins.bench.rigs.satellite.messages import SAFE
from robins.bench.rigs.satellite.vehicle import LatchedInput, acting_command, zero_command
from robins.bench.wire.fields import Values
from robins.rotation import multiply, normalise
from robins.scenario import ScenarioError
from robins.sim import spacecraft
from robins.sim.spacecraft import CraftState, TurnDynamics, rate_b
from robins.sim.star_sensor import StarField, expose, solve, turned, visible_stars
from robins.systems.satellite import nodes
from robins.systems.satellite.nodes import (
    Actuation,
    CameraOptics,
    LoopConstants,
    NoiseFreeInputs,
    StarFrame,
    StepInputs,
    compiled_alone,
)
from robins.systems.satellite.parameters import AttitudeLoop

if TYPE_CHECKING:
    from robins.bench.run.setup import Setup

MARGIN_RAD = 2e-3  # beyond the field of view, for a slightly misaligned camera


def prepare(setup: Setup, given: AttitudeLoop) -> SatelliteConfig:
    """The config of a run, which is that of the satellite.

    Raises:
        ScenarioError: the satellite has no camera.
    """
    if given.star.camera is None:
        raise ScenarioError(
            [
                "star.camera: the laboratory shows stars to a camera, and this satellite has none: "
                "fly laboratory/stars, or give it a table [star.camera]"
            ]
        )
    return satellite.prepare(setup, given)


# ------------------------------------------------------------------------- the craft in two halves


def _dynamics(
    given: LoopConstants, craft: CraftState, acts: Actuation, row: NoiseFreeInputs
) -> TurnDynamics:
    torque, where = (acts.wheel_torque, acts.dipole_b), (row.r_i_m, row.field_i_t)
    return spacecraft.dynamics(given.craft, craft, *torque, *where, row.disturbance_b, given.step_s)


def _turn_step(given: LoopConstants, craft: CraftState, acts: Actuation, row: StepInputs):
    turn = compiled_alone(_dynamics, given, craft, acts, row.course)
    q = spacecraft.kinematics(craft.q_ib, turn.gibbs_b)
    after = CraftState(q, turn.momentum_i, turn.wheel_h)
    return jnp.stack(turn.gibbs_b), rate_b(given.craft, after), after


_kinematics = jax.jit(partial(compiled_alone, spacecraft.kinematics))


def dynamics(config: SatelliteConfig) -> Part:
    """Part that computes the turn of the craft in a step, and its momentum, under all torques.

    The attitude at the start of the step is the last from kinematics; if none came, it is that
    at the end of the last turn.
    """
    wheels = len(config.vehicle.craft.wheel_h)
    turns = driven(config, _turn_step)

    def begin() -> tuple[CraftState, LatchedInput]:
        return config.vehicle.craft, LatchedInput(zero_command())

    def act(state: tuple[CraftState, LatchedInput], k: int, inputs: Inputs):
        craft, held = state
        if (motion := inputs["motion"]) is not None:
            craft = craft._replace(q_ib=motion["q_ib"])
        held, torque, dipole = acting_command(held, inputs["actuation"], wheels)
        gibbs, omega, craft = turns(k, craft, Actuation(torque, dipole, craft.wheel_h))
        said = {"gibbs_b": np.asarray(gibbs), "omega_b": np.asarray(omega)}
        return (craft, held), [("turn", said)]

    example = {
        "actuation": zero_command(),
        "motion": {"q_ib": np.asarray(config.vehicle.craft.q_ib)},
    }
    return Part("dynamics", {"actuation": 0, "motion": 1}, begin, act, example)


def kinematics(config: SatelliteConfig) -> Part:
    """Part that computes the attitude after each turn; if none comes, the last is repeated.

    Its state is the attitude (4,) and the last turn.
    """
    craft = config.vehicle.craft
    omega = np.asarray(rate_b(config.given.craft, craft))
    first = {"gibbs_b": 0.5e-9 * config.step_ns * omega, "omega_b": omega}
    begin = np.asarray(craft.q_ib), first

    def act(state: tuple[np.ndarray, Values], k: int, inputs: Inputs):
        turn = inputs["turn"] or state[1]
        q = np.asarray(_kinematics(state[0], turn["gibbs_b"]))
        return (q, turn), [("motion", {"q_ib": q, "omega_b": turn["omega_b"]})]

    return Part("kinematics", {"turn": 0}, lambda: begin, act, {"turn": first})


# ------------------------------------------------------------------------- the sky and the sensor


def _sky(given: LoopConstants, q_ib: Array) -> tuple[Array, Array]:
    """Directions (N, 3) in sensor axes and magnitudes (N,), NaN where there is no star."""
    assert given.lens is not None
    camera = given.lens.camera
    q_is = multiply(q_ib, normalise(jnp.asarray(camera.q_bs, float)))
    shown = visible_stars(given.lens.sky, q_is, camera, STARS, MARGIN_RAD)
    there = shown.star >= 0
    vectors = jnp.where(there[:, None], shown.vectors_s, jnp.nan)
    return vectors, jnp.where(there, shown.magnitude, jnp.nan)


_shows = jax.jit(partial(compiled_alone, _sky))


def _sensor(
    given: LoopConstants, vectors_s, magnitude, predicted_q_ib, before, row: StepInputs
) -> StarFrame:
    """Star sensor frame from the simulated stars; see `nodes.star`."""
    assert given.lens is not None
    solves = partial(_solve_image, given.lens, given.star_key)
    seen, number = row.course.star.seen, row.course.number
    found = jax.lax.cond(
        seen,
        solves,
        nodes.closed_shutter,
        vectors_s,
        magnitude,
        predicted_q_ib,
        row.star_error,
        number,
    )
    return nodes.star_frame(row, before, *found)


def _solve_image(
    lens: CameraOptics, star_key: Array, vectors_s, magnitude, predicted_q_ib, error, number
):
    # Only the presence of a star counts here: the sensor identifies it.
    there = StarField(vectors_s, magnitude, jnp.where(jnp.isnan(magnitude), -1, 0))
    key = jax.random.fold_in(star_key, number)
    image = expose(key, turned(there, lens.camera, error), lens.camera)
    return nodes.solved_attitude(
        *solve(image, lens.sky, lens.camera, predicted_q_ib, lens.match_rad)
    )


def _is_due(config: SatelliteConfig, step: int) -> bool:
    return bool(config.due[min(step, len(config.due) - 1)])


def sky(config: SatelliteConfig) -> Part:
    """The star simulator: the stars in the field of view, without errors, when a frame is due."""

    def act(state: None, k: int, inputs: Inputs):
        motion = inputs["motion"]
        if motion is None or not _is_due(config, k):
            return None, []
        vectors, magnitude = _shows(config.given, motion["q_ib"])
        said = {"vectors_s": np.asarray(vectors), "magnitude": np.asarray(magnitude)}
        return None, [("stars", said)]

    example = {"motion": {"q_ib": np.asarray(config.vehicle.craft.q_ib)}}
    return Part("sky", {"motion": 0}, lambda: None, act, example)


_expected = jax.jit(nodes.expected_attitude)


def star(config: SatelliteConfig) -> Part:
    """The star sensor: a camera that identifies stars near its predicted attitude.

    The prediction is the last of attitude determination, turned by the gyro. As long as there is
    none, or it is flagged as unreliable, the sensor uses its own last attitude. Its state is the
    last attitude (4,) that it measured, for the fault of a stuck sensor, the predicted attitude
    (4,), and the bias (3,) [rad/s] of the gyro.
    """
    sees = driven(config._replace(machine="jax"), _sensor)  # an image has no place in a program
    q_first, bias = (
        f(config.belief.mean) for f in (jax.jit(config.form.attitude), config.form.bias)
    )
    first = tuple(map(np.asarray, (config.vehicle.star_q_ib, q_first, bias)))

    def act(state: tuple[np.ndarray, ...], k: int, inputs: Inputs):
        estimate, stars = inputs["estimate"], inputs["stars"]
        seen, q, bias = state
        if estimate is not None and not estimate["flags"] & SAFE:
            q, bias = estimate["q_ib"], estimate["gyro_bias"]
        theta = computers.sample_of(inputs["gyro"])
        looks = np.asarray(
            _expected(config.given, q, bias, np.zeros(3) if theta is None else theta)
        )
        if stars is None or not _is_due(config, k):
            return (seen, looks, bias), []
        directions = stars["vectors_s"].reshape(STARS, 3)
        frame = sees(k, directions, stars["magnitude"], looks, seen)
        q = np.asarray(frame.q_ib)
        looks = q if np.all(np.isfinite(q)) else looks
        said = {"q_ib": q, "factor": np.ravel(frame.factor), "stars": int(frame.stars)}
        return (np.asarray(frame.seen_q_ib), looks, bias), [("star", said)]

    shown = {"vectors_s": np.zeros(3 * STARS), "magnitude": np.zeros(STARS)}
    example = {"stars": shown, "gyro": {"theta_b": np.zeros(3)}, "estimate": None}
    return Part("star", {"stars": 0, "gyro": 0, "estimate": 1}, lambda: first, act, example)


# -------------------------------------------------------------------------------- one program


def _move_craft(
    given: LoopConstants, craft: CraftState, acts: Actuation, row: NoiseFreeInputs
) -> CraftState:
    turn = compiled_alone(_dynamics, given, craft, acts, row)
    q = compiled_alone(spacecraft.kinematics, craft.q_ib, turn.gibbs_b)
    return CraftState(q, turn.momentum_i, turn.wheel_h)


def _observe_stars(
    given: LoopConstants, q_ib: Array, predicted_q_ib: Array, before: Array, row: StepInputs
) -> StarFrame:
    return compiled_alone(
        _sensor, given, *compiled_alone(_sky, given, q_ib), predicted_q_ib, before, row
    )


_REACT = partial(nodes.react, move=_move_craft, look=_observe_stars)


def inside(
    config: SatelliteConfig, steps: int | None = None, said: Sequence[OperatorEvent] = ()
) -> Mapping[str, np.ndarray] | None:
    """Same run inside one program, with the same parts."""
    return judging.inside(config, steps, said, _REACT)
