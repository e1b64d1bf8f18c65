"""Conversion of samples and fixes to filter steps, chunk by chunk, for a growing log.

Increments, start, epochs and steps are those of a replay, computed by the same functions from the
recent part of the log. The result does not depend, to the bit, on the division into chunks. Each
stage uses later samples, within its latency:

- an increment is known with the next sample;
- the turn rate at an epoch is a mean about it: `reach_of_rate`;
- the start needs a fix that shows the course, or rest if the heading is given.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation as SciRotation

from robins.dataset import GnssTable
from robins.filters import Belief
from robins.ins.blocks import due_epochs, reach_of_rate
from robins.ins.increments import Increments, IncrementStream
from robins.systems.ins_gnss.log import InsGnssSteps, first_belief, steps_of
from robins.systems.ins_gnss.parameters import InsGnssReplay
from robins.systems.ins_gnss.positions import attitudes
from robins.systems.ins_gnss.recording import Log, believed_sigmas
from robins.systems.ins_gnss.rest import DISPLACEMENT_S, UsualIntervals, known_until
from robins.systems.ins_gnss.start import REST_S, StartPoint, fast_fix, find_start
from robins.systems.parts import ImuBlock
from robins.systems.replaying import imu_blocks
from robins.systems.streaming import LiveError, numbers, refuse_units

_AHEAD_S = 10.0  # most that a fix may be ahead of the newest sample
_COURSE_S = 30.0  # wait for a course before a magnetometer is used
_UNITS_S, _MOST_START_S = 1.0, 600.0  # of samples: to check their unit; kept for the start
# Row of a fix: time [s], latitude, longitude [rad], height [m], three sigmas [m], velocity [m/s],
# its sigmas [m/s], quality; NaN where missing.
WIDTH = 14
MEASURED = [1, 2, 3, 7, 8, 9]  # components of a fix that a filter uses


class InsGnssPath:
    """Converter of samples and fixes to steps of the filter (see the module).

    Attributes:
        imu: increments of the samples; the first sample is zero of the clock of the path.
        first_fix_s: s, time of the first complete fix.
        reach_s: s, lag of the steps behind the samples.
    """

    def __init__(self, parameters: InsGnssReplay, usual: UsualIntervals, delay_s: float):
        """Create a converter without samples.

        Args:
            parameters: as for a replay.
            usual: intervals of samples and fixes.
            delay_s: s, largest delay of a fix; older parts of the log are dropped.
        """
        self._parameters = p = parameters
        self.imu = IncrementStream(usual.sample_s)
        self._steps = np.zeros((0, 8))  # end [s], dt, theta, dv of each increment kept
        self._first = 0  # number of increments before these
        self.fixes = np.zeros((0, WIDTH))  # rows of `row_of`, by time
        self._field = np.zeros((0, 4))  # time [s] and field [T], until the start
        self._known, self._velocities = tuple(usual), False
        self.first_fix_s = math.inf
        self._tick, self._ask_s = 0, 0.0  # tenth of a second of the last search for a start
        self.reach_s = reach_of_rate(usual.sample_s)
        # history needed before the oldest epoch
        self._settling_samples = 2 * max(2, round(p.aids.window / usual.sample_s)) + 1  # samples
        back = max(p.gnss.velocity_window or 0.0, 1.5, 4.0 * usual.fix_s)
        settling_s = 2.0 * p.aids.window + 2.0 * usual.sample_s
        self._back_s = delay_s + 2.0 * self.reach_s + back + settling_s

    @property
    def _usual(self) -> UsualIntervals:
        return UsualIntervals(*self._known)

    def seconds(self, time_ns: int) -> float:
        """Time [s] of a stamp on the clock of the path; NaN before the first sample."""
        imu = self.imu
        return (time_ns - imu.origin_ns) * 1e-9 if len(imu.time_ns) else math.nan

    def push(self, time_ns: np.ndarray, rows: np.ndarray) -> None:
        """Add samples, as `IncrementStream.push`."""
        self._steps = np.concatenate([self._steps, self.imu.push(time_ns, rows)])

    def push_field(self, time_ns: int, field_b: np.ndarray) -> None:
        """Add a magnetometer reading (3,) [T], in body axes, for the start."""
        self._field = np.concatenate([self._field, [[self.seconds(time_ns), *field_b]]])

    def refused(self, row: np.ndarray, oldest_s: float) -> str:
        """Reason for refusing a fix; "" if it is accepted.

        Args:
            row: of `row_of`.
            oldest_s: s, oldest epoch to which the filter can return.
        """
        newest_s = self.imu.newest[0, 0] if len(self.imu.newest) else 0.0
        if math.isnan(row[0]) or row[0] <= 0.0:
            return "too_old"  # before the first sample
        if np.any(np.abs(self.fixes[:, 0] - row[0]) < 1e-9):
            return "duplicate"
        if row[0] <= oldest_s + 1e-9:
            return "too_old"
        nothing = "" if np.any(np.isfinite(row[MEASURED])) else "nan"
        return "ahead" if row[0] > newest_s + _AHEAD_S else nothing

    def push_fix(self, row: np.ndarray) -> None:
        """Add a fix, a row of `row_of`, in any order of time."""
        at = int(np.searchsorted(self.fixes[:, 0], row[0]))
        self.fixes = np.insert(self.fixes, at, row, axis=0)
        self._velocities |= bool(np.any(np.isfinite(row[7:10])))
        if np.all(np.isfinite(row[1:4])):
            self.first_fix_s = min(self.first_fix_s, float(row[0]))

    # --------------------------------------------------------------------------------- start

    def start(self) -> tuple[float, StartPoint, Belief] | None:
        """Time [s], start and belief of a replay of the log so far; None if it cannot start yet.

        Raises:
            LiveError: the samples are of another unit.
        """
        p, rows = self._parameters, self._steps
        if not len(rows):
            return None
        if rows[-1, 0] - rows[min(2, len(rows) - 1), 0] > _MOST_START_S:
            self._halve()
            rows = self._steps
        tick = int(10.0 * rows[-1, 0])
        if tick == self._tick:
            return None  # search ten times per second
        self._tick = tick
        given, waits = p.start.known_heading is not None, rows[-1, 0] - self.first_fix_s
        compass = len(self._field) > 0 and waits > _COURSE_S and rows[-1, 0] >= self._ask_s
        log = self._log(rows[-1, 0] - self.reach_s)
        if not (given or compass) and fast_fix(log, p.start)[0] is None:
            return None
        try:
            found = find_start(log, p.start, p.aids, self._usual, p.gnss)
        except ValueError:
            # not yet; a refused magnetometer is tried again after a tenth of the wait
            self._ask_s = rows[-1, 0] + 0.1 * waits if compass else 0.0
            return None
        if given and not found.sentence.startswith("levelled at rest") and waits < REST_S:
            return None
        raw = rows[2:][: max(1, round(_UNITS_S / self._usual.sample_s))]
        refuse_units(*(raw[:, k : k + 3] / raw[:, 1:2] for k in (2, 5)))
        return float(log.gnss_s[found.fix]), found, first_belief(log, found, p)

    def seek_again(self) -> None:
        """Let the next `start` search, however recent the last search was."""
        self._tick = 0

    def _halve(self) -> None:
        """Replace the older half of the increments by one with their total rotation.

        A given heading is that at the end of the first increment, so this one is kept, followed
        by the sum of those dropped.
        """
        begin, rows = len(self._steps) // 2, self._steps
        gone, end_s = rows[1:begin], rows[begin - 1, 0]
        q = attitudes(np.array([1.0, 0.0, 0.0, 0.0]), gone[:, 2:5])[-1]
        turn = SciRotation.from_quat(q, scalar_first=True).as_rotvec()
        whole = np.concatenate([[end_s, gone[:, 1].sum()], turn, gone[:, 5:].sum(axis=0)])
        self._keep(begin)
        self._steps = np.concatenate([rows[:1], whole[None], self._steps])
        self._field = self._field[self._field[:, 0] > end_s - 1.0]
        self.fixes = self.fixes[self.fixes[:, 0] > end_s]

    def _log(self, until_s: float = math.inf) -> Log:
        """Piece of a log with the increments kept, and the fixes up to a time."""
        rows, f, gnss = self._steps, self.fixes, self._parameters.gnss
        f = f[f[:, 0] <= until_s]
        table = table_of(f, self.imu.origin_ns, self._velocities)
        log = Log(
            Increments(rows[:, 1], rows[:, 2:5], rows[:, 5:8]),
            rows[:, 0],
            table,
            f[:, 0],
            believed_sigmas(table, gnss)[0],
            None,
            None,
            np.zeros(len(f), dtype=bool),
            first=self._first,
        )
        if gnss.use_velocity:  # present even without data, so that the first one compiles nothing
            stated = table_of(f, self.imu.origin_ns, velocities=True)
            log = log._replace(v_n=f[:, 7:10], sigma_v=believed_sigmas(stated, gnss)[1])
        if len(self._field):
            return log._replace(field_s=self._field[:, 0], field_b=self._field[:, 1:])
        return log

    # --------------------------------------------------------------------------------- steps

    def due(self, time_s: float, wanted_s: float) -> list[tuple[float, float]]:
        """Final epochs after a given one, as pairs (time_s, wanted_s).

        Args:
            time_s: s, of the given epoch.
            wanted_s: s, of the last fix, or the start, up to it: blocks are counted from there.
        """
        known_s = self._steps[-1, 0] - self.reach_s if len(self._steps) else -math.inf
        longest_s, fixes_s = self._parameters.update.longest_block, self.fixes[:, 0]
        if known_s <= time_s:
            return []
        return due_epochs(known_s, time_s, wanted_s, fixes_s, longest_s)

    def steps(self, begin_s: float, epochs: np.ndarray) -> InsGnssSteps:
        """Steps from an epoch to later ones (E,) [s] from `due`."""
        log = self._log()
        used = np.isin(log.gnss_s, epochs)
        return steps_of(log, used, begin_s, epochs, self._parameters, self._usual)

    def since(self, begin_s: float) -> ImuBlock:
        """Block (1, K) from an epoch to the newest sample, whose last increment is provisional."""
        rows = self._steps[self._steps[:, 0] > begin_s - 2.0 * self._usual.sample_s]
        final_s = rows[-1, 0] if len(rows) else begin_s
        newest = self.imu.newest
        rows = np.concatenate([rows, newest[newest[:, 0] > final_s]])
        inc, t, update = (
            Increments(rows[:, 1], rows[:, 2:5], rows[:, 5:8]),
            rows[:, 0],
            self._parameters.update,
        )
        return imu_blocks(inc, t, begin_s, t[-1:], update, self._usual.sample_s, 8)

    def forget(self, oldest_s: float) -> None:
        """Drop history that no step from an epoch on needs, in large pieces."""
        begin = oldest_s - self._back_s
        if self._steps[0, 0] >= begin - self._back_s:
            return
        first = int(np.searchsorted(self._steps[:, 0], begin, side="right"))
        since_s = float(self._steps[min(first + self._settling_samples, len(self._steps) - 1), 0])
        aids, usual = self._parameters.aids, self._usual
        self._known = tuple(known_until(self._log(), aids, usual, since_s))
        # a displacement across an outage starts at the last position before it
        far = self.fixes[:, 0] <= begin - DISPLACEMENT_S[-1] - 2.0 * max(1.0, usual.fix_s)
        placed = np.flatnonzero(far & np.all(np.isfinite(self.fixes[:, 1:3]), axis=1))
        self.fixes = self.fixes[placed[-1] if len(placed) else 0 :]
        self._keep(first)

    def _keep(self, begin: int) -> None:
        """Drop the increments before index `begin`."""
        self._steps, self._first = self._steps[begin:], self._first + begin


def row_of(
    time_s: float, place: Any, sigma_m: Any, v_n: Any, sigma_v: Any, quality: Any
) -> np.ndarray:
    """Row (14,) of a fix, see `WIDTH`.

    Raises:
        LiveError: a malformed vector, a velocity without sigmas, or angles beyond those in radians.
    """
    where, sigma = numbers("lat_rad, lon_rad, alt_m", place, 3), numbers("sigma_m", sigma_m, 3)
    missing = np.full(3, np.nan)
    velocity = missing if v_n is None else numbers("v_n", v_n, 3)
    if v_n is not None and sigma_v is None:
        raise LiveError("a velocity needs sigmas", "sigma_v", "give (3,) m/s")
    spread = missing if sigma_v is None else numbers("sigma_v", sigma_v, 3)
    if abs(where[0]) > np.pi / 2 or abs(where[1]) > 2.0 * np.pi:
        what = f"latitude {where[0]:.4g} and longitude {where[1]:.4g} are no radians"
        raise LiveError(what, "push_fix", "of degrees give np.radians")
    # as in a cleaned log: a component without a positive sigma is missing
    where = np.where(np.isfinite(where) & (sigma > 0.0), where, np.nan)
    velocity = np.where(np.isfinite(velocity) & (spread > 0.0), velocity, np.nan)
    sigma = np.where(sigma > 0.0, sigma, 1.0)
    spread = np.where(spread > 0.0, spread, 1.0)
    return np.array([time_s, *where, *sigma, *velocity, *spread, float(quality)])


def table_of(rows: np.ndarray, origin_ns: int, velocities: bool) -> GnssTable:
    """Table of rows (M, 14), with times relative to `origin_ns`, with or without velocities."""
    time_ns = np.round(rows[:, 0] * 1e9).astype(np.int64) + origin_ns
    v, spread = (rows[:, 7:10], rows[:, 10:13]) if velocities else (None, None)
    quality = rows[:, 13].astype(int)
    return GnssTable(time_ns, rows[:, 1], rows[:, 2], rows[:, 3], rows[:, 4:7], v, spread, quality)
