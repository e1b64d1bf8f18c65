"""Model selection for an IMU and a receiver: no fault, or one of clock, gyros, accelerometers.

All models have the same nuisance parameters (`motion_fit`). A block is freed only if that lowers
the residual squares far more than by chance: by the likelihood ratio, a third of which counts, as
residuals of neighbouring changes of velocity are correlated. It is a cause only if no other block
fits about as well.
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

SCALES = np.exp(np.arange(np.log(1e-6), np.log(1e3), 0.2))  # gyro scales at which a fit may start
_BLOCKS = {
    "clock": ("offset", "rate"),
    "scale": ("scale",),
    "gyros": ("gyros",),
    "forces": ("forces",),
}
_COST = {"clock": 2, "scale": 1, "gyros": 9, "forces": 6}  # parameters
_CLEAR = 8.0  # log-likelihood beyond the number of parameters
_SUSPICIOUS = 0.02, 0.3  # unexplained shares, of all and of a stretch, to search starts
_NEAR_S, _FAR_S, _FINE_S, _COARSE_S = 60.0, 4000.0, 0.1, 0.5
_NOISY = 1.25  # residual squares, relative to the stated noise, that count as noise
_SWITCH = 40.0, 12.0  # log-likelihoods that a clock step must gain to be tried
_RATES = np.arange(-0.02, 0.0201, 0.0005)
_PART = 5.0  # log-likelihood that each part with an own offset must gain
_PROMISING = {"clock": 3, "gyros": 2}  # number of starts from which a fit is tried
_ROUNDS = 14
_LEAST_SHARE = 1e-4  # unexplained share below which no block is freed


class ModelChoice(NamedTuple):
    """The selected model."""

    views: MotionIntegrals
    nothing: MotionFit  # with nuisance parameters only
    clocked: MotionFit  # likewise, with a free clock
    fit: MotionFit  # with the free blocks
    free: tuple[str, ...]  # "clock", "gyros", "forces", by decreasing improvement
    rival: str  # a block that fits nearly as well as the first, or ""
    factor: float  # applied to specific forces beforehand, from gravity


def judge(
    imu: ImuTable, gnss: GnssTable, signal: ImuSignal, track: FixTrack, late_s: float | None = None
) -> ModelChoice | None:
    """Select a model; None if there is too little motion.

    Args:
        imu: the table of the signal.
        gnss: the table of the track.
        signal: usable samples.
        track: complete fixes.
        late_s: age of velocities at their stamps [s]; None: found from the positions.
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
    """Signal corrected for the gyro bias at rest, and the factor that scales gravity to m/s^2."""
    windows = windows_of(signal)
    size, bias = usual_force(windows), np.zeros(3)
    if not size > 0.0:
        return None, 1.0
    # a steady turn in flight looks like rest to an IMU, not to a receiver
    if windows.at_rest.any() and _stood(track):
        bias = np.median(windows.gyro[windows.at_rest], axis=0)
    off = size / GRAVITY
    factor = 1.0 if 0.8 < off < 1.25 else 1.0 / off
    return signal._replace(accel=signal.accel * factor, gyro=signal.gyro - bias), factor


def _stood(track: FixTrack) -> bool:
    """True if, by the fixes, the vehicle stood for three seconds."""
    step = np.diff(track.time_s)
    moved = np.diff(track.r_n, axis=0) / step[:, None]
    v = moved if track.v_n is None else track.v_n[1:]
    slow = np.hypot(v[:, 0], v[:, 1]) < 0.3 + (2.0 * track.sigma_m if track.v_n is None else 0.0)
    return float(np.sum(step[slow])) > 3.0


def choose(views: MotionIntegrals) -> tuple[MotionFit, MotionFit, MotionFit, tuple[str, ...], str]:
    """Fits of `ModelChoice`, the free blocks, and the rival of the first."""
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
            break  # everything is explained
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
    # an extra offset for a part of the log must pay off
    gains = [_gain(views, best, one) - _PART * len(one.state.offset) for one in fits]
    return fits[int(np.argmax(gains))]


def _gain(views: MotionIntegrals, before: MotionFit, after: MotionFit) -> float:
    """A third of the gain of log-likelihood, with a variance for each stretch."""
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
    if block != "clock":  # not for a clock, of which a step of a second explains less
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
    """State with the free blocks kept; nuisance parameters restart from the tables as labelled."""
    out = start_of(views, mirror=float(np.sign(np.linalg.det(state.M_a))))
    if "clock" in free:
        out = out._replace(offset=state.offset, rate=state.rate, part=state.part)
    if {"gyros", "scale"} & {*free}:
        out = out._replace(M_g=state.M_g)
    return out._replace(M_a=state.M_a) if "forces" in free else out


def _clocks(views: MotionIntegrals) -> list[PairState]:
    """Clock states that fit best: offset and rate, and offsets of parts."""
    last = (len(views.turn) - 1) / RATE_HZ
    far = min(max(last, float(views.end_s[-1])), _FAR_S)
    lags = np.arange(-_NEAR_S, _NEAR_S + 0.1, _FINE_S)
    if far > _NEAR_S:
        beyond = np.arange(_NEAR_S + _COARSE_S, far, _COARSE_S)
        lags = np.concatenate([-beyond[::-1], lags, beyond])
    squares = squares_by_lag(views, lags)
    changes = np.bincount(views.of)[:, None] / views.stride
    power = power_of(views)
    # without IMU, or at rest: nothing is explained
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
    """Offsets of parts: the path of least cost, with a penalty for each step (Viterbi 1967)."""
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
    """Gyro matrices that fit best: a signed permutation among `axes`, times a factor."""
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
