"""Common motion of IMU and GNSS: both cut into stretches, and the search for a start.

Over a short stretch the gyros give the rotation of the body, so the specific force can be
integrated in non-rotating axes. Up to one constant rotation R the integrals must equal those of
GNSS,

    R sum(C f dt) = change of v - g dt,

for any attitude and mounting. R is found in closed form (Kabsch 1976), as a rotation or as a
reflection; the residual squares rate a delay, or a matrix applied to the gyros. `motion_fit` starts
from the best of them.

The integrals are on a grid of 20 Hz, so vibration does not matter and an hour costs little.
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from robins.dataset import GnssTable
from robins.ins.plausible import EARTH_RATE
from robins.logs.quiet import ImuSignal
from robins.rotation import skew

GRAVITY = 9.8
RATE_HZ = 20
_STRETCH_S = 15.0  # long enough for turns, short enough for the drift of low-cost gyros
_CHANGES = 8  # least number of velocity changes in a stretch
_MOST_STRETCHES, _MOST_OUTSIDE, _MOST_SEARCHED = 20, 6, 8
_SPOT_S, _MOST_SPOTS = 30, 4  # likewise for an IMU that was turned about by hand
_GAP_S = 0.5  # longest gap of IMU samples that is integrated over
_FIX_S, _LOST_S = 0.25, 1.2  # least interval of fixes used; longest one in a stretch
_NOISE = 0.5  # m/s, largest noise of a mean velocity between fixes, which sets their stride

# Steps over which another rotating sensor is compared with the gyros.
_FINE_S = 0.01  # rotations are composed of fine steps
_FAST, _SLOW = (20, 50), (100, 8)  # fine steps of a step that is compared, fewest such steps
_MOST = 1500  # most steps used, those with the largest rotation
_TURNED = 0.1  # rad, least rotation of a useful step


def signed_permutations(proper: bool = False) -> np.ndarray:
    """All signed permutations (48, 3, 3) of three axes, the identity first; or the 24 rotations."""
    out = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            out.append(np.diag(signs)[:, order])
    maps = np.array(out)
    return maps[np.linalg.det(maps) > 0.0] if proper else maps


class MotionIntegrals(NamedTuple):
    """Integrals of the IMU and changes of velocity, on a common time.

    Changes are between nodes of one stretch at least a second apart; they overlap. A node is a
    velocity at a time, or the mean velocity between two positions.
    """

    turn: np.ndarray  # (n + 1, 3) integral of the rate up to each time of the grid [rad]
    push: np.ndarray  # (n + 1, 3) integral of the specific force [m/s]
    gaps: np.ndarray  # (gaps, 2) begin and end of gaps in the samples [s]
    begin_s: np.ndarray  # (nodes,) s
    end_s: np.ndarray  # (nodes,) s, equal to `begin_s` unless velocities are means
    means: bool  # nodes are mean velocities
    node_of: np.ndarray  # (nodes,) stretch of each
    v: np.ndarray  # (nodes, 3) m/s, in the axes of `gained`
    node: np.ndarray  # (k,) first node of each change
    of: np.ndarray  # (k,) stretch of each change
    gained: np.ndarray  # (k, 3) change of v - g dt [m/s], in non-rotating axes
    start_s: np.ndarray  # (stretches,) s, first node
    length_s: float  # of the longest stretch
    middle_s: float  # s, zero of the effect of a clock rate
    stride: int = 1  # nodes between the two of a change
    noise: float = 0.0  # m/s, one sigma of a change from the stated sigmas
    power: str = "change"  # reference of unexplained shares: "change" of velocity, or "gravity"


def views_of(
    signal: ImuSignal,
    kind: str,
    gnss: GnssTable,
    rows: np.ndarray,
    when_s: np.ndarray,
    r_n: np.ndarray,
    v_n: np.ndarray | None,
    noise: tuple[float, float, float],
) -> MotionIntegrals | None:
    """Integrals and changes on a common time; None if no stretch has enough motion.

    Args:
        signal: the IMU.
        kind: "rate" or "increment", of its table.
        gnss: the table of the fixes, for their positions.
        rows: (m,) rows of it to use.
        when_s: (m,) times of the fixes, from the zero of the signal.
        r_n: (m, 3) positions, north-east-down [m].
        v_n: (m, 3) velocities, north-east-down [m/s]; None: positions are used.
        noise: standard deviations of a position along a horizontal axis and over all axes [m], and
            of a velocity along an axis [m/s].
    """
    spacing = min(max(1.0, np.sqrt(6.0) * noise[0] / _NOISE), 5.0) if v_n is None else 1.0
    keep = np.arange(0, len(when_s), max(1, round(_FIX_S / float(np.median(np.diff(when_s))))))
    step = float(np.median(np.diff(when_s[keep]))) if len(keep) > 1 else np.inf
    stride = max(1, round(spacing / step))
    if len(keep) < 4 * stride:
        return None
    v, begin, end, joined = _velocities(when_s[keep], r_n[keep], v_n, keep, stride)
    means = v_n is None
    scatter = np.sqrt(6.0) * (noise[1] / (stride * step) if means else noise[2])
    length = max(_STRETCH_S, _CHANGES * stride * step)
    end_s = float(signal.time_s[-1]) + 0.1
    chosen = _lively(0.5 * (begin + end), v, joined, length, max(0.2, scatter), stride, end_s)
    if not chosen:
        return None
    nodes = np.concatenate(chosen)
    node_of = np.repeat(np.arange(len(chosen)), [len(k) for k in chosen])
    start = np.array([begin[k[0]] for k in chosen])
    since = 0.5 * (begin + end)[nodes] - start[node_of]
    node = np.flatnonzero(node_of[stride:] == node_of[:-stride])
    at_fix = rows[keep[nodes]]
    C = axes_at(gnss.lat_rad[at_fix], gnss.lon_rad[at_fix])
    g_e = C[:, :, 2] * normal_gravity(gnss.lat_rad[at_fix], gnss.alt_m[at_fix])[:, None]
    v_e = np.einsum("nij,nj->ni", C, v[nodes])
    v, gained = _inertial(since, v_e, g_e, node, node + stride)
    turn, push = on_grid(signal, kind)
    return MotionIntegrals(
        *(turn, push, _gaps(signal), begin[nodes], end[nodes], means),
        *(node_of, v, node, node_of[node], gained, start),
        length_s=max(float(end[k[-1]] - begin[k[0]]) for k in chosen),
        middle_s=0.5 * float(start[0] + start[-1]),
        stride=stride,
        noise=float(scatter),
    )


def _velocities(
    time_s: np.ndarray, r_n: np.ndarray, v_n: np.ndarray | None, keep: np.ndarray, stride: int
) -> tuple[np.ndarray, ...]:
    """Velocities (n, 3), begin and end of each (n,) [s], and True (n - 1,) if no gap follows.

    If the receiver gave none, they are means between positions a stride apart.
    """
    step = np.diff(time_s)
    near = step < max(2.5 * float(np.median(step)), _LOST_S)
    if v_n is not None:
        return v_n[keep], time_s, time_s, near
    begin, end = time_s[:-stride], time_s[stride:]
    whole = np.logical_and.reduce(sliding_window_view(near, stride), axis=1)
    v = (r_n[stride:] - r_n[:-stride]) / (end - begin)[:, None]
    return v, begin, end, whole[:-1] & whole[1:]


def _lively(
    time_s: np.ndarray,
    v: np.ndarray,
    joined: np.ndarray,
    length: float,
    least: float,
    stride: int,
    end_s: float,
) -> list[np.ndarray]:
    """Nodes of stretches with enough motion: the one with most in each part of the log.

    Most are within the time of the IMU; the others reveal clocks that were set.
    """
    found = []
    bounds = np.flatnonzero(~np.concatenate([[False], joined, [False]]))
    for low, high in itertools.pairwise(bounds):
        first = low
        while first < high:
            last = int(np.searchsorted(time_s[:high], time_s[first] + length + 1e-6, "right"))
            nodes = np.arange(first, last)
            first = max(last - 1, first + 1)
            if len(nodes) > 4 * stride and time_s[nodes[-1]] - time_s[nodes[0]] > 0.6 * length:
                change = v[nodes[stride:]] - v[nodes[:-stride]]
                power = float(np.mean(np.sum((change - change.mean(axis=0)) ** 2, axis=1)))
                if np.sqrt(power) > least:
                    found.append((power, nodes))
    chosen: list[np.ndarray] = []
    for inside, most in ((True, _MOST_STRETCHES), (False, _MOST_OUTSIDE)):
        some = [
            x for x in found if (time_s[x[1][0]] >= 0.0 and time_s[x[1][-1]] <= end_s) == inside
        ]
        for part in np.array_split(np.arange(len(some)), min(len(some), most) or 1):
            chosen += [some[max(part, key=lambda k: some[k][0])][1]] if len(part) else []
    return sorted(chosen, key=lambda nodes: int(nodes[0]))


def _inertial(
    since_s: np.ndarray, v_e: np.ndarray, g_e: np.ndarray, first: np.ndarray, second: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Velocities, and their changes less gravity, in axes that do not rotate with the Earth.

    Args:
        since_s: (nodes,) time since the axes coincided with Earth-fixed ones [s].
        v_e: (nodes, 3) velocities over the Earth, along its axes [m/s].
        g_e: (nodes, 3) gravity [m/s^2].
        first: (k,) node at which a change begins.
        second: (k,) node at which it ends.
    """
    rate = np.array([0.0, 0.0, EARTH_RATE])
    dt = (since_s[second] - since_s[first])[:, None]
    mean, g = 0.5 * (v_e[first] + v_e[second]), 0.5 * (g_e[first] + g_e[second])
    gained = v_e[second] - v_e[first] + dt * (2.0 * np.cross(rate, mean) - g)
    turned = rotations(since_s[:, None] * rate)
    midway = rotations(0.5 * (since_s[first] + since_s[second])[:, None] * rate)
    return np.einsum("nij,nj->ni", turned, v_e), np.einsum("kij,kj->ki", midway, gained)


def axes_at(lat: np.ndarray, lon: np.ndarray) -> np.ndarray:
    """Matrices (n, 3, 3) from north-east-down to Earth-centred, Earth-fixed axes."""
    sp, cp, sl, cl = np.sin(lat), np.cos(lat), np.sin(lon), np.cos(lon)
    rows = ((-sp * cl, -sl, -cp * cl), (-sp * sl, cl, -cp * sl), (cp, 0.0 * sp, -sp))
    return np.stack([np.stack(row, -1) for row in rows], -2)


def normal_gravity(lat: np.ndarray, alt: np.ndarray) -> np.ndarray:
    """Gravity [m/s^2] by Somigliana's formula and the free-air gradient; to 1e-4 below 30 km."""
    s2 = np.sin(lat) ** 2
    on_ellipsoid = 9.7803253359 * (1 + 0.00193185265241 * s2) / np.sqrt(1 - 0.00669437999 * s2)
    return on_ellipsoid - 3.086e-6 * alt


def stationary_integrals(signal: ImuSignal, kind: str) -> MotionIntegrals | None:
    """Integrals of an IMU alone, assumed stationary but for rotation, so that gravity is constant.

    None unless it was rotated enough to change the direction of specific force by about 10 deg.
    """
    turn, push = on_grid(signal, kind)
    gaps, count, tilted = _gaps(signal), _SPOT_S, []
    for start in np.arange(1.0, len(turn) / RATE_HZ - _SPOT_S - 1.0, _SPOT_S):
        if np.any((gaps[:, 0] < start + _SPOT_S) & (gaps[:, 1] > start)):
            continue
        force = np.diff(push[round(start * RATE_HZ) :: RATE_HZ][: count + 1], axis=0)
        direction = force / np.linalg.norm(force, axis=-1, keepdims=True)
        spread = 1.0 - float(np.linalg.norm(direction.mean(axis=0)))
        if spread > 0.015:
            tilted.append((spread, float(start)))
    if not tilted:
        return None
    starts = np.array(sorted(start for _, start in sorted(tilted)[-_MOST_SPOTS:]))
    node_of = np.repeat(np.arange(len(starts)), count + 1)
    when = (starts[:, None] + np.arange(count + 1.0)).ravel()
    node = np.flatnonzero(node_of[1:] == node_of[:-1])
    gained = np.tile([0.0, 0.0, -GRAVITY], (len(node), 1))
    fields = (node_of, np.zeros((len(when), 3)), node, node_of[node], gained, starts)
    middle = float(np.mean(starts))
    return MotionIntegrals(
        turn, push, gaps, when, when, False, *fields, float(count), middle, power="gravity"
    )


def on_grid(signal: ImuSignal, kind: str) -> tuple[np.ndarray, np.ndarray]:
    """Integrals of rate and specific force up to each time of the grid."""
    grid = np.arange(0.0, signal.time_s[-1], 1.0 / RATE_HZ)
    turn, push = (
        at(grid, signal.time_s, integral(signal.time_s, x, kind))
        for x in (signal.gyro, signal.accel)
    )
    return turn, push


def _gaps(signal: ImuSignal) -> np.ndarray:
    """Begin and end (gaps, 2) [s] of gaps in the samples."""
    step = np.diff(signal.time_s)
    k = np.flatnonzero(step > max(_GAP_S, 3.0 * signal.step_s))
    return np.stack([signal.time_s[k], signal.time_s[k + 1]], axis=-1)


def power_of(views: MotionIntegrals) -> np.ndarray:
    """Mean square (stretches,) [m^2/s^2] to which unexplained shares refer."""
    count = np.bincount(views.of)
    squares = np.bincount(views.of, np.sum(views.gained**2, axis=1)) / count
    if views.power == "gravity":
        return squares
    mean = np.stack([np.bincount(views.of, x) / count for x in views.gained.T])
    return squares - np.sum(mean**2, axis=0)


def squares_by_lag(views: MotionIntegrals, lags_s: np.ndarray) -> np.ndarray:
    """Mean residual squares (stretches, lags) [m^2/s^2] for lags added to the stamps of fixes.

    Args:
        views: the integrals.
        lags_s: (lags,) added to the stamps of fixes [s]. NaN results where no IMU was recorded.
    """
    turn, push = np.diff(views.turn, axis=0), np.diff(views.push, axis=0)
    C = _attitudes(turn)
    dS = np.einsum("nij,nj->ni", C[:-1] @ rotations(0.5 * turn), push)
    S = cumulative(dS)
    D = cumulative(0.5 * (S[1:] + S[:-1])) / RATE_HZ
    out = np.full((len(views.start_s), len(lags_s)), np.nan)
    for s in range(len(out)):
        nodes = views.node_of == s
        begin, end = views.begin_s[nodes], views.end_s[nodes]
        inside = (begin[0] + lags_s > 0.0) & (end[-1] + lags_s < (len(S) - 1) / RATE_HZ)
        for gap in views.gaps:
            inside &= ~((begin[0] + lags_s < gap[1]) & (end[-1] + lags_s > gap[0]))
        lags = lags_s[inside, None]
        if not len(lags):
            continue
        if views.means:
            ends = (between((t + lags) * RATE_HZ, D) for t in (end, begin))
            v = np.subtract(*ends) / (end - begin)[:, None]
        else:
            v = between((end + lags) * RATE_HZ, S)
        out[s, inside] = _compared(views, s, v)[0]
    return out


def squares_by_map(views: MotionIntegrals, maps: np.ndarray, shift_s: np.ndarray) -> np.ndarray:
    """Summed mean residual squares (h, 2) of the best rotation and of the best reflection.

    Args:
        views: the integrals.
        maps: (h, 3, 3) matrices applied to the gyros.
        shift_s: (stretches,) added to the stamps of fixes [s].
    """
    count = int(np.ceil(views.length_s * RATE_HZ)) + 2
    power = power_of(views)
    left = np.zeros((len(maps), 2))
    for s in np.argsort(power)[-_MOST_SEARCHED:].tolist():
        first = views.start_s[s] + shift_s[s]
        index = first * RATE_HZ + np.arange(count + 1)
        turn, push = (np.diff(between(index, x), axis=0) for x in (views.turn, views.push))
        turned = np.einsum("hij,kj->hki", maps, turn)
        C = composed(rotations(turned))
        dS = np.einsum("hkij,kj->hki", C[:, :-1] @ rotations(0.5 * turned), push)
        S = cumulative(dS, axis=1)
        nodes = views.node_of == s
        begin, end = (
            np.clip((t[nodes] - views.start_s[s]) * RATE_HZ, 0, count)
            for t in (views.begin_s, views.end_s)
        )
        if views.means:
            D = np.cumsum(S, axis=1) - 0.5 * S
            v = (_along(end, D) - _along(begin, D)) / (end - begin)[:, None]
        else:
            v = _along(end, S)
        left += np.stack(_compared(views, s, v), axis=-1)
    return left


def _compared(views: MotionIntegrals, s: int, v: np.ndarray) -> list[np.ndarray]:
    """Mean residual squares (h,) of velocities (h, nodes, 3) by a rotation, and by a reflection."""
    once = slice(None, None, views.stride)  # changes that do not overlap
    u = (v[:, views.stride :] - v[:, : -views.stride])[:, once]
    _, *both = kabsch(u, views.gained[views.of == s][once])
    return [left / u.shape[1] for left in both]


def _along(index: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Linear interpolation of (h, n, 3) at real indices along the second axis."""
    return (
        between(index, values.swapaxes(0, 1).reshape(values.shape[1], -1))
        .reshape(len(index), len(values), 3)
        .swapaxes(0, 1)
    )


def _attitudes(turn: np.ndarray) -> np.ndarray:
    """Attitudes (n + 1, 3, 3) after each of n small rotations, computed in blocks and joined."""
    size = int(np.sqrt(len(turn))) + 1
    count = -(-len(turn) // size)
    padded = np.concatenate([turn, np.zeros((count * size - len(turn), 3))])
    C = composed(rotations(padded.reshape(count, size, 3)))
    before = composed(C[None, :, -1])[0]
    joined = (before[:-1, None] @ C[:, :-1]).reshape(-1, 3, 3)
    return np.concatenate([joined, before[-1:]])[: len(turn) + 1]


def composed(steps: np.ndarray) -> np.ndarray:
    """Cumulative products (b, n + 1, 3, 3) of rotations (b, n, 3, 3)."""
    out = np.empty((steps.shape[0], steps.shape[1] + 1, 3, 3))
    out[:, 0] = np.eye(3)
    for k in range(steps.shape[1]):
        np.matmul(out[:, k], steps[:, k], out=out[:, k + 1])
    return out


def cumulative(steps: np.ndarray, axis: int = 0) -> np.ndarray:
    """Sums of steps along an axis, from zero before the first one."""
    sums = np.cumsum(steps, axis=axis)
    return np.concatenate([np.zeros_like(sums.take([0], axis)), sums], axis=axis)


def integral(time_s: np.ndarray, rate: np.ndarray, kind: str = "rate") -> np.ndarray:
    """Integral (n, 3) of a rate (n, 3) from the first sample up to each.

    By the trapezoidal rule; for increments, rates are means since the previous sample.
    """
    mean = rate[1:] if kind == "increment" else 0.5 * (rate[1:] + rate[:-1])
    return cumulative(mean * np.diff(time_s)[:, None])


def at(when: np.ndarray, time_s: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Values (n, 3) interpolated linearly at other times, constant beyond the ends."""
    return np.stack([np.interp(when, time_s, column) for column in values.T], axis=-1)


def between(index: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Linear interpolation of rows at real indices, constant beyond the ends."""
    index = np.clip(index, 0, len(values) - 1)
    low = np.minimum(index.astype(np.int64), len(values) - 2)
    share = (index - low)[..., None]
    return (1.0 - share) * values[low] + share * values[low + 1]


def rotations(phi: np.ndarray) -> np.ndarray:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3) [rad], by Rodrigues' formula."""
    angle = np.linalg.norm(phi, axis=-1)[..., None, None]
    out = phi[..., :, None] * phi[..., None, :]
    out *= 0.5 * np.sinc(0.5 * angle / np.pi) ** 2
    out += np.sinc(angle / np.pi) * skew(phi)
    out += np.cos(angle) * np.eye(3)
    return out


def kabsch(u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Best rotation R of u (h, k, 3) onto v (k, 3), residual squares of it and of a reflection."""
    U, s, Vt = np.linalg.svd(np.einsum("hki,kj->hij", u, v))
    sign = np.sign(np.linalg.det(U) * np.linalg.det(Vt))
    total = np.sum(u * u, axis=(1, 2)) + np.sum(v * v)
    corrected = np.stack([np.ones_like(sign), np.ones_like(sign), sign], axis=-1)
    R = np.einsum("hji,hj,hkj->hik", Vt, corrected, U)
    both = s[:, 0] + s[:, 1]
    return R, total - 2.0 * (both + sign * s[:, 2]), total - 2.0 * (both - sign * s[:, 2])


class TurnSteps(NamedTuple):
    """Steps of 0.2 s in which the sensor turned."""

    begin_s: np.ndarray  # (n,) from the zero of the signal
    end_s: np.ndarray  # (n,)
    C: np.ndarray  # (n, 3, 3) sensor axes at the end to those at the beginning


def steps_of(signal: ImuSignal, time_s: np.ndarray, slow: bool = False) -> TurnSteps | None:
    """Steps with the largest rotation; None if there are too few.

    Args:
        signal: the IMU.
        time_s: (m,) increasing times of the other sensor, from the zero of the signal.
        slow: compare over whole seconds, of which fewer are enough.
    """
    if len(time_s) < 2:
        return None
    per_step, least = _SLOW if slow else _FAST
    begin, end = max(float(time_s[0]), 0.0), min(float(time_s[-1]), float(signal.time_s[-1]))
    count = int((end - begin) / (_FINE_S * per_step))
    if count < least:
        return None
    grid = begin + _FINE_S * per_step * np.arange(count + 1)
    total = np.diff(at(grid, signal.time_s, integral(signal.time_s, signal.gyro)), axis=0)
    known = _recorded(grid, time_s) & _recorded(grid, signal.time_s)
    angle = np.linalg.norm(total, axis=1) * known
    chosen = np.sort(np.argsort(angle)[-_MOST:])
    chosen = chosen[angle[chosen] > _TURNED]
    if len(chosen) < least:
        return None
    return turned_over(signal, grid[chosen], grid[chosen + 1])


def turned_over(signal: ImuSignal, begin_s: np.ndarray, end_s: np.ndarray) -> TurnSteps:
    """Rotation of the IMU over steps of equal duration, composed of fine ones."""
    count = max(1, round(float(end_s[0] - begin_s[0]) / _FINE_S))
    fine_s = begin_s[:, None] + _FINE_S * np.arange(count + 1)
    angles = at(fine_s.ravel(), signal.time_s, integral(signal.time_s, signal.gyro))
    fine = np.diff(angles.reshape(len(begin_s), count + 1, 3), axis=1)
    C = np.broadcast_to(np.eye(3), (len(begin_s), 3, 3))
    for k in range(count):
        C = C @ rotations(fine[:, k])
    return TurnSteps(begin_s, end_s, C)


def _recorded(grid: np.ndarray, time_s: np.ndarray) -> np.ndarray:
    """Mask (len(grid) - 1,) of the steps without a gap in the samples around them."""
    before = np.searchsorted(time_s, grid[:-1], side="right") - 1
    after = np.searchsorted(time_s, grid[1:], side="left")
    span = time_s[np.minimum(after, len(time_s) - 1)] - time_s[np.maximum(before, 0)]
    return span < 2.0 * (grid[1] - grid[0])
