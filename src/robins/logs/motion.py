"""One motion, seen by the IMU and by GNSS: how well do they fit under a hypothesis about the axes?

Over a short stretch the gyros tell how the body turns, so the specific force can be added up in
axes that do not turn. Up to one constant rotation R these sums must be what GNSS saw,

    R sum(C f dt) = change of v - g dt,

whatever the attitude and the mounting. R is found in closed form (Kabsch 1976), as a rotation or as
a reflection; the share of the GNSS accelerations left unexplained judges the hypothesis. Wrong
units, exchanged or reversed axes and late clocks all leave about everything unexplained.

The sums are taken on a grid of 20 Hz, so vibration does not matter and an hour costs little.
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np

from robins.logs.quiet import Signal
from robins.rotation import skew

GRAVITY = 9.8
_RATE_HZ = 20
STRETCH_S = 30  # long enough to turn, short enough for the drift of cheap gyros
_STRETCHES = 4
_NO_LAG = np.zeros(1)
_BIAS_STEP = 1e-4  # rad/s, m/s^2
_BIAS_SIGMA = np.repeat([0.01, 0.1], 3)  # what the unknowns are measured in

# Of steps by which something else that turned is compared with the gyros.
_FINE_S, _PER_STEP = 0.01, 20  # rotations are composed of fine ones, and compared over 0.2 s
_MOST = 1500  # steps, of those that turn most
_LEAST = 50  # below which nothing is judged
_TURNED = 0.1  # rad, of a step that tells something


def signed_permutations() -> np.ndarray:
    """(48, 3, 3): all ways to exchange and reverse three axes, the identity first."""
    out = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            out.append(np.diag(signs)[:, order])
    return np.array(out)


class Pair(NamedTuple):
    """IMU sums on the fine grid and GNSS velocity, both from one zero of time."""

    turn: np.ndarray  # (n + 1, 3) integral of the rate up to each grid time [rad]
    push: np.ndarray  # (n + 1, 3) integral of the specific force [m/s]
    gnss_s: np.ndarray  # (m,) times of the velocities
    v_n: np.ndarray  # (m, 3) m/s, NED
    starts: np.ndarray  # first second of each stretch that is judged
    power: str = "change"  # what the share left is a share of: "change" of velocity, or "gravity"


class Fit(NamedTuple):
    """Results per stretch and hypothesis; NaN where the IMU was not recorded."""

    proper: np.ndarray  # (stretches, hypotheses) share left unexplained by the best rotation
    mirrored: np.ndarray  # (stretches, hypotheses) by the best reflection


def pair_of(signal: Signal, gnss_s: np.ndarray, v_n: np.ndarray, noise: float) -> Pair | None:
    """Put both on one time; None if no stretch has enough motion for a judgement.

    Args:
        signal: the IMU, whose specific force is scaled to gravity at rest.
        gnss_s: (m,) times of the velocities, from the zero of the signal.
        v_n: (m, 3) finite velocities, north-east-down [m/s].
        noise: standard deviation of a velocity's change over a second [m/s].
    """
    turn, push, end = _sums_on_grid(signal)
    first, last = max(0.0, gnss_s[0]), min(end, gnss_s[-1])
    starts = np.arange(np.ceil(first), last - STRETCH_S, STRETCH_S)
    lively = []
    for start in starts:
        if _has_gap(gnss_s, start) or _has_gap(signal.time_s, start):
            continue
        change = np.diff(at(start + np.arange(STRETCH_S + 1), gnss_s, v_n), axis=0)
        power = float(np.mean(np.sum((change - change.mean(axis=0)) ** 2, axis=1)))
        if np.sqrt(power) > max(0.2, 3.0 * noise):
            lively.append((power, start))
    if not lively:
        return None
    best = sorted(start for _, start in sorted(lively)[-_STRETCHES:])
    return Pair(turn, push, gnss_s, v_n, np.array(best))


def at_the_spot(signal: Signal) -> Pair | None:
    """An IMU alone, taken to stay about where it is: then gravity must not turn.

    None unless it is turned about enough that the specific force points elsewhere by 10 deg or so.
    """
    turn, push, end = _sums_on_grid(signal)
    tilted = []
    for start in np.arange(0.0, end - STRETCH_S, STRETCH_S):
        if _has_gap(signal.time_s, start):
            continue
        force = np.diff(push[round(start * _RATE_HZ) :: _RATE_HZ][: STRETCH_S + 1], axis=0)
        direction = force / np.linalg.norm(force, axis=-1, keepdims=True)
        spread = 1.0 - float(np.linalg.norm(direction.mean(axis=0)))
        if spread > 0.015:
            tilted.append((spread, float(start)))
    if not tilted:
        return None
    best = sorted(start for _, start in sorted(tilted)[-_STRETCHES:])
    return Pair(turn, push, np.array([0.0, end]), np.zeros((2, 3)), np.array(best), "gravity")


def _sums_on_grid(signal: Signal) -> tuple[np.ndarray, np.ndarray, float]:
    """Integrals of rate and specific force up to each grid time, and the last of these times."""
    grid = np.arange(0.0, signal.time_s[-1], 1.0 / _RATE_HZ)
    turn, push = (
        at(grid, signal.time_s, integral(signal.time_s, x)) for x in (signal.gyro, signal.accel)
    )
    return turn, push, float(grid[-1])


def _has_gap(time_s: np.ndarray, start: float) -> bool:
    inside = time_s[(time_s >= start) & (time_s <= start + STRETCH_S)]
    return len(inside) < 2 or bool(np.max(np.diff(inside)) > 1.5)


def unexplained(pair: Pair, gyro_maps: np.ndarray, lags_s: np.ndarray = _NO_LAG) -> Fit:
    """Judge hypotheses.

    Args:
        pair: the two views.
        gyro_maps: (h, 3, 3) applied to the angular rate: units, exchanges, reversals.
        lags_s: (h) or (1,) what is added to the GNSS times to find the IMU samples that belong.
    """
    out = [_judge(pair, start, gyro_maps, lags_s) for start in pair.starts]
    return Fit(*(np.stack(part) for part in zip(*out, strict=True)))


def unexplained_but_for_biases(pair: Pair, lags_s: np.ndarray) -> np.ndarray:
    """(stretches, lags) share left by the data as they are, once constant biases are taken off.

    A time offset and an accelerometer bias look alike where the motion is gentle, and a gyro bias
    tilts gravity, so both are estimated with the rotation: two steps of Gauss-Newton on nine
    parameters, differentiated numerically.
    """
    return np.stack([_judge_biased(pair, start, lags_s) for start in pair.starts])


def travel_in_body(pair: Pair) -> np.ndarray:
    """(k, 3) velocities in body axes, where the pair fits as it is and moves: which way is forward.

    Only seconds faster than 0.5 m/s; at most `STRETCH_S` of each stretch.
    """
    out = []
    for start in pair.starts:
        view = _view(pair, start, _NO_LAG)
        sums, C = _sum_unturned(view.turn, view.push)
        R, _, _ = _kabsch(sums, view.wanted)
        v_n = at(start + np.arange(STRETCH_S), pair.gnss_s, pair.v_n)
        v_b = np.einsum("kji,lj,kl->ki", C[0], R[0], v_n)  # C^T R^T v
        out.append(v_b[np.linalg.norm(v_n, axis=-1) > 0.5])
    return np.concatenate(out)


class _View(NamedTuple):
    """One stretch, the IMU seen with several delays."""

    turn: np.ndarray  # (lags, fine, 3) rad
    push: np.ndarray  # (lags, fine, 3) m/s
    wanted: np.ndarray  # (seconds, 3) change of v - g dt
    power: float  # squares of its change
    seen: np.ndarray  # (lags,) bool: all of it was recorded


def _view(pair: Pair, start: float, lags_s: np.ndarray) -> _View:
    seconds = start + np.arange(STRETCH_S + 1)
    wanted = np.diff(at(seconds, pair.gnss_s, pair.v_n), axis=0) - [0.0, 0.0, GRAVITY]
    middle = wanted.mean(axis=0) if pair.power == "change" else 0.0
    power = float(np.sum((wanted - middle) ** 2))
    fine = np.arange(STRETCH_S * _RATE_HZ + 1) / _RATE_HZ + start
    index = (fine + lags_s[:, None]) * _RATE_HZ
    turn, push = (np.diff(_between(index, x), axis=1) for x in (pair.turn, pair.push))
    seen = (index[:, 0] >= 0.0) & (index[:, -1] <= len(pair.turn) - 1)
    return _View(turn, push, wanted, power, seen)


def _judge(
    pair: Pair, start: float, gyro_maps: np.ndarray, lags_s: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    view = _view(pair, start, lags_s)
    count = max(len(gyro_maps), len(lags_s))
    turn, push = (np.broadcast_to(x, (count, *x.shape[1:])) for x in (view.turn, view.push))
    turn = np.einsum("hij,hkj->hki", np.broadcast_to(gyro_maps, (count, 3, 3)), turn)
    sums, _ = _sum_unturned(turn, push)
    _, left, mirrored = _kabsch(sums, view.wanted)
    left, mirrored = (np.where(view.seen, x / view.power, np.nan) for x in (left, mirrored))
    return left, mirrored


def _judge_biased(pair: Pair, start: float, lags_s: np.ndarray) -> np.ndarray:
    view = _view(pair, start, lags_s)
    bias = np.zeros((len(lags_s), 6))  # gyro rad/s, accelerometer m/s^2
    trials = np.concatenate([np.zeros((1, 6)), _BIAS_STEP * np.eye(6)])
    for _ in range(2):
        sums = _sums_without(view, bias[:, None] + trials)
        R, _, _ = _kabsch(sums[:, 0], view.wanted)
        for h in range(len(lags_s)):
            here = sums[h, 0] @ R[h].T
            by_bias = (sums[h, 1:] - sums[h, :1]) @ R[h].T / _BIAS_STEP
            by_turn = np.cross(np.eye(3)[:, None], here)
            design = np.concatenate([by_bias * _BIAS_SIGMA[:, None, None], by_turn])
            rest = (view.wanted - here).ravel()
            solution = np.linalg.lstsq(design.reshape(9, -1).T, rest, rcond=1e-6)[0]
            bias[h] += solution[:6] * _BIAS_SIGMA
    _, left, _ = _kabsch(_sums_without(view, bias[:, None])[:, 0], view.wanted)
    return np.where(view.seen, left / view.power, np.nan)


def _sums_without(view: _View, bias: np.ndarray) -> np.ndarray:
    """(lags, trials, seconds, 3) sums after biases (lags, trials, 6) are taken off."""
    off = bias[:, :, None] / _RATE_HZ
    turn, push = view.turn[:, None] - off[..., :3], view.push[:, None] - off[..., 3:]
    shape = (-1, *turn.shape[2:])
    sums, _ = _sum_unturned(turn.reshape(shape), push.reshape(shape))
    return sums.reshape(*bias.shape[:2], STRETCH_S, 3)


def integral(time_s: np.ndarray, rate: np.ndarray) -> np.ndarray:
    """(n, 3) sum of a rate (n, 3) from the first sample up to each, by the trapezoidal rule."""
    steps = 0.5 * (rate[1:] + rate[:-1]) * np.diff(time_s)[:, None]
    return np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])


def at(when: np.ndarray, time_s: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Columns of values (n, 3) interpolated linearly, held at the ends."""
    return np.stack([np.interp(when, time_s, column) for column in values.T], axis=-1)


def _between(index: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Linear interpolation of rows at real indices, held at the ends."""
    index = np.clip(index, 0, len(values) - 1)
    low = np.minimum(index.astype(np.int64), len(values) - 2)
    share = (index - low)[..., None]
    return (1.0 - share) * values[low] + share * values[low + 1]


def _sum_unturned(turn: np.ndarray, push: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Velocity increments (h, seconds, 3) in the axes of the first moment, and C (h, seconds, 3, 3)
    from the axes at the start of each second to those.
    """
    whole = rotations(turn)
    push = np.einsum("hkij,hkj->hki", rotations(0.5 * turn), push)
    C = np.broadcast_to(np.eye(3), (len(turn), 3, 3))
    out = np.zeros((len(turn), STRETCH_S, 3))
    attitudes = []
    for k in range(turn.shape[1]):
        if k % _RATE_HZ == 0:
            attitudes.append(C)
        out[:, k // _RATE_HZ] += np.einsum("hij,hj->hi", C, push[:, k])
        C = C @ whole[:, k]
    return out, np.stack(attitudes, axis=1)


def rotations(phi: np.ndarray) -> np.ndarray:
    """(..., 3, 3) matrices of rotation vectors (..., 3), by Rodrigues' formula."""
    angle = np.linalg.norm(phi, axis=-1)[..., None, None]
    K = skew(phi)
    half_sinc = np.sinc(0.5 * angle / np.pi)
    return np.eye(3) + np.sinc(angle / np.pi) * K + 0.5 * half_sinc**2 * K @ K


def _kabsch(u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Best rotation R of u (h, k, 3) onto v (k, 3), squares left by it and by a reflection."""
    U, s, Vt = np.linalg.svd(np.einsum("hki,kj->hij", u, v))
    sign = np.sign(np.linalg.det(U) * np.linalg.det(Vt))
    total = np.sum(u * u, axis=(1, 2)) + np.sum(v * v)
    corrected = np.stack([np.ones_like(sign), np.ones_like(sign), sign], axis=-1)
    R = np.einsum("hji,hj,hkj->hik", Vt, corrected, U)
    both = s[:, 0] + s[:, 1]
    return R, total - 2.0 * (both + sign * s[:, 2]), total - 2.0 * (both - sign * s[:, 2])


class Steps(NamedTuple):
    """Steps of 0.2 s in which the sensor turned."""

    begin_s: np.ndarray  # (n,) from the zero of the signal
    end_s: np.ndarray  # (n,)
    C: np.ndarray  # (n, 3, 3) sensor axes at the end to those at the beginning


def steps_of(signal: Signal, time_s: np.ndarray) -> Steps | None:
    """The steps that turn most; None if there are too few.

    Args:
        signal: the IMU.
        time_s: (m,) increasing times of the other sensor, from the zero of the signal.
    """
    if len(time_s) < 2:
        return None
    begin, end = max(float(time_s[0]), 0.0), min(float(time_s[-1]), float(signal.time_s[-1]))
    count = int((end - begin) / (_FINE_S * _PER_STEP))
    if count < _LEAST:
        return None
    fine_s = begin + _FINE_S * np.arange(count * _PER_STEP + 1)
    fine = np.diff(at(fine_s, signal.time_s, integral(signal.time_s, signal.gyro)), axis=0)
    fine = fine.reshape(count, _PER_STEP, 3)
    grid = fine_s[::_PER_STEP]
    known = _recorded(grid, time_s) & _recorded(grid, signal.time_s)
    angle = np.linalg.norm(fine.sum(axis=1), axis=1) * known
    chosen = np.sort(np.argsort(angle)[-_MOST:])
    chosen = chosen[angle[chosen] > _TURNED]
    if len(chosen) < _LEAST:
        return None
    C = np.broadcast_to(np.eye(3), (len(chosen), 3, 3))
    for k in range(_PER_STEP):
        C = C @ rotations(fine[chosen, k])
    return Steps(grid[chosen], grid[chosen + 1], C)


def _recorded(grid: np.ndarray, time_s: np.ndarray) -> np.ndarray:
    """(len(grid) - 1,) whether there is no gap in the samples around each step."""
    before = np.searchsorted(time_s, grid[:-1], side="right") - 1
    after = np.searchsorted(time_s, grid[1:], side="left")
    span = time_s[np.minimum(after, len(time_s) - 1)] - time_s[np.maximum(before, 0)]
    return span < 2.0 * (grid[1] - grid[0])
