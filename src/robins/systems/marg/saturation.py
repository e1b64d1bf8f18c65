"""Gyro saturation: detection of an unknown range, and restoration of clipped peaks.

A clipped signal jumps to a level, stays there, and leaves it by a jump. A smooth peak with two
samples within 0.5 % of its height has its next sample within 4.5 % of it (for a sine, half an
interval is at most 0.1 rad, and cos 0.3 is 0.955); so a level that is reached or left twice by a
larger jump is the end of the range.

If the chip filters after clipping, there is no jump, but a plateau, to which the same rule applies
over more samples. A signal that stays within 0.5 % for d seconds and is more than 5 % lower d
before and d after is clipped. It must last 0.08 s, since the peak of a hand's motion can be flatter
than a sine, and at most 0.4 s: a machine that turns at a constant rate does so for longer.

A replay finds levels over the whole log, so peaks before the first that reveals the range are
restored too. A live object finds them sample by sample (`GyroRange`).
"""

from __future__ import annotations

import numpy as np

from robins.systems.suspects import edges

_LEVEL = 0.005  # relative scatter of samples at the level
_JUMP = 0.05  # share of the level; a smooth peak falls by less in a sample
_LEAST_RATE = 1.0  # rad/s; no gyro has a smaller range
_OFTEN = 2  # jumps to or from the level
_PLATEAU_S = (0.08, 0.4)  # s, shortest and longest plateau; a machine turns for longer
_KEPT_PAIRS = 100  # pairs of samples at the level; more than in a peak
LONGEST_S = 0.2  # s, longest peak that is restored
FLANK = 3  # samples on each side used for that
_FROZEN_SAMPLES = 5  # samples of a block; fewer repeated values are no evidence
_TURNS = np.radians(10.0)  # rad/s; larger than any bias
_OF_CHANGE = 0.02  # weight of a block in the running mean difference of successive samples
_SHAKEN = 0.5  # m/s^2; the specific force varies more in a block of a moving unit
_MISSED = 0.3  # relative sigma of the rate added by restoration


def levels(rate: np.ndarray, step_s: float = 0.0) -> np.ndarray:
    """Magnitudes (3, 2) [rad/s] of the negative and positive end of each range; inf if unknown.

    Args:
        rate: (N, 3) rad/s.
        step_s: s, sampling interval; 0: do not search for plateaus.
    """
    out = np.full((3, 2), np.inf)
    for axis in range(3):
        for side, sign in enumerate((-1.0, 1.0)):
            x = sign * rate[:, axis]
            top = float(np.max(x, initial=0.0))
            if top < _LEAST_RATE:
                continue
            at = x > (1.0 - _LEVEL) * top
            pair = at[1:-2] & at[2:-1]
            low = (1.0 - _JUMP) * top
            jumps = np.sum(pair & (x[:-3] < low)) + np.sum(pair & (x[3:] < low))
            if jumps >= _OFTEN:
                out[axis, side] = (1.0 - _LEVEL) * top
            elif _has_plateau(x, top, step_s):
                # a filtered plateau is not quite level
                out[axis, side] = (1.0 - 2.0 * _LEVEL) * top
    return out


def _has_plateau(x: np.ndarray, top: float, step_s: float) -> bool:
    """True if the signal (N,) has a plateau at `top` that no smooth peak has."""
    for begin, end in edges(x > (1.0 - _LEVEL) * top):
        long = end - 1 - begin
        before, after = begin - long, end - 1 + long
        if not _PLATEAU_S[0] <= long * step_s <= _PLATEAU_S[1] or before < 0 or after >= len(x):
            continue
        if max(x[before], x[after]) < (1.0 - _JUMP) * top:
            return True
    return False


class GyroRange:
    """Ends of each gyro's range and its resolution, found from the samples so far.

    Attributes:
        levels: (3, 2) rad/s, as in the function `levels`.
    """

    def __init__(self, levels: np.ndarray | None = None) -> None:
        """Create with unknown levels, or with given ones of a whole log."""
        self._last = np.zeros((0, 3))  # rad/s, the last three samples
        self._top = np.zeros(6)  # rad/s, largest positive rate of each axis, then negative
        # for each: pairs at its top (lower of the two, sample before, sample after)
        self._pairs: list[np.ndarray] = [np.zeros((0, 3))] * 6
        self.levels = np.full((3, 2), np.inf) if levels is None else levels
        self._step = np.full(3, np.inf)  # rad/s, least nonzero difference on each axis
        self._change = np.full(3, np.nan)  # rad/s, mean difference of successive samples
        self._hung = 0  # successive hanging blocks up to the last

    def read(self, rate: np.ndarray) -> None:
        """Process the next sample (3,) [rad/s]."""
        window = np.concatenate([self._last, rate[None]])
        self._last = window[-3:]
        new = np.concatenate([rate, -rate])
        grown = new > self._top
        self._top = np.maximum(self._top, new)
        near = grown & (self._top >= _LEAST_RATE)
        if len(window) == 4:
            x = np.concatenate([window, -window], axis=1)
            low = np.minimum(x[1], x[2])
            paired = (low > (1.0 - _LEVEL) * self._top) & (self._top >= _LEAST_RATE)
            for k in np.flatnonzero(paired):
                row = np.array([[low[k], x[0, k], x[3, k]]])
                self._pairs[k] = np.concatenate([self._pairs[k][-_KEPT_PAIRS:], row])
            near |= paired
        for k in np.flatnonzero(near):
            top, found = self._top[k], self._pairs[k]
            found = self._pairs[k] = found[found[:, 0] > (1.0 - _LEVEL) * top]
            jumps = np.sum(found[:, 1:] < (1.0 - _JUMP) * top)
            self.levels[k % 3, int(k < 3)] = (1.0 - _LEVEL) * top if jumps >= _OFTEN else np.inf

    def hanging(self, rate: np.ndarray, accel: np.ndarray) -> int:
        """Detect gyros that repeat one rate during a block while the unit is shaken.

        A converter or driver that hangs repeats its last values, within one least significant
        digit. So does a unit that does not turn, or one with noise below that digit: gyros hang
        only if they read a turn, and varied from sample to sample before.

        Args:
            rate: (n + 1, 3) rad/s, from the last sample before the block on.
            accel: (n + 1, 3) m/s^2.

        Returns:
            Number of successive hanging blocks up to this one, including the block after the last,
            which may begin so; 0 if the gyros do not hang.
        """
        change = np.abs(np.diff(rate, axis=0))
        known, usual = self._step, self._change
        least = np.min(np.where(change > 0.0, change, np.inf), axis=0, initial=np.inf)
        self._step = np.minimum(known, least)
        last = rate[-max(_FROZEN_SAMPLES, len(change) // 2) :]
        before, self._hung = self._hung, 0
        if len(change) >= len(last) and np.all(np.isfinite(known)):
            repeats = np.all(np.ptp(last, axis=0) <= 1.5 * known)
            turns = np.linalg.norm(last.mean(axis=0)) > _TURNS
            shaken = np.max(np.ptp(accel[1:], axis=0)) > _SHAKEN
            if repeats and turns and shaken and np.all(usual > 0.5 * known):
                self._hung = before + 1
        if not self._hung and len(change):
            share = 1.0 if np.any(np.isnan(usual)) else _OF_CHANGE
            self._change = np.where(np.isnan(usual), 0.0, usual) * (1.0 - share)
            self._change = self._change + share * change.mean(axis=0)
        # the block after the last hanging one may begin so
        return self._hung or (before + 1 if before else 0)


def beyond(rate: np.ndarray, levels: np.ndarray, most: float) -> np.ndarray:
    """Mask (N, 3) of rates at the end of a range.

    Args:
        rate: (N, 3) rad/s.
        levels: (3, 2) rad/s, as in the function `levels`.
        most: rad/s, range by the data sheet.
    """
    limit = np.minimum(levels, 0.99 * most)
    return (rate <= -limit[:, 0]) | (rate >= limit[:, 1])


def bridged(
    time_ns: np.ndarray, rate: np.ndarray, full: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Restore peaks clipped at the end of the range.

    A peak is the cubic through the last good sample before and the first after it, with the slopes
    of the flanks. Peaks longer than `LONGEST_S` stay clipped.

    Args:
        time_ns: (N,) int64.
        rate: (N, 3) rad/s.
        full: (N, 3) bool, at the end of the range.

    Returns:
        Rates (N, 3) [rad/s], and standard deviation (N, 3) of the restored ones; NaN elsewhere.
    """
    out, doubt = rate.copy(), np.full(rate.shape, np.nan)
    for axis in range(3):
        for begin, end in edges(full[:, axis]):
            if begin < FLANK or end + FLANK > len(rate):
                continue
            before, after = slice(begin - FLANK, begin), slice(end, end + FLANK)
            if np.any(full[before, axis]) or np.any(full[after, axis]):
                continue
            t = (time_ns[before.start : after.stop] - time_ns[begin - 1]) * 1e-9
            h, u = t[-FLANK], t[FLANK:-FLANK] / t[-FLANK]
            if h > LONGEST_S:
                continue
            x, sign = rate[:, axis], np.sign(rate[begin, axis])
            rise = _slope(t[:FLANK], x[before])
            fall = _slope(t[-FLANK:][::-1], x[after][::-1])
            cubic = (
                (2.0 * u**3 - 3.0 * u**2 + 1.0) * x[begin - 1]
                + (3.0 * u**2 - 2.0 * u**3) * x[end]
                + (u**3 - 2.0 * u**2 + u) * h * rise
                + (u**3 - u**2) * h * fall
            )
            added = np.maximum(sign * (cubic - x[begin:end]), 0.0)
            out[begin:end, axis] += sign * added
            doubt[begin:end, axis] = _MISSED * added
    return out, doubt


def _slope(t: np.ndarray, x: np.ndarray) -> float:
    """Slope at the last of three samples, of the parabola through them."""
    late, early = (x[2] - x[1]) / (t[2] - t[1]), (x[1] - x[0]) / (t[1] - t[0])
    return float(late + (late - early) * (t[2] - t[1]) / (t[2] - t[0]))
