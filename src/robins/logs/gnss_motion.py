"""Motion of a GNSS table by itself: positions in metres against velocities."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from robins.dataset import GnssTable
from robins.earth import curvature_radii
from robins.logs.fix_kinds import SINGLE_M
from robins.logs.limits import ALT_LIMIT_M, SPEED_LIMIT
from robins.logs.motion import at, integral
from robins.logs.ordering import increasing

_BASE_S = 1.0
_BASES_S = (_BASE_S, 2.0, 4.0, 8.0)  # the shortest one with enough motion is used
_SPEED = 0.3  # m/s; a slower receiver is at rest
_NORMAL = 0.6745  # median size of a standard normal number
_KEPT = 0.9  # share of the steps, those that fit best, used for the delay of velocities


class FixTrack(NamedTuple):
    """Complete fixes of a table, in order of time."""

    rows: np.ndarray  # (m,) index into the table
    time_s: np.ndarray  # (m,) since the table's first row
    r_n: np.ndarray  # (m, 3) m north, east, down of the first fix
    v_n: np.ndarray | None  # (m, 3) m/s north, east, down
    sigma_m: float  # horizontal position noise of an axis, median
    scatter_m: float  # position noise over all three axes, root of the sum of squares
    sigma_v: float  # velocity noise, median over all axes


def track_of(gnss: GnssTable, *, swap: bool = False) -> FixTrack | None:
    """Fixes with all components; None if there are fewer than ten.

    Args:
        gnss: the table.
        swap: exchange latitude and longitude, to test for that error.
    """
    lat, lon = (gnss.lon_rad, gnss.lat_rad) if swap else (gnss.lat_rad, gnss.lon_rad)
    place = np.stack([lat, lon, gnss.alt_m], axis=-1)
    good = np.all(np.abs(place) <= [np.deg2rad(89.9), 2 * np.pi, ALT_LIMIT_M], axis=1)
    v = gnss.v_n
    if v is not None:
        good &= np.all(np.abs(v) <= SPEED_LIMIT, axis=1)
    rows = np.flatnonzero(good)
    rows = rows[increasing(gnss.time_ns[rows])]
    if len(rows) < 10:
        return None
    if v is not None:
        v = v[rows] if gnss.nav == "NED" else v[rows][:, [1, 0, 2]] * [1.0, 1.0, -1.0]
    lat, lon, alt = place[rows].T
    meridian, transverse = curvature_radii(lat)
    east = np.unwrap(lon) - lon[0]
    r_n = np.stack(
        [(lat - lat[0]) * (meridian + alt), east * (transverse + alt) * np.cos(lat), alt[0] - alt],
        axis=-1,
    )
    sigma_v = np.inf if gnss.sigma_v is None else float(np.median(gnss.sigma_v[rows]))
    sigma_m = _sigmas(gnss, rows, r_n)
    time_s = (gnss.time_ns[rows] - gnss.time_ns[0]) * 1e-9
    horizontal, scatter = float(np.mean(sigma_m[:2])), float(np.linalg.norm(sigma_m))
    return FixTrack(rows, time_s, r_n, v, horizontal, scatter, sigma_v)


def _sigmas(gnss: GnssTable, rows: np.ndarray, r_n: np.ndarray) -> np.ndarray:
    """Median sigma of each axis (3,) [m]; where none is stated, by the roughness of the positions.

    Third differences of white noise have 20 times its variance, and a vehicle adds little to most.
    """
    stated = np.array(gnss.sigma_m[rows])
    if gnss.assumed_m is not None:
        stated[gnss.assumed_m[rows]] = np.nan
    rough = np.median(np.abs(np.diff(r_n, 3, axis=0)), axis=0) / (_NORMAL * np.sqrt(20.0))
    lacking = np.isnan(stated).all(axis=0)
    known = np.nanmedian(np.where(lacking, 0.0, stated), axis=0)
    return np.where(lacking, np.minimum(rough, SINGLE_M), known)


class PositionSteps(NamedTuple):
    """Change of position [m] over one to eight seconds, from positions and from velocities."""

    of_position: np.ndarray  # (k, 3)
    of_velocity: np.ndarray  # (k, 3)


def steps_of(track: FixTrack, late_s: float = 0.0) -> PositionSteps | None:
    """Steps of a moving receiver; None without velocities, or if it moves too little to judge.

    Args:
        track: the fixes.
        late_s: age of velocities at their stamps [s].
    """
    if track.v_n is None:
        return None
    of_position, of_velocity, duration = _steps_over(track, track.v_n, _BASE_S, late_s)
    # By either, so that positions or velocities in a wrong unit do not look like rest.
    by_either = _moves(of_velocity, duration, track.sigma_m)
    by_either |= _moves(of_position, duration, track.sigma_m)
    if np.count_nonzero(by_either) < 10:
        return None
    either = PositionSteps(of_position[by_either], of_velocity[by_either])
    # Choosing steps by noisy positions alone would bias their lengths upwards.
    for base_s in _BASES_S:
        of_position, of_velocity, duration = _steps_over(track, track.v_n, base_s, late_s)
        moving = _moves(of_velocity, duration, track.sigma_m)
        if np.count_nonzero(moving) >= 10:
            return PositionSteps(of_position[moving], of_velocity[moving])
    return either


def _moves(way: np.ndarray, duration: np.ndarray, sigma_m: float) -> np.ndarray:
    """Mask (k,) of displacements longer than those of a receiver at rest."""
    return np.linalg.norm(way[:, :2], axis=-1) > np.maximum(_SPEED * duration, 5.0 * sigma_m)


def _steps_over(
    track: FixTrack, v_n: np.ndarray, base_s: float, late_s: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Change of position from positions and from velocities (k, 3) [m], and duration (k,) [s]."""
    time_s = track.time_s
    stride = max(1, round(base_s / float(np.median(np.diff(time_s)))))
    first = np.arange(0, len(time_s) - stride, max(1, stride // 2))
    last = first + stride
    if not len(first):
        return np.empty((0, 3)), np.empty((0, 3)), np.empty(0)
    near = time_s[last] - time_s[first] < 1.5 * np.median(time_s[last] - time_s[first])
    first, last = first[near], last[near]
    path = integral(time_s, v_n)
    ends = (at(time_s[rows] + late_s, time_s, path) for rows in (last, first))
    return track.r_n[last] - track.r_n[first], np.subtract(*ends), time_s[last] - time_s[first]


def velocity_delay(track: FixTrack) -> float | None:
    """Age of velocities at their stamps [s], from the positions; None if unclear.

    Many receivers state the mean velocity of the last epoch, half an epoch late.
    """
    if track.v_n is None or np.median(np.diff(track.time_s)) > 1.1:
        return None
    lags = np.arange(-10, 11) * 0.05
    left = []
    for lag in lags:
        steps = steps_of(track, float(lag))
        if steps is None:
            return None
        apart = np.sum((steps.of_position - steps.of_velocity)[:, :2] ** 2, axis=1)
        # steps due to reflected signals carry no information on the delay
        left.append(np.mean(np.sort(apart)[: max(1, round(_KEPT * len(apart)))]))
    late = lowest(lags, np.array(left))
    clear = late is not None and min(left) < 0.5 * left[len(lags) // 2]
    return late if clear else None


def lowest(x: np.ndarray, y: np.ndarray) -> float | None:
    """Abscissa of the minimum of a sampled curve, by the parabola through three points.

    None at an end, or next to a missing sample (NaN).
    """
    if np.isnan(y).all():
        return None
    k = int(np.nanargmin(y))
    if k in (0, len(x) - 1):
        return None
    below, here, above = y[k - 1 : k + 2]
    bend = below - 2.0 * here + above
    return float(x[k] + 0.5 * (x[1] - x[0]) * (below - above) / bend) if bend > 0 else None
