"""Blocks of IMU increments, one per filter epoch.

The IMU runs at hundreds of hertz, the covariance and the aids at a few. A block holds the
increments between two epochs, padded with increments of zero duration, so that a whole log has one
shape and a run is one scan over blocks with one scan inside. An increment that contains an epoch is
split there, so that every measurement is applied to the state at its own time.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation as SciRotation

from robins.ins.frames import turned
from robins.ins.increments import Increments


def epochs_between(
    start_s: float, end_s: float, wanted_s: np.ndarray, longest_s: float, even: bool = True
) -> np.ndarray:
    """Epochs at all wanted times in (start, end], with more between them to limit block length.

    Args:
        start_s: where the first block begins.
        end_s: where the last block ends.
        wanted_s: times that need an epoch of their own (measurements).
        longest_s: longest block allowed.
        even: split evenly; else into longest blocks and a rest, as without knowledge of the next
            wanted time.

    Returns:
        (E,) strictly increasing; the last one is end_s.
    """
    wanted = np.unique(np.asarray(wanted_s, dtype=float))
    wanted = wanted[(wanted > start_s) & (wanted <= end_s)]
    edges = np.unique(np.concatenate([[start_s], wanted, [end_s]]))
    out = []
    for a, b in pairwise(edges):
        # tolerance, so that 1.0000001 s does not become two blocks
        pieces = max(1, int(np.ceil((b - a) / longest_s - 1e-6)))
        part = np.arange(1, pieces + 1)
        out.append(a + (b - a) * part / pieces if even else a + longest_s * part)
        out[-1][-1] = b
    return np.concatenate(out) if out else np.zeros(0)


def due_epochs(
    known_s: float, time_s: float, wanted_s: float, measured_s: np.ndarray, longest_s: float
) -> list[tuple[float, float]]:
    """Epochs after `time_s` that later measurements cannot change, each with its `wanted_s`.

    Args:
        known_s: up to where samples and measurements are known.
        time_s: the last epoch.
        wanted_s: the last measurement up to there, or the start; blocks are counted from it.
        measured_s: (M,) increasing times of measurements.
        longest_s: longest block.
    """
    # one block further, whose end is not an epoch
    edges = epochs_between(wanted_s, known_s + longest_s, measured_s, longest_s, even=False)
    edges = edges[(edges > time_s) & (edges <= known_s)]
    wanted = np.where(np.isin(edges, measured_s), edges, wanted_s)
    return list(zip(edges.tolist(), np.maximum.accumulate(wanted).tolist(), strict=True))


def usual_width(longest_s: float, usual_s: float) -> int:
    """Number of pieces in the longest block at the usual interval, with some to spare."""
    return -(-math.ceil(1.1 * longest_s / usual_s + 2.0) // 8) * 8


_SLACK_S = 1e-9  # rounding of a time stamp


def _shares(
    time_s: np.ndarray, dt: np.ndarray, start_s: float, epoch_s: np.ndarray
) -> tuple[np.ndarray, ...]:
    """Pieces between epochs: end [s], index of the increment, share of it, and share before."""
    begin_s = time_s - dt
    inside = (time_s > start_s) & (begin_s < epoch_s[-1])
    edges = np.concatenate([[start_s], epoch_s, time_s[inside]])
    edges = np.unique(edges[(edges >= start_s) & (edges <= epoch_s[-1])])
    ends, starts = edges[1:], edges[:-1]
    middle = 0.5 * (starts + ends)
    parent = np.minimum(np.searchsorted(time_s, middle), len(dt) - 1)
    real = (ends - starts) > _SLACK_S  # edges that differ by less are one edge
    starts, ends, parent = starts[real], ends[real], parent[real]
    share = np.clip((ends - starts) / dt[parent], 0.0, 1.0)
    before = np.clip((starts - begin_s[parent]) / dt[parent], 0.0, 1.0)
    whole = share > 1.0 - 1e-6
    return ends, parent, np.where(whole, 1.0, share), np.where(whole, 0.0, before)


def cut(
    increments: Increments, time_s: np.ndarray, start_s: float, epoch_s: np.ndarray, least: int = 8
) -> tuple[Increments, np.ndarray]:
    """Group increments by epoch, splitting those that contain an epoch.

    A split increment is divided in proportion to time, at a constant rate within it; the second
    part's velocity increment is rotated into the body axes at its own start.

    Args:
        increments: N increments; dt (N,), theta (N, 3), dv (N, 3). Displacements are not used: a
            piece is taken to have constant specific force, to the order of the other terms.
        time_s: (N,) end of each increment; it begins at ``time_s - dt``.
        start_s: beginning of the first block.
        epoch_s: (E,) end of each block, increasing.
        least: pad every block to this many pieces, or to the longest block, rounded up to a
            multiple of 8 so that logs of like rate share a compilation.

    Returns:
        dt (E, K), theta (E, K, 3) and dv (E, K, 3), padded with zeros, and (E, K) the index of the
        increment of each piece, -1 where padded.

    Raises:
        ValueError: the increments do not cover (start_s, last epoch].
    """
    dt, theta, dv = (np.asarray(a, dtype=float) for a in increments[:3])
    time_s, epoch_s = np.asarray(time_s, dtype=float), np.asarray(epoch_s, dtype=float)
    begin_s = time_s - dt
    if len(dt) == 0 or begin_s[0] > start_s + _SLACK_S or time_s[-1] < epoch_s[-1] - _SLACK_S:
        have = "none" if len(dt) == 0 else f"{begin_s[0]:.6f} to {time_s[-1]:.6f} s"
        raise ValueError(
            f"the IMU does not cover the blocks from {start_s:.6f} to {epoch_s[-1]:.6f} s: "
            f"its increments reach from {have}"
        )
    ends, parent, share, before = _shares(time_s, dt, start_s, epoch_s)
    piece_theta = share[:, None] * theta[parent]
    piece_dv = share[:, None] * dv[parent]
    late = before > 0.0
    if np.any(late):
        turn = SciRotation.from_rotvec(-before[late, None] * theta[parent[late]])
        piece_dv[late] = turned(turn.as_matrix(), piece_dv[late])
    block = np.searchsorted(epoch_s, ends - _SLACK_S)
    count = np.bincount(block, minlength=len(epoch_s))
    width = max(-(-int(count.max(initial=1)) // 8) * 8, least)
    first = np.concatenate([[0], np.cumsum(count)[:-1]])
    column = np.arange(len(block)) - first[block]
    shape = (len(epoch_s), width)
    out_dt, out_theta, out_dv = np.zeros(shape), np.zeros((*shape, 3)), np.zeros((*shape, 3))
    out_parent = np.full(shape, -1)
    out_dt[block, column] = share * dt[parent]
    out_theta[block, column] = piece_theta
    out_dv[block, column] = piece_dv
    out_parent[block, column] = parent
    return Increments(out_dt, out_theta, out_dv), out_parent


def reach_of_rate(usual_s: float) -> float:
    """Reach of `rate_about` around a time [s], for a sensor with this sampling interval."""
    return max(0.01, 1.5 * usual_s)


def rate_about(
    increments: Increments, time_s: np.ndarray, at_s: np.ndarray, usual_s: float | None = None
) -> np.ndarray:
    """Gyro rate (E, 3) [rad/s] at given times: mean over the increments that end within 10 ms.

    Args:
        increments: dt (N,), theta (N, 3).
        time_s: (N,) end of each.
        at_s: (E,) times [s].
        usual_s: s, sampling interval; None: the median of dt.
    """
    dt, theta = increments[:2]
    half = reach_of_rate(float(np.median(dt)) if usual_s is None else usual_s)
    a = np.searchsorted(time_s, at_s - half)
    b = np.minimum(np.maximum(np.searchsorted(time_s, at_s + half), a + 1), len(dt))
    a = np.minimum(a, b - 1)
    total, length = np.zeros((len(at_s), 3)), np.zeros(len(at_s))
    for k in range(int(np.max(b - a, initial=0))):
        there = a + k < b
        total[there] += theta[a[there] + k]
        length[there] += dt[a[there] + k]
    return total / length[:, None]


_Piece = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, SciRotation]


def _backwards(
    increments: Increments, time_s: np.ndarray, begin_s: np.ndarray, end_s: np.ndarray
) -> Iterator[_Piece]:
    """Pieces of increments in windows (begin, end], the latest first.

    Yields:
        (E,) row of the increment, share of it in the window, length [s] and middle [s] of that
        part, and the turn from the axes at its start to those at the end of the window.
    """
    sample = np.searchsorted(time_s, end_s - _SLACK_S)
    turn = SciRotation.identity(len(end_s))
    while True:
        inside = (sample >= 0) & (sample < len(time_s))
        k = np.clip(sample, 0, len(time_s) - 1)
        end = np.minimum(time_s[k], end_s)
        begin = np.maximum(time_s[k] - increments.dt[k], begin_s)
        length = np.where(inside, np.maximum(end - begin, 0.0), 0.0)
        if not np.any(length > 0.0):
            return
        share = length / increments.dt[k]
        # dv is in the axes at the start of its interval, so its rotation comes first
        turn = turn * SciRotation.from_rotvec(-share[:, None] * increments.theta[k])
        yield k, share, length, 0.5 * (begin + end), turn
        sample = sample - 1


def mean_rate(
    increments: Increments, time_s: np.ndarray, begin_s: np.ndarray, end_s: np.ndarray
) -> np.ndarray:
    """Mean gyro rate (E, 3) [rad/s] over windows (begin, end] [s] that the increments cover."""
    total = np.zeros((len(end_s), 3))
    for row, share, *_ in _backwards(increments, time_s, begin_s, end_s):
        total += share[:, None] * increments.theta[row]
    return total / (end_s - begin_s)[:, None]


def gained_between(
    increments: Increments, time_s: np.ndarray, begin_s: np.ndarray, end_s: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Turn (E, 3) [rad] and velocity gained (E, 3) [m/s] over windows (begin, end] [s].

    The turn is a rotation vector, the velocity the integral of the specific force in the body axes
    at the end.
    """
    gained, back = np.zeros((len(end_s), 3)), np.zeros((len(end_s), 3))
    for row, share, length, _, turn in _backwards(increments, time_s, begin_s, end_s):
        gained += turned(turn.as_matrix(), share[:, None] * increments.dv[row])
        # not beyond the own window: a further turn by zero may round
        back = np.where(length[:, None] > 0.0, turn.as_rotvec(), back)
    return -back, gained


def gained_in_window(
    increments: Increments, time_s: np.ndarray, at_s: np.ndarray, window_s: float
) -> tuple[np.ndarray, np.ndarray]:
    """Mean velocity gained over a window up to its end.

    The mean over s in (t - T, t] of v(t) - v(s) is the integral of the specific force with a weight
    that grows from 0 at t - T to 1 at t, in the body axes at t.

    Args:
        increments: dt (N,), theta (N, 3), dv (N, 3).
        time_s: (N,) end of each.
        at_s: (E,) ends of the windows.
        window_s: length T; 0 for none.

    Returns:
        Gain (E, 3) [m/s] of specific force, gravity not included, and integral of the weight (E,)
        [s], T/2 if the samples cover the window.
    """
    gained, age = np.zeros((len(at_s), 3)), np.zeros(len(at_s))
    if window_s <= 0.0:
        return gained, age
    for row, share, length, middle_s, turn in _backwards(increments, time_s, at_s - window_s, at_s):
        weight = 1.0 - (at_s - middle_s) / window_s
        gained += (weight * share)[:, None] * turned(turn.as_matrix(), increments.dv[row])
        age += weight * length
    return gained, age
