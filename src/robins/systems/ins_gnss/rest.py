"""Whether a vehicle stands still, by its samples and by what fixes tell of its motion.

A fix of metres that lies where the last one lay excludes no slow motion. So fixes are compared over
ways as long as their noise asks for: from the shortest time over which a motion of `_SEEN` times
`aids.moving_speed` would have been seen, rest is certain, and from the shortest over which the way
is beyond its noise, motion is.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from robins.earth import Geodetic
from robins.ins.rest import (
    NOTHING,
    Known,
    Told,
    calmest_in_motion,
    confirmed,
    quiet_since,
    standstill,
    unrest,
)
from robins.systems.ins_gnss.parameters import Aids
from robins.systems.ins_gnss.recording import Log

WAYS_S = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0)  # times over which places are compared
_SIGMAS = 4.0
_SEEN = 5.0  # times the speed of motion: what moves faster would have been seen


class Usual(NamedTuple):
    """What a piece of a log that is too short does not tell of the whole."""

    sample_s: float  # interval between samples
    fix_s: float  # between fixes
    known: Known = NOTHING


class _Looks(NamedTuple):
    """What samples and fixes of a log show."""

    still: np.ndarray  # (N,) bool, by spread
    mean_rate: np.ndarray  # (N, 3) rad/s
    unrest: np.ndarray  # (N,)
    told: Told
    wait_s: float  # how long a fix tells it
    known: Known


def at_rest(log: Log, aids: Aids, usual: Usual | None = None) -> tuple[np.ndarray, np.ndarray]:
    """(N,) bool, whether the vehicle certainly stands still at each increment; (N, 3) mean rate."""
    seen = _looks(log, aids, usual)
    still = confirmed(seen.still, seen.unrest, log.time_s, *seen[3:])
    return still, seen.mean_rate


def looks_still(log: Log, aids: Aids, usual: Usual | None = None) -> tuple[np.ndarray, np.ndarray]:
    """As `at_rest`, but where fixes that come say nothing, the spread of the samples decides."""
    seen = _looks(log, aids, usual)
    silent = np.isnan(seen.told.moved_s) & ~seen.told.moves
    told = seen.told._replace(rests_s=np.where(silent, np.inf, seen.told.rests_s))
    return confirmed(seen.still, seen.unrest, log.time_s, told, *seen[4:]), seen.mean_rate


def known_until(log: Log, aids: Aids, usual: Usual, since_s: float) -> Known:
    """What has to be known of a log where only its part after a time is kept."""
    seen = _looks(log, aids, usual)
    before = seen.told.time_s < since_s
    # with the two fixes that the last of these intervals is known by
    old = seen.told._replace(**{k: v[: np.sum(before) + 2] for k, v in seen.told._asdict().items()})
    least = calmest_in_motion(seen.unrest, log.time_s, old, seen.wait_s, seen.known)[-1]
    last = max(int(np.searchsorted(log.time_s, since_s)) - 1, 0)
    began = quiet_since(seen.still, log.time_s, seen.known)[last]
    return Known(float(least) if least > 0.0 else np.inf, float(began), since_s)


def _looks(log: Log, aids: Aids, usual: Usual | None) -> _Looks:
    sample_s, known = (None, NOTHING) if usual is None else (usual.sample_s, usual.known)
    still, mean_rate = standstill(log.increments, *aids.quiet, sample_s, log.first)
    told = told_by(log, aids.moving_speed)
    between = float(np.median(np.diff(told.time_s))) if len(told.time_s) > 1 else 1.0
    wait_s = 1.5 * max(1.0, between if usual is None else usual.fix_s)
    quiet = unrest(log.increments, *aids.quiet, sample_s, log.first)
    return _Looks(still, mean_rate, quiet, told, wait_s, known)


def told_by(log: Log, speed: float) -> Told:
    """What fixes and wheels tell of motion faster than a speed [m/s]."""
    told = _by_velocity(log, speed) if log.gnss.v_n is not None else _by_way(log, speed)
    if log.wheels is None:
        return told
    wheels = _by_speed(log.wheels.time_s, np.abs(log.wheels.speed), log.wheels.sigma, speed)
    both = [np.concatenate(pair) for pair in zip(told, wheels, strict=True)]
    order = np.argsort(both[0], kind="stable")
    return Told(*(a[order] for a in both))


def _by_speed(time_s: np.ndarray, size: np.ndarray, sigma: np.ndarray, speed: float) -> Told:
    """What speeds (M,) with sigmas [m/s] tell, each of its own instant."""
    moves = size > np.maximum(speed, _SIGMAS * sigma)
    rests = ~moves & (size + _SIGMAS * sigma < _SEEN * speed)
    return Told(time_s, moves, *(np.where(x, time_s, np.nan) for x in (moves, rests)))


def _by_velocity(log: Log, speed: float) -> Told:
    """What the velocities of fixes tell."""
    g = log.gnss
    assert g.v_n is not None
    assert g.sigma_v is not None
    size = np.hypot(g.v_n[:, 0], g.v_n[:, 1])
    known = ~log.withheld & np.isfinite(size)
    return _by_speed(log.gnss_s[known], size[known], np.max(g.sigma_v[known, :2], axis=1), speed)


def _by_way(log: Log, speed: float) -> Told:
    """What the ways between fixes tell, where the receiver gives no velocity."""
    g = log.gnss
    known = ~log.withheld & np.isfinite(g.lat_rad) & np.isfinite(g.lon_rad)
    time_s, noise = log.gnss_s[known], np.max(g.sigma_m[known, :2], axis=1)
    place = Geodetic(*map(jnp.asarray, (g.lat_rad[known], g.lon_rad[known], 0.0 * time_s)))
    moves = np.zeros(len(time_s), bool)
    moved_s, rests_s = np.full((2, len(time_s)), np.nan)
    for way_s in WAYS_S if len(time_s) else ():
        before = np.searchsorted(time_s, time_s - way_s + 1e-6, side="right") - 1
        before = np.maximum(before, 0)
        there = Geodetic(place.lat[before], place.lon[before], place.alt[before])
        way = np.hypot(*np.asarray(there.local(place)).T[:2])
        lasted, spread = time_s - time_s[before], _SIGMAS * np.hypot(noise, noise[before])
        moved = (lasted > 0.0) & (way > np.maximum(speed * lasted, spread))
        rested = (lasted > 0.0) & ~moved & (way + spread < _SEEN * speed * lasted)
        moves |= moved & (way_s == WAYS_S[0])
        moved_s = np.fmax(moved_s, np.where(moved, time_s[before], np.nan))
        rests_s = np.fmax(rests_s, np.where(rested, time_s[before], np.nan))
    return Told(time_s, moves, moved_s, rests_s)
