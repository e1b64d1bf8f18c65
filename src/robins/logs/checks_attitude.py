"""Checks of recorded attitudes against the gyros and gravity.

A quaternion does not show its convention: scalar first or last, body to navigation or the inverse,
axes of the body. Only the right one rotates as the gyros do.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from robins.dataset import AttitudeTable, ImuTable
from robins.logs.checks_motion import words_of
from robins.logs.findings import Finding
from robins.logs.motion import TurnSteps, signed_permutations, steps_of
from robins.logs.ordering import increasing
from robins.logs.quiet import ImuSignal, error, signal_of, warning, windows_of
from robins.logs.tables import TOLERANCE
from robins.rotation import to_dcm

_WRONG, _RIGHT, _BETTER = 0.4, 0.15, 0.25  # unexplained shares of the rotation
_UPRIGHT = 0.9  # cosine between gravity by these attitudes and the vertical

_ORDERS = {
    "scalar last (x, y, z, w): put the last column first": ([3, 0, 1, 2], 1.0),
    "navigation to body: turn the sign of x, y and z": ([0, 1, 2, 3], -1.0),
    "scalar last and navigation to body: put the last column first and turn the sign of the "
    "others": ([3, 0, 1, 2], -1.0),
}


def check_attitude(imu: ImuTable, attitude: AttitudeTable) -> Iterator[Finding]:
    """Findings about attitudes, given a sound IMU; see the module."""
    known = np.abs(np.linalg.norm(attitude.q_nb, axis=1) - 1.0) < TOLERANCE
    if not known.any():
        yield warning(attitude, "attitude_missing", len(attitude))(
            "there is not one attitude in it, so nothing can be compared."
        )
        return
    signal = signal_of(imu)
    if signal is None or attitude.body != imu.body:
        return
    rows = np.flatnonzero(known)
    rows = rows[increasing(attitude.time_ns[rows])]
    time_s = (attitude.time_ns[rows] - int(imu.time_ns[signal.rows[0]])) * 1e-9
    q = attitude.q_nb[rows]
    steps = steps_of(signal, time_s)
    of_turning = [] if steps is None else list(_turning(attitude, steps, time_s, q))
    yield from of_turning
    if not of_turning:
        yield from _upright(attitude, signal, time_s, q)


def _turning(
    attitude: AttitudeTable, steps: TurnSteps, time_s: np.ndarray, q: np.ndarray
) -> Iterator[Finding]:
    as_is = _left_over(steps, time_s, q)[0]
    if as_is < _WRONG:
        return
    good = min(_RIGHT, _BETTER * as_is)
    shown = f"the attitudes do not turn as the gyros say ({as_is:.0%} of it is left over)"
    for words, (order, sign) in _ORDERS.items():
        other = q[:, order] * [1.0, sign, sign, sign]
        if (left := _left_over(steps, time_s, other)[0]) < good:
            yield error(attitude, "attitude_order", float(as_is))(
                f"{shown}, but they do ({left:.0%}) if the quaternions are {words}."
            )
            return
    maps = signed_permutations(proper=True)
    left = _left_over(steps, time_s, q, maps)
    k = int(np.argmin(left))
    if left[k] < good:
        yield error(attitude, "attitude_axes", float(as_is))(
            f"{shown}, but they do ({left[k]:.0%}) with the gyros {words_of(maps[k], 'gyro')}. "
            "They are those of a body with other axes than the sensor's; turn one into the other."
        )
        return
    yield warning(attitude, "attitude_disagrees", float(as_is))(
        f"{shown}, whatever order, sense or axes are tried. They are of another body or another "
        "time; what is compared with them will seem wrong."
    )


def _left_over(
    steps: TurnSteps, time_s: np.ndarray, q: np.ndarray, maps: np.ndarray | None = None
) -> np.ndarray:
    """Share (h,) of the rotation that the gyros do not explain, for each map of axes."""
    S = np.eye(3)[None] if maps is None else maps
    before, after = (to_dcm(_at(when, time_s, q)) for when in (steps.begin_s, steps.end_s))
    turned = np.swapaxes(before, 1, 2) @ after
    said = np.einsum("hij,njk,hlk->hnil", S, steps.C, S, optimize=True)
    rest = np.sum((turned - said) ** 2, axis=(1, 2, 3))
    return rest / np.sum((np.eye(3) - steps.C) ** 2)


def _upright(
    attitude: AttitudeTable, signal: ImuSignal, time_s: np.ndarray, q: np.ndarray
) -> Iterator[Finding]:
    """Check by the specific force at rest that these attitudes are upright."""
    windows = windows_of(signal)
    middle = signal.time_s[windows.first] + 0.5
    known = windows.at_rest & (middle > time_s[0]) & (middle < time_s[-1])
    if not known.any():
        return
    C = to_dcm(_at(middle[known], time_s, q))
    force = np.einsum("nij,nj->ni", C, windows.accel[known])
    x, y, z = np.median(force / np.linalg.norm(force, axis=1, keepdims=True), axis=0)
    up = z if attitude.nav == "ENU" else -z
    if up > _UPRIGHT:
        return
    other = "NED" if attitude.nav == "ENU" else "ENU"
    cause = (
        f"The attitudes are probably to {other}"
        if up < -_UPRIGHT
        else "The frame they refer to does not stand upright, or is of another body"
    )
    yield error(attitude, "attitude_frame", float(up))(
        f"at rest the specific force points along ({x:+.2f}, {y:+.2f}, {z:+.2f}) by these "
        f"attitudes, where {attitude.nav} has up at (0, 0, {1 if other == 'NED' else -1}). "
        f"{cause}."
    )


def _at(when: np.ndarray, time_s: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Quaternions interpolated linearly between recorded ones, which are close together."""
    after = np.clip(np.searchsorted(time_s, when), 1, len(time_s) - 1)
    one, other = q[after - 1], q[after]
    other = other * np.where(np.sum(one * other, axis=1) < 0.0, -1.0, 1.0)[:, None]
    share = (when - time_s[after - 1]) / (time_s[after] - time_s[after - 1])
    between = one + share[:, None] * (other - one)
    return between / np.linalg.norm(between, axis=1, keepdims=True)
