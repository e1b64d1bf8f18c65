"""The vehicle: dynamics, actuators, gyro, star sensor, and the rate table that turns the gyro."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from robins.bench.parts.station import Inputs, Part
from robins.bench.rigs.satellite.config import SatelliteConfig, driven
from robins.bench.rigs.satellite.messages import WHEELS
from robins.bench.wire.fields import Values
from robins.rotation import conjugate, multiply, to_rotvec
from robins.sim.rate_table import RateTable, TableState, step
from robins.sim.spacecraft import CraftState, rate_b
from robins.systems.satellite import nodes
from robins.systems.satellite.nodes import Actuation, ActuatorCommand, LoopConstants, StepInputs

Numbers = Array | np.ndarray
HELD = 1  # steps for which the last values replace missing ones


class LatchedInput(NamedTuple):
    """Last values received, and the number of steps without any since."""

    values: Any
    age: int = 0


def latched(held: LatchedInput, came: Values | np.ndarray | tuple | None) -> LatchedInput:
    """Values to use in this step: those received, else the last; `trusted` limits their age."""
    return LatchedInput(held.values, held.age + 1) if came is None else LatchedInput(came, 0)


def trusted(held: LatchedInput) -> bool:
    """True if the last values are still valid."""
    return held.age <= HELD


def stale(held: LatchedInput) -> LatchedInput:
    """The same values, marked as no longer valid."""
    return held._replace(age=HELD + 1)


def per_wheel(torque: np.ndarray) -> np.ndarray:
    """Torques of the wheels, padded with zeros to the wheels of the wire."""
    out = np.zeros(WHEELS)
    out[: len(torque)] = torque
    return out


def zero_command() -> dict[str, np.ndarray]:
    """A command, or an actuation, of zero."""
    return {"wheel_torque": np.zeros(WHEELS), "dipole_b": np.zeros(3)}


def acting_command(
    held: LatchedInput, came: Values | None, wheels: int
) -> tuple[LatchedInput, Any, Any]:
    """Torques and dipole that act in this step: those received, the last ones, or zero."""
    held = latched(held, came)
    use = held.values if trusted(held) else zero_command()
    return held, use["wheel_torque"][:wheels], use["dipole_b"]


def _step_craft(given: LoopConstants, craft: CraftState, acts: Actuation, row: StepInputs):
    craft = nodes.compiled_alone(nodes.plant, given, craft, acts, row.course)
    return craft, rate_b(given.craft, craft)


def plant(config: SatelliteConfig) -> Part:
    """Dynamics and kinematics of the craft; without actuation nothing acts on it."""
    wheels = len(config.vehicle.craft.wheel_h)
    moves = driven(config, _step_craft)

    def begin() -> tuple[CraftState, LatchedInput]:
        return config.vehicle.craft, LatchedInput(zero_command())

    def act(state: tuple[CraftState, LatchedInput], k: int, inputs: Inputs):
        craft, held = state
        held, torque, dipole = acting_command(held, inputs["actuation"], wheels)
        acts = Actuation(torque, dipole, craft.wheel_h)
        craft, omega = moves(k, craft, acts)
        return (craft, held), [
            ("motion", {"q_ib": np.asarray(craft.q_ib), "omega_b": np.asarray(omega)})
        ]

    return Part("plant", {"actuation": 0}, begin, act, {"actuation": zero_command()})


@jax.jit
def _follow(given: RateTable, state: TableState, q_ib: Array, omega_b: Array, dt_s: Array):
    # The rate that leads to the attitude of the craft at the end of the step.
    wanted = to_rotvec(multiply(conjugate(state.q_ib), q_ib)) / dt_s
    return step(given, state, wanted, dt_s)


@jax.jit
def _turn_on(given: RateTable, state: TableState, dt_s: Array):
    # The table keeps its rate.
    return step(given, state, state.rate_b, dt_s)


def table(config: SatelliteConfig) -> Part:
    """Rate table that turns the gyro with the craft, exactly or with a lag."""
    first = np.asarray(config.vehicle.craft.q_ib)
    rate = rate_b(config.given.craft, config.vehicle.craft)
    dt = jnp.asarray(config.step_ns * 1e-9)

    ideal = RateTable(*(jnp.full(3, x) for x in (1e-9, jnp.inf, jnp.inf)))
    begin = TableState(jnp.asarray(first), rate)

    def act(state: TableState, k: int, inputs: Inputs):
        motion = inputs["motion"]
        if motion is None:
            state, q = _turn_on(config.table or ideal, state, dt)
        elif config.table is None:
            state, q = TableState(motion["q_ib"], motion["omega_b"]), motion["q_ib"]
        else:
            state, q = _follow(config.table, state, motion["q_ib"], motion["omega_b"], dt)
        return state, [("mounted", {"q_ib": np.asarray(q)})]

    example = {"motion": {"q_ib": first, "omega_b": np.asarray(rate)}}
    rare = partial(_turn_on, config.table or ideal, begin, dt)
    return Part("table", {"motion": 0}, lambda: begin, act, example, rare)


def _actuate(
    given: LoopConstants, wheel_h: Array, command: ActuatorCommand, row: StepInputs
) -> Actuation:
    return nodes.actuators(given, wheel_h, command, row.course)


def actuators(config: SatelliteConfig) -> Part:
    """Wheels and magnetorquers; a command is held for one more step, then they give zero."""
    wheels = len(config.vehicle.craft.wheel_h)
    gives = driven(config, _actuate)

    def begin() -> tuple[Numbers, LatchedInput]:
        return config.vehicle.craft.wheel_h, LatchedInput(zero_command())

    def act(state: tuple[Numbers, LatchedInput], k: int, inputs: Inputs):
        wheel_h, held = state
        held, torque, dipole = acting_command(held, inputs["command"], wheels)
        command = ActuatorCommand(torque, dipole)
        acts = gives(k, wheel_h, command)
        given = {
            "wheel_torque": per_wheel(np.asarray(acts.wheel_torque)),
            "dipole_b": np.asarray(acts.dipole_b),
        }
        speeds = {"momentum": per_wheel(np.asarray(acts.wheel_h))}
        return (acts.wheel_h, held), [("actuation", given), ("wheels", speeds)]

    return Part("actuators", {"command": 0}, begin, act, {"command": zero_command()})


_expected = jax.jit(nodes.expected_attitude)


def gyro(config: SatelliteConfig) -> Part:
    """Gyro triad: reports the rotation since its last sample, in whole counts."""
    reads = driven(config, nodes.gyro)
    first = (jnp.asarray(config.vehicle.craft.q_ib), config.vehicle.residue)

    def act(state: tuple[Numbers, Numbers], k: int, inputs: Inputs):
        before, residue = state
        if (mounted := inputs["mounted"]) is None:  # the next sample includes this turn
            return state, []
        theta, residue = reads(k, before, mounted["q_ib"], residue)
        return (mounted["q_ib"], residue), [("gyro", {"theta_b": np.asarray(theta)})]

    example = {"mounted": {"q_ib": np.asarray(config.vehicle.craft.q_ib)}}
    return Part("gyro", {"mounted": 0}, lambda: first, act, example)


def star(config: SatelliteConfig) -> Part:
    """The star sensor; a camera is given the predicted attitude to identify its stars."""
    lens = config.given.lens
    # A program of scalars cannot hold an image.
    sees = driven(config if lens is None else config._replace(machine="jax"), nodes.star)
    takes = {"motion": 0} if lens is None else {"motion": 0, "gyro": 0, "estimate": 1}
    at_first = np.asarray(config.vehicle.star_q_ib)

    def begin() -> tuple[np.ndarray, ...]:
        return at_first, np.asarray(config.form.attitude(config.belief.mean)), np.zeros(3)

    def act(state: tuple[np.ndarray, ...], k: int, inputs: Inputs):
        seen, q, bias = state
        if lens is not None and (estimate := inputs["estimate"]) is not None:
            q, bias = estimate["q_ib"], estimate["gyro_bias"]
        turned = inputs.get("gyro")
        theta = np.zeros(3) if turned is None else turned["theta_b"]
        motion = inputs["motion"]
        if motion is None or not config.due[min(k, len(config.due) - 1)]:
            return (seen, q, bias), []
        at = motion["q_ib"]
        looks = at if lens is None else _expected(config.given, q, bias, theta)
        frame = sees(k, at, looks, seen)
        factor = np.zeros(9) if frame.factor is None else np.ravel(np.asarray(frame.factor))
        stars = 0 if frame.stars is None else int(frame.stars)
        says = {"q_ib": np.asarray(frame.q_ib), "factor": factor, "stars": stars}
        return (np.asarray(frame.seen_q_ib), q, bias), [("star", says)]

    seen, q, bias = begin()
    example = {
        "motion": {"q_ib": seen},
        "gyro": {"theta_b": np.zeros(3)},
        "estimate": {"q_ib": q, "gyro_bias": bias},
    }
    return Part("star", takes, begin, act, example)
