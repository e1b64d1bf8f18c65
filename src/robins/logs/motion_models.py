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
from robins.logs.gnss_motion import FixTrack, velocity_delay
from robins.logs.motion import (
    GRAVITY,
    RATE_HZ,
    MotionIntegrals,
    power_of,
    signed_permutations,
    squares_by_lag,
    squares_by_map,
    views_of,
)
from robins.logs.motion_fit import MotionFit, PairState, fit, prior_of, start_of
from robins.logs.quiet import ImuSignal, usual_force, windows_of

SCALES = np.exp(np.arange(np.log(1e-6), np.log(1e3), 0.2))  # of gyros, where a fit may start
_BLOCKS = {
    "clock": ("offset", "rate"),
    "scale": ("scale",),
    "gyros": ("gyros",),
    "forces": ("forces",),
}
_COST = {"clock": 2, "scale": 1, "gyros": 9, "forces": 6}  # parameters
_CLEAR = 8.0  # log-likelihood beyond the number of parameters
_SUSPICIOUS = 0.02, 0.3  # shares left, of all and of a stretch, from which starts are searched
_NEAR_S, _FAR_S, _FINE_S, _COARSE_S = 60.0, 4000.0, 0.1, 0.5
_NOISY = 1.25  # squares of the stated noise that noise may leave
_SWITCH = 40.0, 12.0  # log-likelihood that a step of the clock must gain, to be tried
_RATES = np.arange(-0.02, 0.0201, 0.0005)
_PART = 5.0  # log-likelihood that each of its parts must gain
_PROMISING = {"clock": 3, "gyros": 2}  # starts of which a fit is tried
_ROUNDS = 14
_LEAST_SHARE = 1e-4  # left, below which nothing is gained


class ModelChoice(NamedTuple):
    """The model chosen."""

    views: MotionIntegrals
    nothing: MotionFit  # with nuisances only
    clocked: MotionFit  # likewise, and the clock free
    fit: MotionFit  # with the blocks that are free
    free: tuple[str, ...]  # "clock", "gyros", "forces", in the order of what they explain
    rival: str  # a block that explains nearly as much as the first, or ""
    factor: float  # by which specific forces were multiplied before, as gravity suggested


def judge(
    imu: ImuTable, gnss: GnssTable, signal: ImuSignal, track: FixTrack, late_s: float | None = None
) -> ModelChoice | None:
    """Choose a model; None if there is too little motion.

    Args:
        imu: the table of the signal.
        gnss: the table of the track.
        signal: usable samples.
        track: complete fixes.
        late_s: age of velocities at their stamps; by default as the positions tell.
    """
    scaled, factor = _at_rest(signal, track)
    if scaled is None:
        return None
    late = velocity_delay(track) if late_s is None else late_s
    start_s = (int(imu.time_ns[signal.rows[0]]) - int(gnss.time_ns[0])) * 1e-9
    when = track.time_s - start_s - (late or 0.0)
    noise = track.sigma_m, track.sigma_v if np.isfinite(track.sigma_v) else 0.1
    views = views_of(scaled, imu.kind, gnss, track.rows, when, track.r_n, track.v_n, noise)
    if views is None:
        return None
    return ModelChoice(views, *choose(views), factor)


def _at_rest(signal: ImuSignal, track: FixTrack) -> tuple[ImuSignal | None, float]:
    """Signal without the bias of the gyros at rest, in m/s^2 by a factor if gravity needs one."""
    windows = windows_of(signal)
    size, bias = usual_force(windows), np.zeros(3)
    if not size > 0.0:
        return None, 1.0
    # A steady turn in the air looks like rest to an IMU, not to a receiver.
    if windows.at_rest.any() and _stood(track):
        bias = np.median(windows.gyro[windows.at_rest], axis=0)
    off = size / GRAVITY
    factor = 1.0 if 0.8 < off < 1.25 else 1.0 / off
    return signal._replace(accel=signal.accel * factor, gyro=signal.gyro - bias), factor


def _stood(track: FixTrack) -> bool:
    """Judge by the fixes whether the vehicle stood for three seconds."""
    step = np.diff(track.time_s)
    moved = np.diff(track.r_n, axis=0) / step[:, None]
    v = moved if track.v_n is None else track.v_n[1:]
    slow = np.hypot(v[:, 0], v[:, 1]) < 0.3 + (2.0 * track.sigma_m if track.v_n is None else 0.0)
    return float(np.sum(step[slow])) > 3.0


def choose(views: MotionIntegrals) -> tuple[MotionFit, MotionFit, MotionFit, tuple[str, ...], str]:
    """Fits of `ModelChoice`, the blocks that are free, and a rival of the first."""
    nothing = fit(views, start_of(views), prior_of())
    best, clocked, free, rival = nothing, nothing, (), ""
    for _ in range(2):
        fits = {
            block: _freed(views, block, best, free)
            for block in _BLOCKS
            if not {block, *(("scale",) if block == "gyros" else ())} <= {*free}
        }
        clocked = clocked if free else fits["clock"]
        gain = {b: _gain(views, best, f) - _COST[b] for b, f in fits.items()}
        order = sorted(gain, key=lambda b: -gain[b])
        first = order[0]
        if not gain[first] > _CLEAR:
            break
        others = [b for b in order[1:] if not {b, first} <= {"scale", "gyros"}]
        if not free and gain[others[0]] > gain[first] - _CLEAR:
            rival = others[0]
        best, free = fits[first], (*free, first)
        if best.left(views) * float(np.mean(power_of(views))) < _NOISY * views.noise**2:
            break  # nothing is left to be explained
    return nothing, clocked, best, free, rival


def _freed(views: MotionIntegrals, block: str, best: MotionFit, free: tuple[str, ...]) -> MotionFit:
    """A model with one more block, from the most promising start."""
    trials = []
    for start in _starts(views, block, best, free):
        parts = len(start.offset)
        names = [name for b in (*free, block) for name in _BLOCKS[b]]
        if parts > 1 and "rate" in names:
            names.remove("rate")
        trials.append((start, prior_of(parts, *names)))
    if len(trials) > 1:
        seen = [_gain(views, best, fit(views, start, prior, 0)) for start, prior in trials]
        promising = np.argsort(seen)[-_PROMISING.get(block, 1) :]
        trials = [trials[k] for k in promising]
    fits = [fit(views, start, prior, _ROUNDS) for start, prior in trials]
    # a part of the log with an offset of its own must be worth it
    gains = [_gain(views, best, one) - _PART * len(one.state.offset) for one in fits]
    return fits[int(np.argmax(gains))]


def _gain(views: MotionIntegrals, before: MotionFit, after: MotionFit) -> float:
    """Log-likelihood gained, of which a third counts; each stretch has a variance of its own."""
    least = _LEAST_SHARE * float(np.median(power_of(views)))
    one, other = (np.log(f.by_stretch(views) + least) for f in (before, after))
    strain = (before.strain - after.strain) / 3.0
    return 0.5 * (float(np.bincount(views.of) @ (one - other)) / np.sqrt(views.stride) + strain)


def _starts(
    views: MotionIntegrals, block: str, best: MotionFit, free: tuple[str, ...]
) -> list[PairState]:
    """States from which a model with one more free block is fitted."""
    state = _known(views, best.state, free)
    out, power = [state], power_of(views)
    share, noise = best.by_stretch(views) / power, views.noise**2 / power
    usual = _NOISY * views.noise**2 / float(np.mean(power))
    if block != "clock":  # a step of a second explains less than that
        usual = max(_SUSPICIOUS[0], usual)
    if best.left(views) < usual and np.all(share < np.maximum(_SUSPICIOUS[1], 4.0 * noise)):
        return out
    if block == "clock" and not {"gyros", "scale"} & {*free}:
        out += _clocks(views)
    if block == "gyros":
        out += _maps(views, state, signed_permutations())
    if block == "scale":
        out += _maps(views, state, np.eye(3)[None])
    return out


def _known(views: MotionIntegrals, state: PairState, free: tuple[str, ...]) -> PairState:
    """State of the free blocks; nuisances start again from the claims of the tables."""
    out = start_of(views, mirror=float(np.sign(np.linalg.det(state.M_a))))
    if "clock" in free:
        out = out._replace(offset=state.offset, rate=state.rate, part=state.part)
    if {"gyros", "scale"} & {*free}:
        out = out._replace(M_g=state.M_g)
    return out._replace(M_a=state.M_a) if "forces" in free else out


def _clocks(views: MotionIntegrals) -> list[PairState]:
    """Offset and rate, and offsets of parts, that explain most."""
    last = (len(views.turn) - 1) / RATE_HZ
    far = min(max(last, float(views.end_s[-1])), _FAR_S)
    lags = np.arange(-_NEAR_S, _NEAR_S + 0.1, _FINE_S)
    if far > _NEAR_S:
        beyond = np.arange(_NEAR_S + _COARSE_S, far, _COARSE_S)
        lags = np.concatenate([-beyond[::-1], lags, beyond])
    squares = squares_by_lag(views, lags)
    changes = np.bincount(views.of)[:, None] / views.stride
    power = power_of(views)
    # where no IMU was, or it stood: all is left
    missing = np.isnan(squares)
    left = np.where(missing, power[:, None], squares)
    cost = changes * np.log(left + 1e-3 * np.median(power))
    start = start_of(views)
    return [_line(views, start, lags, cost), *(_steps(start, lags, cost, s) for s in _SWITCH)]


def _line(
    views: MotionIntegrals, start: PairState, lags: np.ndarray, cost: np.ndarray
) -> PairState:
    """The best offset and rate."""
    near = np.abs(lags) <= _NEAR_S
    lags, cost = lags[near], cost[:, near]
    since = views.start_s + 0.5 * views.length_s - views.middle_s
    best = np.inf, 0.0, 0.0
    for rate in _RATES:
        moved = np.round((lags[:, None] + rate * since - lags[0]) / _FINE_S).astype(int)
        outside = (moved < 0) | (moved >= len(lags))
        inside = cost[np.arange(len(since)), np.clip(moved, 0, len(lags) - 1)]
        total = np.sum(np.where(outside, cost.max(axis=1), inside), axis=1)
        k = int(np.argmin(total))
        if total[k] < best[0] - 1e-9:
            best = float(total[k]), float(lags[k]), float(rate)
    return start._replace(offset=np.array([best[1]]), rate=best[2])


def _steps(start: PairState, lags: np.ndarray, cost: np.ndarray, switch: float) -> PairState:
    """Offsets of parts: the path of least cost, which pays for each step (Viterbi 1967)."""
    total, before = cost[0], []
    for row in cost[1:]:
        k = int(np.argmin(total))
        stay = total <= total[k] + switch
        before.append(np.where(stay, np.arange(len(lags)), k))
        total = np.minimum(total, total[k] + switch) + row
    path = [int(np.argmin(total))]
    for came in reversed(before):
        path.append(int(came[path[-1]]))
    path = np.array(path[::-1])
    part = np.concatenate([[0], np.cumsum(np.abs(np.diff(lags[path])) > 0.6)])
    offset = np.array([np.median(lags[path[part == p]]) for p in range(part[-1] + 1)])
    return start._replace(offset=offset, part=part)


def _maps(views: MotionIntegrals, state: PairState, axes: np.ndarray) -> list[PairState]:
    """Maps of the gyros that explain most: one of some orders and signs of axes, and a factor."""
    shift = state.shift(np.arange(len(views.start_s)), views.start_s, views.middle_s)
    scale, out = 1.0, []
    for _ in range(2):
        by_axes = squares_by_map(views, scale * axes, shift)
        by_axes = by_axes if len(axes) > 1 else by_axes[:, :1]
        k, mirror = map(int, np.unravel_index(int(np.argmin(by_axes)), by_axes.shape))
        out.append((scale * axes[k], 1.0 - 2.0 * mirror))
        by_scale = squares_by_map(views, SCALES[:, None, None] * axes[k], shift)[:, mirror]
        scale = float(SCALES[int(np.argmin(by_scale))])
        out.append((scale * axes[k], 1.0 - 2.0 * mirror))
    return [
        start_of(views, M, sign)._replace(offset=state.offset, rate=state.rate, part=state.part)
        for M, sign in out
    ]
