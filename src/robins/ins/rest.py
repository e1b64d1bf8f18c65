"""Causal detection of rest, sample by sample.

`standstill` looks at the scatter of the samples over a window, as suits a vehicle that stops.
`robins.ins.alignment.is_static` judges a whole record instead. Neither distinguishes a smooth
motion at constant speed from rest.
"""

from __future__ import annotations

import numpy as np

from robins.ins.increments import Increments


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


def standstill(
    increments: Increments,
    window_s: float,
    quiet_rate: float,
    quiet_force: float,
    usual_s: float | None = None,
    first: int = 0,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
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
        (N,) bool, (N, 3) mean gyro rate over the window [rad/s], and (N,) unrest: the spread, in
        thresholds, of the axis that is the farthest from still.
    """
    dt, theta, dv = increments[:3]
    width = max(2, round(window_s / (float(np.median(dt)) if usual_s is None else usual_s)))
    mean_rate, spread_rate = moving_statistics(theta / dt[:, None], width, first)
    _, spread_force = moving_statistics(dv / dt[:, None], width, first)
    still = np.all(spread_rate < quiet_rate, axis=1)
    still &= np.all(spread_force < quiet_force, axis=1)
    still &= np.all(np.abs(mean_rate) < 4.0 * quiet_rate, axis=1)
    still[: max(width - 1 - first, 0)] = False
    each = np.concatenate([spread_rate / quiet_rate, spread_force / quiet_force], axis=1)
    return still, mean_rate, np.max(each, axis=1)
