"""Live navigation: samples and fixes are processed as they arrive, each answered at once.

`LiveInsGnss` is a causal filter of a replay, by the same code, epoch by epoch. Differences from a
replay, which has the whole log:

- **Late fixes.** The state of the filter at each epoch of the last `longest_delay_s` is kept. A
  late fix is used at its own time: the filter goes back to the epoch before it and repeats the
  steps since, so that the order of arrival makes no difference; one from before the start, within
  that delay, may change the start. An older fix is refused (`gnss_too_old`), and so is a second one
  of the same time (`gnss_duplicate`); one newer than the newest sample waits.
- **A latency of 10 ms**, or 1.5 sampling intervals if longer. The turn rate at an epoch is a mean
  about it, and an increment is final only with the next sample. The filter lags by that much, and
  the answer to a sample is its state predicted to that sample; the last increment is provisional.
- **The start.** With a given heading the filter waits for rest, at most ten seconds from the first
  complete fix on. A magnetometer is used if no fix was fast enough for 30 s; a replay uses it if no
  fix of the log is. Answers before the start are `STARTING`, without numbers.
- A gap longer than `update.longest_gap` restarts the object. `outages` are ignored.
- The rates of samples and fixes, which a replay finds from the log, are given to the constructor.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial, reduce
from itertools import chain
from operator import or_
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from robins.errors import require
from robins.filters import Belief, Filter, FilterState, Model
from robins.filters.machine import usual
from robins.filters.online import WatchedStep
from robins.filters.run import Step
from robins.ins.frames import turned
from robins.systems.ins_gnss.log import ASSUMED, SMOOTHED, contender
from robins.systems.ins_gnss.parameters import InsGnssReplay
from robins.systems.ins_gnss.path import InsGnssPath, row_of
from robins.systems.ins_gnss.positions import attitudes
from robins.systems.ins_gnss.recording import axes_of
from robins.systems.ins_gnss.rest import UsualIntervals
from robins.systems.ins_gnss.robust import navigation
from robins.systems.parts import ImuBlock
from robins.systems.streaming import (
    Flag,
    Live,
    LiveError,
    MeasurementOutcome,
    numbers,
    online,
    outcomes_of,
    outliers_of,
    stamp,
    with_outcomes,
)
from robins.systems.study import Case

_PATIENCE_S = 0.1
_WIDTH = 19  # of the vector: attitude, velocity, position and nine sigmas


class Navigation(NamedTuple):
    """Answer to a sample or a fix: the state at the IMU; NaN while `STARTING`."""

    time_ns: int
    q_nb: np.ndarray  # (4,) forward-right-down to north-east-down, scalar first
    v_n: np.ndarray  # (3,) m/s
    lat_rad: float
    lon_rad: float
    alt_m: float
    sigma: np.ndarray  # (9,) attitude [rad], velocity [m/s], position [m], each NED
    flags: Flag
    # probability that each suspect of a bank is at fault, after the last fix or standstill
    wrong: Mapping[str, float] = {}
    seen: Mapping[str, MeasurementOutcome] = {}  # by sensor, in the last step of the filter


def predicted_vector(filter_: Filter, model: Model, state: FilterState, u: ImuBlock) -> jax.Array:
    """Predicted mean and standard deviations after a block, as one vector."""
    return _vector(filter_.predict(state, model.motion, u)[1].belief)


def _vector(belief: Belief) -> jax.Array:
    x = navigation(belief.mean)
    p = x.position
    place = jnp.stack([p.lat, p.lon, p.alt])
    return jnp.concatenate([x.q_nb.wxyz, x.v_n, place, belief.sigma[:9]])


def posterior_vector(step: Step) -> WatchedStep:
    """Posterior as in `predicted_vector`, then sensor outcomes and probabilities of suspects."""
    return with_outcomes(step, _vector(step.posterior))


def answer_of(
    time_ns: int,
    x: np.ndarray,
    flags: Flag,
    sensors: Sequence[str] = (),
    suspects: Sequence[str] = (),
) -> Navigation:
    """Unpack a vector of `predicted_vector` or `posterior_vector` into an answer.

    Args:
        time_ns: stamp of the answer.
        x: the vector.
        flags: of the answer.
        sensors: names of those in a vector of `posterior_vector`, in order.
        suspects: of a bank.
    """
    lat, lon, alt = x[7:10].tolist()
    seen, wrong = outcomes_of(x[_WIDTH:], sensors, suspects)
    return Navigation(time_ns, x[:4], x[4:7], lat, lon, alt, x[10:_WIDTH], flags, wrong, seen)


class LiveInsGnss(Live):
    """Live navigation state at each sample (the module lists differences from a replay).

    Attributes:
        counts: `imu_...` and `gnss_...`, refused ones by reason; `begun_anew`, `imu_gaps_declared`,
            `blocks_over_imu_gaps`, `steps_again` (blocks repeated for late fixes); `outliers_...`
            by sensor, measurements that the filter refused (`Flag.OUTLIER`).
        start: sentence on how the start was found; "" before.
        epoch: answer at the last step of the filter, with the fixes up to then; None before.
        passed: such answers of all steps made by the last sample or fix, in order.
    """

    _parameters: ClassVar[type[Any]] = InsGnssReplay
    _kept: ClassVar[tuple[str, ...]] = (
        "_past", "_counted", "_last_step", "start", "_begun_s",
    )  # fmt: skip
    _parts: ClassVar[tuple[str, ...]] = ("_gate", "_path")
    _declares_gaps = True
    _assumed = ASSUMED

    def __init__(
        self,
        parameters: InsGnssReplay,
        rate_hz: float,
        fix_rate_hz: float = 1.0,
        filter: str = "robust",
        longest_delay_s: float = 1.0,
        machine: str | None = None,
    ):
        """Create the object, and build its programs before the first sample.

        Args:
            parameters: as for a replay; the lever arm is `gnss.lever_arm`.
            rate_hz: of the samples.
            fix_rate_hz: of the receiver.
            filter: name of a causal filter of replays.
            longest_delay_s: largest delay of a fix.
            machine: machine that steps the filter, as for `OnlineFilter`; default: `usual()`.
                Programs of "vm" are kept in the user's cache; "c" needs minutes to compile once.

        Raises:
            ValueError: a rate or delay is not positive, `update.longest_gap` is too short for the
                rate, or there is no such machine or no causal filter of this name.
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
        super().__init__(parameters, longest_s, max(3, round(_PATIENCE_S * rate_hz)), **made_with)
        self._usual = UsualIntervals(1.0 / rate_hz, 1.0 / fix_rate_hz)
        self._delay_s = longest_delay_s
        asked = contender(parameters, self._usual.fix_s, filter)
        self._on = partial(online, asked.filter, asked.model, machine=made_with["machine"])
        self._case, self._suspects = asked.case, asked.filter.suspects
        orientation = parameters.imu.orientation
        self._C_bs = axes_of(orientation) if any(orientation) else None
        self.start_over()
        self._compile()

    def _restart(self) -> None:
        """Reset all but the counts and the stamps."""
        self._path = InsGnssPath(self.parameters, self._usual, self._delay_s)
        self._past: list[Any] = []  # epochs within the longest delay, as from `InsGnssPath.due`
        self._states: list[Any] = []  # states of the filter at these
        self._counted: list[Any] = []  # names counted at these
        self._last_step: Any = None  # stamp, vector and sensors of the last step
        self.start, self._begun_s, self.epoch = "", math.nan, None
        self.passed: list[Navigation] = []
        self._online = None

    def push_imu(
        self, time_ns: Any, gyro_rad_s: Any, accel_m_s2: Any, field_t: Any = None
    ) -> Navigation:
        """Process an inertial sample; return the state at its stamp.

        Args:
            time_ns: stamp, integer nanoseconds, on the same clock as those of fixes.
            gyro_rad_s: (3,) rate along the axes of the sensor; NaN if missing.
            accel_m_s2: (3,) specific force.
            field_t: (3,) T of a magnetometer, used for the start only.

        Raises:
            LiveError: a malformed stamp or vector, or values of another unit; the object continues
                with the next sample.
        """
        self.passed, time = [], stamp(time_ns)
        values = np.stack([numbers("gyro", gyro_rad_s, 3), numbers("accel", accel_m_s2, 3)])
        field = None if field_t is None else numbers("field", field_t, 3)
        if not self._accepts("imu", time, values.ravel()):
            return self._answer(time, Flag.REFUSED)
        if self._C_bs is not None:
            values = turned(self._C_bs, values)
            field = None if field is None else turned(self._C_bs, field)
        self._path.push(np.array([time]), values.reshape(1, 6))
        if field is not None and not self.start and np.all(np.isfinite(field)):
            self._path.push_field(time, field)
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
        """Process a fix, late or not; return the state at the newest sample.

        Args:
            time_ns: stamp, integer nanoseconds: time of validity plus `gnss.latency`.
            lat_rad: latitude of the antenna; NaN if missing.
            lon_rad: its longitude; NaN if missing.
            alt_m: its height above the ellipsoid; NaN if missing.
            sigma_m: (3,) m, north, east, down.
            v_n: (3,) m/s, north, east, down, or None.
            sigma_v: (3,) m/s, required with a velocity.
            quality: RTKLIB quality, 0 if unknown.

        Raises:
            LiveError: a malformed stamp or number, or angles in another unit; the object remains
                usable.
        """
        self.passed, time = [], stamp(time_ns)
        place = lat_rad, lon_rad, alt_m
        row = row_of(self._path.seconds(time), place, sigma_m, v_n, sigma_v, quality)
        oldest_s, is_first = -math.inf, False
        if self._past:
            oldest_s, is_first = self._past[0][0], self._past[0][0] == self._begun_s
        if is_first:  # this fix may change the start itself
            newest_s = self._path.seconds(int(self._path.imu.time_ns[-1]))
            oldest_s = min(oldest_s, newest_s - self._delay_s)
        if why := self._path.refused(row, oldest_s):
            self.counts[f"gnss_{why}"] += 1
        if why and not (why == "nan" and self._online is not None):  # an empty fix is an epoch
            return self._answer(int([time, *self._path.imu.time_ns][-1]), Flag.REFUSED)
        self._path.push_fix(row)
        if is_first and row[0] <= self._begun_s:
            self._go_back_to(0)
        else:
            self._go_back(float(row[0]))
        self._advance()
        return self._answer(int(self._path.imu.time_ns[-1]), Flag.REFUSED if why else Flag(0))

    def _advance(self) -> None:
        """Make all filter steps that the samples allow."""
        if self._online is None and not self._begin():
            return
        at_s, wanted_s = self._past[-1]
        if not (epochs := self._path.due(at_s, wanted_s)):
            return
        u, y, aux, _ = self._path.steps(at_s, np.array([edge_s for edge_s, _ in epochs]))
        for k, epoch in enumerate(epochs):
            self._step(epoch, *jax.tree_util.tree_map(lambda a, k=k: np.asarray(a)[k], (u, y, aux)))
        self._forget()

    def _begin(self) -> bool:
        """Start the filter once the start is known; True if it runs."""
        try:
            found = self._path.start()
        except LiveError:
            self._restart()
            raise
        if found is None:
            return False
        begin_s, start, belief = found
        self._online = self._on(self._case(Case(belief, None, {}, {}, None)).start)
        self._past, self._states = [(begin_s, begin_s)], [self._online.state]
        self._counted = [[]]
        self.start, self._begun_s = start.sentence, begin_s
        return True

    def _step(self, epoch: tuple[float, float], u: ImuBlock, y: PyTree, aux: PyTree) -> None:
        """Step the filter to an epoch, with the measurements there."""
        assert self._online is not None
        found = np.asarray(self._online.step(y, u, aux, keep=posterior_vector))
        time_ns = round(epoch[0] * 1e9) + self._path.imu.origin_ns
        self._last_step = time_ns, found, sorted(y)
        self.epoch = self._epoch()
        self.passed.append(self.epoch)
        counted = [f"outliers_{name}" for name in outliers_of(self.epoch.seen, self.epoch.wrong)]
        counted += ["blocks_over_imu_gaps"] * int(np.asarray(u.noise_scale) > 1.0)
        self.counts.update(counted)
        self._past.append(epoch)
        self._counted.append(counted)
        self._states.append(self._online.state)

    def _epoch(self) -> Navigation:
        """Answer of the last step of the filter."""
        time_ns, found, sensors = self._last_step
        answer = answer_of(time_ns, found, Flag(0), sensors, self._suspects)
        return answer._replace(
            flags=Flag.OUTLIER if outliers_of(answer.seen, answer.wrong) else Flag(0)
        )

    def _forget(self) -> None:
        """Drop states and samples older than the longest delay."""
        now = self._past[-1][0]
        first = next(k for k, e in enumerate(self._past) if e[0] >= now - self._delay_s)
        # a fix of that age starts from the epoch before it
        keep = max(first - 1, 0)
        del self._past[:keep], self._states[:keep], self._counted[:keep]
        self._path.forget(self._past[0][0])

    def _go_back(self, time_s: float) -> None:
        """Return to the last epoch that a fix at this time does not change."""
        if not self._past or time_s > self._past[-1][0] + self._path.reach_s:
            return
        longest_s, keep = self.parameters.update.longest_block, 1
        for k, (at_s, wanted_s) in enumerate(self._past):
            number, due = round((at_s - wanted_s) / longest_s), (time_s - wanted_s) / longest_s
            if at_s < time_s and (number == 0 or number < due - 1e-6):
                keep = k + 1
        self._go_back_to(keep)

    def _go_back_to(self, keep: int) -> None:
        """Return to the last of the first `keep` epochs, or to before the start if 0."""
        if keep == len(self._past):
            return
        steps = len(self._past) - max(keep, 1)
        self.counts["steps_again"] += steps
        self.counts.subtract(chain(*self._counted[keep:]))
        self.counts = +self.counts  # drop counts that fell to zero
        del self._past[keep:], self._states[keep:], self._counted[keep:]
        assert self._online is not None
        if keep:
            self._online.state = self._states[-1]
            self._online.forget(steps)
        else:
            self._online, self.start, self.epoch, self._last_step = None, "", None, None
            self._path.seek_again()

    def _answer(self, time_ns: int, mark: Flag) -> Navigation:
        if self._online is None:
            none, nan = np.full(9, np.nan), math.nan
            starting = mark | Flag.STARTING
            return Navigation(time_ns, none[:4], none[:3], nan, nan, nan, none, starting)
        u = jax.tree_util.tree_map(lambda a: a[0], self._path.since(self._past[-1][0]))
        found = self._online.look(predicted_vector, u)
        answer = answer_of(time_ns, np.asarray(found), mark)
        if self.epoch is None:
            return answer
        flags = reduce(or_, (one.flags for one in (self.epoch, *self.passed)), mark)
        return answer._replace(wrong=self.epoch.wrong, seen=self.epoch.seen, flags=flags)

    def _compile(self) -> None:
        """Compile all programs by running through a standstill, which is discarded."""
        step = round(1e9 * self._usual.sample_s)
        attitudes(np.array([1.0, 0.0, 0.0, 0.0]), np.zeros((0, 3)))
        second, ones = max(1, round(1e9 / step)), np.ones(3)
        place = InsGnssReplay.model_validate({"start": {"known_heading": 0.0}}).start
        p, self.parameters = self.parameters, self.parameters.model_copy(update={"start": place})
        C, self._C_bs = self._C_bs, None
        self._restart()
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

    def _known_states(self) -> list[PyTree]:
        return self._states

    def _resume_from(self, states: list[PyTree]) -> None:
        super()._resume_from(states)
        self._states = states
        self.epoch = None if self._last_step is None else self._epoch()
