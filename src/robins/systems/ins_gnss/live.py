"""Navigation while the vehicle moves: samples and fixes in as they come, the state out at once.

`LiveInsGnss` is a causal filter of a replay, by the same code, epoch after epoch. What a replay has
at once and a live object has not:

- **Late fixes.** The state of the filter at each epoch of the last `longest_delay_s` is kept. A fix
  whose time has passed is used at its own time: the filter goes back to the epoch before it and
  takes the samples and fixes since then again, so that the order of arrival changes nothing. An
  older one is refused (`gnss_too_old`), one of the same time as another too (`gnss_duplicate`); one
  that is newer than the newest sample waits.
- **A look ahead of 10 ms**, or one and a half samples where these are rarer. The turn rate at an
  epoch is a mean about it, and the increment before the last sample is known with the next one. So
  the filter is that much behind, and the answer to a sample is its state carried on over what came
  since, exactly what it predicts; the last increment is made of the samples so far.
- **The start.** With a given heading the filter waits for rest, at most ten seconds from the first
  whole fix on. A magnetometer is asked where for 30 s no fix was fast enough; a replay asks it
  where none of the log is. Answers before are `STARTING`, without numbers.
- A gap longer than `update.longest_gap` begins anew. `outages` are not looked at.
- Rates that a replay takes from the whole log (of samples, of fixes) are told by who makes it.
"""

from __future__ import annotations

import math
from functools import partial
from itertools import chain
from typing import Any, ClassVar, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, PyTree

from robins.dataset import ImuTable
from robins.errors import require
from robins.filters import OnlineFilter
from robins.filters.machine import usual
from robins.ins.blocks import cut, reach_of_rate, usual_width
from robins.ins.increments import Increments, from_imu
from robins.systems import replaying
from robins.systems.ins_gnss.live_answers import (
    Navigation,
    answer_of,
    kept,
    outliers_of,
    predicted,
)
from robins.systems.ins_gnss.live_fixes import TOLD, WIDTH, row_of, some, table_of
from robins.systems.ins_gnss.log import (
    SMOOTHED,
    contender,
    first_belief,
    steps_of,
)
from robins.systems.ins_gnss.parameters import InsGnssReplay
from robins.systems.ins_gnss.positions import attitudes
from robins.systems.ins_gnss.recording import Log, axes_of, believed_sigmas
from robins.systems.ins_gnss.rest import WAYS_S, UsualIntervals, known_until
from robins.systems.ins_gnss.start import REST_S, fast_fix, find_start
from robins.systems.parts import ImuBlock
from robins.systems.streaming import (
    Flag,
    Live,
    LiveError,
    TimestampGate,
    numbers,
    online,
    refuse_units,
    restored,
    stamp,
)
from robins.systems.study import Case

_PATIENCE_S, _AHEAD_S = 0.1, 10.0  # of the newest sample, by which a fix may be
_COURSE_S = 30.0  # how long a course is waited for
_UNITS_S, _MOST_START_S = 1.0, 600.0  # of samples: whose size tells their unit, for the start


class Epoch(NamedTuple):
    """The end of the block up to which the filter has come."""

    time_s: float
    wanted_s: float  # the fix, or the start, since which the blocks are counted
    number: int  # of blocks since


class LiveInsGnss(Live):
    """The state of a vehicle at each sample, at once (see the module for what differs).

    Attributes:
        counts: `imu_...` and `gnss_...`, refused by reason; `begun_anew`, `imu_gaps_declared`,
            `blocks_over_imu_gaps`, `steps_again` (blocks repeated for late fixes); `outliers_...`
            by sensor, measurements that the filter refused (`Flag.OUTLIER`).
        start: the sentence on how the start was found; "" before.
        epoch: what the filter itself said last, with the fixes up to then; None before.
        passed: the same of each epoch that the last sample or fix brought, in order.
    """

    _parameters: ClassVar[type[Any]] = InsGnssReplay
    _kept: ClassVar[tuple[str, ...]] = (
        "_origin_ns", "_raw_ns", "_raw", "_steps", "_first", "_newest", "_fixes", "_field", "_past",
        "_counted", "_last_step", "_known", "_velocities", "start", "_first_fix_s",
    )  # fmt: skip
    _parts: ClassVar[tuple[str, ...]] = ("_door",)

    def __init__(
        self,
        parameters: InsGnssReplay,
        rate_hz: float,
        fix_rate_hz: float = 1.0,
        filter: str = "robust",
        longest_delay_s: float = 1.0,
        machine: str | None = None,
    ):
        """Begin; programs are made before the first sample.

        Args:
            parameters: as of a replay; the lever arm is `gnss.lever_arm`.
            rate_hz: of the samples.
            fix_rate_hz: of the receiver.
            filter: a causal one of the replays.
            longest_delay_s: how late a fix may come.
            machine: the machine that steps the filter, as for `OnlineFilter`; default: `usual()`.
                Programs of "vm" are kept in the user's cache, "c" is compiled for minutes once.

        Raises:
            ValueError: a rate or delay is not positive, or there is no such machine or no causal
                filter of this name.
        """
        positive = {"rate_hz": rate_hz, "fix_rate_hz": fix_rate_hz}
        for what, value in {**positive, "longest_delay_s": longest_delay_s}.items():
            require(value > 0.0, f"{what} must be positive", value)
        longest_s = parameters.update.longest_gap
        what = f"update.longest_gap, {longest_s:g} s, must be 1.5 intervals of samples or more, at"
        require(rate_hz * longest_s > 1.5, f"{what} {rate_hz:g} Hz {1.5 / rate_hz:.3g} s")
        require(filter not in SMOOTHED, f"{filter} smooths: it needs the whole log")
        made_with = {"fix_rate_hz": fix_rate_hz, "filter": filter, "rate_hz": rate_hz}
        made_with |= {"longest_delay_s": longest_delay_s, "machine": machine or usual()}
        super().__init__(parameters, **made_with)
        p = parameters
        self._usual = UsualIntervals(1.0 / rate_hz, 1.0 / fix_rate_hz)
        self._reach_s = reach_of_rate(self._usual.sample_s)
        self._delay_s = longest_delay_s
        self._width = usual_width(p.update.longest_block, self._usual.sample_s)
        # what has to be looked back at from the oldest epoch
        self._settled = 2 * max(2, round(p.aids.window / self._usual.sample_s)) + 1  # samples
        back = max(p.gnss.velocity_window or 0.0, 1.5, 4.0 * self._usual.fix_s)
        settling_s = 2.0 * p.aids.window + 2.0 * self._usual.sample_s
        self._back_s = longest_delay_s + 2.0 * self._reach_s + back + settling_s
        asked = contender(p, self._usual.fix_s, filter)
        self._on = partial(online, asked.filter, asked.model, machine=made_with["machine"])
        self._case, self._suspects = asked.case, asked.filter.suspects
        self._C_bs = axes_of(p.imu.orientation) if any(p.imu.orientation) else None
        self._patience = max(3, round(_PATIENCE_S * rate_hz))
        self.start_over()
        self._compile()

    def start_over(self) -> None:
        """Be as new: without samples, fixes and counts."""
        self._door = TimestampGate(self.parameters.update.longest_gap, self._patience)
        self.counts.clear()
        self._restart()

    def _restart(self) -> None:
        """Forget all but the counts and the stamps."""
        self._origin_ns: int | None = None
        self._raw_ns: list[int] = []  # the last four samples
        self._raw: list[np.ndarray] = []
        self._steps = np.zeros((0, 8))  # end [s], dt, turn, velocity of each increment kept
        self._first = 0  # number of increments before these
        self._newest = np.zeros((0, 8))  # the last increment, as far as it is known
        self._fixes = np.zeros((0, WIDTH))  # rows of `live_fixes`, by time
        self._field = np.zeros((0, 4))  # time [s] and field [T], until the start
        self._past: list[Any] = []  # epochs of the longest delay, as plain tuples
        self._states: list[Any] = []  # of the filter at them
        self._counted: list[Any] = []  # by epoch, what was counted there
        self._last_step: Any = None  # stamp, vector and sensors of the last step
        self._known, self._velocities = tuple(self._usual), False
        self._first_fix_s = math.inf
        self.start, self.epoch = "", None
        self.passed: list[Navigation] = []
        self._online: OnlineFilter | None = None

    def push_imu(
        self, time_ns: Any, gyro_rad_s: Any, accel_m_s2: Any, field_t: Any = None
    ) -> Navigation:
        """Take an inertial sample; the state at its stamp.

        Args:
            time_ns: stamp, whole nanoseconds, of the clock that fixes have too.
            gyro_rad_s: (3,) rate along the axes of the sensor; NaN is missing.
            accel_m_s2: (3,) specific force.
            field_t: (3,) T of a magnetometer, for the start alone.

        Raises:
            LiveError: a stamp or vector of another kind, or numbers that are those of another unit;
                the object goes on with the next sample.
        """
        self.passed, time = [], stamp(time_ns)
        values = np.stack([numbers("gyro", gyro_rad_s, 3), numbers("accel", accel_m_s2, 3)])
        field = None if field_t is None else numbers("field", field_t, 3)
        why = self._door.check(time, values.ravel())
        if why == "anew":
            kind = "imu_gaps_declared" if self._raw_ns and time > self._raw_ns[-1] else "begun_anew"
            self.counts[kind] += 1
            self._restart()
        elif why:
            self.counts[f"imu_{why}"] += 1
            return self._answer(time, Flag.REFUSED)
        if self._C_bs is not None:
            values = values @ self._C_bs.T
            field = None if field is None else self._C_bs @ field
        self._origin_ns = time if self._origin_ns is None else self._origin_ns
        self._raw_ns, self._raw = [*self._raw_ns, time][-4:], [*self._raw, values.ravel()][-4:]
        if field is not None and not self.start and np.all(np.isfinite(field)):
            self._field = np.concatenate([self._field, [[self._seconds(time), *field]]])
        self._integrate()
        self._advance()
        return self._answer(time, Flag(0))

    def push_fix(
        self,
        time_ns: Any,
        lat_rad: float,
        lon_rad: float,
        alt_m: float,
        sigma_m: Any,
        v_n: Any = None,
        sigma_v: Any = None,
        quality: int = 0,
    ) -> Navigation:
        """Take a fix, late or not; the state at the newest sample.

        Args:
            time_ns: when it was true (`gnss.latency` later), whole nanoseconds.
            lat_rad: of the antenna, NaN where missing, and
            lon_rad: likewise, and
            alt_m: above the ellipsoid.
            sigma_m: (3,) m, north, east, down.
            v_n: (3,) m/s, north, east, down, or None.
            sigma_v: (3,) m/s, with a velocity.
            quality: of RTKLIB, 0 unknown.

        Raises:
            LiveError: a stamp or number of another kind, or angles that are those of another unit;
                the object goes on.
        """
        self.passed, time = [], stamp(time_ns)
        seconds = math.nan if self._origin_ns is None else self._seconds(time)
        row = row_of(seconds, (lat_rad, lon_rad, alt_m), sigma_m, v_n, sigma_v, quality)
        newest = self._newest[0, 0] if len(self._newest) else 0.0
        oldest = self._past[0][0] if self._past else -math.inf
        if why := self._refused_fix(row, oldest, newest):
            self.counts[f"gnss_{why}"] += 1
        if why and not (why == "nan" and self._online is not None):  # which is an epoch then
            return self._answer(self._raw_ns[-1] if self._raw_ns else time, Flag.REFUSED)
        at = int(np.searchsorted(self._fixes[:, 0], row[0]))
        self._fixes = np.insert(self._fixes, at, row, axis=0)
        self._velocities |= bool(np.any(np.isfinite(row[7:10])))
        if np.all(np.isfinite(row[1:4])):
            self._first_fix_s = min(self._first_fix_s, float(row[0]))
        self._go_back(float(row[0]))
        self._advance()
        return self._answer(self._raw_ns[-1], Flag.REFUSED if why else Flag(0))

    def _refused_fix(self, row: np.ndarray, oldest: float, newest: float) -> str:
        if math.isnan(row[0]) or row[0] <= 0.0:
            return "too_old"  # before the first sample
        if np.any(np.abs(self._fixes[:, 0] - row[0]) < 1e-9):
            return "duplicate"
        if row[0] <= oldest + 1e-9:
            return "too_old"
        nothing = "" if np.any(np.isfinite(row[TOLD])) else "nan"
        return "ahead" if row[0] > newest + _AHEAD_S else nothing

    def _seconds(self, time_ns: int) -> float:
        return (time_ns - (self._origin_ns or 0)) * 1e-9

    def _integrate(self) -> None:
        """The increment before the last is known with this sample; the last one nearly."""
        if len(self._raw) < 2:
            return
        rows = np.array(self._raw)
        table = ImuTable(np.array(self._raw_ns), rows[:, :3], rows[:, 3:], "rate")
        made, end_ns = from_imu(table, self._usual.sample_s)
        ends = np.array([self._seconds(int(t)) for t in end_ns])
        found = np.column_stack([ends, *(np.asarray(a, float) for a in made[:3])])
        # of four samples the middle increment, and at the beginning the first one, are final
        if len(rows) == 4:
            final = found[1:2] if len(self._steps) else found[:2]
            self._steps = np.concatenate([self._steps, final])
        self._newest = found[-1:]

    def _keep(self, begin: int) -> None:
        """Drop increments before a row."""
        self._steps, self._first = self._steps[begin:], self._first + begin

    def _log(self) -> Log:
        """Increments and all fixes as a piece of a log."""
        rows = self._steps
        f = self._fixes
        table = table_of(f, self._origin_ns or 0, self._velocities)
        gnss = self.parameters.gnss
        sigma_m, _ = believed_sigmas(table, gnss)
        log = Log(
            Increments(rows[:, 1], rows[:, 2:5], rows[:, 5:8]),
            rows[:, 0],
            table,
            f[:, 0],
            sigma_m,
            None,
            None,
            np.zeros(len(f), dtype=bool),
        )
        log = log._replace(first=self._first)
        if gnss.use_velocity:  # there or not, so that nothing is compiled when the first one comes
            fix_table = table_of(f, self._origin_ns or 0, velocities=True)
            log = log._replace(v_n=f[:, 7:10], sigma_v=believed_sigmas(fix_table, gnss)[1])
        if len(self._field):
            return log._replace(field_s=self._field[:, 0], field_b=self._field[:, 1:])
        return log

    def _advance(self) -> None:
        """Take all steps that can be taken."""
        if self._online is None:
            self._seek()
        while self._online is not None:
            at = Epoch(*self._past[-1])
            longest_s, number = self.parameters.update.longest_block, at.number + 1
            edge = at.wanted_s + longest_s * number
            later = self._fixes[self._fixes[:, 0] > at.time_s, 0]
            wanted = len(later) > 0 and (later[0] - at.wanted_s) / longest_s - 1e-6 <= number
            edge = float(later[0]) if wanted else edge
            if not len(self._steps) or self._steps[-1, 0] < edge + self._reach_s:
                return
            self._step(Epoch(edge, edge, 0) if wanted else Epoch(edge, at.wanted_s, number))

    def _seek(self) -> None:
        """Find the start where a replay of the log so far would, and begin."""
        p, rows = self.parameters, self._steps
        if not len(rows):
            return
        if rows[-1, 0] - rows[0, 0] > _MOST_START_S:
            self._keep(len(rows) // 2)
            rows = self._steps
            self._field = self._field[self._field[:, 0] > rows[0, 0] - 1.0]
            self._fixes = self._fixes[self._fixes[:, 0] > rows[0, 0]]
        if int(10.0 * rows[-1, 0]) == int(10.0 * (rows[-1, 0] - rows[-1, 1])):
            return  # ten times a second are enough
        given, waits = p.start.known_heading is not None, rows[-1, 0] - self._first_fix_s
        compass = len(self._field) > 0 and waits > _COURSE_S
        log = self._log()
        within = self._fixes[:, 0] <= rows[-1, 0] - self._reach_s
        log = log._replace(
            gnss=some(log.gnss, within),
            **{
                name: None if (a := getattr(log, name)) is None else a[within]
                for name in ("gnss_s", "sigma_m", "v_n", "sigma_v", "withheld")
            },
        )
        if not (given or compass) and fast_fix(log, p.start)[0] is None:
            return
        try:
            found = find_start(log, p.start, p.aids, self._usual, p.gnss)
        except ValueError:
            return  # not yet
        rested = found.sentence.startswith("levelled at rest")
        if given and not rested and waits < REST_S:
            return
        begin_s = float(log.gnss_s[found.fix])
        raw = rows[rows[:, 0] <= rows[0, 0] + _UNITS_S]
        try:
            refuse_units(*(raw[:, k : k + 3] / raw[:, 1:2] for k in (2, 5)))
        except LiveError:
            self._restart()
            raise
        belief = self._case(Case(first_belief(log, found, p), None, {}, {}, None)).start
        self._online = self._on(belief)
        self._past, self._states = [tuple(Epoch(begin_s, begin_s, 0))], [self._online.state]
        self._counted = [[]]
        self.start = found.sentence

    def _step(self, to: Epoch) -> None:
        """One step of the filter, to an epoch, with what was measured there."""
        assert self._online is not None
        at, log = Epoch(*self._past[-1]), self._log()
        used = np.abs(log.gnss_s - to.time_s) < 1e-9
        usual = UsualIntervals(*self._known)
        steps = steps_of(log, used, at.time_s, np.array([to.time_s]), self.parameters, usual)
        u, y, aux = jax.tree_util.tree_map(lambda a: np.asarray(a)[0], tuple(steps[:3]))
        found = np.asarray(self._online.step(y, u, aux, keep=kept))
        time_ns = round(to.time_s * 1e9) + (self._origin_ns or 0)
        self._last_step = time_ns, found, sorted(y)
        self.epoch = self._epoch()
        self.passed.append(self.epoch)
        counted = [f"outliers_{name}" for name in outliers_of(self.epoch)]
        counted += ["blocks_over_imu_gaps"] * int(np.asarray(u.noise_scale) > 1.0)
        self.counts.update(counted)
        self._past.append(tuple(to))
        self._counted.append(counted)
        self._states.append(self._online.state)
        self._forget()

    def _epoch(self) -> Navigation:
        """Answer of the last step of the filter."""
        time_ns, found, sensors = self._last_step
        answer = answer_of(time_ns, found, Flag(0), sensors, self._suspects)
        return answer._replace(flags=Flag.OUTLIER if outliers_of(answer) else Flag(0))

    def _forget(self) -> None:
        """Drop what is older than the longest delay, in large pieces."""
        now = self._past[-1][0]
        first = next(k for k, e in enumerate(self._past) if e[0] >= now - self._delay_s)
        # one epoch before it is where a fix of that age is counted from
        keep = max(first - 1, 0)
        del self._past[:keep], self._states[:keep], self._counted[:keep]
        begin = self._past[0][0] - self._back_s
        if self._steps[0, 0] < begin - self._back_s:
            first = int(np.searchsorted(self._steps[:, 0], begin, side="right"))
            settled = min(first + self._settled, len(self._steps) - 1)
            since_s, usual = float(self._steps[settled, 0]), UsualIntervals(*self._known)
            self._known = tuple(known_until(self._log(), self.parameters.aids, usual, since_s))
            # a way over an outage begins at the last place before it
            far = self._fixes[:, 0] <= begin - WAYS_S[-1] - 2.0 * max(1.0, self._usual.fix_s)
            placed = np.flatnonzero(far & np.all(np.isfinite(self._fixes[:, 1:3]), axis=1))
            self._fixes = self._fixes[placed[-1] if len(placed) else 0 :]
            self._keep(first)

    def _go_back(self, time_s: float) -> None:
        """Return to the last epoch before a fix was known."""
        if not self._past or time_s > self._past[-1][0] + self._reach_s:
            return
        longest_s, keep = self.parameters.update.longest_block, 1
        for k, row in enumerate(self._past):
            at = Epoch(*row)
            due = (time_s - at.wanted_s) / longest_s - 1e-6
            if at.time_s < time_s and (at.number == 0 or at.number < due):
                keep = k + 1
        if keep < len(self._past):
            self.counts["steps_again"] += len(self._past) - keep
            self.counts.subtract(chain(*self._counted[keep:]))
            self.counts = +self.counts  # without what was counted in these alone
            del self._past[keep:], self._states[keep:], self._counted[keep:]
            assert self._online is not None
            self._online.state = self._states[-1]

    def _answer(self, time_ns: int, mark: Flag) -> Navigation:
        if self._online is None or not len(self._newest):
            none, nan = np.full(9, np.nan), math.nan
            starting = mark | Flag.STARTING
            return Navigation(time_ns, none[:4], none[:3], nan, nan, nan, none, starting)
        at = Epoch(*self._past[-1])
        rows = self._steps[self._steps[:, 0] > at.time_s - 2.0 * self._usual.sample_s]
        final_s = rows[-1, 0] if len(rows) else at.time_s
        last = self._newest[self._newest[:, 0] > final_s]
        rows = np.concatenate([rows, last])
        end_s = float(rows[-1, 0])
        inc = Increments(rows[:, 1], rows[:, 2:5], rows[:, 5:8])
        blocks = cut(inc, rows[:, 0], at.time_s, np.array([end_s]), least=self._width + 8)
        scale = replaying.noise_scale(
            blocks, rows[:, 1], self.parameters.update.gap_noise, self._usual.sample_s
        )
        u = jax.tree_util.tree_map(lambda a: a[0], ImuBlock(blocks.increments, scale))
        found = self._online.look(predicted, u)
        answer = answer_of(time_ns, np.asarray(found), mark)
        if self.epoch is None:
            return answer
        flags = mark | self.epoch.flags
        return answer._replace(wrong=self.epoch.wrong, seen=self.epoch.seen, flags=flags)

    def _compile(self) -> None:
        """Have all compiled by a standstill that is thrown away."""
        step = round(1e9 * self._usual.sample_s)
        attitudes(np.array([1.0, 0.0, 0.0, 0.0]), np.zeros((0, 3)))
        second, ones = max(1, round(1e9 / step)), np.ones(3)
        place = InsGnssReplay.model_validate({"start": {"known_heading": 0.0}}).start
        p, self.parameters = self.parameters, self.parameters.model_copy(update={"start": place})
        C, self._C_bs = self._C_bs, None
        last = math.ceil((3.0 + 2.0 * p.aids.window + p.update.longest_block) * 1e9 / step)
        try:
            for k in range(10 * last):
                if k and k % second == 0:
                    self.push_fix((k - 1) * step, 0.7, 0.1, 100.0, ones, 0.0 * ones, ones)
                self.push_imu(k * step, np.zeros(3), np.array([0.0, 0.0, -9.8]))
                if k >= last and self.epoch is not None:
                    break
        finally:
            self.parameters, self._C_bs = p, C
            self._compiled_state = None if self._online is None else self._online.state
            self.start_over()

    def _state_now(self) -> PyTree:
        return None if self._online is None else self._states

    def _go_on_from(self, state: list[Array]) -> None:
        count = len(self._past)
        each = len(state) // count
        like = self._compiled_state
        self._states = [restored(like, state[k * each : (k + 1) * each]) for k in range(count)]
        self._online = self._on(self._states[-1])
        self.epoch = None if self._last_step is None else self._epoch()
