"""The doctor on an IMU alone that was turned about: gyro unit and axes, by gravity standing still.

Weaker than `checks_motion`, for the sensor's own acceleration disturbs it and a reflection of both
triads looks like gyros of the opposite sense; used where GNSS cannot judge.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from robins.dataset import ImuTable
from robins.logs.checks_motion import SCALES, words_of
from robins.logs.findings import Finding
from robins.logs.motion import GRAVITY, at_the_spot, signed_permutations, unexplained
from robins.logs.quiet import error, signal_of, windows_of

_WRONG, _RIGHT, _BETTER = 0.1, 0.1, 0.2  # shares of gravity left unexplained


def check_turning(imu: ImuTable) -> Iterator[Finding]:
    """Findings about gyros that do not turn gravity as the accelerometers see it turn."""
    signal = signal_of(imu)
    if signal is None:
        return
    windows = windows_of(signal)
    size = float(np.median(np.linalg.norm(windows.accel[windows.calm], axis=-1)))
    if not size > 0.0:
        return
    pair = at_the_spot(signal._replace(accel=signal.accel * (GRAVITY / size)))
    if pair is None:
        return
    as_is = float(np.mean(unexplained(pair, np.eye(3)[None]).proper))
    if not as_is > _WRONG:
        return
    scales = np.array([*SCALES, 0.0])  # the last: as if it had not turned at all
    maps = np.concatenate([signed_permutations(), scales[:, None, None] * np.eye(3)])
    left = np.mean(unexplained(pair, maps).proper, axis=0)
    k = int(np.argmin(left))
    # A vehicle that only accelerates needs no turns to be explained, and tells nothing about them.
    if left[k] > min(_RIGHT, _BETTER * as_is, 0.5 * left[-1]):
        return
    shown = (
        f"turned about, the gyros do not turn gravity as the accelerometers see it turn "
        f"({as_is:.0%} of it is left over"
    )
    code, cause = _meaning(maps[k], float(scales[k - 48]) if k >= 48 else None)
    yield error(
        imu,
        code,
        float(left[k]),
        f"{shown}, with other gyro columns {left[k]:.0%}). {cause}.",
    )


def _meaning(gyro_map: np.ndarray, scale: float | None) -> tuple[str, str]:
    """Code and cause, if the gyros fit after this map, or after this change of unit."""
    if scale is not None:
        unit, mend = SCALES[scale]
        return "gyro_unit", f"The gyro columns are probably {unit}: {mend}"
    if np.array_equal(gyro_map, -np.eye(3)):
        return "left_handed", (
            "The gyros have the opposite sense of rotation, or both triads are left-handed: two "
            "axes exchanged or one reversed, alike in both"
        )
    return "gyro_axes", (
        f"The gyros fit as {words_of(gyro_map, 'gyro')}; or the accelerometers' columns were "
        "exchanged or reversed accordingly"
    )
