"""Detects causally, sample by sample, when a unit stands still.

`standstill` looks at the scatter of the samples over a window, as suits a vehicle that stops;
`still_samples` at their distance from running means, and for how long it has been small, as suits a
unit in a hand. `robins.ins.alignment.is_static` judges a whole record instead. None of them tells a
smooth motion at constant speed from rest; `confirmed` asks fixes of it, too.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from robins.ins.increments import Increments

_MEMORY_S = 0.5  # time constant of the running means
_FEWEST = 5  # samples in the memory, below which nothing can be told
_CALMER = 0.5  # at rest without fixes: this share of the least unrest seen in motion, or less


def moving_statistics(
    values: np.ndarray, width: int, first: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation over the `width` samples up to each one.

    Sums are taken within blocks of `width` samples from the first of all on (van Herk 1992), so a
    piece of a record has the bits of the whole, from its sample ``2 * width`` on.

    Args:
        values: (N, axes).
        width: samples in a window; the first windows of a record are shorter.
        first: number of samples of the record before these.

    Returns:
        (N, axes) each.
    """
    count = np.minimum(first + np.arange(1, len(values) + 1), width)[:, None]
    # a window is a block, or the end of a block and the beginning of the next one
    lead = first % width
    rows = np.zeros((-(-(lead + len(values)) // width) * width, values.shape[1]))
    rows[lead : lead + len(values)] = values
    mean, square = (
        _moving_sum(x, width)[lead : lead + len(values)] / count for x in (rows, rows**2)
    )
    return mean, np.sqrt(np.maximum(square - mean**2, 0.0))


def _moving_sum(rows: np.ndarray, width: int) -> np.ndarray:
    """Sums (N, axes) over the `width` rows up to each one; N is a multiple of it."""
    blocks = rows.reshape(-1, width, rows.shape[1])
    head = np.cumsum(blocks, axis=1).reshape(rows.shape)
    tail = np.cumsum(blocks[:, ::-1], axis=1)[:, ::-1].reshape(rows.shape)
    before = np.zeros_like(rows)
    before[width - 1 :] = tail[: len(rows) - width + 1]
    before[width - 1 :: width] = 0.0
    return head + before


def _width(dt: np.ndarray, window_s: float, usual_s: float | None) -> int:
    """Samples in a window."""
    return max(2, round(window_s / (float(np.median(dt)) if usual_s is None else usual_s)))


def standstill(
    increments: Increments,
    window_s: float,
    quiet_rate: float,
    quiet_force: float,
    usual_s: float | None = None,
    first: int = 0,
) -> tuple[np.ndarray, np.ndarray]:
    """True where the unit stood still over the window up to each increment.

    Still means: on every axis the spread of turn rate and specific force is below its threshold,
    and the mean rate below four times its own.

    Args:
        increments: dt (N,) s, theta (N, 3) rad, dv (N, 3) m/s.
        window_s: length of the window.
        quiet_rate: rad/s.
        quiet_force: m/s^2.
        usual_s: s, sampling interval; None: the median of dt.
        first: number of increments of the record before these.

    Returns:
        (N,) bool, and (N, 3) mean gyro rate over the window [rad/s].
    """
    dt, theta, dv = increments[:3]
    width = _width(dt, window_s, usual_s)
    mean_rate, spread_rate = moving_statistics(theta / dt[:, None], width, first)
    _, spread_force = moving_statistics(dv / dt[:, None], width, first)
    still = np.all(spread_rate < quiet_rate, axis=1)
    still &= np.all(spread_force < quiet_force, axis=1)
    still &= np.all(np.abs(mean_rate) < 4.0 * quiet_rate, axis=1)
    still[: max(width - 1 - first, 0)] = False
    return still, mean_rate


def unrest(
    increments: Increments,
    window_s: float,
    quiet_rate: float,
    quiet_force: float,
    usual_s: float | None = None,
    first: int = 0,
) -> np.ndarray:
    """(N,) spread over the window up to each increment, in thresholds of `standstill`; the axis
    that is the farthest from still. Arguments as of `standstill`.
    """
    dt, theta, dv = increments[:3]
    width = _width(dt, window_s, usual_s)
    _, spread_rate = moving_statistics(theta / dt[:, None], width, first)
    _, spread_force = moving_statistics(dv / dt[:, None], width, first)
    each = np.concatenate([spread_rate / quiet_rate, spread_force / quiet_force], axis=1)
    return np.max(each, axis=1)


class Told(NamedTuple):
    """What M fixes tell of motion; each may prove it, exclude it, or tell nothing."""

    time_s: np.ndarray  # (M,) increasing
    moves: np.ndarray  # (M,) bool, it moves now, or has within the last second
    moved_s: np.ndarray  # (M,) beginning of the shortest time in which it has moved; NaN where none
    rests_s: np.ndarray  # (M,) of the shortest time in which it has not moved; NaN where none


class Known(NamedTuple):
    """What is known of the record before a piece of it."""

    calmest: float = np.inf  # least unrest in motion, by the intervals that begin before `since_s`
    quiet_s: float = -np.inf  # last time before `since_s` at which the samples were not quiet
    since_s: float = -np.inf  # before, statistics over windows lack samples


NOTHING = Known()


def confirmed(
    still: np.ndarray,
    unrest: np.ndarray,
    time_s: np.ndarray,
    told: Told,
    wait_s: float,
    known: Known = NOTHING,
) -> np.ndarray:
    """Which samples that look still are: a vehicle on a smooth road looks like one at rest.

    The last fix decides, where it proves motion, or excludes it for a time that began after the
    samples became quiet. Where it does neither, since it is old or its noise is large, a sample
    counts as still only if it is plainly calmer than the unit was in any interval before, between
    two fixes that said, as did the next, that it moves; if there was none, spread alone tells
    nothing. Nothing of the future is used.

    Args:
        still: (N,) bool, by the spread of the samples.
        unrest: (N,) the spread itself, in any unit.
        time_s: (N,) increasing times of the samples.
        told: what fixes tell.
        wait_s: how long a fix tells it.
        known: what was known before these.

    Returns:
        (N,) bool.
    """
    if len(told.time_s) == 0:
        return still & (unrest < (0.0 if known.calmest == np.inf else _CALMER * known.calmest))
    began = quiet_since(still, time_s, known)
    last = np.searchsorted(told.time_s, time_s + 1e-9, side="right") - 1
    at = np.maximum(last, 0)
    recent = (last >= 0) & (time_s - told.time_s[at] <= wait_s)
    moving = recent & (told.moves[at] | (told.moved_s[at] >= began))
    rests = recent & (told.rests_s[at] >= began)
    least = calmest_in_motion(unrest, time_s, told, wait_s, known)
    return still & ~moving & (rests | (unrest < _CALMER * least[last + 1]))


def quiet_since(still: np.ndarray, time_s: np.ndarray, known: Known = NOTHING) -> np.ndarray:
    """(N,) last time up to each sample at which the samples were not quiet; arguments as above."""
    quiet = still | (time_s < known.since_s)
    return np.maximum(np.maximum.accumulate(np.where(quiet, -np.inf, time_s)), known.quiet_s)


def calmest_in_motion(
    unrest: np.ndarray,
    time_s: np.ndarray,
    told: Told,
    wait_s: float,
    known: Known = NOTHING,
) -> np.ndarray:
    """(M + 1,) least unrest in motion as it is known after so many fixes; 0 where it is not.

    Arguments as of `confirmed`.
    """
    fix_s, moves = told.time_s, told.moves
    edges = np.searchsorted(time_s, fix_s)
    least = np.full(len(fix_s) + 1, known.calmest)
    for k in range(1, len(fix_s) - 1):
        begin, end = edges[k - 1], edges[k]
        is_new = fix_s[k - 1] >= known.since_s and fix_s[k] - fix_s[k - 1] <= wait_s
        if is_new and begin < end and np.all(moves[k - 1 : k + 2]):
            least[k + 2] = np.min(unrest[begin:end])
    least = np.minimum.accumulate(least)
    return np.where(np.isfinite(least), least, 0.0)


def still_samples(
    increments: Increments, after_s: float, quiet_rate: float, quiet_force: float, most_rate: float
) -> np.ndarray:
    """(N,) bool: whether the unit has lain still for a while, sample by sample.

    Still means that rate and specific force stay near their running means, and the mean rate near
    zero, without a break. Samples that are too rare for a mean over half a second tell nothing.

    Args:
        increments: dt (N,) s, theta (N, 3) rad, dv (N, 3) m/s.
        after_s: how long without a break.
        quiet_rate: rad/s, largest distance from the mean.
        quiet_force: m/s^2, the same.
        most_rate: rad/s, a mean rate above is no bias but a turn.
    """
    dt, theta, dv = increments[:3]
    rate, force = theta / dt[:, None], dv / dt[:, None]
    step = float(np.median(dt)) if len(dt) else 0.0
    if step <= 0.0 or _FEWEST * step > _MEMORY_S:
        return np.zeros(len(dt), dtype=bool)
    mean_rate, mean_force = _running_mean(rate, step), _running_mean(force, step)
    quiet = np.linalg.norm(rate - mean_rate, axis=1) < quiet_rate
    quiet &= np.linalg.norm(force - mean_force, axis=1) < quiet_force
    quiet &= np.all(np.abs(mean_rate) < most_rate, axis=1)
    quiet &= dt < after_s
    time = np.cumsum(dt)
    # time at which the quiet spell that holds now began
    began = np.maximum.accumulate(np.where(quiet, -np.inf, time))
    began = np.where(np.isfinite(began), began, 0.0)
    return quiet & (time - began >= after_s)


def _running_mean(values: np.ndarray, step: float) -> np.ndarray:
    """First-order low-pass, begun at the first sample."""
    # Imported here: it takes most of a second, and a simulation needs none of it.
    from scipy.signal import lfilter

    share = -np.expm1(-step / _MEMORY_S)
    return np.asarray(lfilter([share], [1.0, share - 1.0], values - values[0], axis=0)) + values[0]
