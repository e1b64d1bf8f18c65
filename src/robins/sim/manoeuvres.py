"""Motions for in-flight alignment: a banking aircraft, a ship in waves, a rough road.

    right, left = np.deg2rad([30.0, -30.0])
    s_turn = [BankedTurn(0.0, 10.0), BankedTurn(right, 31.0), BankedTurn(left, 30.0)]
    motion = fly(Geodetic.from_degrees(32.0, 118.0, 5000.0), s_turn, speed_mps=100.0)

`fly` follows commanded bank angles at constant speed and height, `sail` sways about a straight
course, `roughen` shakes the attitude of any motion, such as one of `robins.sim.commands`. Offline,
NumPy, north-east-down and forward-right-down; see `robins.sim.trajectory`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation as _Rotation

from robins.earth import Geodetic, gravity
from robins.errors import require
from robins.sim.trajectory import (
    MotionProfile,
    along,
    from_velocity,
    knots_of,
    quaternion,
    smoothstep,
)

_STEEPEST_RAD = np.deg2rad(85.0)
_KNOTS_A_PERIOD = 20


class BankedTurn(NamedTuple):
    """Bank angle, right wing down positive, and duration of the leg, roll-in included."""

    bank_rad: float
    duration_s: float


class Wave(NamedTuple):
    """``amplitude sin(2 pi t / period + phase)``."""

    amplitude: float  # rad, or m of heave
    period_s: float
    phase_rad: float = 0.0


class SeaMotion(NamedTuple):
    """Motion of a ship in waves: sums of sines."""

    roll: Sequence[Wave] = ()  # rad
    pitch: Sequence[Wave] = ()  # rad
    yaw: Sequence[Wave] = ()  # rad, about the course
    heave: Sequence[Wave] = ()  # m, upwards


MODERATE_SEA = SeaMotion(
    roll=(Wave(np.deg2rad(5.0), 10.0), Wave(np.deg2rad(1.0), 6.3, 1.0)),
    pitch=(Wave(np.deg2rad(2.0), 6.0, 0.5), Wave(np.deg2rad(0.5), 4.1, 2.0)),
    yaw=(Wave(np.deg2rad(1.5), 8.0, 1.5),),
    heave=(Wave(1.0, 7.0, 0.8),),
)
"""Round numbers for a ship of some thousand tonnes; assumed, without a source."""


def fly(
    start: Geodetic,
    banks: Sequence[BankedTurn],
    speed_mps: float,
    heading_rad: float = 0.0,
    pitch_rad: float = 0.0,
    roll_s: float = 2.0,
    knots_hz: float = 50.0,
) -> MotionProfile:
    """An aircraft that banks as commanded, at constant ground speed, height and pitch.

    It begins with level wings and rolls to the bank of each leg within the leg's first `roll_s`,
    smoothly (two continuous derivatives). The heading turns at ``g tan(bank) / V``, the rate of a
    level coordinated turn. The bank is such that there is no lateral specific force: that
    commanded, but for the few arcminutes that pitch and Coriolis acceleration require.

    Args:
        start: position at the start.
        banks: the legs, in order.
        speed_mps: over the ground.
        heading_rad: initial heading, clockwise from north.
        pitch_rad: constant pitch.
        roll_s: time to roll from one bank to the next.
        knots_hz: of the splines.

    Raises:
        ValueError: no legs; a leg not longer than it takes to roll; a bank of 85 deg or more; a
            speed or a time that is not positive; a pole.
    """
    require(banks, "banks: the list is empty")
    _positive(speed_mps=speed_mps, roll_s=roll_s, knots_hz=knots_hz)
    for k, leg in enumerate(banks):
        if not leg.duration_s >= roll_s:
            raise ValueError(
                f"bank {k} lasts {leg.duration_s:g} s, less than the {roll_s:g} s it takes to roll"
            )
        if not abs(leg.bank_rad) < _STEEPEST_RAD:
            raise ValueError(
                f"bank {k} is {np.rad2deg(leg.bank_rad):g} deg; a level turn needs less than 85 deg"
            )
    t = knots_of(float(sum(leg.duration_s for leg in banks)), knots_hz)
    bank, begin, before = np.zeros_like(t), 0.0, 0.0
    for leg in banks:
        bank += (leg.bank_rad - before) * smoothstep(np.clip((t - begin) / roll_s, 0.0, 1.0))
        begin, before = begin + leg.duration_s, leg.bank_rad
    g = float(np.asarray(gravity(start.lat, start.alt)))
    turn = make_interp_spline(t, g * np.tan(bank) / speed_mps, k=5).antiderivative()
    heading = heading_rad + turn(t)
    v_n = speed_mps * np.stack([np.cos(heading), np.sin(heading), np.zeros_like(t)], -1)
    pitch = np.full_like(t, pitch_rad)
    path = from_velocity(t, v_n, start, quaternion(np.zeros_like(t), pitch, heading))
    attitude = along(path.at(t), heading, pitch, "aircraft")
    return from_velocity(t, v_n, start, attitude)


def sail(
    start: Geodetic,
    duration_s: float,
    speed_mps: float = 0.0,
    heading_rad: float = 0.0,
    sea: SeaMotion = MODERATE_SEA,
    knots_hz: float = 20.0,
) -> MotionProfile:
    """A ship on a straight course at constant speed, swaying and heaving in the sea.

    Args:
        start: position at still water; the heave at time zero adds to its height.
        duration_s: of the motion.
        speed_mps: over the ground, along the course; may be zero.
        heading_rad: the course, clockwise from north; the yaw of the sea adds to the heading only.
        sea: roll, pitch, yaw and heave of the ship.
        knots_hz: knot rate of the splines; raised to twenty a period of the fastest wave.

    Raises:
        ValueError: a duration or period that is not positive, a negative speed, or a pole.
    """
    _positive(duration_s=duration_s, knots_hz=knots_hz)
    require(speed_mps >= 0.0, f"speed_mps is {speed_mps}: a ground speed is not negative")
    t = knots_of(duration_s, _dense(knots_hz, *sea))
    roll, pitch, yaw, heave = (_sum(waves, t) for waves in sea)
    v_n = np.empty((len(t), 3))
    v_n[:, 0], v_n[:, 1] = speed_mps * np.cos(heading_rad), speed_mps * np.sin(heading_rad)
    v_n[:, 2] = -_slope(sea.heave, t)
    origin = Geodetic(start.lat, start.lon, float(start.alt) + float(heave[0]))
    return from_velocity(t, v_n, origin, quaternion(roll, pitch, heading_rad + yaw))


def roughen(
    motion: MotionProfile,
    roll: Sequence[Wave] = (),
    pitch: Sequence[Wave] = (),
    knots_hz: float = 50.0,
) -> MotionProfile:
    """The same path with small oscillations of roll and pitch added, as on a rough road.

    Raises:
        ValueError: a period that is not positive.
    """
    t = knots_of(motion.duration_s, _dense(knots_hz, roll, pitch))
    sway = quaternion(_sum(roll, t), _sum(pitch, t), np.zeros_like(t))
    k = motion.at(t)
    base, top = (_Rotation.from_quat(q, scalar_first=True) for q in (k.q_nb, sway))
    origin = Geodetic(k.lat[0], k.lon[0], k.alt[0])
    return from_velocity(t, k.v_n, origin, (base * top).as_quat(scalar_first=True))


def _dense(knots_hz: float, *sums: Sequence[Wave]) -> float:
    waves = [wave for waves in sums for wave in waves]
    for wave in waves:
        require(wave.period_s > 0.0, f"{wave}: the period must be positive")
    return max([knots_hz, *(_KNOTS_A_PERIOD / wave.period_s for wave in waves)])


def _sum(waves: Sequence[Wave], t: np.ndarray) -> np.ndarray:
    total = np.zeros_like(t)
    for wave in waves:
        total += wave.amplitude * np.sin(2.0 * np.pi * t / wave.period_s + wave.phase_rad)
    return total


def _slope(waves: Sequence[Wave], t: np.ndarray) -> np.ndarray:
    total = np.zeros_like(t)
    for wave in waves:
        omega = 2.0 * np.pi / wave.period_s
        total += wave.amplitude * omega * np.cos(omega * t + wave.phase_rad)
    return total


def _positive(**values: float) -> None:
    for name, value in values.items():
        require(np.isfinite(value) and value > 0.0, f"{name} is {value}; it must be positive")
