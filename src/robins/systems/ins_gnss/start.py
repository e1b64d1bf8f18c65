"""Start of a replay: levelling, heading and initial velocity, at rest or in motion."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from robins import rotation
from robins.earth import gravity_n
from robins.earth.magnetic import decimal_year, elements, field_n, wmm_for
from robins.ins.alignment import level
from robins.ins.rest import moving_statistics
from robins.systems.ins_gnss.parameters import Aids, Gnss, InsGnssStart
from robins.systems.ins_gnss.positions import (
    attitudes,
    best_lines,
    course_fix,
    fitted,
    with_heading,
)
from robins.systems.ins_gnss.recording import Log
from robins.systems.ins_gnss.rest import DISPLACEMENT_S, UsualIntervals, at_rest, usual_of

REST_S = 10.0  # after the first complete fix, within which a filter with a given heading levels
UNKNOWN_SPEED = 10.0  # m/s, sigma of an unknown velocity


class StartPoint(NamedTuple):
    """First fix of the filter, with attitude and velocity there."""

    fix: int  # row of the complete fix at which the filter starts
    q_nb: np.ndarray  # (4,)
    tilt_sigma_rad: float
    gyro_bias: np.ndarray  # (3,) rad/s, mean rate of a standstill, else zero
    sentence: str  # how the start was found, for the report
    heading_sigma_rad: float
    v_n: np.ndarray  # (3,) m/s; of the antenna if stated by the receiver
    # (3, 2, 2) covariance of velocity and position on each axis; None: from `InsGnssStart`
    spread: np.ndarray | None = None
    offset_n: np.ndarray | None = None  # (3,) m, IMU from the fix; None: from the lever arm


def fast_fix(log: Log, start: InsGnssStart) -> tuple[int | None, bool, str]:
    """First fix with a course, and True if that is from positions; else None, and the reason."""
    v_n = log.gnss.v_n
    speed = np.zeros(len(log.gnss_s)) if v_n is None else np.hypot(v_n[:, 0], v_n[:, 1])
    usable = np.flatnonzero((speed >= start.course_speed) & (log.gnss_s > log.time_s[0]))
    by_way = course_fix(log, start)
    if by_way is not None and not (len(usable) and usable[0] < by_way):
        return by_way, True, ""
    if len(usable):
        return int(usable[0]), False, ""
    least = f"{start.course_speed:.2f} m/s"
    if v_n is None:
        why = (
            f"the log has no GNSS velocity, and its positions prove no motion of {least}; give "
            "start.known_heading, or lower start.course_speed"
        )
    else:
        why = (
            f"the fastest fix moves at {np.nanmax(speed, initial=0.0):.2f} m/s and a course is "
            f"taken from {least} on; lower start.course_speed or give start.known_heading"
        )
    return None, False, why


def _compass(
    log: Log, q_nb: np.ndarray, when_s: float, fix: int, otherwise: str
) -> tuple[float, str]:
    """Heading [rad] by the magnetometer within a second of a time, and a sentence.

    The declination is that of the World Magnetic Model, for 2025 if the stamps have no date.

    Args:
        log: with a magnetometer.
        q_nb: (4,) levelled, at heading zero.
        when_s: the time [s].
        fix: row of a fix nearby.
        otherwise: reason why there is no other heading.

    Raises:
        ValueError: the field is not that of the Earth.
    """
    assert log.field_s is not None
    assert log.field_b is not None
    near = np.abs(log.field_s - when_s) <= 1.0
    g = log.gnss
    time_ns = int(g.time_ns[fix])
    place = float(g.lat_rad[fix]), float(g.lon_rad[fix]), float(g.alt_m[fix])
    year = min(max(decimal_year(time_ns), 2020.0), 2030.0)
    year = year if decimal_year(time_ns) > 2000.0 else 2025.0
    earth = elements(field_n(wmm_for(year), *place, year))
    field = np.mean(log.field_b[near], axis=0) if np.any(near) else np.full(3, np.nan)
    share = float(np.linalg.norm(field) / earth.total_t)
    if not 0.7 < share < 1.4:
        raise ValueError(
            f"the heading at the start is not known: {otherwise}; the magnetometer reads "
            f"{share:.2g} of the Earth's field, so it is not asked either"
        )
    level_b = np.asarray(rotation.rotate(jnp.asarray(q_nb), jnp.asarray(field)))
    declination = float(earth.declination_rad)
    heading = declination - float(np.arctan2(level_b[1], level_b[0]))
    return heading, (
        f"heading {np.degrees(heading) % 360:.1f} deg from the magnetometer, with a declination of "
        f"{np.degrees(declination):+.1f} deg"
    )


def find_start(
    log: Log,
    start: InsGnssStart,
    aids: Aids,
    usual: UsualIntervals | None = None,
    gnss: Gnss | None = None,
) -> StartPoint:
    """Level on the quietest early window; take the heading as given or from the course.

    The gyros propagate the tilt from that window to the time at which the course is known, from the
    first fix faster than ``start.course_speed`` or from positions (`course_fix`); body forward is
    then along the course. A given heading is that at the first sample, and the window ends
    `REST_S` after the first complete fix. The filter starts at the first complete fix from then on
    with a known velocity. If no fix is fast enough, a magnetometer is used, if there is one.

    Args:
        log: at least up to that time.
        start: parameters of the start.
        aids: limits of rest.
        usual: intervals, if the log is too short to find them; None: found from the log.
        gnss: lever arm and latency; None: both zero.

    Raises:
        ValueError: no heading is known, nor a magnetometer that reads the Earth's field; there is
            no complete fix, or none after that time; or the mean specific force is not gravity.
    """
    usual, gnss, g = usual or usual_of(log), gnss or Gnss(), log.gnss
    whole = _complete_fixes(log)
    some, given = int(whole[0]), start.known_heading is not None
    fast, by_way, unknown = (None, False, "") if given else fast_fix(log, start)
    if unknown and log.field_b is None:
        raise ValueError(f"the heading at the start is not known: {unknown}")
    until_s = log.gnss_s[some] + REST_S if given else np.inf
    at, last, q_nb, tilt, bias, sentence = _levelled(log, start, aids, usual, fast, until_s)
    begin_s = float(log.time_s[at])
    if start.known_heading is not None:
        q_nb = with_heading(_carried(log, q_nb, at, 0, bias), start.known_heading)
        sentence += f", heading given as {np.degrees(start.known_heading):.1f} deg"
        at, begin_s = 0, begin_s if tilt == start.tilt else float(log.gnss_s[some])
    elif fast is None:
        heading, source = _compass(log, q_nb, begin_s, some, unknown)
        q_nb, sentence = with_heading(q_nb, heading), f"{sentence}, {source}"
    else:
        q_nb, at, begin_s = _carried(log, q_nb, at, last, bias), last, float(log.gnss_s[fast])
    if fast is not None and not by_way and g.v_n is not None:
        q_nb = with_heading(q_nb, float(np.arctan2(g.v_n[fast, 1], g.v_n[fast, 0])))
        sentence += _course(g.v_n[fast], begin_s, "")
    later = whole[log.gnss_s[whole] >= begin_s - 1e-6]
    if len(later) == 0:
        raise ValueError(f"no whole GNSS fix after the attitude is known, at {begin_s:.1f} s")
    first = int(later[0])
    found = StartPoint(first, q_nb, tilt, bias, sentence, start.heading, np.zeros(3))
    if log.v_n is not None and not by_way and np.all(np.isfinite(log.v_n[first])):
        if fast is None:
            q_nb = _carried(log, q_nb, at, _row(log, first), bias)
        return found._replace(q_nb=q_nb, v_n=log.v_n[first])
    later = later[log.gnss_s[later] <= log.gnss_s[first] + DISPLACEMENT_S[-1]]
    none = np.zeros(len(later), bool)
    stands = none if by_way else at_rest(log, aids, usual, log.gnss_s[later])[0]
    return _by_positions(log, found, at, later, stands, start, gnss, by_way)


def _complete_fixes(log: Log) -> np.ndarray:
    """Rows of complete fixes (three coordinates) within the time of the increments.

    Raises:
        ValueError: there is none.
    """
    g, begin_s, end_s = log.gnss, log.time_s[0] - log.increments.dt[0], log.time_s[-1]
    whole = np.all(np.isfinite([g.lat_rad, g.lon_rad, g.alt_m]), axis=0)
    rows = np.flatnonzero(whole & (log.gnss_s > begin_s) & (log.gnss_s <= end_s))
    if not len(rows):
        raise ValueError(f"no whole GNSS fix between {begin_s:.1f} and {end_s:.1f} s")
    return rows


def _levelled(
    log: Log,
    start: InsGnssStart,
    aids: Aids,
    usual: UsualIntervals,
    fast: int | None,
    until_s: float,
) -> tuple[int, int, np.ndarray, float, np.ndarray, str]:
    """Level at rest, or on the quietest second, of the samples up to a time or a fast fix.

    Returns:
        Row of the increment there, row of the last one considered, attitude (4,) with heading zero,
        sigma of its tilt [rad], gyro bias (3,) [rad/s], and a sentence.

    Raises:
        ValueError: the mean specific force is not gravity.
    """
    dt, _, dv = log.increments[:3]
    still, mean_rate = at_rest(log, aids, usual, lenient=True)
    width = max(2, round(2.0 * aids.window / usual.sample_s))
    # without a course nothing after the first rest is used
    end = min(int(np.searchsorted(log.time_s, until_s)), len(dt) - 1)
    enough = min(int(np.append(np.flatnonzero(still)[width : width + 1], end)[0]), end)
    last = enough if fast is None else _row(log, fast)
    until = slice(last + 1)
    mean_force, spread = moving_statistics(dv[until] / dt[until, None], width, log.first)
    quiet_enough = np.flatnonzero(still[: last + 1])
    if len(quiet_enough):
        at = int(quiet_enough[min(len(quiet_enough) - 1, width)])
        tilt, how, bias = start.tilt, "at rest", np.mean(mean_rate[quiet_enough], axis=0)
    else:
        first = min(width - 1, last)
        at = first + int(np.argmin(np.sum(spread[first : last + 1] ** 2, axis=1)))
        tilt, how, bias = 3.0 * start.tilt, "on the quietest second, moving", np.zeros(3)
    force, some = mean_force[at], _complete_fixes(log)[0]
    place = (np.asarray(x[some], float) for x in (log.gnss.lat_rad, log.gnss.alt_m))
    here = np.linalg.norm(gravity_n(*place))
    if not 0.5 * here < np.linalg.norm(force) < 1.5 * here:
        raise ValueError(
            f"cannot level: the mean specific force at {log.time_s[at]:.2f} s is "
            f"{np.linalg.norm(force):.2f} m/s^2, gravity is {here:.2f}"
        )
    q_nb = np.asarray(level(force, 0.0, 0.0).q_nb.wxyz)
    return at, last, q_nb, tilt, bias, f"levelled {how} at {log.time_s[at]:.1f} s"


def _carried(log: Log, q_nb: np.ndarray, at: int, to: int, bias: np.ndarray) -> np.ndarray:
    """Attitude (4,) propagated by the gyros from the end of one increment to that of another."""
    low, high = min(at, to) + 1, max(at, to) + 1
    theta = log.increments.theta[low:high] - bias * log.increments.dt[low:high, None]
    theta = theta if to > at else -theta[::-1]
    return attitudes(q_nb, theta)[-1] if len(theta) else q_nb


def _course(v_n: np.ndarray, at_s: float, by: str) -> str:
    """Part of the sentence on a start: heading and source of the course, a velocity."""
    return (
        f"; heading {np.degrees(np.arctan2(v_n[1], v_n[0])) % 360:.1f} deg from the course{by} at "
        f"{at_s:.1f} s, when the speed reached {np.hypot(v_n[0], v_n[1]):.2f} m/s"
    )


def _by_positions(
    log: Log,
    level_: StartPoint,
    at: int,
    later: np.ndarray,
    stands: np.ndarray,
    start: InsGnssStart,
    gnss: Gnss,
    by_way: bool,
) -> StartPoint:
    """Start at the first of some complete fixes at which the velocity is known.

    It is that of the receiver; else zero at certain rest; else that of a line through the
    positions. If there is none within 32 s, it is 0 +- `UNKNOWN_SPEED`. The attitude of `level_` is
    that at the end of increment `at`; `later` (K,) are rows of complete fixes, `stands` (K,) is
    true at rest, and with `by_way` the course is that of the positions.

    Raises:
        ValueError: the log ends before the velocity is known.
    """
    v_n = np.full((len(log.gnss_s), 3), np.nan) if log.v_n is None else log.v_n
    tilt, bias = level_.tilt_sigma_rad, level_.gyro_bias
    sure = np.isfinite(best_lines(log, later, tilt)[1]) & ~log.withheld[later]
    known = np.all(np.isfinite(v_n[later]), axis=1) | stands | sure
    if not np.any(known) and log.time_s[-1] - log.gnss_s[later[0]] < DISPLACEMENT_S[-1]:
        raise ValueError(
            f"the velocity at the start is not known: from {log.gnss_s[later[0]]:.1f} s on there "
            f"are no three whole fixes within {DISPLACEMENT_S[-1]:.0f} s, and no rest; "
            "give more of the log"
        )
    k = int(np.argmax(known))
    fix, own = int(later[k]), np.isfinite(v_n[later[k]])
    q_nb = _carried(log, level_.q_nb, at, _row(log, fix), bias)
    found = level_._replace(fix=fix, q_nb=q_nb)
    size = np.where(own, start.velocity, start.velocity if stands[k] else UNKNOWN_SPEED)
    if not sure[k] or stands[k]:
        place = np.maximum(start.position, log.sigma_m[fix])
        spread = np.stack([np.diag(x) for x in np.stack([size, place], axis=1) ** 2])
        return found._replace(v_n=np.where(own, v_n[fix], 0.0), spread=spread)
    q_nb, offset, v, spread = fitted(log, fix, q_nb, tilt, gnss, bias, not by_way)
    sigma, speed = float(np.sqrt(np.max(spread[:2, 0, 0]))), float(np.hypot(*v[:2]))
    heading, sentence = start.heading, level_.sentence
    if by_way:
        heading = float(np.hypot(heading, sigma / speed))
        sentence += _course(v, log.gnss_s[fix], " of positions")
    else:
        sentence += f"; velocity from positions, {speed:.2f} +- {sigma:.2f} m/s"
    # a stated velocity is better than that of a line
    for axis in np.flatnonzero(own):
        spread[axis] = np.diag([start.velocity**2, spread[axis, 1, 1]])
    return found._replace(
        q_nb=q_nb,
        sentence=sentence,
        heading_sigma_rad=heading,
        v_n=np.where(own, v_n[fix], v),
        spread=spread,
        offset_n=offset,
    )


def _row(log: Log, fix: int) -> int:
    """Row of the increment that holds a fix."""
    return int(np.searchsorted(log.time_s, log.gnss_s[fix]))
