"""The doctor on gyros and magnetometer together: do they turn about the same axes?

The Earth's field stands still, so from one moment to the next it must turn in the sensor as the
gyros say, m(t + dt) = C' m(t). Magnetometers are chips of their own, and often sit otherwise than
the gyros beside them, or in the same casing with other axes. Each way to exchange and reverse the
columns is tried, with an offset (hard iron) of its own; a field and its opposite turn alike, so of
each pair only the right-handed one is.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from robins.dataset import ImuTable, MagTable
from robins.logs.checks_motion import words_of
from robins.logs.findings import Finding
from robins.logs.motion import at, integral, rotations, signed_permutations
from robins.logs.ordering import increasing
from robins.logs.quiet import Signal, finding, signal_of

_FINE_S, _PER_STEP = 0.01, 20  # rotations are composed of fine ones, and compared over 0.2 s
_STEPS = 1500  # of those that turn most
_LEAST = 50  # steps below which nothing is judged
_TURNED = 0.1  # rad, of a step that tells something
_WRONG, _RIGHT, _BETTER = 0.4, 0.15, 0.25  # shares of the change left unexplained


def check_mag_axes(imu: ImuTable, mag: MagTable) -> Iterator[Finding]:
    """Findings about a field that does not turn as the gyros say; none if they hardly turn."""
    signal = signal_of(imu)
    if signal is None or mag.body != imu.body:
        return
    time_s, field = _readings(mag, int(imu.time_ns[signal.rows[0]]))
    pairs = _pairs(signal, time_s, field) if len(field) > _LEAST else None
    if pairs is None:
        return
    maps = signed_permutations()
    maps = maps[np.linalg.det(maps) > 0.0]
    left = _left_over(*pairs, maps)
    k = int(np.argmin(left))
    if left[0] < _WRONG or left[k] > min(_RIGHT, _BETTER * left[0]):
        return
    yield finding(
        mag,
        "error",
        "field_axes",
        float(left[0]),
        f"the magnetic field does not turn as the gyros say ({left[0]:.0%} of its change is left "
        f"over), but it does ({left[k]:.0%}) with the columns {words_of(maps[k], 'field')}, or all "
        "three of these reversed. The magnetometer is mounted otherwise than the gyros: exchange "
        "its columns so.",
    )


def _readings(mag: MagTable, start_ns: int) -> tuple[np.ndarray, np.ndarray]:
    """Times [s] and field of unit size, each reading once and in order."""
    good = np.isfinite(mag.field_t).all(axis=1) & (mag.field_t != 0.0).any(axis=1)
    rows = np.flatnonzero(good)
    rows = rows[increasing(mag.time_ns[rows])]
    field = mag.field_t[rows]
    fresh = np.concatenate([[True], np.diff(field, axis=0).any(axis=1)])[: len(rows)]
    field = field[fresh]
    size = np.median(np.linalg.norm(field, axis=1)) if len(field) else 1.0
    return (mag.time_ns[rows[fresh]] - start_ns) * 1e-9, field / size


def _pairs(
    signal: Signal, time_s: np.ndarray, field: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Field before and after each step that turns, and (n, 3, 3) how the gyros say it turns."""
    begin, end = max(time_s[0], 0.0), min(time_s[-1], signal.time_s[-1])
    count = int((end - begin) / (_FINE_S * _PER_STEP))
    if count < _LEAST:
        return None
    grid = begin + _FINE_S * np.arange(count * _PER_STEP + 1)
    fine = np.diff(at(grid, signal.time_s, integral(signal.time_s, signal.gyro)), axis=0)
    fine = fine.reshape(count, _PER_STEP, 3)
    m = at(grid[::_PER_STEP], time_s, field)
    known = _recorded(grid[::_PER_STEP], time_s) & _recorded(grid[::_PER_STEP], signal.time_s)
    most = np.linalg.norm(fine.sum(axis=1), axis=1) * known
    chosen = np.sort(np.argsort(most)[-_STEPS:])
    chosen = chosen[most[chosen] > _TURNED]
    if len(chosen) < _LEAST:
        return None
    C = np.broadcast_to(np.eye(3), (len(chosen), 3, 3))
    for k in range(_PER_STEP):
        C = C @ rotations(fine[chosen, k])
    return m[chosen], m[chosen + 1], np.swapaxes(C, 1, 2)


def _recorded(grid: np.ndarray, time_s: np.ndarray) -> np.ndarray:
    """(len(grid) - 1,) whether there is no gap in the samples around each step."""
    step = grid[1] - grid[0]
    before = np.searchsorted(time_s, grid[:-1], side="right") - 1
    after = np.searchsorted(time_s, grid[1:], side="left")
    return time_s[np.minimum(after, len(time_s) - 1)] - time_s[np.maximum(before, 0)] < 2.0 * step


def _left_over(
    before: np.ndarray, after: np.ndarray, turn: np.ndarray, maps: np.ndarray
) -> np.ndarray:
    """(h,) share of the change of the field that each map and its best offset leave over."""
    rest = np.einsum("hij,nj->hni", maps, after)
    rest = rest - np.einsum("nij,hjk,nk->hni", turn, maps, before, optimize=True)
    by_offset = (np.eye(3) - turn).reshape(-1, 3)
    flat = rest.reshape(len(maps), -1).T
    offset = np.linalg.lstsq(by_offset, flat, rcond=1e-3)[0]
    return np.sum((flat - by_offset @ offset) ** 2, axis=0) / np.sum((after - before) ** 2)
