"""Standstill detection of a vehicle, from inertial samples and the evidence of fixes.

Two equal fixes with errors of metres do not exclude slow motion. Fixes are therefore compared over
several intervals: rest is certain since the shortest one over which a motion of `_SEEN` times
`aids.moving_speed` would have been detected, and motion since the shortest one over which the
displacement exceeds its noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from robins.earth.wgs84 import A_M, E2
from robins.ins.increments import usual_interval
from robins.ins.rest import standstill
from robins.systems.ins_gnss.parameters import Aids
from robins.systems.ins_gnss.recording import Log

DISPLACEMENT_S = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0)  # intervals over which positions are compared
_SIGMAS = 4.0
_SEEN = 5.0  # times `aids.moving_speed`: a speed that rest must exclude
_CALMER = 0.5  # rest without fixes: unrest below this share of the least in motion


class UsualIntervals(NamedTuple):
    """Quantities of a whole log that cannot be found from a piece of it."""

    sample_s: float  # interval between samples
    fix_s: float  # between fixes
    calmest: float = np.inf  # least unrest in motion, over intervals that begin before `since_s`
    quiet_s: float = -np.inf  # last time before `since_s` at which the samples were not quiet
    since_s: float = -np.inf  # earlier statistics over windows lack samples


def usual_of(log: Log) -> UsualIntervals:
    """Usual intervals of samples and fixes in a log."""
    fix_s = float(np.median(np.diff(log.gnss_s))) if len(log.gnss_s) > 1 else 1.0
    return UsualIntervals(usual_interval(log.increments.dt), fix_s)


class Evidence(NamedTuple):
    """Evidence of motion in each of M fixes, which may prove it, exclude it, or be inconclusive."""

    time_s: np.ndarray  # (M,) increasing
    moves: np.ndarray  # (M,) bool, in motion now, or within about the last second
    moved_s: np.ndarray  # (M,) begin of the shortest interval with motion; NaN if none
    rests_s: np.ndarray  # (M,) begin of the shortest interval without motion; NaN if none


# (N,) bool still by scatter, (N, 3) mean rate [rad/s], (N,) unrest, evidence, its validity [s]
_Observed = tuple[np.ndarray, np.ndarray, np.ndarray, list[Evidence], float]


def at_rest(
    log: Log,
    aids: Aids,
    usual: UsualIntervals,
    at_s: np.ndarray | None = None,
    lenient: bool = False,
) -> tuple[np.ndarray, np.ndarray]:
    """Mask (E,) of certain standstill, and mean raw gyro rate (E, 3) [rad/s].

    Args:
        log: samples and fixes.
        aids: limits of rest.
        usual: of the whole log.
        at_s: (E,) times [s]; None: the end of each increment.
        lenient: if fixes are inconclusive, the scatter of the samples decides.
    """
    still, mean_rate, unrest, evidence, wait_s = _observed(log, aids, usual)
    if lenient:
        for k, one in enumerate(evidence):
            silent = np.isnan(one.moved_s) & ~one.moves
            evidence[k] = one._replace(rests_s=np.where(silent, np.inf, one.rests_s))
    rows = rows_at(log.time_s, at_s)
    return confirmed(still, unrest, log.time_s, evidence, wait_s, usual, at_s), mean_rate[rows]


def known_until(log: Log, aids: Aids, usual: UsualIntervals, since_s: float) -> UsualIntervals:
    """Update `usual` before the part of a log up to `since_s` is dropped."""
    still, _, unrest, evidence, wait_s = _observed(log, aids, usual)
    least = usual.calmest
    for one in evidence:
        # with the two fixes that end and confirm the last interval
        old = Evidence(*(a[: int(np.sum(one.time_s < since_s)) + 2] for a in one))
        found = calmest_in_motion(unrest, log.time_s, old, wait_s, usual, since_s)[-1]
        least = min(least, float(found))
    last = max(int(np.searchsorted(log.time_s, since_s)) - 1, 0)
    began = float(quiet_since(still, log.time_s, usual)[last])
    return usual._replace(calmest=least, quiet_s=began, since_s=since_s)


def rows_at(time_s: np.ndarray, at_s: np.ndarray | None) -> np.ndarray:
    """Rows (E,) of the increments, ending at times (N,), that contain times (E,); None: all."""
    if at_s is None:
        return np.arange(len(time_s))
    return np.minimum(np.searchsorted(time_s, at_s - 1e-9), len(time_s) - 1)


def _observed(log: Log, aids: Aids, usual: UsualIntervals) -> _Observed:
    wait_s = 1.5 * max(1.0, usual.fix_s)
    observed = standstill(log.increments, *aids.quiet, usual.sample_s, log.first)
    return *observed, evidence_of(log, aids.moving_speed, wait_s), wait_s


def confirmed(
    still: np.ndarray,
    unrest: np.ndarray,
    time_s: np.ndarray,
    evidence: Sequence[Evidence],
    wait_s: float,
    usual: UsualIntervals,
    at_s: np.ndarray | None = None,
) -> np.ndarray:
    """Confirm quiet samples as standstill by other evidence: a smooth road looks like rest.

    The last fix of each source decides if it proves motion, or excludes it since a time after the
    samples became quiet; one source that proves motion suffices. If all are inconclusive, being old
    or noisy, the unit counts as still only if it is much calmer than in every earlier interval of
    motion, that is, between two fixes that prove motion, followed by a third that does; without
    such an interval, scatter alone proves nothing. No future data are used.

    Args:
        still: (N,) bool, by the scatter of the samples.
        unrest: (N,) the scatter itself, in any unit.
        time_s: (N,) increasing times of the samples.
        evidence: of motion and rest, by source.
        wait_s: validity of a fix as evidence [s].
        usual: quantities of the log before these samples.
        at_s: (E,) times [s]; None: those of the samples.

    Returns:
        Mask (E,) of standstill.
    """
    rows = rows_at(time_s, at_s)
    at_s = time_s if at_s is None else at_s
    began = quiet_since(still, time_s, usual)[rows]
    moving, rests = np.zeros((2, len(rows)), bool)
    least = np.full(len(rows), usual.calmest)
    for one in evidence:
        if not len(one.time_s):
            continue
        count = np.searchsorted(one.time_s, at_s + 1e-9, side="right")
        last = np.maximum(count - 1, 0)
        recent = (count > 0) & (at_s - one.time_s[last] <= wait_s)
        moving |= recent & (one.moves[last] | (one.moved_s[last] >= began))
        rests |= recent & (one.rests_s[last] >= began)
        calmest = calmest_in_motion(unrest, time_s, one, wait_s, usual)
        least = np.minimum(least, calmest[count])
    calm = np.isfinite(least) & (unrest[rows] < _CALMER * least)
    return still[rows] & ~moving & (rests | calm)


def quiet_since(still: np.ndarray, time_s: np.ndarray, usual: UsualIntervals) -> np.ndarray:
    """Last time (N,) up to each sample at which samples were not quiet; see `confirmed`."""
    quiet = still | (time_s < usual.since_s)
    return np.maximum(np.maximum.accumulate(np.where(quiet, -np.inf, time_s)), usual.quiet_s)


def calmest_in_motion(
    unrest: np.ndarray,
    time_s: np.ndarray,
    evidence: Evidence,
    wait_s: float,
    usual: UsualIntervals,
    until_s: float = np.inf,
) -> np.ndarray:
    """Least unrest in motion (M + 1,) known after 0, 1, ... M fixes; infinite if unknown.

    Arguments as in `confirmed`. Only intervals that begin before `until_s` count; if it is given,
    the last one needs no confirmation by the next fix.
    """
    fix_s, moves = evidence.time_s, evidence.moves
    least = np.full(len(fix_s) + 1, usual.calmest)
    if len(fix_s) < 2:
        return least
    edges = np.searchsorted(time_s, fix_s)
    lowest = np.minimum.reduceat(np.append(unrest, np.inf), edges)[:-1]
    counts = (edges[:-1] < edges[1:]) & (np.diff(fix_s) <= wait_s) & moves[:-1] & moves[1:]
    counts &= np.append(moves[2:], until_s < np.inf)  # confirmed by the next one
    counts &= (fix_s[:-1] >= usual.since_s) & (fix_s[:-1] < until_s)
    lowest = np.where(counts, lowest, np.inf)
    least[3:] = lowest[:-1]  # known from the next one on
    least[-1] = min(least[-1], lowest[-1])
    return np.minimum.accumulate(least)


def evidence_of(log: Log, speed: float, wait_s: float) -> list[Evidence]:
    """Evidence of motion faster than a speed [m/s] from velocities, displacements and wheels."""
    evidence = [_by_displacement(log, speed, wait_s)]
    if log.v_n is not None and log.sigma_v is not None:
        known = ~log.withheld & np.all(np.isfinite(log.v_n[:, :2]), axis=1)
        size = np.hypot(*log.v_n[known, :2].T)
        noise = np.max(log.sigma_v[known, :2], axis=1)
        evidence.append(_by_speed(log.gnss_s[known], size, noise, speed))
    if log.wheels is not None:
        w = log.wheels
        evidence.append(_by_speed(w.time_s, np.abs(w.speed), w.sigma, speed))
    return evidence


def _by_speed(time_s: np.ndarray, size: np.ndarray, sigma: np.ndarray, speed: float) -> Evidence:
    """Evidence from speeds (M,) with sigmas [m/s], each at one instant."""
    moves = size > np.maximum(speed, _SIGMAS * sigma)
    rests = ~moves & (size + _SIGMAS * sigma < _SEEN * speed)
    return Evidence(time_s, moves, *(np.where(x, time_s, np.nan) for x in (moves, rests)))


def _by_displacement(log: Log, speed: float, wait_s: float) -> Evidence:
    """Evidence from displacements to fixes without a velocity, from earlier fixes."""
    g = log.gnss
    known = ~log.withheld & np.isfinite(g.lat_rad) & np.isfinite(g.lon_rad)
    time_s, noise = log.gnss_s[known], np.max(log.sigma_m[known, :2], axis=1)
    lat, lon = g.lat_rad[known], g.lon_rad[known]
    moves = np.zeros(len(time_s), bool)
    moved_s, rests_s = np.full((2, len(time_s)), np.nan)
    for way_s in DISPLACEMENT_S if len(time_s) else ():
        before = np.searchsorted(time_s, time_s - way_s + 1e-6, side="right") - 1
        before = np.maximum(before, 0)
        way = np.hypot(*displacements(lat, lat - lat[before], lon - lon[before]))
        lasted, spread = time_s - time_s[before], _SIGMAS * np.hypot(noise, noise[before])
        moved = (lasted > 0.0) & (way > np.maximum(speed * lasted, spread))
        rested = (lasted > 0.0) & ~moved & (way + spread < _SEEN * speed * lasted)
        if way_s == DISPLACEMENT_S[0]:
            moves = moved & (lasted <= way_s + wait_s)
        moved_s = np.fmax(moved_s, np.where(moved, time_s[before], np.nan))
        rests_s = np.fmax(rests_s, np.where(rested, time_s[before], np.nan))
    alone = np.ones(len(time_s), bool)
    if log.v_n is not None:
        alone = ~np.all(np.isfinite(log.v_n[known, :2]), axis=1)
    return Evidence(*(a[alone] for a in (time_s, moves, moved_s, rests_s)))


def displacements(
    lat: np.ndarray, dlat: np.ndarray, dlon: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Displacement north and east [m] of small differences of latitude and longitude [rad]."""
    square = 1.0 - E2 * np.sin(lat) ** 2
    across = A_M / np.sqrt(square)  # radius of curvature in the prime vertical
    along = across * (1.0 - E2) / square  # in the meridian
    return along * dlat, across * np.cos(lat) * np.angle(np.exp(1j * dlon))
