"""The physics of the multirotor, and its instruments.

Four motors in an X, each a first-order lag behind its command; a rigid body under their thrust,
their reaction, drag against the wind, gravity, and the ground that it stands on:

    m v' = -C_nb (0, 0, sum T) - c (v - w) + m g,   J omega' = M T - d omega - omega x J omega

(Mahony, Kumar & Corke, "Multirotor aerial vehicles", IEEE Robotics & Automation Magazine 19, 2012,
eq. 1 to 6.) A step is semi-implicit: rates first, then what they move, as a strapdown computes it.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from robins.bench.parts.station import Inputs, Part
from robins.bench.rigs.multirotor.flight import MultirotorConfig
from robins.earth.atmosphere import G0, pressure_Pa
from robins.rotation import conjugate, from_rotvec, multiply, rotate, to_dcm

DOWN = np.array([0.0, 0.0, 1.0])
ARM_M = 0.18  # of each motor, along x and along y
REACTION_M = 0.05  # ratio of torque about z to thrust

FORWARD, RIGHT = np.array([1.0, -1.0, 1.0, -1.0]), np.array([1.0, -1.0, -1.0, 1.0])
# The first two propellers turn counter-clockwise seen from above; the reaction is clockwise.
REACTS = np.array([1.0, 1.0, -1.0, -1.0])
MIXER = np.stack([-ARM_M * RIGHT, ARM_M * FORWARD, REACTION_M * REACTS])  # (3, 4) N m per N
MOST_N, LAG_S = 8.0, 0.02  # of a motor
MASS_KG, DRAG_KG_S = 1.5, 0.2
INERTIA_KG_M2 = np.array([0.02, 0.02, 0.04])
DAMPING = 2e-3  # N m s/rad
FIX_S, SLOW_S = 0.2, 0.02  # periods of fixes; of compass and barometer


class Airframe(NamedTuple):
    """The craft."""

    q_nb: Any  # (4,)
    omega_b: Any  # (3,) rad/s
    p_n: Any  # (3,) m
    v_n: Any  # (3,) m/s
    thrust: Any  # (4,) N
    f_b: Any  # (3,) m/s^2, over the last step


def at_rest() -> Airframe:
    """Craft level on the ground, heading north."""
    none = np.zeros(3)
    return Airframe(np.array([1.0, 0.0, 0.0, 0.0]), none, none, none, np.zeros(4), -G0 * DOWN)


@jax.jit
def moved(s: Airframe, control: Array, wind_n: Array, dt: Array) -> Airframe:
    """Step of dt [s] under motor commands (4,) in [0, 1] and the wind (3,) [m/s] NED."""
    down, inertia = jnp.asarray(DOWN), jnp.asarray(INERTIA_KG_M2)
    thrust = s.thrust + (1.0 - jnp.exp(-dt / LAG_S)) * (MOST_N * control - s.thrust)
    gyroscopic = jnp.cross(s.omega_b, inertia * s.omega_b)
    torque = jnp.asarray(MIXER) @ thrust - DAMPING * s.omega_b - gyroscopic
    omega = s.omega_b + dt * torque / inertia
    q = multiply(s.q_nb, from_rotvec(dt * omega))
    drag_b = -DRAG_KG_S * rotate(conjugate(q), s.v_n - wind_n)
    f_b = (drag_b - down * jnp.sum(thrust)) / MASS_KG
    v = s.v_n + dt * (rotate(q, f_b) + G0 * down)
    flies = Airframe(q, omega, s.p_n + dt * v, v, thrust, f_b)
    still = jnp.zeros(3)
    stands = Airframe(s.q_nb, still, s.p_n, still, thrust, -G0 * rotate(conjugate(s.q_nb), down))
    on_ground = (s.p_n[2] >= 0.0) & (v[2] >= 0.0)
    return jax.tree_util.tree_map(lambda a, b: jnp.where(on_ground, a, b), stands, flies)


def craft(config: MultirotorConfig) -> Part:
    """The craft; a motor command holds until the next."""
    wind_n, dt = np.asarray(config.given.wind), config.step_ns * 1e-9
    begin = (at_rest(), np.zeros(4))

    def act(state: tuple[Airframe, np.ndarray], k: int, inputs: Inputs):
        asked = inputs["motors"]
        control = state[1] if asked is None else asked["control"]
        after = Airframe(*map(np.asarray, moved(state[0], control, wind_n, dt)))
        said = {name: getattr(after, name) for name in ("q_nb", "omega_b", "p_n", "v_n", "f_b")}
        return (after, control), [("motion", said)]

    def compiled() -> None:
        act(begin, 0, {"motors": None})

    return Part("craft", {"motors": 1}, lambda: begin, act, rare=compiled)


def _noise(config: MultirotorConfig, part: int, k: int, count: int) -> np.ndarray:
    """Standard normal numbers of a part in a step, from a counter-based generator."""
    key = np.array([config.seed, part], np.uint64)
    return np.random.Generator(np.random.Philox(key=key, counter=[0, k, 0, 0])).normal(size=count)


def _every(config: MultirotorConfig, seconds: float) -> int:
    return max(1, round(seconds * 1e9 / config.step_ns))


def imu(config: MultirotorConfig) -> Part:
    """The inertial unit: one sample per step; compass and barometer at their own period."""
    given, every = config.given, _every(config, SLOW_S)

    def act(state: None, k: int, inputs: Inputs):
        if (motion := inputs["motion"]) is None:
            return None, []
        noise = _noise(config, 0, k, 10)
        field_b, pressure = np.full(3, np.nan), np.nan
        if k % every == 0:
            field_b = to_dcm(motion["q_nb"]).T @ config.field_n_T + given.compass * noise[6:9]
            pressure = pressure_Pa(given.alt - motion["p_n"][2]) + given.barometer * noise[9]
        said = {
            "omega_b": motion["omega_b"] + given.gyro * noise[:3],
            "f_b": motion["f_b"] + given.accelerometer * noise[3:6],
            "field_b": field_b,
            "pressure": pressure,
        }
        return None, [("sample", said)]

    return Part("imu", {"motion": 0}, lambda: None, act)


def gnss(config: MultirotorConfig) -> Part:
    """The GNSS receiver, with five fixes per second."""
    given, every = config.given, _every(config, FIX_S)

    def act(state: None, k: int, inputs: Inputs):
        motion = inputs["motion"]
        if motion is None or k % every:
            return None, []
        noise = _noise(config, 1, k, 6)
        lat, lon, alt = config.place(motion["p_n"] + given.receiver * noise[:3])
        v_n = motion["v_n"] + given.receiver_velocity * noise[3:]
        return None, [("fix", {"lat": lat, "lon": lon, "alt": alt, "v_n": v_n})]

    return Part("gnss", {"motion": 0}, lambda: None, act)
