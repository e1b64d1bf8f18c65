"""Velocity and course from positions, for receivers without velocity.

A weighted line is fitted to the positions of a window that ends with a fix. Of windows from 0.25 to
32 s the one with the least uncertainty is used: a short one averages little, and over a long one a
tilt error causes a velocity error. Nothing after the fix is used, so that a live filter starts as a
replay does.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Array
from scipy.spatial.transform import Rotation as SciRotation

from robins import rotation
from robins.program.scanned import named_scan
from robins.systems.ins_gnss.parameters import Gnss, InsGnssStart
from robins.systems.ins_gnss.recording import Log
from robins.systems.ins_gnss.rest import DISPLACEMENT_S, displacements

WINDOWS_S = (0.25, 0.5, *DISPLACEMENT_S)
MOST = 9  # positions of a window, evenly spaced; those of a fast receiver are redundant
LEAST = 3  # two give no residual that reveals a faulty one
SURE = 5.0  # sigmas of a speed to give a course: by chance once in 3e5 fixes at rest
_G = 9.81


def attitudes(q: np.ndarray, theta: np.ndarray) -> np.ndarray:
    """Attitudes (N, 4) after each of N body rotation vectors (N, 3) [rad], from q (4,) on."""
    return named_scan(_turned_by, q, theta)[1]


def _turned_by(q: Array, theta: Array) -> tuple[Array, Array]:
    now = rotation.normalise(rotation.multiply(q, rotation.from_rotvec(theta)))
    return now, now


def with_heading(q_nb: np.ndarray, heading_rad: float) -> np.ndarray:
    """Attitude q_nb (4,) with the same tilt and another heading."""
    turn = SciRotation.from_rotvec([0.0, 0.0, heading_rad - heading_of(q_nb)])
    return (turn * SciRotation.from_quat(q_nb, scalar_first=True)).as_quat(scalar_first=True)


def heading_of(q_nb: np.ndarray) -> float:
    """Heading [rad] of an attitude (4,)."""
    w, x, y, z = q_nb
    return float(np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)))


def course_fix(log: Log, start: InsGnssStart) -> int | None:
    """Row of the first fix without a velocity whose positions give a course; None if none does.

    The speed must be at least `start.course_speed`, and `SURE` times its sigma.
    """
    missing = np.ones(len(log.gnss_s), bool)
    if log.gnss.v_n is not None:
        missing = ~np.all(np.isfinite(log.gnss.v_n[:, :2]), axis=1)
    ends = np.flatnonzero(missing & _is_complete(log))
    v, sigma, _ = best_lines(log, ends, start.tilt)
    speed = np.hypot(v[:, 0], v[:, 1])
    sure = ends[speed >= np.maximum(start.course_speed, SURE * sigma)]
    return int(sure[0]) if len(sure) else None


def best_lines(
    log: Log, ends: np.ndarray, tilt_rad: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Velocities of lines through the positions up to some fixes, in the best window of each.

    Args:
        log: fixes.
        ends: (K,) rows of complete fixes, the last of each window.
        tilt_rad: sigma of the tilt, which projects gravity into the horizontal.

    Returns:
        Velocities (K, 3) [m/s, NED], their larger horizontal sigmas (K,) [m/s], and windows (K,)
        [s]; NaN, infinite and 0 if no window has enough positions.
    """
    found = np.full((len(ends), 3), np.nan), np.full(len(ends), np.inf), np.zeros(len(ends))
    for window_s in WINDOWS_S:
        time_s, place, sigma = _gathered(log, ends, window_s)
        _, v, spread = _lines(time_s, place, sigma)
        size = np.sqrt(np.max(spread[:, :2, 0, 0], axis=1))
        size = np.hypot(size, 0.5 * _G * tilt_rad * -np.nanmin(time_s, axis=1, initial=0.0))
        better = size < found[1]
        for of, one in zip(found, (v, size, np.full(len(ends), window_s)), strict=True):
            of[better] = one[better]
    return found


def fitted(
    log: Log,
    fix: int,
    q_nb: np.ndarray,
    tilt_rad: float,
    gnss: Gnss,
    bias: np.ndarray,
    heading_known: bool = True,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """State at a fix from the positions up to it, corrected for the motion measured by the IMU.

    The model is p(t) = p + v (t - t_fix) + d(t) + C(t) l, where d is the double integral of the
    acceleration and l the lever arm: the remaining motion is a line, whatever the vehicle does.

    Args:
        log: increments and fixes.
        fix: row of a complete fix, for which `best_lines` finds a window.
        q_nb: (4,) at the increment that contains the fix.
        tilt_rad: sigma of its tilt.
        gnss: lever arm and latency.
        bias: (3,) rad/s of the gyros.
        heading_known: if False, the body points along the velocity, and q_nb gets that heading.

    Returns:
        q_nb (4,), offset (3,) [m] of the IMU from the fix, velocity (3,) [m/s], and covariance
        (3, 2, 2) of velocity and position on each axis; north, east, down.
    """
    window_s = float(best_lines(log, np.array([fix]), tilt_rad)[2][0])
    time_s, place, sigma = _gathered(log, np.array([fix]), window_s)
    if not heading_known:
        v = _lines(time_s, place, sigma)[1][0]
        q_nb = with_heading(q_nb, float(np.arctan2(v[1], v[0])))
    moved, arms = _between(log, fix, q_nb, gnss, bias, time_s[0])
    time_s = time_s - gnss.latency  # times of validity of the positions
    for _ in range(1 if heading_known else 4):  # in a turn, the first course lags
        p, v, spread = _lines(time_s, place - (moved + arms)[None], sigma)
        heading = float(np.arctan2(v[0, 1], v[0, 0]))
        if not heading_known:
            C = SciRotation.from_rotvec([0.0, 0.0, heading - heading_of(q_nb)])
            moved, arms = C.apply(moved), C.apply(arms)
            q_nb = with_heading(q_nb, heading)
    p, v, spread = _lines(time_s, place - (moved + arms)[None], sigma)
    lasted = -float(np.nanmin(time_s))
    # error of velocity and position at the end, per tilt error
    drift = _G * tilt_rad * np.array([lasted / 2.0, lasted**2 / 12.0])
    return q_nb, p[0], v[0], spread[0] + np.outer(drift, drift)


def _is_complete(log: Log) -> np.ndarray:
    """Mask (M,) of complete fixes within the time of the IMU that are not withheld."""
    g, begin_s = log.gnss, log.time_s[0] - log.increments.dt[0]
    whole = np.all(np.isfinite([g.lat_rad, g.lon_rad, g.alt_m]), axis=0) & ~log.withheld
    return whole & (log.gnss_s > begin_s) & (log.gnss_s <= log.time_s[-1])


def _gathered(
    log: Log, ends: np.ndarray, window_s: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times (K, MOST) [s] and positions (K, MOST, 3) [m, NED] relative to each end, and sigmas.

    NaN times and positions fill up windows with fewer fixes.
    """
    known, g = np.flatnonzero(_is_complete(log)), log.gnss
    wanted = log.gnss_s[ends][:, None] - window_s * np.linspace(1.0, 0.0, MOST) - 1e-6
    at = np.minimum(np.searchsorted(log.gnss_s[known], wanted), max(len(known) - 1, 0))
    once = np.diff(at, axis=1, prepend=-1) > 0
    rows = known[at] if len(known) else np.zeros(wanted.shape, int)
    north, east = displacements(
        g.lat_rad[ends][:, None],
        g.lat_rad[rows] - g.lat_rad[ends][:, None],
        g.lon_rad[rows] - g.lon_rad[ends][:, None],
    )
    place = np.stack([north, east, g.alt_m[ends][:, None] - g.alt_m[rows]], axis=-1)
    time_s = np.where(once, log.gnss_s[rows] - log.gnss_s[ends][:, None], np.nan)
    return time_s, np.where(once[..., None], place, np.nan), log.sigma_m[rows]


def _lines(
    time_s: np.ndarray, place: np.ndarray, sigma: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Weighted lines: position and velocity (K, 3) at time 0, covariance (K, 3, 2, 2) of (v, p).

    Covariances are scaled up if the residuals exceed the sigmas (Birge ratio), so that a gross
    error of a position gives no velocity. NaN, with infinite covariance, if there are too few.
    """
    here = np.isfinite(time_s)
    count = np.sum(here, axis=1)
    t = np.where(here, time_s, 0.0)[..., None]
    y = np.where(here[..., None], place, 0.0)
    w = np.where(here[..., None], 1.0 / sigma**2, 0.0)
    s0, s1, s2, sy, sty = (_summed(w * x) for x in (np.ones_like(t), t, t * t, y, t * y))
    few = (count < LEAST)[:, None]
    det = np.where(few, 1.0, s0 * s2 - s1 * s1)
    p, v = (s2 * sy - s1 * sty) / det, (s0 * sty - s1 * sy) / det
    left = _summed(w * (y - p[:, None] - v[:, None] * t) ** 2)
    excess = np.sum(left, axis=1) / np.maximum(3 * (count - 2), 1)
    spread = np.stack([s0, -s1, -s1, s2], axis=-1).reshape(*p.shape, 2, 2) / det[..., None, None]
    spread = spread * np.maximum(excess, 1.0)[:, None, None, None]
    p, v = (np.where(few, np.nan, x) for x in (p, v))
    return p, v, np.where(few[..., None, None], np.inf, spread)


def _summed(x: np.ndarray) -> np.ndarray:
    """Sum over axis 1, to the same bits for any number of rows."""
    total = np.zeros((x.shape[0], x.shape[2]))
    for k in range(x.shape[1]):
        total += x[:, k]
    return total


def _between(
    log: Log, fix: int, q_nb: np.ndarray, gnss: Gnss, bias: np.ndarray, time_s: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """IMU motion d(t) (MOST, 3) and lever arms C(t) l (MOST, 3) [m, NED] at the fixes of a window.

    See `fitted`. A fix stamped t is valid at t - latency; the state is that at the last stamp.
    """
    now_s, (dt, theta, dv) = log.gnss_s[fix], log.increments[:3]
    last = int(np.searchsorted(log.time_s, now_s))
    first_s = now_s + np.nanmin(time_s) - max(gnss.latency, 0.0)
    first = min(int(np.searchsorted(log.time_s, first_s)), last)
    rows = np.arange(last, first - 1, -1)  # backwards
    q = attitudes(q_nb, -(theta[rows] - bias * dt[rows, None]))
    C = SciRotation.from_quat(np.concatenate([q_nb[None], q])[:, [1, 2, 3, 0]])
    pushed = C[1:].apply(dv[rows]) + np.array([0.0, 0.0, _G]) * dt[rows, None]
    nodes = np.append(log.time_s[rows], log.time_s[rows[-1]] - dt[rows[-1]])
    u = np.concatenate([np.zeros((1, 3)), -np.cumsum(pushed, axis=0)])
    d = np.concatenate(
        [np.zeros((1, 3)), -np.cumsum(0.5 * (u[1:] + u[:-1]) * dt[rows, None], axis=0)]
    )
    arms = C.apply(gnss.lever_arm)

    def at(values: np.ndarray, when_s: np.ndarray) -> np.ndarray:
        columns = [np.interp(when_s, nodes[::-1], x[::-1]) for x in values.T]
        return np.stack(columns, axis=-1)

    valid_s = np.where(np.isfinite(time_s), now_s + time_s - gnss.latency, now_s)
    u_now, d_now = at(u, np.array([now_s])), at(d, np.array([now_s]))
    ways_m = at(d, valid_s) - d_now - u_now * (valid_s - now_s)[:, None]
    return ways_m, at(arms, valid_s)
