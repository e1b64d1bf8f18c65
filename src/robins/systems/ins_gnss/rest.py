"""Standstill of a vehicle, by its samples and by the evidence of fixes.

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
from robins.ins.increments import usual_interval
from robins.ins.rest import standstill, unrest
from robins.systems.ins_gnss.parameters import Aids
from robins.systems.ins_gnss.recording import Log

WAYS_S = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0)  # times over which places are compared
_SIGMAS = 4.0
_SEEN = 5.0  # times the speed of motion: what moves faster would have been seen
_CALMER = 0.5  # at rest without fixes: this share of the least unrest seen in motion, or less


class Usual(NamedTuple):
    """Numbers of a whole log that a piece of it does not show."""

    sample_s: float  # interval between samples
    fix_s: float  # between fixes
    calmest: float = np.inf  # least unrest in motion, by the intervals that begin before `since_s`
    quiet_s: float = -np.inf  # last time before `since_s` at which the samples were not quiet
    since_s: float = -np.inf  # before it statistics over windows lack samples


def usual_of(log: Log) -> Usual:
    """Intervals of samples and of fixes in a log."""
    fix_s = float(np.median(np.diff(log.gnss_s))) if len(log.gnss_s) > 1 else 1.0
    return Usual(usual_interval(log.increments.dt), fix_s)


class Told(NamedTuple):
    """Evidence of motion in each of M fixes, which may prove it, exclude it, or tell nothing."""

    time_s: np.ndarray  # (M,) increasing
    moves: np.ndarray  # (M,) bool, it moves now, or has within the last second
    moved_s: np.ndarray  # (M,) beginning of the shortest time in which it has moved; NaN where none
    rests_s: np.ndarray  # (M,) of the shortest time in which it has not moved; NaN where none


# (N,) bool still by spread, (N, 3) mean rate [rad/s], (N,) unrest, evidence, how long it holds [s]
_Shown = tuple[np.ndarray, np.ndarray, np.ndarray, Told, float]


def at_rest(log: Log, aids: Aids, usual: Usual) -> tuple[np.ndarray, np.ndarray]:
    """(N,) bool, whether the vehicle certainly stands still at each increment; (N, 3) mean rate."""
    still, mean_rate, unrest_, told, wait_s = _shown(log, aids, usual)
    return confirmed(still, unrest_, log.time_s, told, wait_s, usual), mean_rate


def looks_still(log: Log, aids: Aids, usual: Usual) -> tuple[np.ndarray, np.ndarray]:
    """As `at_rest`, but where fixes that come say nothing, the spread of the samples decides."""
    still, mean_rate, unrest_, told, wait_s = _shown(log, aids, usual)
    silent = np.isnan(told.moved_s) & ~told.moves
    told = told._replace(rests_s=np.where(silent, np.inf, told.rests_s))
    return confirmed(still, unrest_, log.time_s, told, wait_s, usual), mean_rate


def known_until(log: Log, aids: Aids, usual: Usual, since_s: float) -> Usual:
    """Numbers of a log of which only the part after a time is kept."""
    still, _, unrest_, told, wait_s = _shown(log, aids, usual)
    # with the two fixes that the last of these intervals is known by
    count = int(np.sum(told.time_s < since_s)) + 2
    old = Told(*(a[:count] for a in told))
    least = calmest_in_motion(unrest_, log.time_s, old, wait_s, usual)[-1]
    last = max(int(np.searchsorted(log.time_s, since_s)) - 1, 0)
    began = quiet_since(still, log.time_s, usual)[last]
    calmest = float(least) if least > 0.0 else np.inf
    return usual._replace(calmest=calmest, quiet_s=float(began), since_s=since_s)


def _shown(log: Log, aids: Aids, usual: Usual) -> _Shown:
    args = log.increments, *aids.quiet, usual.sample_s, log.first
    told, wait_s = told_by(log, aids.moving_speed), 1.5 * max(1.0, usual.fix_s)
    return *standstill(*args), unrest(*args), told, wait_s


def confirmed(
    still: np.ndarray,
    unrest: np.ndarray,
    time_s: np.ndarray,
    told: Told,
    wait_s: float,
    usual: Usual,
) -> np.ndarray:
    """Find the samples that look still and are: a smooth road looks like rest.

    The last fix decides, where it proves motion, or excludes it for a time that began after the
    samples became quiet. Where it does neither, since it is old or its noise is large, a sample
    counts as still only if it is plainly calmer than the unit was in any interval before, between
    two fixes that said, as did the next, that it moves; if there was none, spread alone tells
    nothing. Nothing of the future is used.

    Args:
        still: (N,) bool, by the spread of the samples.
        unrest: (N,) the spread itself, in any unit.
        time_s: (N,) increasing times of the samples.
        told: what fixes tell.
        wait_s: how long a fix tells it.
        usual: what was known before these.

    Returns:
        (N,) bool.
    """
    if len(told.time_s) == 0:
        return still & (unrest < (0.0 if usual.calmest == np.inf else _CALMER * usual.calmest))
    began = quiet_since(still, time_s, usual)
    last = np.searchsorted(told.time_s, time_s + 1e-9, side="right") - 1
    at = np.maximum(last, 0)
    recent = (last >= 0) & (time_s - told.time_s[at] <= wait_s)
    moving = recent & (told.moves[at] | (told.moved_s[at] >= began))
    rests = recent & (told.rests_s[at] >= began)
    least = calmest_in_motion(unrest, time_s, told, wait_s, usual)
    return still & ~moving & (rests | (unrest < _CALMER * least[last + 1]))


def quiet_since(still: np.ndarray, time_s: np.ndarray, usual: Usual) -> np.ndarray:
    """(N,) last time up to each sample at which the samples were not quiet; arguments as above."""
    quiet = still | (time_s < usual.since_s)
    return np.maximum(np.maximum.accumulate(np.where(quiet, -np.inf, time_s)), usual.quiet_s)


def calmest_in_motion(
    unrest: np.ndarray,
    time_s: np.ndarray,
    told: Told,
    wait_s: float,
    usual: Usual,
) -> np.ndarray:
    """(M + 1,) least unrest in motion as it is known after so many fixes; 0 where it is not.

    Arguments as of `confirmed`.
    """
    fix_s, moves = told.time_s, told.moves
    edges = np.searchsorted(time_s, fix_s)
    least = np.full(len(fix_s) + 1, usual.calmest)
    for k in range(1, len(fix_s) - 1):
        begin, end = edges[k - 1], edges[k]
        is_new = fix_s[k - 1] >= usual.since_s and fix_s[k] - fix_s[k - 1] <= wait_s
        if is_new and begin < end and np.all(moves[k - 1 : k + 2]):
            least[k + 2] = np.min(unrest[begin:end])
    least = np.minimum.accumulate(least)
    return np.where(np.isfinite(least), least, 0.0)


def told_by(log: Log, speed: float) -> Told:
    """Evidence of fixes and wheels of motion faster than a speed [m/s]."""
    told = _by_velocity(log, speed) if log.gnss.v_n is not None else _by_way(log, speed)
    if log.wheels is None:
        return told
    wheels = _by_speed(log.wheels.time_s, np.abs(log.wheels.speed), log.wheels.sigma, speed)
    both = [np.concatenate(pair) for pair in zip(told, wheels, strict=True)]
    order = np.argsort(both[0], kind="stable")
    return Told(*(a[order] for a in both))


def _by_speed(time_s: np.ndarray, size: np.ndarray, sigma: np.ndarray, speed: float) -> Told:
    """Evidence of speeds (M,) with sigmas [m/s], each of its own instant."""
    moves = size > np.maximum(speed, _SIGMAS * sigma)
    rests = ~moves & (size + _SIGMAS * sigma < _SEEN * speed)
    return Told(time_s, moves, *(np.where(x, time_s, np.nan) for x in (moves, rests)))


def _by_velocity(log: Log, speed: float) -> Told:
    """Evidence of the velocities of fixes."""
    g = log.gnss
    assert g.v_n is not None
    assert g.sigma_v is not None
    size = np.hypot(g.v_n[:, 0], g.v_n[:, 1])
    known = ~log.withheld & np.isfinite(size)
    return _by_speed(log.gnss_s[known], size[known], np.max(g.sigma_v[known, :2], axis=1), speed)


def _by_way(log: Log, speed: float) -> Told:
    """Evidence of the ways between fixes, where the receiver gives no velocity."""
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
