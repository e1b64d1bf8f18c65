"""The computers on board: attitude determination by any filter of the family, and control.

When a sensor fails: without star frames, for any time, the attitude follows the gyro alone. A
missing gyro sample is replaced by the last one for one period. After that the rate is not known:
the estimate is flagged "safe: do not steer by this", control commands zero to wheels and
magnetorquers, and when the gyro is back the filter restarts from the next star frame. It does the
same when the operator resets it, with the bias of its first start.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from robins.bench.parts.station import Inputs, Part
from robins.bench.rigs.satellite.config import SatelliteConfig, compiled, driven
from robins.bench.rigs.satellite.messages import (
    AS_IT_IS,
    HELD,
    KEPT,
    REFUSED,
    SAFE,
    SHORT,
    SILENT,
    STAND_BY,
    USED,
)
from robins.bench.rigs.satellite.reference import (
    SlewPlan,
    attitude_target,
    plan_after_command,
    precompile,
)
from robins.bench.rigs.satellite.vehicle import (
    LatchedInput,
    Numbers,
    latched,
    per_wheel,
    stale,
    trusted,
    zero_command,
)
from robins.bench.wire.fields import Values
from robins.filters import Belief, Code, OnlineFilter
from robins.filters.chi_square import chi_square
from robins.filters.kalman import FilterState
from robins.rotation import Rotation, normalise
from robins.systems.satellite import nodes
from robins.systems.satellite.model import GATE, make_filter, start
from robins.systems.satellite.nodes import NO_GAIN, STAR, ActuatorCommand, LoopConstants, StepInputs

StateT = TypeVar("StateT")
SILENT_PERIODS = 4  # star sensor periods without a frame, after which it is flagged as silent
_LIMIT = float(chi_square(GATE, 3))


def sample_of(gyro: Values | None) -> np.ndarray | None:
    """Turn that the gyro reports; None if it did not come, or an axis is missing."""
    if gyro is None or not np.all(np.isfinite(gyro["theta_b"])):
        return None
    return gyro["theta_b"]


def reset_if_late(part: Part, forgets: Callable[[StateT], StateT]) -> Part:
    """Wrap a part so that it resets its state if its first step is not the first of the run.

    The part has then lost power: determination waits for a star frame to start from, and control
    commands zero until it receives an estimate.
    """
    first = part.begin()

    def act(state: Any, k: int, inputs: Inputs):
        return part.act(forgets(first) if state is first and k > 0 else state, k, inputs)

    return part._replace(begin=lambda: first, act=act)


class DeterminationState(NamedTuple):
    """State of the attitude determination."""

    filter: FilterState
    gyro: LatchedInput
    since_star: int = 0  # steps
    lost: bool = False  # waits for a star frame to start again


class _Determination:
    """The filter and the functions around it, compiled or interpreted as the config requires."""

    def __init__(self, config: SatelliteConfig):
        self.config, self.form = config, config.form
        self.additive = config.build == "quaternion"
        self.online = OnlineFilter(
            config.filter, config.model, config.start, machine=config.machine
        )
        self.first = self.online.state
        self.period = int(np.max(np.diff(np.flatnonzero(config.due)), initial=1))
        # A filter with rules gives no distance of a refused frame; one without does.
        self.plain = make_filter("quaternion" if self.additive else "mekf")
        self.sensor = config.model.sensor(STAR)
        self.plausible_attitude = compiled(config, nodes.plausible_attitude)
        self.report = compiled(config, self._report)
        self.judge = compiled(config, self._judge)
        self.fresh = compiled(config, self._fresh)

    def _report(self, belief: Belief):
        q = nodes.compiled_alone(self.form.attitude, belief.mean)  # as in `nodes.react`
        rows = self.form.rows(q)
        factor = belief.factor if rows is None else rows @ belief.factor
        return q, self.form.bias(belief.mean), jnp.sqrt(jnp.sum(factor * factor, -1))

    def _judge(self, belief: Belief, y: Rotation, factor: Array | None):
        state = self.plain.init(belief, self.config.model.dims)
        info = self.plain.update(state, self.sensor, y, factor)[1]
        return info.innovation, info.sigma, info.nis

    def _fresh(self, q_ib: Array, bias: Array, state: FilterState) -> FilterState:
        q = normalise(q_ib)
        believed = start(q, self.config.attitude_rad, 0.0, self.additive)
        old = state.belief
        mean = self.form.state(q, bias)
        block = believed.factor.shape[-1] - 3
        factor = believed.factor.at[block:, :].set(old.factor[block:, :])
        return self.config.filter.reset(state, Belief(mean, factor))  # all modes of a bank, too

    def act(self, state: DeterminationState, k: int, inputs: Inputs):
        """Predict with a sample of the gyro, update with a star frame, and report."""
        online, frame = self.online, inputs["star"]
        gyro = latched(state.gyro, sample_of(inputs["gyro"]))
        flags = 0 if gyro.age == 0 else HELD
        online.state, lost = state.filter, state.lost or not trusted(gyro)
        if (mode := inputs["mode"]) is not None and mode["reset"]:
            online.state, lost = self.first, True
        if not lost:
            online.predict(gyro.values)
        sent, received = [], False
        if frame is not None:
            y = self.plausible_attitude(frame["q_ib"])
            received = bool(np.isfinite(np.asarray(y.wxyz)[0]))
            if not received and np.all(np.isfinite(frame["q_ib"])):
                flags |= SHORT
            if lost and received and trusted(gyro):
                bias = self.form.bias(online.belief.mean)
                online.state, lost = self.fresh(frame["q_ib"], bias, self.first), False
                flags |= USED
            elif not lost:
                more, innovation = self._update(frame, y, received)
                flags, sent = flags | more, innovation
        since = 0 if received else state.since_star + 1
        flags |= SILENT * (since > SILENT_PERIODS * self.period) | SAFE * lost
        q, bias, sigma = (np.asarray(x) for x in self.report(online.belief))
        sigma = np.full(6, np.nan) if lost else sigma
        estimate = {"q_ib": q, "gyro_bias": bias, "sigma": sigma, "flags": flags}
        return DeterminationState(online.state, gyro, since, lost), [*sent, ("estimate", estimate)]

    def _update(self, frame: Values, y: Rotation, received: bool):
        """Update with a star frame: its flags, and the innovation of a received frame."""
        sent, factor = [], _factor(self.config, frame)
        if received:
            judged = self.judge(self.online.belief, y, factor)
            sent.append(("innovation", _innovation(*judged)))
        info = self.online.update(y, STAR, factor)
        code = Code(int(info.code))
        flags = USED * (code is Code.DONE) | REFUSED * (code is Code.REFUSED)
        return flags | KEPT * bool(info.notes.get(NO_GAIN, False)), sent


def adm(config: SatelliteConfig) -> Part:
    """Attitude determination: predicts with the gyro, updates with the star sensor."""
    made = _Determination(config)
    # Before the first sample the rate is the last that the gyro reported.
    begin = DeterminationState(made.first, LatchedInput(np.asarray(config.vehicle.theta)))
    q_ib = np.asarray(jax.jit(config.form.attitude)(made.first.belief.mean))
    example = {
        "gyro": {"theta_b": np.asarray(config.vehicle.theta)},
        "star": {"q_ib": q_ib, "factor": np.ravel(np.eye(3))},
        "mode": None,
    }

    def rare() -> None:
        fresh, _ = made.act(begin._replace(lost=True), 0, example)
        made.act(fresh, 0, {**example, "star": None})

    takes = {"gyro": 0, "star": 0, "mode": 1}
    part = Part("adm", takes, lambda: begin, made.act, example, rare)
    return reset_if_late(part, lambda state: state._replace(lost=True))


def _factor(config: SatelliteConfig, frame: Values) -> np.ndarray | None:
    """Factor of the measurement covariance of a frame; None if frames do not carry it."""
    return None if config.given.lens is None else frame["factor"].reshape(3, 3)


def _innovation(innovation: Numbers, sigma: Numbers, nis: Numbers | float) -> Values:
    ratio = float(nis) / _LIMIT
    return {
        "innovation": np.asarray(innovation),
        "sigma": np.asarray(sigma),
        "ratio": ratio if math.isfinite(ratio) else np.nan,
    }


class ControlState(NamedTuple):
    """State of the attitude control: its last inputs, and the target."""

    estimate: LatchedInput  # q_ib, bias, whether it is fit for control
    theta: LatchedInput
    wheel_h: Any
    plan: SlewPlan | None = None  # None: the course of the scenario
    stands_by: bool = False


def _control_step(
    given: LoopConstants, q_ib: Array, bias: Array, theta: Array, wheel_h: Array, row: StepInputs
) -> ActuatorCommand:
    return nodes.acm(given, q_ib, bias, theta, wheel_h, row.course)


def acm(config: SatelliteConfig) -> Part:
    """Attitude control: commands torques of the wheels and a dipole of the magnetorquers."""
    steers = driven(config, _control_step)
    vehicle = config.vehicle
    wheels = len(vehicle.craft.wheel_h)
    mean = config.belief.mean
    q0 = np.asarray(jax.jit(config.form.attitude)(mean))
    first = (q0, np.asarray(config.form.bias(mean)), True)
    begin = ControlState(
        LatchedInput(first),
        LatchedInput(np.asarray(vehicle.theta)),
        np.asarray(vehicle.craft.wheel_h),
    )

    def act(state: ControlState, k: int, inputs: Inputs):
        estimate, gyro, speeds = inputs["estimate"], inputs["gyro"], inputs["wheels"]
        if k > 0:  # before the first step there are no messages
            known = estimate and (
                estimate["q_ib"],
                estimate["gyro_bias"],
                not estimate["flags"] & SAFE,
            )
            state = ControlState(
                latched(state.estimate, known),
                latched(state.theta, sample_of(gyro)),
                state.wheel_h if speeds is None else speeds["momentum"][:wheels],
                state.plan,
                state.stands_by,
            )
        if (asked := inputs["reference"]) is not None:
            state = state._replace(
                plan=plan_after_command(config, state.plan, k, asked["q_ib"], asked["rate"])
            )
        if (mode := inputs["mode"]) is not None and mode["mode"] != AS_IT_IS:
            state = state._replace(stands_by=mode["mode"] == STAND_BY)
        q, bias, steered = state.estimate.values
        heard = trusted(state.estimate) and trusted(state.theta)
        if state.stands_by or not (steered and heard):
            return state, [("command", zero_command())]
        # A row begins with the target attitude.
        at = () if state.plan is None else np.concatenate(attitude_target(config, state.plan, k))
        command = steers(k, q, bias, state.theta.values, state.wheel_h, begins=at)
        torque = per_wheel(np.asarray(command.wheel_torque))
        return state, [
            ("command", {"wheel_torque": torque, "dipole_b": np.asarray(command.dipole_b)})
        ]

    takes = {"estimate": 1, "gyro": 1, "wheels": 1, "reference": 1, "mode": 1}
    part = Part("acm", takes, lambda: begin, act, dict.fromkeys(takes), lambda: precompile(config))
    return reset_if_late(part, lambda state: state._replace(estimate=stale(state.estimate)))
