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
from robins.logs.limits import FIELD_LIMIT_T, few_beyond
from robins.logs.motion import at, signed_permutations
from robins.logs.ordering import increasing
from robins.logs.quiet import error, signal_of
from robins.logs.steps import steps_of

_WRONG, _RIGHT, _BETTER = 0.4, 0.15, 0.25  # shares of the change left unexplained


def check_mag_axes(imu: ImuTable, mag: MagTable) -> Iterator[Finding]:
    """Findings about a field that does not turn as the gyros say; none if they hardly turn."""
    signal = signal_of(imu)
    if signal is None or mag.body != imu.body:
        return
    time_s, field = _readings(mag, int(imu.time_ns[signal.rows[0]]))
    steps = steps_of(signal, time_s)
    if steps is None:
        return
    maps = signed_permutations()
    maps = maps[np.linalg.det(maps) > 0.0]
    before, after = (at(when, time_s, field) for when in (steps.begin_s, steps.end_s))
    left = _left_over(before, after, np.swapaxes(steps.C, 1, 2), maps)
    k = int(np.argmin(left))
    if left[0] < _WRONG or left[k] > min(_RIGHT, _BETTER * left[0]):
        return
    yield error(
        mag,
        "field_axes",
        float(left[0]),
        f"the magnetic field does not turn as the gyros say ({left[0]:.0%} of its change is left "
        f"over), but it does ({left[k]:.0%}) with the columns {words_of(maps[k], 'field')}, or all "
        "three of these reversed. The magnetometer is mounted otherwise than the gyros: exchange "
        "its columns so.",
    )


def _readings(mag: MagTable, start_ns: int) -> tuple[np.ndarray, np.ndarray]:
    """Times [s] and field of unit size, each reading once and in order."""
    good = np.isfinite(mag.field_t).all(axis=1) & (np.linalg.norm(mag.field_t, axis=1) > 0.0)
    good &= ~few_beyond(mag.field_t, FIELD_LIMIT_T)
    rows = np.flatnonzero(good)
    rows = rows[increasing(mag.time_ns[rows])]
    field = mag.field_t[rows]
    fresh = np.concatenate([[True], np.diff(field, axis=0).any(axis=1)])[: len(rows)]
    field = field[fresh]
    size = np.median(np.linalg.norm(field, axis=1)) if len(field) else 1.0
    return (mag.time_ns[rows[fresh]] - start_ns) * 1e-9, field / size


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
