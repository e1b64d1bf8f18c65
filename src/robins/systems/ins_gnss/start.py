"""Where a replay begins: at rest or not, level, and with which heading."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from robins import rotation
from robins.earth import gravity_n
from robins.earth.magnetic import decimal_year, elements, field_n, wmm_for
from robins.ins.alignment import level
from robins.ins.rest import moving_statistics
from robins.program.evaluated import evaluated
from robins.program.scanned import named_scan
from robins.systems.ins_gnss.parameters import Aids, Start
from robins.systems.ins_gnss.recording import Log
from robins.systems.ins_gnss.rest import Usual, looks_still, usual_of


class StartPoint(NamedTuple):
    """Where and how the filter begins."""

    fix: int  # row of the whole fix that it begins at
    q_nb: np.ndarray  # (4,)
    tilt_sigma_rad: float
    gyro_bias: np.ndarray  # (3,) rad/s, mean rate of a standstill, else zero
    sentence: str  # how it was found, for the reader


def turned(q: np.ndarray, theta: np.ndarray) -> np.ndarray:
    """Attitude (4,) after rotation vectors (N, 3) in body axes."""
    return named_scan(_turned_by, q, theta)[0]


def _turned_by(q: Array, theta: Array) -> tuple[Array, None]:
    return rotation.normalise(rotation.multiply(q, rotation.from_rotvec(theta))), None


def with_heading(q_nb: np.ndarray, heading_rad: float) -> np.ndarray:
    """The same tilt with another heading."""

    def turned_to(q_nb, heading_rad):
        _, _, now = rotation.to_euler(q_nb)
        turn = rotation.from_rotvec(jnp.array([0.0, 0.0, 1.0]) * (heading_rad - now))
        return rotation.multiply(turn, q_nb)

    return np.asarray(evaluated(turned_to, q_nb, heading_rad))


def _fast_fix(log: Log, start: Start) -> tuple[int | None, str]:
    """The first fix that a course can be taken from; None and why where there is none."""
    v_n = log.gnss.v_n
    if v_n is None:
        return None, (
            "the log has no GNSS velocity to take a course from; give start.known_heading"
        )
    speed = np.hypot(v_n[:, 0], v_n[:, 1])
    usable = np.flatnonzero((speed >= start.course_speed) & (log.gnss_s > log.time_s[0]))
    if len(usable):
        return int(usable[0]), ""
    return None, (
        f"the fastest fix moves at {np.nanmax(speed):.2f} m/s and a course is taken from "
        f"{start.course_speed:.2f} m/s on; lower start.course_speed or give start.known_heading"
    )


def _compass(
    log: Log,
    q_nb: np.ndarray,
    when_s: float,
    place: tuple[float, float, float],
    time_ns: int,
    otherwise: str,
) -> tuple[float, str]:
    """Heading [rad] by the magnetometer over the second before a time, and a sentence.

    The declination is that of the World Magnetic Model, of today where the stamps are no date.

    Args:
        log: with a magnetometer.
        q_nb: (4,) levelled, at heading zero.
        when_s: the time.
        place: latitude, longitude [rad], height [m].
        time_ns: of a fix.
        otherwise: why there is no other heading.

    Raises:
        ValueError: the field is not that of the Earth.
    """
    assert log.field_s is not None
    assert log.field_b is not None
    near = np.abs(log.field_s - when_s) <= 1.0
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


def find_start(log: Log, start: Start, aids: Aids, usual: Usual | None = None) -> StartPoint:
    """Level on the quietest early window; take the heading as given or from the GNSS course.

    The gyros carry the tilt from that window to the moment the course is known (first fix faster
    than ``start.course_speed``); body forward is then taken along the course. The filter begins at
    the first whole fix from there on. Where no fix is fast enough a magnetometer is asked, if there
    is one.

    Args:
        log: at least up to that moment.
        start: how well it is known.
        aids: what rest is.
        usual: where the log is too short to tell.

    Raises:
        ValueError: no heading is known: none was given, no fix is fast enough, and there is no
            magnetometer that reads the Earth's field; there is no whole fix, or none after that
            moment; or the mean specific force is not gravity's.
    """
    (dt, theta, dv), time_s, gnss_s = log.increments[:3], log.time_s, log.gnss_s
    g, v_n, begin_s = log.gnss, log.gnss.v_n, time_s[0] - dt[0]
    whole = np.all(np.isfinite([g.lat_rad, g.lon_rad, g.alt_m]), axis=0)
    whole &= (gnss_s > begin_s) & (gnss_s <= time_s[-1])
    if not np.any(whole):
        raise ValueError(f"no whole GNSS fix between {begin_s:.1f} and {time_s[-1]:.1f} s")
    fast, unknown = None, ""
    if start.known_heading is None:
        fast, unknown = _fast_fix(log, start)
        if unknown and log.field_b is None:
            raise ValueError(f"the heading at the start is not known: {unknown}")
    usual = usual or usual_of(log)
    still, mean_rate = looks_still(log, aids, usual)
    width = max(2, round(2.0 * aids.window / usual.sample_s))
    mean_force, spread = moving_statistics(dv / dt[:, None], width, log.first)
    # without a course nothing is taken from after the rest that it begins at
    enough = np.append(np.flatnonzero(still)[width : width + 1], len(dt) - 1)[0]
    last = int(enough) if fast is None else int(np.searchsorted(time_s, gnss_s[fast]))
    quiet_enough = np.flatnonzero(still[: last + 1])
    if len(quiet_enough):
        at = int(quiet_enough[min(len(quiet_enough) - 1, width)])
        tilt, how, bias = start.tilt, "at rest", np.mean(mean_rate[quiet_enough], axis=0)
    else:
        first = min(width - 1, last)
        at = first + int(np.argmin(np.sum(spread[first : last + 1] ** 2, axis=1)))
        tilt, how, bias = 3.0 * start.tilt, "on the quietest second, moving", np.zeros(3)
    force, some = mean_force[at], np.flatnonzero(whole)[0]
    here = np.linalg.norm(gravity_n(*(np.asarray(x[some], float) for x in (g.lat_rad, g.alt_m))))
    if not 0.5 * here < np.linalg.norm(force) < 1.5 * here:
        raise ValueError(
            f"cannot level: the mean specific force at {time_s[at]:.2f} s is "
            f"{np.linalg.norm(force):.2f} m/s^2, gravity is {here:.2f}"
        )
    sentence = f"levelled {how} at {time_s[at]:.1f} s"
    heading = start.known_heading or 0.0
    q_nb = np.asarray(level(force, 0.0, heading).q_nb.wxyz)
    begin_s = float(time_s[at])
    if unknown:
        place = float(g.lat_rad[some]), float(g.lon_rad[some]), float(g.alt_m[some])
        heading, told = _compass(log, q_nb, begin_s, place, int(g.time_ns[some]), unknown)
        q_nb = with_heading(q_nb, heading)
        sentence += f", {told}"
    elif fast is None:
        sentence += f", heading given as {np.degrees(heading):.1f} deg"
    else:
        assert v_n is not None
        assert fast is not None
        carried = theta[at + 1 : last + 1] - bias * dt[at + 1 : last + 1, None]
        heading = float(np.arctan2(v_n[fast, 1], v_n[fast, 0]))
        q_nb = with_heading(turned(q_nb, carried), heading)
        begin_s = float(gnss_s[fast])
        sentence += (
            f"; heading {np.degrees(heading) % 360:.1f} deg from the course at {begin_s:.1f} s, "
            f"when the speed reached {np.hypot(*v_n[fast, :2]):.2f} m/s"
        )
    later = np.flatnonzero(whole & (gnss_s >= begin_s - 1e-6))
    if len(later) == 0:
        raise ValueError(f"no whole GNSS fix after the attitude is known, at {begin_s:.1f} s")
    return StartPoint(int(later[0]), q_nb, tilt, bias, sentence)
