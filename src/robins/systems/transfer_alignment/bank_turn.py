"""A bank turn in closed form: roll in, turn level at a constant rate, roll out, fly on.

The manoeuvre of Gu & Qin (2005) in the axes of that paper: navigation frame east-north-up (ENU),
body right-forward-up (RFU). Speed and height stay; the heading changes only between the two rolls,
at the rate a / v of the horizontal acceleration a. Plain NumPy, evaluated once for all runs.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from robins import units
from robins.earth import earth_rate_n, transport_rate_n
from robins.ins.frames import swap

G_M_S2 = units.parse("1 g", "acceleration")
MEAN_POINTS = 50  # midpoints of a mean; 50 leave 2e-6 of 3.6 deg of roll


class BankTurn(NamedTuple):
    """The manoeuvre; it begins level at time 0."""

    speed_m_s: float
    acceleration_m_s2: float  # horizontal, to the right in the turn; negative: a left turn
    roll_time_s: float  # of each of the two rolls, at a constant rate
    turn_time_s: float  # between them
    lat_rad: float
    heading_rad: float = 0.0  # at the start, clockwise from north


def roll_rad(turn: BankTurn, t_s: np.ndarray | float) -> np.ndarray:
    """Roll, right wing down: that of a coordinated turn, atan(a / g), between the rolls."""
    bank = np.arctan(turn.acceleration_m_s2 / G_M_S2)
    at = np.cumsum([0.0, turn.roll_time_s, turn.turn_time_s, turn.roll_time_s])
    return np.asarray(np.interp(t_s, at, [0.0, bank, bank, 0.0]))


def heading_rad(turn: BankTurn, t_s: np.ndarray | float) -> np.ndarray:
    """Heading, clockwise from north; not wrapped."""
    turning = np.clip(np.asarray(t_s, float) - turn.roll_time_s, 0.0, turn.turn_time_s)
    return np.asarray(turn.heading_rad + turn.acceleration_m_s2 / turn.speed_m_s * turning)


def load_factor(turn: BankTurn, t_s: np.ndarray | float) -> np.ndarray:
    """Specific force over g that holds the height at this roll: 1 / cos(roll)."""
    return np.asarray(1.0 / np.cos(roll_rad(turn, t_s)))


def attitude_enu(turn: BankTurn, t_s: np.ndarray | float) -> np.ndarray:
    """C_nb, (..., 3, 3), RFU to ENU: Rz(-heading) Ry(roll), the pitch being zero."""
    h, r = heading_rad(turn, t_s), roll_rad(turn, t_s)
    zero, one = np.zeros_like(h), np.ones_like(h)
    about_up = [[np.cos(h), np.sin(h), zero], [-np.sin(h), np.cos(h), zero], [zero, zero, one]]
    about_nose = [[np.cos(r), zero, np.sin(r)], [zero, one, zero], [-np.sin(r), zero, np.cos(r)]]
    first, second = (np.moveaxis(np.array(a), (0, 1), (-2, -1)) for a in (about_up, about_nose))
    return first @ second


def mean_attitude_enu(turn: BankTurn, begin_s: np.ndarray, period_s: float) -> np.ndarray:
    """Mean of C_nb over each period, (E, 3, 3): what turns a constant drift over it.

    Args:
        turn: the manoeuvre.
        begin_s: (E,) begins of the periods.
        period_s: their length.
    """
    inside = (np.arange(MEAN_POINTS) + 0.5) / MEAN_POINTS * period_s
    return np.mean(attitude_enu(turn, np.asarray(begin_s)[:, None] + inside), axis=1)


def rate_in_enu(turn: BankTurn, t_s: np.ndarray | float) -> np.ndarray:
    """omega_in_n, (..., 3) rad/s, ENU: Earth rate and transport rate at sea level."""
    h = heading_rad(turn, t_s)
    v_ned = turn.speed_m_s * np.stack([np.cos(h), np.sin(h), np.zeros_like(h)], -1)
    over_earth = np.asarray(transport_rate_n(turn.lat_rad, 0.0, v_ned))
    return np.asarray(swap(over_earth + np.asarray(earth_rate_n(turn.lat_rad))))
