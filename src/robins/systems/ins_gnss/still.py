"""When the vehicle stands still, and which way it points before the filter starts."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation as SciRotation

from robins import rotation
from robins.earth import gravity
from robins.systems.ins_gnss.parameters import Aids, Start


class StartPoint(NamedTuple):
    """Where and how the filter begins."""

    time_s: float
    q_nb: np.ndarray  # (4,)
    tilt_sigma_rad: float
    heading_sigma_rad: float
    gyro_bias: np.ndarray  # (3,) rad/s, mean rate of a standstill, else zero
    sentence: str  # how it was found, for the reader


def moving_statistics(values: np.ndarray, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation over the `width` samples up to each one.

    Args:
        values: (N, axes).
        width: samples in a window; the first windows are shorter.

    Returns:
        (N, axes) each.
    """
    shift = np.mean(values, axis=0)  # keeps the difference of squares well conditioned
    x = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values - shift, axis=0)])
    xx = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum((values - shift) ** 2, axis=0)])
    end = np.arange(1, len(values) + 1)
    begin = np.maximum(end - width, 0)
    count = (end - begin)[:, None]
    mean = (x[end] - x[begin]) / count
    variance = np.maximum((xx[end] - xx[begin]) / count - mean**2, 0.0)
    return mean + shift, np.sqrt(variance)


def standstill(
    dt: np.ndarray, theta: np.ndarray, dv: np.ndarray, aids: Aids
) -> tuple[np.ndarray, np.ndarray]:
    """Whether the vehicle stood still over the window up to each increment.

    Still means: spread of specific force and turn rate below their thresholds on every axis.
    A smooth motion at constant speed passes too, which is why `Aids` lets a user switch it off.

    Returns:
        (N,) bool, and (N, 3) mean gyro rate over the window [rad/s].
    """
    rate, force = theta / dt[:, None], dv / dt[:, None]
    width = max(2, round(aids.window / float(np.median(dt))))
    mean_rate, spread_rate = moving_statistics(rate, width)
    _, spread_force = moving_statistics(force, width)
    still = np.all(spread_rate < aids.quiet_rate, axis=1)
    still &= np.all(spread_force < aids.quiet_accel, axis=1)
    still &= np.all(np.abs(mean_rate) < 4.0 * aids.quiet_rate, axis=1)
    still[: width - 1] = False
    return still, mean_rate


def level(force_b: np.ndarray, heading_rad: float) -> np.ndarray:
    """Attitude q_nb from a mean specific force at rest and a heading (Groves 2013, sec. 5.6.1)."""
    f = force_b / np.linalg.norm(force_b)
    roll = np.arctan2(-f[1], -f[2])
    pitch = np.arctan2(f[0], np.hypot(f[1], f[2]))
    return np.asarray(rotation.from_euler(roll, pitch, heading_rad))


@jax.jit
def _turned(q, theta):
    def step(q, t):
        return rotation.normalise(rotation.multiply(q, rotation.from_rotvec(t))), None

    return jax.lax.scan(step, q, theta)[0]


def with_heading(q_nb: np.ndarray, heading_rad: float) -> np.ndarray:
    """The same tilt with another heading."""
    _, _, now = (float(a) for a in rotation.to_euler(jnp.asarray(q_nb)))
    turn = SciRotation.from_rotvec([0.0, 0.0, heading_rad - now])
    q = turn * SciRotation.from_quat(np.roll(q_nb, -1))  # SciPy keeps the scalar last
    return np.roll(q.as_quat(), 1)


def find_start(
    time_s: np.ndarray,
    dt: np.ndarray,
    theta: np.ndarray,
    dv: np.ndarray,
    gnss_s: np.ndarray,
    v_n: np.ndarray | None,
    lat_rad: float,
    alt_m: float,
    start: Start,
    aids: Aids,
) -> StartPoint:
    """Level on the quietest early window; take the heading as given or from the GNSS course.

    The gyros carry the tilt from that window to the moment the course is known (first fix faster
    than ``start.course_speed``); body forward is then taken along the course.

    Args:
        time_s: (N,) end of each increment.
        dt: (N,) s, with theta (N, 3) rad and dv (N, 3) m/s.
        theta: see dt.
        dv: see dt.
        gnss_s: (M,) fix times.
        v_n: (M, 3) GNSS velocity north, east, down, or None.
        lat_rad: latitude, for gravity.
        alt_m: height, for gravity.
        start: parameters.
        aids: parameters of the standstill test.

    Raises:
        ValueError: no heading is known: none was given, and no fix is fast enough.
    """
    still, mean_rate = standstill(dt, theta, dv, aids)
    width = max(2, round(2.0 * aids.window / float(np.median(dt))))
    mean_force, spread = moving_statistics(dv / dt[:, None], width)
    fast = None
    if start.known_heading is None:
        if v_n is None:
            raise ValueError(
                "the heading at the start is not known: the log has no GNSS velocity to take a "
                "course from; give start.known_heading"
            )
        speed = np.hypot(v_n[:, 0], v_n[:, 1])
        usable = np.flatnonzero((speed >= start.course_speed) & (gnss_s > time_s[0]))
        if len(usable) == 0:
            raise ValueError(
                f"the heading at the start is not known: the fastest fix moves at "
                f"{np.nanmax(speed):.2f} m/s and a course is taken from "
                f"{start.course_speed:.2f} m/s on; lower start.course_speed or give "
                f"start.known_heading"
            )
        fast = usable[0]
    last = len(dt) - 1 if fast is None else int(np.searchsorted(time_s, gnss_s[fast]))
    first = min(width - 1, last)
    quiet_enough = np.flatnonzero(still[: last + 1])
    if len(quiet_enough):
        at = int(quiet_enough[min(len(quiet_enough) - 1, width)])
        tilt, how, bias = start.tilt, "at rest", mean_rate[at]
        bias = np.mean(mean_rate[quiet_enough], axis=0)
    else:
        at = first + int(np.argmin(np.sum(spread[first : last + 1] ** 2, axis=1)))
        tilt, how, bias = 3.0 * start.tilt, "on the quietest second, moving", np.zeros(3)
    force = mean_force[at]
    g = float(np.asarray(gravity(jnp.asarray(lat_rad), jnp.asarray(alt_m))))
    if not 0.5 * g < np.linalg.norm(force) < 1.5 * g:
        raise ValueError(
            f"cannot level: the mean specific force at {time_s[at]:.2f} s is "
            f"{np.linalg.norm(force):.2f} m/s^2, gravity is {g:.2f}"
        )
    if fast is None:
        heading = float(start.known_heading or 0.0)
        sentence = (
            f"levelled {how} at {time_s[at]:.1f} s, heading given as {np.degrees(heading):.1f} deg"
        )
        q = level(force, heading)
        return StartPoint(float(time_s[at]), q, tilt, start.heading, bias, sentence)
    q = level(force, 0.0)
    carried = jnp.asarray(theta[at + 1 : last + 1] - bias * dt[at + 1 : last + 1, None])
    q = np.asarray(_turned(jnp.asarray(q), carried))
    assert v_n is not None
    heading = float(np.arctan2(v_n[fast, 1], v_n[fast, 0]))
    sentence = (
        f"levelled {how} at {time_s[at]:.1f} s; heading {np.degrees(heading) % 360:.1f} deg from "
        f"the course at {gnss_s[fast]:.1f} s, when the speed reached "
        f"{np.hypot(*v_n[fast, :2]):.2f} m/s"
    )
    q = with_heading(q, heading)
    return StartPoint(float(gnss_s[fast]), q, tilt, start.heading, bias, sentence)
