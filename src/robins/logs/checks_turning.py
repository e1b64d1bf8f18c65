"""Check of an IMU by itself that was turned about: gravity must turn as the gyros say.

Weaker than the motion of fixes (`checks_motion`), and used if these give no result: the sensor's
own acceleration disturbs it, and a reflection of both triads looks like gyros of the opposite
sense.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from robins.dataset import ImuTable
from robins.logs.checks_motion import unit_finding, words_of
from robins.logs.findings import Finding
from robins.logs.gnss_motion import lowest
from robins.logs.motion import (
    GRAVITY,
    power_of,
    signed_permutations,
    squares_by_map,
    stationary_integrals,
)
from robins.logs.motion_models import SCALES as STARTS
from robins.logs.quiet import error, signal_of, usual_force, windows_of

_WRONG, _RIGHT, _BETTER = 0.1, 0.1, 0.2  # shares of the turning of gravity left unexplained
_TIED = 1e-3  # difference of shares that noise makes
_SIGMA = 0.03  # sigma of a gyro scale


def check_turning(imu: ImuTable) -> Iterator[Finding]:
    """Findings about gyros inconsistent with the rotation of gravity in accelerometer axes."""
    signal = signal_of(imu)
    if signal is None:
        return
    size = usual_force(windows_of(signal))
    if not size > 0.0:
        return
    views = stationary_integrals(signal._replace(accel=signal.accel * (GRAVITY / size)), imu.kind)
    if views is None:
        return
    scales = np.array([*STARTS, 0.0])  # the last: no rotation
    maps = np.concatenate([signed_permutations(), scales[:, None, None] * np.eye(3)])
    squares = squares_by_map(views, maps, np.zeros(len(views.start_s)))[:, 0]
    left = squares / np.sum(power_of(views))
    if not left[0] > _WRONG:
        return
    k, tied = _simplest(maps, left)
    # A vehicle that only accelerates is explained without rotation, and gives no evidence on it.
    if left[k] > min(_RIGHT, _BETTER * left[0], 0.5 * left[-1]):
        return
    shown = (
        "turned about, the gyros do not turn gravity as the accelerometers see it turn "
        f"({left[0]:.0%} of it is left over, with other gyro columns {left[k]:.0%})"
    )
    if k >= 48:
        near = lowest(np.log(scales[k - 49 : k - 46]), left[k - 1 : k + 2])
        value = float(scales[k - 48] if near is None else np.exp(near))
        yield unit_finding(imu, value, _SIGMA * value, signal.step_s, shown)
    elif np.array_equal(maps[k], -np.eye(3)):
        yield error(imu, "left_handed", float(left[k]))(
            f"{shown}. The gyros have the opposite sense of rotation, or both triads are "
            "left-handed: two axes exchanged or one reversed, alike in both."
        )
    else:
        hardly = " It turned too little about the other axes to test them." if tied else ""
        yield error(imu, "gyro_axes", float(left[k]))(
            f"{shown}. The gyros fit as {words_of(maps[k], 'gyro')}; or the accelerometers' "
            f"columns were exchanged or reversed accordingly.{hardly}"
        )


def _simplest(maps: np.ndarray, left: np.ndarray) -> tuple[int, bool]:
    """Index of the map that changes fewest columns of those that fit about best, and if others do.

    Args:
        maps: (k, 3, 3) gyro maps.
        left: (k,) unexplained share of each.
    """
    best = float(np.min(left))
    near = np.flatnonzero(left <= max(1.5 * best, best + _TIED))
    changed = np.any(np.abs(maps[near] - np.eye(3)) > 1e-9, axis=2).sum(axis=1)
    order = np.lexsort((left[near], changed))
    return int(near[order[0]]), len(near) > 1
