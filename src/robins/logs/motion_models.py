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
from robins.logs.motion_fit import MotionFit, PairState, corrected, fit, prior_of, start_of
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
_CLOSE_S, _NEAR_S, _FAR_S, _FINE_S, _COARSE_S = 5.0, 60.0, 4000.0, 0.1, 0.5
_NOISY = 1.25  # residual squares, relative to the stated noise, that count as noise
_SWITCH = 12.0  # cost that a clock step must save to be tried
_RATES = np.arange(-0.02, 0.0201, 0.0005)
_PART = 5.0  # log-likelihood that each part with an own offset must gain
_PROMISING = {"clock": 3, "scale": 1, "gyros": 2, "forces": 1}  # starts from which a fit is tried
_ROUNDS = 14
_LEAST_REST_S = 3.0
_LEAST_SHARE = 1e-4  # unexplained share below which no block is freed


class ModelChoice(NamedTuple):
    """The selected model."""

    views: MotionIntegrals
    nothing: MotionFit  # with nuisance parameters only
    clocked: MotionFit  # likewise, with a free clock
    fit: MotionFit  # with the free blocks
    free: tuple[str, ...]  # "clock", "gyros", "forces", by decreasing improvement
    rival: str  # a block that fits nearly as well as the first, or ""
    other: MotionFit | None  # with steps of the clock for its rate, if about as good, or vice versa
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
    sigma_v = track.sigma_v if np.isfinite(track.sigma_v) else 0.1
    noise = track.sigma_m, track.scatter_m, sigma_v
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
    # A steady turn looks like rest to an IMU, not to a receiver, whose clock may be off: the
    # windows of least rate are taken for as long as it stood.
    stood_s, window_s = _stood_s(track), float(np.diff(signal.time_s[windows.first[:2]]).sum())
    if windows.at_rest.any() and stood_s > _LEAST_REST_S:
        gyro = windows.gyro[windows.at_rest]
        slowest = np.argsort(np.linalg.norm(gyro, axis=1))
        count = len(gyro) if window_s == 0.0 else max(1, round(stood_s / window_s))
        bias = np.median(gyro[slowest[:count]], axis=0)
    off = size / GRAVITY
    factor = 1.0 if 0.8 < off < 1.25 else 1.0 / off
    return signal._replace(accel=signal.accel * factor, gyro=signal.gyro - bias), factor


def _stood_s(track: FixTrack) -> float:
    """Time for which, by the fixes, the vehicle stood [s].

    Positions are compared over three seconds, or over what makes their noise less than 0.6 m/s.
    """
    time_s, v, least = track.time_s, track.v_n, 0.3
    step = np.diff(time_s)
    if v is None:
        span = max(_LEAST_REST_S, 5.0 * track.sigma_m)
        stride = max(1, round(span / float(np.median(step))))
        over, least = time_s[stride:] - time_s[:-stride], 0.3 + 3.0 * track.sigma_m / span
        v = (track.r_n[stride:] - track.r_n[:-stride]) / over[:, None]
    slow = np.hypot(v[1:, 0], v[1:, 1]) < least
    return float(np.sum(step[: len(slow)][slow]))


def choose(
    views: MotionIntegrals,
) -> tuple[MotionFit, MotionFit, MotionFit, tuple[str, ...], str, MotionFit | None]:
    """Fits of `ModelChoice`, the free blocks, the rival of the first, and the other clock."""
    nothing = fit(views, start_of(views), prior_of())
    best, clocked, free, rival, other = nothing, nothing, (), "", None
    for _ in range(2):
        found = {
            block: _freed(views, block, best, free)
            for block in _BLOCKS
            if not {block, *(("scale",) if block == "gyros" else ())} <= {*free}
        }
        fits = {block: one for block, (one, _) in found.items()}
        clocked = clocked if free else fits["clock"]
        gain = {b: _gain(views, best, f) - _COST[b] for b, f in fits.items()}
        order = sorted(gain, key=lambda b: -gain[b])
        first = order[0]
        if not gain[first] > _CLEAR:
            break
        others = [b for b in order[1:] if not {b, first} <= {"scale", "gyros"}]
        if not free and gain[others[0]] > gain[first] - _CLEAR:
            rival = others[0]
        other = found[first][1] if first == "clock" else other
        best, free = fits[first], (*free, first)
        if best.left(views) * float(np.mean(power_of(views))) < _NOISY * views.noise**2:
            break  # everything is explained
    return nothing, clocked, best, free, rival, other


def _freed(
    views: MotionIntegrals, block: str, best: MotionFit, free: tuple[str, ...]
) -> tuple[MotionFit, MotionFit | None]:
    """A model with one more block, from the best fit so far or from the most promising start.

    And, if a clock with a rate and one with steps are about as good, that of the other kind.
    """
    known, starts = _starts(views, block, best, free)

    def fitted(start: PairState, rounds: int, begin: PairState | None = None) -> MotionFit:
        parts = len(start.offset)
        names = [name for b in (*free, block) for name in _BLOCKS[b]]
        if parts > 1 and "rate" in names:
            names.remove("rate")
        return fit(views, start, prior_of(parts, *names), rounds, begin)

    if len(starts) > _PROMISING[block]:
        seen = [_gain(views, best, fitted(start, 0)) for start in starts]
        different = np.unique(np.round(seen, 6), return_index=True)[1]
        starts = [starts[k] for k in different[-_PROMISING[block] :]]
    fits = [fitted(known, _ROUNDS, best.state), *(fitted(start, _ROUNDS) for start in starts)]
    gains = np.array([_gain(views, best, one) for one in fits])
    steps = np.array([len(one.state.offset) > 1 for one in fits])
    k = int(np.argmax(gains))
    others = np.flatnonzero((steps != steps[k]) & (gains > gains[k] - _CLEAR))
    return fits[k], fits[others[np.argmax(gains[others])]] if len(others) else None


def _gain(views: MotionIntegrals, before: MotionFit, after: MotionFit) -> float:
    """A third of the gain of log-likelihood, with a variance for each stretch.

    An extra offset for a part of the log must pay off.
    """
    least = _LEAST_SHARE * float(np.median(power_of(views)))
    one, other = (np.log(f.by_stretch(views) + least) for f in (before, after))
    strain = (before.strain - after.strain) / 3.0
    gain = 0.5 * (float(np.bincount(views.of) @ (one - other)) / np.sqrt(views.stride) + strain)
    return gain - _PART * (len(after.state.offset) - len(before.state.offset))


def _starts(
    views: MotionIntegrals, block: str, best: MotionFit, free: tuple[str, ...]
) -> tuple[PairState, list[PairState]]:
    """Prior mean of a model with one more free block, and other states to start from."""
    state = _known(views, best.state, free)
    out, power = [], power_of(views)
    share, noise = best.by_stretch(views) / power, views.noise**2 / power
    usual = _NOISY * views.noise**2 / float(np.mean(power))
    if block != "clock":  # not for a clock, of which a step of a second explains less
        usual = max(_SUSPICIOUS[0], usual)
    odd = share > np.maximum(_SUSPICIOUS[1], 4.0 * noise)
    far = bool(best.left(views) > usual or np.any(odd))
    if far:
        out.append(state)
    if block == "clock" and not {"gyros", "scale"} & {*free}:
        out += _clocks(views, best, far)
    if far and block in ("gyros", "scale"):
        axes = signed_permutations()
        out += _maps(views, state, axes if block == "gyros" else axes[:1])
    return state, out


def _known(views: MotionIntegrals, state: PairState, free: tuple[str, ...]) -> PairState:
    """State with the free blocks kept; nuisance parameters restart from the tables as labelled."""
    out = start_of(views, mirror=float(np.sign(np.linalg.det(state.M_a))))
    if "clock" in free:
        out = out._replace(offset=state.offset, rate=state.rate, part=state.part)
    if {"gyros", "scale"} & {*free}:
        out = out._replace(M_g=state.M_g)
    return out._replace(M_a=state.M_a) if "forces" in free else out


def _clocks(views: MotionIntegrals, best: MotionFit, far: bool) -> list[PairState]:
    """Clock states that fit best: offset and rate, and offsets of parts.

    By the triads as labelled, and by those of the best fit so far, whose biases a small error of
    the clock spoils little.
    """
    last = (len(views.turn) - 1) / RATE_HZ
    farthest = min(max(last, float(views.end_s[-1])), _FAR_S) if far else 0.0
    reach = _NEAR_S if far else _CLOSE_S
    lags = np.arange(-reach, reach + 0.5 * _FINE_S, _FINE_S)
    beyond = np.arange(reach + _COARSE_S, farthest, _COARSE_S)
    start, out = start_of(views), []
    for known, these in (
        (views, np.concatenate([-beyond[::-1], lags, beyond])),
        (corrected(views, best.state), lags),
    ):
        cost = _cost_by_lag(known, these)
        steps = _steps(start, these, cost)
        out += [_line(views, start, these, cost), *([steps] if steps.part[-1] else [])]
    return out


def _cost_by_lag(views: MotionIntegrals, lags: np.ndarray) -> np.ndarray:
    """Log-likelihood ratios (stretches, lags) that count a change of velocity once, times -2/3."""
    squares, power = squares_by_lag(views, lags), power_of(views)
    # without IMU, or at rest: nothing is explained
    left = np.where(np.isnan(squares), power[:, None], squares)
    changes = np.bincount(views.of)[:, None] / views.stride
    return changes * np.log(left + _LEAST_SHARE * np.median(power))


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


def _steps(start: PairState, lags: np.ndarray, cost: np.ndarray) -> PairState:
    """Offsets of parts: the log is cut where that lowers the cost most, and its parts again."""
    first, bounds, done = 0, [len(cost)], []
    while bounds:
        part = cost[first : bounds[-1]]
        before = np.cumsum(part, axis=0)
        after = before[-1] - before
        both = before.min(axis=1) + after.min(axis=1)  # of a cut after each stretch
        k = int(np.argmin(both))
        if both[k] < both[-1] - _SWITCH:
            bounds.append(first + k + 1)
        else:
            done.append((first, float(lags[np.argmin(before[-1])])))
            first = bounds.pop()
    part = np.searchsorted([k for k, _ in done], np.arange(len(cost)), side="right") - 1
    return start._replace(offset=np.array([lag for _, lag in done]), part=part)


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
