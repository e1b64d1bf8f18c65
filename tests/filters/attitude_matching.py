"""Attitude matching of a slave inertial unit with its master: nine states, 20 s, 400 updates.

The matrices of the reference scenario of a well-known transfer alignment (Gu & Qin 2005): an
aircraft at 240 m/s rolls in within 1 s to a level turn of 3 g, holds it for 11 s and rolls out.
State: attitude error phi (E N U), gyro drift eps and mounting angle mu (body: right forward up),
in one unit of angle throughout, eps per second. Plain NumPy, no filter.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from robins.filters import Belief, Model, Motion, Sensor

PERIOD_S = 0.05
STEPS = 400
PER_DEG = {"rad": np.pi / 180.0, "deg": 1.0, "arcmin": 60.0}

SPEED_M_S = 240.0
TURN_RAD_S = 3.0 * 9.80665 / SPEED_M_S
BANK_RAD = np.arctan(3.0)
LAT_RAD = np.deg2rad(34.0)
EARTH_RAD_S = 7.292115e-5
RADIUS_M = 6378137.0
ECCENTRICITY_SQ = 0.00669437999014


class System(NamedTuple):
    """x' = F x + w, z = H x + v with R = I, over the run; P0 before the first prediction."""

    F: np.ndarray  # (T, 9, 9)
    Q: np.ndarray  # (9, 9)
    H: np.ndarray  # (T, 3, 9)
    P0: np.ndarray  # (9, 9)

    def run_with(self) -> tuple:
        """Model, start and the inputs and extras of a run; sizes alone decide what is compiled."""
        motion = Motion(move, jnp.sqrt(jnp.diag(self.Q)))
        model = Model(motion, (Sensor(read, np.ones(3), 3),))
        start = Belief.of(np.zeros(9), self.P0)
        return model, start, jnp.array(self.F), {"y": jnp.array(self.H)}


def move(x, F):
    return F @ x


def read(x, H):
    return H @ x


def _cross(w):
    return np.array([[0.0, -w[2], w[1]], [w[2], 0.0, -w[0]], [-w[1], w[0], 0.0]])


def heading_rad(t_s):
    """Clockwise from north, starting there."""
    return TURN_RAD_S * np.clip(np.asarray(t_s) - 1.0, 0.0, 11.0)


def C_nb(t_s):
    """(..., 3, 3) body to ENU: Rz(-heading) Ry(roll) at zero pitch."""
    h = heading_rad(t_s)
    r = np.interp(t_s, [0.0, 1.0, 12.0, 13.0], [0.0, BANK_RAD, BANK_RAD, 0.0])
    zero, one = np.zeros_like(h), np.ones_like(h)
    turn = [[np.cos(h), np.sin(h), zero], [-np.sin(h), np.cos(h), zero], [zero, zero, one]]
    roll = [[np.cos(r), zero, np.sin(r)], [zero, one, zero], [-np.sin(r), zero, np.cos(r)]]
    turn, roll = (np.moveaxis(np.array(a), (0, 1), (-2, -1)) for a in (turn, roll))
    return turn @ roll


def omega_in_n(t_s):
    """(3,) rate of the navigation frame [rad/s], ENU: earth rate and transport rate."""
    h = heading_rad(t_s)
    across = 1.0 - ECCENTRICITY_SQ * np.sin(LAT_RAD) ** 2
    RN = RADIUS_M / np.sqrt(across)
    RM = RN * (1.0 - ECCENTRICITY_SQ) / across
    east, north = SPEED_M_S * np.sin(h), SPEED_M_S * np.cos(h)
    return np.array(
        [
            -north / RM,
            EARTH_RAD_S * np.cos(LAT_RAD) + east / RN,
            EARTH_RAD_S * np.sin(LAT_RAD) + east * np.tan(LAT_RAD) / RN,
        ]
    )


def attitude_matching(unit: str = "deg", steps: int = STEPS, P0: str = "physical") -> System:
    """The matrices in one unit of angle.

    Args:
        unit: "rad", "deg" or "arcmin".
        steps: updates, the first one filter period after the start.
        P0: "physical", (0.5 deg)^2, (1 deg/h)^2, (0.3 deg)^2; or "identity", in the unit.
    """
    per_deg = PER_DEG[unit]
    F, H = np.tile(np.eye(9), (steps, 1, 1)), np.zeros((steps, 3, 9))
    for k in range(steps):
        t_s = k * PERIOD_S
        # 3.6 deg of roll go by in one period of the roll-in: its mean attitude turns the drift.
        mean_C = C_nb(t_s + (np.arange(50) + 0.5) / 50 * PERIOD_S).mean(axis=0)
        F[k, :3, :3] -= _cross(omega_in_n(t_s + PERIOD_S / 2)) * PERIOD_S
        F[k, :3, 3:6] = -mean_C * PERIOD_S
        H[k, :, :3] = np.eye(3)
        H[k, :, 6:] = -C_nb(t_s + PERIOD_S)
    walk = 0.1 / 60.0 * per_deg  # 0.1 deg/sqrt(h), per sqrt(s)
    Q = np.diag(np.repeat([walk**2 * PERIOD_S, 0.0, 0.0], 3))
    sigma = np.repeat([0.5 * per_deg, per_deg / 3600.0, 0.3 * per_deg], 3)
    return System(F, Q, H, np.eye(9) if P0 == "identity" else np.diag(sigma**2))
