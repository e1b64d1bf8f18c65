"""Attitude matching in a bank turn: the manoeuvre, and the linear system of its errors.

After Gu & Qin (2005), eq. 6 to 10, with errors defined to match its printed signs. n is
east-north-up (ENU), s the slave's and m the master's right-forward-up body axes (RFU), omega_in the
rate of n. The slave is mounted on the master with a mounting error mu, in slave axes, and a flexure
lambda, in master axes; a computed attitude has the error phi:

    C_ms  = exp(lambda x) C_nominal exp(mu x)          (1)   slave axes to master axes
    C_hat = exp(-phi x) C                              (2)

State x = [phi, eps, mu], or [phi, eps, mu, lambda, lambda'], in radians and rad/s: angles, and the
drift eps of the slave's gyros, which have white noise w of density N:

    phi' = -omega_in x phi - C_ns (eps + w)            (3)   eq. 7 of the paper
    eps' = 0,   mu' = 0                                (4)
    lambda'' + 2 zeta wn lambda' + wn^2 lambda = q     (5)   optional, see `robins.sim.flexure`

The measurement is the skew part of the product of the attitudes, with white noise v of variance R:

    Z = vee(skew(C_hat_nm C_nominal C_hat_ns'))        (6)   eq. 6
      = phi - C_nm C_nominal mu - C_nm lambda + v      (7)   eq. 10

phi is the error of the slave's *own* attitude, which includes the flexure, because its gyros sense
it: so flexure drives no other state, and enters Z once. Accelerometers do not enter (velocity is
not measured; its effect through omega_in is 0.02' over 20 s).
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxtyping import Array, ArrayLike

from robins import _float64, units  # noqa: F401
from robins.earth import earth_rate_n, transport_rate_n
from robins.filters import Belief, Model, Sensor
from robins.ins.frames import swap
from robins.rotation import Rotation, skew
from robins.sim.flexure import Flexure, stationary_sigma, swing
from robins.systems.parts import moved_by, seen_by
from robins.systems.transfer_alignment.attitude_matching.parameters import (
    AttitudeMatching,
    BankTurn,
)

ATTITUDE = "attitude_matching"  # name of the sensor
PHI, EPS, MU, LAMBDA = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12)
STATES, STATES_FLEXIBLE = 9, 15
G_M_S2 = units.parse("1 g", "acceleration")
MEAN_POINTS = 50  # midpoints of a mean; 50 leave an error of 2e-6 for 3.6 deg of roll


# ----------------------------------------------------------------------------------- the bank turn


def roll_rad(turn: BankTurn, t_s: np.ndarray | float) -> np.ndarray:
    """Roll, right wing down; in the turn that of a coordinated one, atan(a / g)."""
    bank = np.arctan(turn.acceleration / G_M_S2)
    at = np.cumsum([0.0, turn.roll_time, turn.turn_time, turn.roll_time])
    return np.asarray(np.interp(t_s, at, [0.0, bank, bank, 0.0]))


def heading_rad(turn: BankTurn, t_s: np.ndarray | float) -> np.ndarray:
    """Heading, clockwise from north, not wrapped; in the turn its rate is a / v."""
    turning = np.clip(np.asarray(t_s, float) - turn.roll_time, 0.0, turn.turn_time)
    return np.asarray(turn.heading + turn.acceleration / turn.speed * turning)


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
    """Mean of C_nb over each period, (E, 3, 3), from its begin (E,): it maps a constant drift."""
    inside = (np.arange(MEAN_POINTS) + 0.5) / MEAN_POINTS * period_s
    return np.mean(attitude_enu(turn, np.asarray(begin_s)[:, None] + inside), axis=1)


def rate_in_enu(turn: BankTurn, t_s: np.ndarray | float) -> np.ndarray:
    """omega_in_n, (..., 3) rad/s, ENU: Earth rate and transport rate at sea level."""
    h = heading_rad(turn, t_s)
    v_ned = turn.speed * np.stack([np.cos(h), np.sin(h), np.zeros_like(h)], -1)
    over_earth = np.asarray(transport_rate_n(turn.latitude, 0.0, v_ned))
    return np.asarray(swap(over_earth + np.asarray(earth_rate_n(turn.latitude))))


# ------------------------------------------------------------------------------- the linear system


class LinearSystem(NamedTuple):
    """x' = F x + G w, z = H x + v over a run, in one unit of angle; w of unit variance.

    n is 9, or 15 with flexure; leading axis E of the updates, the first one a period after the
    start.
    """

    F: np.ndarray  # (E, n, n)
    G: np.ndarray  # (n, q), Q = G G'
    H: np.ndarray  # (E, 3, n)
    sigma: np.ndarray  # (n,) standard deviations of the initial state

    def in_unit(self, unit: str) -> LinearSystem:
        """The system, given in radians, in another unit of angle: F and H are unchanged."""
        per_rad = float(units.from_si(1.0, units.unit(unit, "angle")))
        return self._replace(G=per_rad * self.G, sigma=per_rad * self.sigma)

    def start(self) -> Belief:
        """The belief before the first prediction, with a mean of zero."""
        return Belief(jnp.zeros(len(self.sigma)), jnp.diag(jnp.asarray(self.sigma)))

    def model(self, sigma: float) -> Model:
        """The model, for white measurement noise of this size on each axis.

        Everything but the number of states is data, so filters of one size share a compiled
        program, in any unit and for any noise. F is the input of the motion and H that of the
        sensor: see `inputs`.
        """
        return Model(moved_by(None, _moved, jnp.asarray(self.G)), (reading(float(sigma)),))

    def inputs(self) -> tuple[Array, dict[str, Array]]:
        """``u`` and ``aux`` of a run."""
        return jnp.asarray(self.F), {ATTITUDE: jnp.asarray(self.H)}


def reading(sigma: ArrayLike) -> Sensor:
    """Sensor of the matched attitude, with white noise of this sigma on each axis."""
    return seen_by(_seen, jnp.full(3, sigma), 3, ATTITUDE)


def _moved(G, x, F):
    return F @ x, F, G


def _seen(x, H):
    return H @ x, H


def error_dynamics(C_ns: np.ndarray, omega_in_n: np.ndarray) -> np.ndarray:
    """F of x' = F x in continuous time, eqs. (3) and (4), (..., 9, 9), for omega_in in rad/s."""
    #     phi           eps    mu
    #     -[omega_in x] -C_ns  0   phi
    #     0             0      0   eps
    #     0             0      0   mu
    F = np.zeros((*np.shape(C_ns)[:-2], STATES, STATES))
    F[..., PHI, PHI] = -np.asarray(skew(jnp.asarray(omega_in_n)))
    F[..., PHI, EPS] = -C_ns
    return F


def matching_matrix(C_nm: np.ndarray, C_nominal: np.ndarray, flexible: bool = False) -> np.ndarray:
    """H of Z = H x, eq. (7), (..., 3, 9), or (..., 3, 15) with states of the flexure."""
    #     phi  eps  mu              lambda  lambda'
    #     I    0    -C_nm C_nominal -C_nm   0
    H = np.zeros((*np.shape(C_nm)[:-2], 3, STATES_FLEXIBLE if flexible else STATES))
    H[..., PHI] = np.eye(3)
    H[..., MU] = -C_nm @ C_nominal
    if flexible:
        H[..., LAMBDA] = -C_nm
    return H


def linear_system(
    given: AttitudeMatching, updates: int, flexure: Flexure | None = None
) -> LinearSystem:
    """The filter's linear system along a bank turn, in radians.

    With the period T of the updates, Phi = I + F T and Q = diag(N^2 T I, 0, 0); gyro noise is white
    and equal on all axes, so no rotation changes it. The attitudes in F and H are those of the
    manoeuvre and of the nominal mounting, so nothing depends on a measurement. F is taken to first
    order with the mean attitude of each period: in a roll of 72 deg/s, 3.6 deg go by in 50 ms.

    Args:
        given: the scenario.
        updates: number of updates.
        flexure: adds six states of this flexure; its bending and tails are not modelled.
    """
    turn, T, spread = given.manoeuvre, given.period, given.believed
    nominal = np.asarray(Rotation.from_rotvec(given.mounting.nominal).as_dcm())
    begin_s = T * np.arange(updates)
    mean_C_ns = mean_attitude_enu(turn, begin_s, T) @ nominal
    F = error_dynamics(mean_C_ns, rate_in_enu(turn, begin_s + 0.5 * T))
    H = matching_matrix(attitude_enu(turn, begin_s + T), nominal, flexure is not None)
    rigid = LinearSystem(
        F=np.eye(STATES) + T * F,
        G=given.slave.gyro_noise * np.sqrt(T) * np.eye(STATES, 3),
        H=H,
        sigma=np.repeat([spread.attitude, spread.gyro_bias, spread.mounting], 3),
    )
    if flexure is None:
        return rigid
    swings, drive = (np.asarray(a) for a in swing(flexure, T))
    Phi = np.zeros((updates, STATES_FLEXIBLE, STATES_FLEXIBLE))
    Phi[:, :STATES, :STATES], Phi[:, STATES:, STATES:] = rigid.F, swings
    G = np.asarray(scipy.linalg.block_diag(rigid.G, drive))
    return LinearSystem(Phi, G, H, np.concatenate([rigid.sigma, stationary_sigma(flexure)]))
