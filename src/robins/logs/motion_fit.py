"""Least-squares fit of an IMU and a receiver to their common motion.

Over a stretch of time the gyros give the rotation C of the body since its begin, so the velocity
gained by the antenna in non-rotating axes is, up to one rotation R of the stretch,

    R (sum C (M_a f - b_a) dt + C (w x l)) = change of v - g dt,   w = M_g w_m - b_g,

at the times t + offset + rate t of the clock of the IMU. Unknown are the matrices M_g and M_a (up
to a common rotation, so M_a is upper triangular), the biases, the lever arm l, the clock, and R.
All but the clock, and M_g, M_a beyond a few percent, are nuisance parameters of every model: a
model is a set of prior standard deviations about the start, and a wide one frees a block.

Residuals of a stretch are correlated, so a sigma is the larger of that for white residuals and that
from the scores of the stretches (Liang and Zeger 1986). R is in closed form (Kabsch 1976).
Velocities are in axes that are inertial during a stretch, so Earth rate needs no terms.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np

from robins.logs.motion import (
    RATE_HZ,
    MotionIntegrals,
    between,
    composed,
    cumulative,
    kabsch,
    power_of,
    rotations,
)
from robins.rotation import skew

SCALE, GYRO_BIAS, FORCE, FORCE_BIAS = slice(0, 9), slice(9, 12), slice(12, 18), slice(18, 21)
LEVER, RATE, OFFSET = slice(21, 24), 24, 25  # an offset for each part of the log
_UPPER = np.triu_indices(3)
_PAD_S, _SMOOTH_S, _EDGE_S = 0.5, 0.1, 0.1
_MOST, _MOST_BIAS, _MOST_LEVER_M = 0.3, 1.0, 5.0  # largest steps of Gauss-Newton
_SHORTER = 0.3  # share of a step that did not help, which is tried next
_STILL = 0.03  # step, in sigmas, that ends the iteration
_TRIMMED = 0.95  # share of the residuals, the smallest, that rates a fit
_ROBUST = 3.0  # typical residuals; larger ones have less weight


class PairState(NamedTuple):
    """Estimated or assumed parameters."""

    M_g: np.ndarray  # (3, 3) applied to angular rates
    b_g: np.ndarray  # (3,) rad/s, subtracted afterwards
    M_a: np.ndarray  # (3, 3) applied to specific forces
    b_a: np.ndarray  # (3,) m/s^2, subtracted afterwards
    lever: np.ndarray  # (3,) m from the IMU to the antenna, body axes
    rate: float  # s/s, added to the stamps of fixes for each second from the middle
    offset: np.ndarray  # (parts,) s, added to the stamps of fixes
    part: np.ndarray  # (stretches,) part of the log of each

    def shift(self, stretch: np.ndarray, time_s: np.ndarray, middle_s: float) -> np.ndarray:
        """Correction [s] to the stamps of fixes at times [s] of stretches."""
        return self.offset[self.part[stretch]] + self.rate * (time_s - middle_s)


class MotionFit(NamedTuple):
    """A fitted model."""

    state: PairState
    sigma: np.ndarray  # (parameters,) one sigma; relative for the matrices
    R: np.ndarray  # (stretches, 3, 3) from the first axes of each to those of its velocities
    squares: np.ndarray  # (k,) residual square of each change of velocity; NaN without IMU
    turned: np.ndarray  # (nodes, 3, 3) attitude C in the middle of each node
    strain: float = 0.0  # chi-square of the parameters relative to their prior
    azimuth: float = 0.0  # rad, one sigma of what the parameters turn all R about the vertical

    def left(self, views: MotionIntegrals) -> float:
        """Unexplained share of the change of velocity; infinite without IMU."""
        seen = np.isfinite(self.squares)
        if not seen.any():
            return np.inf
        return trimmed(self.squares[seen]) / float(np.mean(power_of(views)[views.of[seen]]))

    def by_stretch(self, views: MotionIntegrals) -> np.ndarray:
        """Mean residual squares (stretches,); those of the whole change without IMU."""
        power, out = power_of(views), np.empty(len(views.start_s))
        for s in range(len(out)):
            mine = self.squares[views.of == s]
            out[s] = trimmed(mine) if np.isfinite(mine).all() else power[s]
        return out


def trimmed(squares: np.ndarray) -> float:
    """Mean of squares without the largest twentieth."""
    return float(np.mean(np.sort(squares)[: max(1, round(_TRIMMED * len(squares)))]))


def start_of(
    views: MotionIntegrals, M_g: np.ndarray | None = None, mirror: float = 1.0
) -> PairState:
    """Initial state: tables as labelled, with an optional matrix for the gyros."""
    zero, eye = np.zeros(3), np.eye(3)
    part = np.zeros(len(views.start_s), int)
    M_g = eye if M_g is None else M_g
    return PairState(M_g, zero, mirror * eye, zero, zero, 0.0, np.zeros(1), part)


def corrected(views: MotionIntegrals, state: PairState) -> MotionIntegrals:
    """Integrals of the IMU with the matrices and biases of a state applied."""
    time_s = np.arange(len(views.turn))[:, None] / RATE_HZ
    return views._replace(
        turn=views.turn @ state.M_g.T - time_s * state.b_g,
        push=views.push @ state.M_a.T - time_s * state.b_a,
    )


def _sums(views: MotionIntegrals, state: PairState) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Gained velocity and its derivatives.

    Returns:
        u: (k, 3, 1 + parameters) in the first axes of the stretch.
        C: (nodes, 3, 3) attitudes in the middle of each node.
        seen: (k,) bool, changes for which the IMU was recorded.
    """
    n_fine = int(np.ceil((views.length_s * (1 + abs(state.rate)) + 2 * _PAD_S) * RATE_HZ))
    all_ = np.arange(len(views.start_s))
    first = views.start_s + state.shift(all_, views.start_s, views.middle_s) - _PAD_S
    index = first[:, None] * RATE_HZ + np.arange(n_fine + 1)
    turn, push = (np.diff(between(index, x), axis=1) for x in (views.turn, views.push))
    whole = turn @ state.M_g.T, push @ state.M_a.T
    dphi = whole[0] - state.b_g / RATE_HZ
    S, C = _grown(*whole, dphi, whole[1] - state.b_a / RATE_HZ)
    begin, end = (
        (t + state.shift(views.node_of, t, views.middle_s) - first[views.node_of]) * RATE_HZ
        for t in (views.begin_s, views.end_s)
    )
    at = partial(_sampled, views.node_of)
    angle, C_end = cumulative(dphi, axis=1), at(end, C)

    def speed(index: np.ndarray) -> np.ndarray:
        """Velocity (nodes, 3, 1) of the antenna."""
        return at(index, S[..., :1]) + (_swing(at, index, C, angle) @ state.lever)[..., None]

    if views.means:
        over = ((end - begin) / RATE_HZ)[:, None, None]
        D = cumulative((S[:, 1:] + S[:, :-1]) * (0.5 / RATE_HZ), axis=1)
        u = (at(end, D) - at(begin, D)) / over
        force = (speed(end) - speed(begin)) / over
        swing = (C_end - at(begin, C)) / over
    else:
        u, apart = at(end, S), _SMOOTH_S * RATE_HZ
        force = (speed(end + apart) - speed(end - apart)) / (2 * _SMOOTH_S)
        swing = _swing(at, end, C, angle)
    u[..., 0] += swing @ state.lever
    middle = 0.5 * (views.begin_s + views.end_s) - views.middle_s
    in_part = state.part[views.node_of][:, None] == np.arange(len(state.offset))
    u = np.concatenate(
        [u, swing, force * middle[:, None, None], force * in_part[:, None, :]], axis=-1
    )
    last = np.zeros(len(all_))
    np.maximum.at(last, views.node_of, end)
    seen = _recorded(views, first + _PAD_S, first + last / RATE_HZ)[views.of]
    C_middle = at(0.5 * (begin + end), C)
    return u[views.node + views.stride] - u[views.node], C_middle, seen


def _sampled(stretch: np.ndarray, index: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Linear interpolation (nodes, ...) of values (stretches, fine + 1, ...) at real indices."""
    fine = values.shape[1]
    place = np.clip(index, 0, fine - 1) + stretch * fine
    rows = between(place, values.reshape(len(values) * fine, -1))
    return rows.reshape(-1, *values.shape[2:])


def _swing(
    at: Callable[[np.ndarray, np.ndarray], np.ndarray],
    index: np.ndarray,
    C: np.ndarray,
    angle: np.ndarray,
) -> np.ndarray:
    """Matrices (nodes, 3, 3) C [omega x] from a lever arm to the velocity of its end."""
    # by two differences (Richardson), since a mean over 0.2 s would smooth the motion of a step
    ends = [at(index + k, angle) for k in (-2, -1, 1, 2)]
    omega = (8.0 * (ends[2] - ends[1]) - (ends[3] - ends[0])) * (RATE_HZ / 12.0)
    return at(index, C) @ skew(omega)


def _grown(
    turn: np.ndarray, push: np.ndarray, dphi: np.ndarray, dp: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Velocity with its derivatives by the parameters of the triads, and attitude.

    Args:
        turn: (stretches, fine, 3) small rotations before bias correction [rad].
        push: (stretches, fine, 3) small velocity increments in body axes, likewise [m/s].
        dphi: (stretches, fine, 3) small rotations [rad].
        dp: (stretches, fine, 3) small velocity increments in body axes [m/s].

    Returns:
        (stretches, fine + 1, 3, 22) and (stretches, fine + 1, 3, 3).
    """
    C = composed(rotations(dphi))
    Cm = C[:, :-1] @ rotations(0.5 * dphi)
    dS = np.einsum("skij,skj->ski", Cm, dp)
    bias = -Cm / RATE_HZ
    of_rate = np.einsum("skij,skl->skijl", Cm, turn).reshape(*Cm.shape[:2], 3, 9)
    psi = np.concatenate([of_rate, bias], axis=-1)
    psi = np.cumsum(psi, axis=1) - 0.5 * psi
    by_turn = -skew(dS) @ psi
    by_force = np.einsum("skij,skl->skijl", Cm, push)[..., _UPPER[0], _UPPER[1]]
    columns = np.concatenate([dS[..., None], by_turn, by_force, bias], axis=-1)
    return cumulative(columns, axis=1), C


def _recorded(views: MotionIntegrals, first: np.ndarray, last: np.ndarray) -> np.ndarray:
    """Mask (stretches,) of those with IMU samples without a gap from first to last."""
    inside = (first > -_EDGE_S) & (last < (len(views.turn) - 1) / RATE_HZ + _EDGE_S)
    begin, end = views.gaps.T
    return inside & ~np.any((begin < last[:, None]) & (end > first[:, None]), axis=1)


def fit(
    views: MotionIntegrals,
    start: PairState,
    prior: np.ndarray,
    rounds: int = 8,
    begin: PairState | None = None,
) -> MotionFit:
    """Fit all parameters by Gauss-Newton, with shorter steps where a step does not help.

    Args:
        views: the integrals.
        start: the prior mean.
        prior: (parameters, parameters) prior covariance.
        rounds: largest number of steps.
        begin: initial state, by default the prior mean.
    """
    best, step = _step(views, begin or start, start, prior)
    count = int(np.sum(np.isfinite(best.squares)))
    cost, share = _cost(best, count), 1.0
    most = np.full(len(step), _MOST)
    most[FORCE_BIAS], most[LEVER] = _MOST_BIAS, _MOST_LEVER_M
    for _ in range(rounds):
        if not share * np.max(np.abs(step / best.sigma)) > _STILL:
            break
        state = _moved(best.state, share * np.clip(step, -most, most))
        result, onward = _step(views, state, start, prior)
        now = _cost(result, count)
        if now < cost:
            best, step, cost, share = result, onward, now, 1.0
        else:
            share *= _SHORTER
    return best


def _cost(result: MotionFit, count: int) -> float:
    """Minus twice the log-likelihood of a number of changes; infinite without IMU.

    It is that of the mean without the largest residuals. A state by which fewer changes are within
    the log has the cost of as many.
    """
    seen = result.squares[np.isfinite(result.squares)]
    if not len(seen):
        return np.inf
    return 3 * count * np.log(trimmed(seen) + 1e-12) + result.strain


def _moved(state: PairState, step: np.ndarray) -> PairState:
    E_a = np.zeros((3, 3))
    E_a[_UPPER] = step[FORCE]
    return state._replace(
        M_g=(np.eye(3) + step[SCALE].reshape(3, 3)) @ state.M_g,
        b_g=state.b_g + step[GYRO_BIAS],
        M_a=(np.eye(3) + E_a) @ state.M_a,
        b_a=state.b_a + step[FORCE_BIAS],
        lever=state.lever + step[LEVER],
        rate=state.rate + float(step[RATE]),
        offset=state.offset + step[OFFSET:],
    )


def _moved_by(state: PairState, start: PairState) -> np.ndarray:
    """Parameters of a state relative to a start."""
    E_g = state.M_g @ np.linalg.inv(start.M_g) - np.eye(3)
    E_a = state.M_a @ np.linalg.inv(start.M_a) - np.eye(3)
    return np.concatenate(
        [
            E_g.ravel(),
            *(state.b_g - start.b_g, E_a[_UPPER], state.b_a - start.b_a),
            *(state.lever - start.lever, [state.rate - start.rate], state.offset - start.offset),
        ]
    )


def _step(
    views: MotionIntegrals, state: PairState, start: PairState, prior: np.ndarray
) -> tuple[MotionFit, np.ndarray]:
    """Evaluation of a state, and the Gauss-Newton step from it."""
    u, C, recorded = _sums(views, state)
    count, stretches = u.shape[2] - 1, len(views.start_s)
    R = np.tile(np.eye(3), (stretches, 1, 1))
    rest = np.full(views.gained.shape, np.nan)
    rows = [np.flatnonzero((views.of == s) & recorded) for s in range(stretches)]
    for s, k in enumerate(rows):
        if len(k):
            R[s] = kabsch(u[k, :, 0][None], views.gained[k])[0][0]
            rest[k] = views.gained[k] - u[k, :, 0] @ R[s].T
    squares = np.sum(rest**2, axis=1)
    usual = max(np.sqrt(np.nanmedian(squares) / 2.37), 1e-6) if recorded.any() else np.nan
    weight = 1.0 / (1.0 + squares / (3.0 * (_ROBUST * usual) ** 2))
    H, g, scores, along = np.zeros((count, count)), np.zeros(count), [], []
    for s, k in enumerate(rows):
        if len(k):
            A = (R[s] @ u[k, :, 1:]).reshape(-1, count)
            B = -skew(u[k, :, 0] @ R[s].T).reshape(-1, 3)
            w, r = np.repeat(weight[k], 3), rest[k].ravel()
            # what a rotation of the stretch explains is no evidence for other parameters
            inside = B.T @ (w[:, None] * B) + 1e-9 * np.eye(3)
            turn = np.linalg.solve(inside, B.T @ (w[:, None] * A))
            up = np.mean(views.gained[k], axis=0)
            along.append(up @ turn / np.linalg.norm(up))
            A = A - B @ turn
            r = r - B @ np.linalg.solve(inside, B.T @ (w * r))
            H += A.T @ (w[:, None] * A)
            scores.append(A.T @ (w * r))
            g += scores[-1]
    free = 3.0 * np.sum(recorded) - min(count, np.sum(recorded)) - 3.0 * stretches
    free = max(free, 0.5 * np.sum(recorded), 1.0)
    variance = max(float(np.nansum(weight * squares)) / free, 1e-10)
    expected = np.linalg.inv(prior)
    inverse = np.linalg.inv(H / variance + expected)
    moved = _moved_by(state, start)
    step = inverse @ (g / variance - expected @ moved)
    meat = np.array(scores).T @ np.array(scores) if scores else np.zeros_like(H)
    meat *= len(scores) / max(len(scores) - 1, 1) / variance**2
    both = inverse, inverse @ meat @ inverse
    spread = np.max([np.diag(P) for P in both], axis=0)
    turn = np.mean(along, axis=0) if along else np.zeros(count)
    azimuth = float(np.sqrt(max(turn @ P @ turn for P in both)))
    strain = float(moved @ expected @ moved)
    return MotionFit(state, np.sqrt(spread), R, squares, C, strain, azimuth), step


def prior_of(parts: int = 1, *free: str) -> np.ndarray:
    """Prior covariance of the parameters: that of sound tables, wide for free blocks.

    Args:
        parts: number of parts of the log with separate clock offsets.
        free: among "offset", "rate", "scale" (common to all gyros), "gyros", "forces".
    """
    sigma = np.empty(OFFSET + parts)
    sigma[SCALE] = 0.3 if "gyros" in free else 0.02
    sigma[FORCE] = 0.3 if "forces" in free else 0.01
    sigma[GYRO_BIAS], sigma[FORCE_BIAS], sigma[LEVER] = 0.01, 0.3, 2.0
    sigma[RATE] = 0.02 if "rate" in free else 2e-5
    sigma[OFFSET:] = 1.0 if "offset" in free else 0.01
    out = np.diag(sigma**2)
    if "scale" in free:
        alike = np.eye(3).ravel()
        out[SCALE, SCALE] += 0.3**2 * np.outer(alike, alike)
    return out
