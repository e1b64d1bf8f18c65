"""Autopilots of the multirotor: ours, or PX4's or ArduPilot's SITL at the end of a socket.

`Part.rare` waits for another program to connect: once, in the part's process, before its hello.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array

from robins.bench.bridges import ardupilot as of_ardupilot
from robins.bench.bridges import px4 as of_px4
from robins.bench.bridges.errors import BridgeClosed, BridgeTimeout
from robins.bench.bridges.px4_messages import GnssFix, Sensors
from robins.bench.parts.station import Inputs, Part
from robins.bench.rigs.multirotor import craft
from robins.bench.rigs.multirotor.craft import DOWN, INERTIA_KG_M2, MASS_KG
from robins.bench.rigs.multirotor.flight import MultirotorConfig
from robins.bench.wire.fields import Values
from robins.earth.atmosphere import G0
from robins.rotation import conjugate, from_dcm, from_rotvec, multiply, rotate, to_rotvec

CONNECT_S = 100.0  # time for another program to start; less than the bench waits for a part
ANSWER_S = 10.0
_AGAIN = "begin the run anew, then start the autopilot's SITL again"


def autopilot(config: MultirotorConfig) -> Part:
    """The selected autopilot."""
    return {"own": own_autopilot, "px4": px4, "ardupilot": ardupilot}[config.autopilot](config)


def _motors(shares: ArrayLike | Sequence[float] = (0.0,) * 4, answered: bool = True) -> Values:
    return {"control": np.clip(np.asarray(shares, float), 0.0, 1.0), "answered": int(answered)}


# ------------------------------------------------------------------------------------------ ours

READY_S = 1.0  # settling time of the instruments before the motors start
LEVEL_1_S, COMPASS, PLACE, SPEED = 0.1, 0.02, 0.1, 0.3  # gains: of level per second, of a compass
# sample, of position and velocity per fix
CLIMB_M_S, PUSH_M_S2 = 2.0, 4.0  # limits
HOLD_1_S, FOLLOW_1_S, LEAN_1_S2 = 1.0, 2.5, 2.0  # gains: position, velocity, wind integral
TURN_1_S, RATE_1_S = 6.0, 20.0  # gains: attitude, turn rate
_UNMIX = np.linalg.inv(np.vstack([np.ones(4), craft.MIXER]))  # thrusts from a force and torques


class EstimatorState(NamedTuple):
    """Estimates of our autopilot, and the integral acceleration that compensates the wind."""

    q_nb: Any  # (4,)
    v_n: Any  # (3,) m/s
    p_n: Any  # (3,) m from the start
    lean_n: Any  # (3,) m/s^2


@jax.jit
def estimated(
    s: EstimatorState,
    omega_b: Array,
    f_b: Array,
    field_b: Array,
    fix: Array,
    field_n: Array,
    dt: Array,
) -> EstimatorState:
    """Strapdown step, corrected by the vertical of a hover, the compass and the fixes.

    A complementary filter of constant gains (Mahony, Hamel & Pflimlin, IEEE Trans. Automatic
    Control 53, 2008). ``fix`` (6,) is position [m] and velocity [m/s], NED; NaN is missing.
    """
    q = multiply(s.q_nb, from_rotvec(dt * omega_b))
    down = jnp.asarray(DOWN)
    down_b = rotate(conjugate(q), down)
    level_b = jnp.cross(-f_b / jnp.maximum(jnp.linalg.norm(f_b), 1.0), down_b)
    seen = rotate(q, field_b)
    sine = (seen[0] * field_n[1] - seen[1] * field_n[0]) / (
        jnp.hypot(seen[0], seen[1]) * jnp.hypot(field_n[0], field_n[1])
    )
    heading = COMPASS * jnp.where(jnp.isfinite(sine), sine, 0.0)
    q = multiply(q, from_rotvec(LEVEL_1_S * dt * level_b + heading * down_b))
    v = s.v_n + dt * (rotate(q, f_b) + G0 * down)
    p = s.p_n + dt * v
    off = fix - jnp.concatenate([p, v])
    off = jnp.where(jnp.isfinite(off), off, 0.0)
    return EstimatorState(q, v + SPEED * off[3:], p + PLACE * off[:3], s.lean_n)


@jax.jit
def controlled(
    s: EstimatorState, omega_b: Array, height_m: Array, dt: Array
) -> tuple[EstimatorState, Array]:
    """Cascade of position, velocity, attitude and rate loops; motor commands (4,), not limited."""
    down = jnp.asarray(DOWN)
    off = HOLD_1_S * (-height_m * down - s.p_n)
    wanted = off * jnp.minimum(1.0, CLIMB_M_S / jnp.maximum(jnp.linalg.norm(off), 1e-9))
    off = wanted - s.v_n
    lean = jnp.clip(s.lean_n + dt * LEAN_1_S2 * off, -PUSH_M_S2, PUSH_M_S2)
    f_n = jnp.clip(FOLLOW_1_S * off + lean, -PUSH_M_S2, PUSH_M_S2) - G0 * down
    size = jnp.linalg.norm(f_n)
    z = -f_n / size
    y = jnp.cross(z, jnp.array([1.0, 0.0, 0.0]))  # heading north
    y = y / jnp.linalg.norm(y)
    q_wanted = from_dcm(jnp.stack([jnp.cross(y, z), y, z], axis=1))
    turn = to_rotvec(multiply(conjugate(s.q_nb), q_wanted))
    torque = jnp.asarray(INERTIA_KG_M2) * RATE_1_S * (TURN_1_S * turn - omega_b)
    thrust = jnp.asarray(_UNMIX) @ jnp.concatenate([MASS_KG * size[None], torque])
    return s._replace(lean_n=lean), thrust / craft.MOST_N


def own_autopilot(config: MultirotorConfig) -> Part:
    """Our autopilot: hovers at the height of the scenario. State: estimates and last sample."""
    dt, nothing = config.step_ns * 1e-9, np.full(6, np.nan)
    none = np.zeros(3)
    rest = {"omega_b": none, "f_b": -G0 * DOWN, "field_b": nothing[:3], "pressure": np.nan}
    begin = (EstimatorState(np.array([1.0, 0.0, 0.0, 0.0]), none, none, none), rest)

    def act(state: tuple[EstimatorState, Values], k: int, inputs: Inputs):
        estimate, sample = state[0], inputs["sample"] or state[1]
        fix = nothing
        if (found := inputs["fix"]) is not None:
            place = config.p_n(np.array([found["lat"], found["lon"], found["alt"]]))
            fix = np.concatenate([place, found["v_n"]])
        seen = [sample[name] for name in ("omega_b", "f_b", "field_b")]
        estimate, asked = (
            estimated(estimate, *seen, fix, config.field_n_T, dt),
            _motors(answered=False),
        )
        if (k + 1) * dt > READY_S:
            estimate, shares = controlled(estimate, sample["omega_b"], config.given.height, dt)
            asked = _motors(shares)
        return (EstimatorState(*map(np.asarray, estimate)), sample), [("motors", asked)]

    takes = {"sample": 0, "fix": 0}

    def compiled() -> None:
        act(begin, int(READY_S / dt) + 1, dict.fromkeys(takes))

    return Part("autopilot", takes, lambda: begin, act, rare=compiled)


# ---------------------------------------------------------------------------- programs of their own


@contextmanager
def _until_lost(line: of_px4.Px4Simulator | of_ardupilot.ArduPilotPhysics) -> Iterator[None]:
    """Close the line at an error, and name the fix."""
    try:
        yield
    except BridgeClosed as error:
        line.close()
        raise BridgeClosed(error.what, error.where, _AGAIN) from None
    except BridgeTimeout:
        line.close()
        raise


def px4(config: MultirotorConfig) -> Part:
    """The simulator's side of the connection to PX4; while PX4 starts, the motors are off."""
    lines: list[of_px4.Px4Simulator] = []

    def connect() -> None:
        lines.append(of_px4.Px4Simulator(config.address, config.port or of_px4.PORT))
        with _until_lost(lines[0]):
            lines[0].accept(CONNECT_S)

    def act(last: Values, k: int, inputs: Inputs):
        time_us, sample, fix = (k + 1) * config.step_ns // 1000, inputs["sample"], inputs["fix"]
        with _until_lost(lines[0]):
            if fix is not None and np.isfinite([fix["lat"], *fix["v_n"]]).all():
                place = {"lat_rad": fix["lat"], "lon_rad": fix["lon"], "alt_m": fix["alt"]}
                lines[0].send(GnssFix(time_us=time_us, **place, v_n_m_s=fix["v_n"]))
            said = None if sample is None else lines[0].step(_sensors(time_us, sample))
        if said is not None:
            last = _motors(said.controls[:4] if said.armed else (0.0,) * 4)
        return last, [("motors", last)]

    takes = {"sample": 0, "fix": 0}
    return Part("autopilot", takes, lambda: _motors(answered=False), act, rare=connect)


def _sensors(time_us: int, sample: Values) -> Sensors:
    now = np.isfinite([sample["pressure"], *sample["field_b"]]).all()
    return Sensors(
        time_us=time_us,
        f_b_m_s2=sample["f_b"],
        omega_ib_b_rad_s=sample["omega_b"],
        field_b_T=sample["field_b"] if now else None,
        pressure_Pa=sample["pressure"] if now else None,
    )


def ardupilot(config: MultirotorConfig) -> Part:
    """The physics' side of the connection to ArduPilot, which simulates its own sensors."""
    lines: list[of_ardupilot.ArduPilotPhysics] = []

    def asked(timeout_s: float, fix: str) -> of_ardupilot.Servos:
        servos, where = lines[0].receive(timeout_s), f"ArduPilot at port {lines[0].port}"
        if servos is None:
            raise BridgeTimeout(f"nothing came within {timeout_s:g} s", where, fix)
        if servos.restarted:
            raise BridgeClosed("it was started anew in the middle of the run", where)
        return servos

    def connect() -> None:
        lines.append(
            of_ardupilot.ArduPilotPhysics(config.address, config.port or of_ardupilot.PORT)
        )
        with _until_lost(lines[0]):
            asked(CONNECT_S, "start ArduPilot's SITL")

    def act(last: Values, k: int, inputs: Inputs):
        if (motion := inputs["motion"]) is not None:
            state = of_ardupilot.BodyState(
                time_s=(k + 1) * config.step_ns * 1e-9,
                f_b_m_s2=motion["f_b"],
                omega_ib_b_rad_s=motion["omega_b"],
                position_n_m=motion["p_n"],
                v_n_m_s=motion["v_n"],
                q_nb=motion["q_nb"],
            )
            with _until_lost(lines[0]):
                lines[0].reply(state)
                pulses_us = asked(ANSWER_S, _AGAIN).pwm_us[:4]
            # of 1000 to 2000 us; 0: this output does nothing
            last = _motors([(us - 1000) / 1000 for us in pulses_us])
        return last, [("motors", last)]

    return Part("autopilot", {"motion": 0}, lambda: _motors(answered=False), act, rare=connect)
