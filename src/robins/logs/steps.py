"""How the gyros say that the sensor turned, over short steps; what else turned must agree."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from robins.logs.motion import at, integral, rotations
from robins.logs.quiet import Signal

_FINE_S, _PER_STEP = 0.01, 20  # rotations are composed of fine ones, and compared over 0.2 s
_MOST = 1500  # steps, of those that turn most
_LEAST = 50  # below which nothing is judged
_TURNED = 0.1  # rad, of a step that tells something


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
