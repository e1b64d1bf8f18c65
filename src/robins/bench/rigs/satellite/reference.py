"""Target attitude: along the course of the scenario, or as commanded by the operator.

A commanded attitude is reached by a rest-to-rest slew about one axis, from the target attitude at
the time of the command; the return to the course is such a slew too. The target is a pure function
of the commands, with the same bits in control, in the run inside one program, and in evaluation.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import NamedTuple

import jax
import numpy as np

from robins.bench.rigs.satellite.config import SatelliteConfig
from robins.bench.wire.fields import Values
from robins.rotation import conjugate, multiply, rotate, to_rotvec
from robins.sim.attitude_reference import (
    PEAK_ACCELERATION,
    PEAK_RATE,
    Reference,
    handover_reference,
)
from robins.systems.satellite.nodes import UNIT

SHARE = 0.5  # of the capacity of the wheels that a slew uses
_DEFAULT_RATE = 0.5  # of the greatest rate, if no rate is commanded
_OFF = 2.0 * UNIT  # greatest error of the squared norm of a quaternion
_BRAKES = 4.0  # peak acceleration times duration over initial rate, for a decaying rate: 3.94

CommandedAttitude = tuple[int, np.ndarray, float]  # first step that received it, q_ib, rate


class SlewPlan(NamedTuple):
    """Last command of the operator, and the slew to it."""

    edge: int  # at which it was received: the start of the step of that number
    q_ib: np.ndarray  # (4,) commanded attitude; NaN: the course
    turn: np.ndarray  # (3,) rad from the commanded to the target attitude at the edge
    rate: np.ndarray  # (3,) rad/s of the latter relative to the former
    length_s: float  # duration of the slew


_STILL = np.zeros(3)


def attitude_target(config: SatelliteConfig, plan: SlewPlan | None, edge: int) -> Reference:
    """Target attitude at an edge, 0 to E, by the last plan before it."""
    if plan is None or np.isnan(plan.q_ib[0]):
        course, last = config.rows.course, len(config.due) - 1
        k = min(edge, last)
        q = course.ref_q_ib[k] if edge <= last else course.ref_end_q_ib[last]
        base = Reference(q, course.ref_omega_b[k], course.ref_alpha_b[k])
    else:
        base = Reference(plan.q_ib, _STILL, _STILL)
    if plan is None:
        return base
    since_s = (edge - plan.edge) * config.step_ns * 1e-9
    if since_s >= plan.length_s:
        return base
    # one epoch at a time, so that all callers get the same bits
    one = Reference(*(x[None] for x in base))
    way = handover_reference(one, plan.turn, plan.rate, plan.length_s, np.array([since_s]))
    return Reference(*(np.asarray(x)[0] for x in way))


def plan_after_command(
    config: SatelliteConfig, plan: SlewPlan | None, edge: int, q_ib: np.ndarray, rate: float
) -> SlewPlan | None:
    """Plan after a command of the operator.

    Args:
        config: of the run.
        plan: before the command.
        edge: at which the command was received.
        q_ib: (4,) commanded attitude; NaN: back to the course. One whose norm is not one is
            ignored, as by `plausible_attitude` for the star sensor.
        rate: greatest rate of the slew [rad/s]; 0: half of what the wheels allow.
    """
    square = float(np.sum(q_ib * q_ib))
    if abs(square - 1.0) > _OFF:
        return plan
    now, to = attitude_target(config, plan, edge), q_ib / np.sqrt(square)
    there = attitude_target(config, SlewPlan(edge, to, _STILL, _STILL, 0.0), edge)
    turn, against = (np.asarray(x) for x in _between(there, now))
    angle, speed = float(np.sqrt(np.sum(turn**2))), float(np.sqrt(np.sum(against**2)))
    most, acceleration = limits(config)
    at_most = min(rate or _DEFAULT_RATE * most, most)
    way_s = max(
        PEAK_RATE * angle / at_most,
        (PEAK_ACCELERATION * angle / acceleration) ** 0.5,
        _BRAKES * speed / acceleration,
        config.step_ns * 1e-9,
    )
    return SlewPlan(edge, to, turn, against, way_s)


@jax.jit
def _between(there: Reference, now: Reference):
    """Rotation vector [rad] and rate [rad/s] of the second relative to the first, in its axes."""
    turn = multiply(conjugate(there.q_ib), now.q_ib)
    return to_rotvec(turn), now.omega_b - rotate(conjugate(turn), there.omega_b)


def limits(config: SatelliteConfig) -> tuple[float, float]:
    """Greatest rate [rad/s] and acceleration [rad/s^2] of a slew about any axis.

    They use half of the momentum and of the torque of the wheels, about the axis where the
    allocation gives least, for the greatest moment of inertia (bounded by the row sums).
    """
    craft = config.given.craft
    inertia = float(np.max(np.sum(np.abs(np.asarray(craft.inertia_b)), axis=1)))
    shares = np.sqrt(np.sum(np.asarray(config.given.pinv) ** 2, axis=1))  # of a unit torque
    used = shares > 0.0
    h, tau = (
        float(np.min(np.asarray(x)[used] / shares[used]))
        for x in (craft.wheel_momentum_limit, craft.wheel_torque_limit)
    )
    return SHARE * h / inertia, SHARE * tau / inertia


def target_attitudes(config: SatelliteConfig, said: Iterable[CommandedAttitude]) -> list[Reference]:
    """Target attitudes at each edge of the E steps, E + 1 of them.

    Args:
        config: of the run.
        said: commands of the operator, in order; of two in one step the later applies.
    """
    heard = {step: (q_ib, rate) for step, q_ib, rate in said}
    out: list[Reference] = []
    plan = None
    for edge in range(len(config.due) + 1):
        if edge in heard:
            plan = plan_after_command(config, plan, edge, *heard[edge])
        out.append(attitude_target(config, plan, edge))
    return out


def commands_until(series: Mapping[str, np.ndarray], steps: int) -> list[CommandedAttitude]:
    """Commands sent by the end of a number of steps; a finite rate marks a command, since its
    attitude may be NaN.
    """
    rate = series["reference.rate"][:steps]
    heard = np.flatnonzero(np.isfinite(rate))
    return [(int(k) + 1, series["reference.q_ib"][k], float(rate[k])) for k in heard]


def target_after(
    config: SatelliteConfig, series: Mapping[str, np.ndarray], steps: int
) -> Reference:
    """Target attitude after a number of steps."""
    plan = None
    for step, q_ib, rate in commands_until(series, steps):
        plan = plan_after_command(config, plan, step, q_ib, rate)
    return attitude_target(config, plan, steps)


def reference_q_ib(
    config: SatelliteConfig, series: Mapping[str, np.ndarray], steps: int
) -> np.ndarray:
    """Target attitudes (steps, 4) at the end of each step."""
    if not (said := commands_until(series, steps)):
        return np.asarray(config.rows.course.ref_end_q_ib)[:steps]
    return np.array([at.q_ib for at in target_attitudes(config, said)[1 : steps + 1]])


def refuses(message: str, values: Values) -> str:
    """Reason to refuse an operator message; empty if it can be sent."""
    q = values.get("q_ib", np.full(4, np.nan))
    square = float(np.sum(q * q))
    if not np.any(np.isfinite(q)) or abs(square - 1.0) <= _OFF:
        return ""
    what = "misses a number" if np.isnan(square) else f"has the length {square**0.5:.6g}"
    return f"q_ib {what}: give a quaternion of length one, w x y z, or none for the course"


def precompile(config: SatelliteConfig) -> None:
    """Compile the functions that run at a command."""
    plan = plan_after_command(config, None, 0, np.array([0.5, 0.5, 0.5, 0.5]), 0.0)
    attitude_target(config, plan, 1)
