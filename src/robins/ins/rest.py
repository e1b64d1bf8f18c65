"""Causal detection of rest, sample by sample.

`standstill` uses the scatter of the samples over a window, which suits a vehicle that stops.
`robins.ins.alignment.is_static` tests a whole record instead. Neither distinguishes a smooth
motion at constant speed from rest.
"""

from __future__ import annotations

import numpy as np

from robins.ins.increments import Increments

_ROWS = 1 << 16  # samples searched together: temporary arrays stay small in a long log


def moving_statistics(
    values: np.ndarray, width: int, first: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation over the `width` samples up to each one.

    Sums are taken within blocks of `width` samples from the first of the record on (van Herk 1992),
    so a piece of a record gives the bits of the whole, from its sample ``2 * width`` on.

    Args:
        values: (N, axes).
        width: samples in a window; the first windows of a record are shorter.
        first: number of samples of the record before these.

    Returns:
        Both (N, axes).
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


def standstill(
    increments: Increments,
    window_s: float,
    quiet_rate: float,
    quiet_force: float,
    usual_s: float | None = None,
    first: int = 0,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Detect standstill over the window up to each increment.

    At standstill, on every axis, the standard deviations of turn rate and specific force are below
    their thresholds, and the mean rate is below four times that of the rate.

    Args:
        increments: dt (N,) s, theta (N, 3) rad, dv (N, 3) m/s.
        window_s: duration of the window [s].
        quiet_rate: threshold of the standard deviation of rate [rad/s].
        quiet_force: threshold of the standard deviation of specific force [m/s^2].
        usual_s: s, sampling interval; None: the median of dt.
        first: number of increments of the record before these.

    Returns:
        Mask (N,) of standstill, mean gyro rate (N, 3) [rad/s] over the window, and unrest (N,): the
        largest standard deviation of any axis, in thresholds.
    """
    usual_s = float(np.median(increments.dt)) if usual_s is None else usual_s
    width = max(2, round(window_s / usual_s))
    parts = []
    for begin in range(0, max(len(increments.dt), 1), _ROWS):
        since = max(begin - 2 * width, 0)  # with the samples that its windows need
        part = Increments(*(a[since : begin + _ROWS] for a in increments[:3]))
        found = _still(part, width, quiet_rate, quiet_force, first + since)
        parts.append([a[begin - since :] for a in found])
    still, mean_rate, unrest = (np.concatenate(each) for each in zip(*parts, strict=True))
    return still, mean_rate, unrest


def _still(
    increments: Increments, width: int, quiet_rate: float, quiet_force: float, first: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Standstill of a part of a record, see `standstill`; `width` is the number of samples."""
    dt, theta, dv = increments[:3]
    mean_rate, spread_rate = moving_statistics(theta / dt[:, None], width, first)
    _, spread_force = moving_statistics(dv / dt[:, None], width, first)
    still = np.all(spread_rate < quiet_rate, axis=1)
    still &= np.all(spread_force < quiet_force, axis=1)
    still &= np.all(np.abs(mean_rate) < 4.0 * quiet_rate, axis=1)
    still[: max(width - 1 - first, 0)] = False
    each = np.concatenate([spread_rate / quiet_rate, spread_force / quiet_force], axis=1)
    return still, mean_rate, np.max(each, axis=1)
