"""Attitude matching: a slave's computed attitude against its master's, as a linear system.

Gu & Qin (2005), eq. 7 to 10, with the errors that its printed signs mean (spec of the axes in
`bank_turn`). n is the navigation frame, s the slave's body axes, m the master's, and C_hat =
exp(-phi x) C for a computed attitude. The slave sits on the master by

    C_sm = exp(lambda x) C_nominal exp(mu x)        (slave axes to master axes)

with the flexure lambda in master axes and the mounting error mu in slave axes. States, in one unit
of angle throughout, rates in that unit per second:

    phi  (3)  attitude error of the slave, n           phi' = -omega_in x phi - C_sn (eps + noise)
    eps  (3)  constant drift of its gyros, s           eps' = 0
    mu   (3)  mounting error, s                        mu'  = 0
    lambda, lambda' (6)  flexure and its rate, m       optional, second-order Gauss-Markov

    Z = vee of the skew part of C_hat_mn C_nominal C_hat_sn'
      = phi - C_mn C_nominal mu - C_mn lambda - noise

phi is the error of the slave's *own* attitude, which the flexure turns and the slave's gyros feel:
so flexure drives no other state, and enters Z once. What the accelerometers do has no part in this
(velocity is not measured; through omega_in it is 0.02' over 20 s).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jax.tree_util import Partial

from robins import _float64, units  # noqa: F401
from robins.filters import Belief, Model, Motion, Sensor
from robins.sim.flexure import Flexure, transition
from robins.systems.transfer_alignment.bank_turn import (
    BankTurn,
    attitude_enu,
    mean_attitude_enu,
    rate_in_enu,
)

ATTITUDE = "attitude_matching"  # name of the sensor
STATES = 9
STATES_FLEXIBLE = 15


class Spread(NamedTuple):
    """What is known of the states at the start, as standard deviations, and of the gyros."""

    attitude_rad: float
    gyro_bias_rad_s: float
    mounting_rad: float
    gyro_noise: float  # rad/sqrt(s)


class AttitudeMatching(NamedTuple):
    """x' = F x + G w, z = H x + v over a run, in one unit of angle; w of unit variance.

    n is 9, or 15 with flexure; leading axis E of the updates, the first one a period after the
    start.
    """

    F: np.ndarray  # (E, n, n)
    G: np.ndarray  # (n, q)
    H: np.ndarray  # (E, 3, n)
    sigma: np.ndarray  # (n,) standard deviations of the initial state

    def in_unit(self, unit: str) -> AttitudeMatching:
        """The same system, which is in radians, in another unit of angle: F and H stay."""
        per_rad = float(units.from_si(1.0, units.unit(unit, "angle")))
        return self._replace(G=per_rad * self.G, sigma=per_rad * self.sigma)

    def first(self, updates: int) -> AttitudeMatching:
        """The same, ending earlier."""
        return self._replace(F=self.F[:updates], H=self.H[:updates])

    @property
    def P0(self) -> np.ndarray:
        """(n, n) covariance of the initial state."""
        return np.diag(self.sigma**2)

    @property
    def Q(self) -> np.ndarray:
        """(n, n) covariance of the process noise of a period."""
        return self.G @ self.G.T

    def start(self) -> Belief:
        """The belief before the first prediction: no error."""
        return Belief(jnp.zeros(len(self.sigma)), jnp.diag(jnp.asarray(self.sigma)))

    def model(self, sigma: float) -> Model:
        """The model, for white measurement noise of this size on each axis.

        Everything but the number of states is data, so that filters of one size share what was
        compiled, in any unit and for any noise. A run takes F for its inputs and H for what the
        sensor needs: see `inputs`.
        """
        G = jnp.asarray(self.G)
        sensor = Sensor(_read, jnp.full(3, float(sigma)), 3, ATTITUDE, linear=_seen)
        return Model(Motion(_move, G, linear=Partial(_moved, G)), (sensor,))

    def inputs(self) -> tuple[Any, dict[str, Any]]:
        """``u`` and ``aux`` of a run."""
        return jnp.asarray(self.F), {ATTITUDE: jnp.asarray(self.H)}


def _move(x, F):
    return F @ x


def _moved(G, x, F):
    return F @ x, F, G


def _read(x, H):
    return H @ x


def _seen(x, H):
    return H @ x, H


def cross_matrix(w: np.ndarray) -> np.ndarray:
    """(..., 3, 3) with ``cross_matrix(w) @ v == cross(w, v)``."""
    return np.cross(np.asarray(w)[..., None, :], np.eye(3)).swapaxes(-1, -2)


def error_dynamics(C_sn: np.ndarray, omega_in_n: np.ndarray) -> np.ndarray:
    """F of x' = F x in continuous time, (..., 9, 9).

    Args:
        C_sn: (..., 3, 3) slave axes to n.
        omega_in_n: (..., 3) rad/s, rate of n.
    """
    F = np.zeros((*np.shape(C_sn)[:-2], STATES, STATES))
    F[..., :3, :3] = -cross_matrix(omega_in_n)
    F[..., :3, 3:6] = -C_sn
    return F


def matching_matrix(C_mn: np.ndarray, C_nominal: np.ndarray, flexible: bool = False) -> np.ndarray:
    """H of Z = H x, (..., 3, 9), or (..., 3, 15) with flexure.

    Args:
        C_mn: (..., 3, 3) master axes to n.
        C_nominal: (3, 3) slave axes to master axes, as mounted on paper.
        flexible: whether the state has flexure.
    """
    H = np.zeros((*np.shape(C_mn)[:-2], 3, STATES_FLEXIBLE if flexible else STATES))
    H[..., :3] = np.eye(3)
    H[..., 6:9] = -C_mn @ C_nominal
    if flexible:
        H[..., 9:12] = -C_mn
    return H


def attitude_matching(
    turn: BankTurn,
    period_s: float,
    updates: int,
    spread: Spread,
    C_nominal: np.ndarray | None = None,
    flexure: Flexure | None = None,
) -> AttitudeMatching:
    """The system along a bank turn, in radians.

    The attitudes in F and H are those of the manoeuvre and of the nominal mounting, so nothing
    depends on a measurement. F is taken to first order with the mean attitude of each period: in a
    roll of 72 deg/s, 3.6 deg go by in 50 ms.

    Args:
        turn: the manoeuvre.
        period_s: between two updates.
        updates: how many.
        spread: initial standard deviations and gyro noise.
        C_nominal: (3, 3) slave axes to master axes, as mounted on paper; by default the identity.
        flexure: adds six states that swing so; its bending and tails are not modelled.
    """
    nominal = np.eye(3) if C_nominal is None else np.asarray(C_nominal)
    begin_s = period_s * np.arange(updates)
    mean_C = mean_attitude_enu(turn, begin_s, period_s) @ nominal
    Phi = np.eye(STATES) + period_s * error_dynamics(
        mean_C, rate_in_enu(turn, begin_s + 0.5 * period_s)
    )
    H = matching_matrix(attitude_enu(turn, begin_s + period_s), nominal, flexure is not None)
    # white on all axes alike, so no rotation changes it
    G = spread.gyro_noise * np.sqrt(period_s) * np.eye(STATES, 3)
    initial = np.repeat([spread.attitude_rad, spread.gyro_bias_rad_s, spread.mounting_rad], 3)
    if flexure is None:
        return AttitudeMatching(Phi, G, H, initial)
    swing, drive, swing_sigma = _swing(flexure, period_s)
    return AttitudeMatching(
        _block_diagonal(Phi, np.broadcast_to(swing, (updates, 6, 6))),
        _block_diagonal(G, drive),
        H,
        np.concatenate([initial, swing_sigma]),
    )


def _swing(flexure: Flexure, period_s: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Transition, noise factor and stationary spread of [lambda, lambda'], three axes each."""
    Phi, L, sigma = np.zeros((6, 6)), np.zeros((6, 6)), np.zeros(6)
    for axis in range(3):
        both = [axis, axis + 3]
        size, tau = float(flexure.sigma_rad[axis]), float(flexure.tau_s[axis])
        step, drive = (np.asarray(a) for a in transition(size, tau, flexure.damping, period_s))
        Phi[np.ix_(both, both)], L[np.ix_(both, both)] = step, drive
        stationary = scipy.linalg.solve_discrete_lyapunov(step, drive @ drive.T)
        sigma[both] = np.sqrt(np.diag(stationary))  # angle and rate are uncorrelated
    return Phi, L, sigma


def _block_diagonal(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Blocks (..., n, p) and (..., m, q) to (..., n + m, p + q)."""
    n, p = a.shape[-2:]
    out = np.zeros((*a.shape[:-2], n + b.shape[-2], p + b.shape[-1]))
    out[..., :n, :p], out[..., n:, p:] = a, b
    return out
