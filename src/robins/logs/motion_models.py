"""The choice of a model for an IMU and a receiver: nothing wrong, a clock, the gyros, the forces.

All models have the same nuisances (`motion_fit`). A block is freed only where that lowers the
squares left by far more than chance does: by the likelihood ratio, of which a third counts, since
residuals of neighbouring changes of velocity are correlated. It is a cause only where no other
block does about as well.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from robins.dataset import GnssTable, ImuTable
from robins.logs.gnss_motion import Track, lateness
from robins.logs.motion import (
    GRAVITY,
    RATE_HZ,
    Views,
    power_of,
    signed_permutations,
    squares_by_lag,
    squares_by_map,
    views_of,
)
from robins.logs.motion_fit import Fit, State, fit, prior_of, start_of
from robins.logs.quiet import Signal, usual_force, windows_of

SCALES = np.exp(np.arange(np.log(1e-6), np.log(1e3), 0.2))  # of gyros, where a fit may start
_BLOCKS = {"clock": ("offset", "rate"), "gyros": ("gyros",), "forces": ("forces",)}
_COST = {"clock": 2, "gyros": 9, "forces": 6}  # parameters
_CLEAR = 8.0  # log-likelihood beyond the number of parameters
_SUSPICIOUS = 0.02, 0.3  # shares left, of all and of a stretch, from which starts are searched
_NEAR_S, _FAR_S, _FINE_S, _COARSE_S = 60.0, 4000.0, 0.25, 0.5
_SWITCH = 40.0  # log-likelihood that a step of the clock must gain
_RATES = np.arange(-0.02, 0.0201, 0.0005)
_ROUNDS = 14
_LEAST_SHARE = 1e-4  # left, below which nothing is gained


class Verdict(NamedTuple):
    """The model chosen."""

    views: Views
    nothing: Fit  # with nuisances only
    fit: Fit  # with the blocks that are free
    free: tuple[str, ...]  # "clock", "gyros", "forces", in the order of what they explain
    rival: str  # a block that explains nearly as much as the first, or ""
    bias: np.ndarray  # (3,) of the gyros at rest, taken off before [rad/s]
    late_s: float  # age of the velocities that was taken off their stamps [s]


def judge(
    imu: ImuTable, gnss: GnssTable, signal: Signal, track: Track, late_s: float | None = None
) -> Verdict | None:
    """Choose a model; None if there is too little motion.

    Args:
        imu: the table of the signal.
        gnss: the table of the track.
        signal: usable samples.
        track: complete fixes.
        late_s: age of velocities at their stamps; by default as the positions tell.
    """
    scaled, bias = _at_rest(signal, track)
    if scaled is None:
        return None
    late = lateness(track) if late_s is None else late_s
    start_s = (int(imu.time_ns[signal.rows[0]]) - int(gnss.time_ns[0])) * 1e-9
    when = track.time_s - start_s - (late or 0.0)
    noise = track.sigma_m, track.sigma_v if np.isfinite(track.sigma_v) else 0.1
    views = views_of(scaled, imu.kind, gnss, track.rows, when, track.r_n, track.v_n, noise)
    if views is None:
        return None
    return Verdict(views, *choose(views), bias, late or 0.0)


def _at_rest(signal: Signal, track: Track) -> tuple[Signal | None, np.ndarray]:
    """Signal without the bias of the gyros at rest, and in m/s^2 if gravity tells another unit."""
    windows = windows_of(signal)
    size, bias = usual_force(windows), np.zeros(3)
    if not size > 0.0:
        return None, bias
    # A steady turn in the air looks like rest to an IMU, not to a receiver.
    if windows.at_rest.any() and _stood(track):
        bias = np.median(windows.gyro[windows.at_rest], axis=0)
    off = size / GRAVITY
    factor = 1.0 if 0.8 < off < 1.25 else 1.0 / off
    return signal._replace(accel=signal.accel * factor, gyro=signal.gyro - bias), bias


def _stood(track: Track) -> bool:
    """Judge by the fixes whether the vehicle stood for three seconds."""
    step = np.diff(track.time_s)
    moved = np.diff(track.r_n, axis=0) / step[:, None]
    v = moved if track.v_n is None else track.v_n[1:]
    slow = np.hypot(v[:, 0], v[:, 1]) < 0.3 + (2.0 * track.sigma_m if track.v_n is None else 0.0)
    return float(np.sum(step[slow])) > 3.0


def choose(views: Views) -> tuple[Fit, Fit, tuple[str, ...], str]:
    """The fit with nuisances only, the one chosen, its blocks, and a rival of the first."""
    nothing = fit(views, start_of(views), prior_of())
    best, free, rival = nothing, (), ""
    for _ in range(2):
        fits = {}
        for block in _BLOCKS.keys() - set(free):
            for start in _starts(views, block, best, free):
                parts = len(start.offset)
                names = [name for b in (*free, block) for name in _BLOCKS[b]]
                if parts > 1:
                    names.remove("rate")
                tried = fit(views, start, prior_of(parts, *names), _ROUNDS)
                if block not in fits or _gain(views, fits[block], tried) > 0.0:
                    fits[block] = tried
        gain = {b: _gain(views, best, f) - _COST[b] for b, f in fits.items()}
        order = sorted(gain, key=lambda b: -gain[b])
        if not gain[order[0]] > _CLEAR:
            break
        if not free and len(order) > 1 and gain[order[1]] > gain[order[0]] - _CLEAR:
            rival = order[1]
        best, free = fits[order[0]], (*free, order[0])
    return nothing, best, free, rival


def _gain(views: Views, before: Fit, after: Fit) -> float:
    """Log-likelihood gained, of which a third counts; each stretch has a variance of its own."""
    least = _LEAST_SHARE * float(np.median(power_of(views)))
    one, other = (np.log(f.by_stretch(views) + least) for f in (before, after))
    return 0.5 * float(np.bincount(views.of) @ (one - other))


def _starts(views: Views, block: str, best: Fit, free: tuple[str, ...]) -> list[State]:
    """States from which a model with one more free block is fitted."""
    out = [best.state]
    worst = float(np.max(best.by_stretch(views) / power_of(views)))
    if best.left(views) < _SUSPICIOUS[0] and worst < _SUSPICIOUS[1]:
        return out
    if block == "clock" and "gyros" not in free:
        out += _clocks(views)
    if block == "gyros":
        out += _maps(views, best.state)
    return out


def _clocks(views: Views) -> list[State]:
    """Offset and rate, and offsets of parts, that explain most."""
    last = (len(views.turn) - 1) / RATE_HZ
    far = min(max(last, float(views.end_s[-1])), _FAR_S)
    lags = np.arange(-_NEAR_S, _NEAR_S + 0.1, _FINE_S)
    if far > _NEAR_S:
        beyond = np.arange(_NEAR_S + _COARSE_S, far, _COARSE_S)
        lags = np.concatenate([-beyond[::-1], lags, beyond])
    squares = squares_by_lag(views, lags)
    changes = np.bincount(views.of, minlength=len(squares))[:, None]
    power = power_of(views)
    # where no IMU was, or it stood: all is left
    missing = np.isnan(squares)
    left = np.where(missing, power[:, None], squares / changes)
    cost = changes * np.log(left + 1e-3 * np.median(power))
    start = start_of(views)
    return [_line(views, start, lags, cost), _steps(start, lags, cost)]


def _line(views: Views, start: State, lags: np.ndarray, cost: np.ndarray) -> State:
    """The best offset and rate."""
    near = np.abs(lags) <= _NEAR_S
    lags, cost = lags[near], cost[:, near]
    since = views.start_s + 0.5 * views.length_s - views.middle_s
    best = np.inf, 0.0, 0.0
    for rate in _RATES:
        moved = np.round((lags[:, None] + rate * since - lags[0]) / _FINE_S).astype(int)
        outside = (moved < 0) | (moved >= len(lags))
        total = np.sum(
            np.where(
                outside,
                cost.max(axis=1),
                cost[np.arange(len(since)), np.clip(moved, 0, len(lags) - 1)],
            ),
            axis=1,
        )
        k = int(np.argmin(total))
        if total[k] < best[0] - 1e-9:
            best = float(total[k]), float(lags[k]), float(rate)
    return start._replace(offset=np.array([best[1]]), rate=best[2])


def _steps(start: State, lags: np.ndarray, cost: np.ndarray) -> State:
    """Offsets of parts: the path of least cost, which pays for each step (Viterbi 1967)."""
    total, before = cost[0], []
    for row in cost[1:]:
        k = int(np.argmin(total))
        stay = total <= total[k] + _SWITCH
        before.append(np.where(stay, np.arange(len(lags)), k))
        total = np.minimum(total, total[k] + _SWITCH) + row
    path = [int(np.argmin(total))]
    for came in reversed(before):
        path.append(int(came[path[-1]]))
    path = np.array(path[::-1])
    part = np.concatenate([[0], np.cumsum(np.abs(np.diff(lags[path])) > 0.6)])
    offset = np.array([np.median(lags[path[part == p]]) for p in range(part[-1] + 1)])
    return start._replace(offset=offset, part=part)


def _maps(views: Views, state: State) -> list[State]:
    """Maps of the gyros that explain most: an axis order, signs and a factor."""
    shift = state.shift(np.arange(len(views.start_s)), views.start_s, views.middle_s)
    axes, scale = signed_permutations(), 1.0
    order, mirror, out = np.eye(3), 0, []
    for _ in range(2):
        by_scale = squares_by_map(views, SCALES[:, None, None] * order, shift)
        best = int(np.argmin(by_scale[:, mirror]))
        scale = float(SCALES[best])
        by_axes = squares_by_map(views, scale * axes, shift)
        k, mirror = map(int, np.unravel_index(int(np.argmin(by_axes)), by_axes.shape))
        order = axes[k]
        out.append((scale * order, 1.0 - 2.0 * mirror))
    as_is = squares_by_map(views, axes, shift)
    k, mirror = map(int, np.unravel_index(int(np.argmin(as_is)), as_is.shape))
    out.append((axes[k], 1.0 - 2.0 * mirror))
    return [
        start_of(views, M, sign)._replace(offset=state.offset, rate=state.rate, part=state.part)
        for M, sign in out
    ]
