"""Live transfer alignment: samples of the slave and records of the master as they come.

`LiveAlignment` is a filter of a replay, by the same steps. Differences from a replay:

- **Late records.** The filter lags the samples by 10 ms, or by a sampling interval if that is
  longer, less the delay of the records. A record whose stamp the filter has passed is used at the
  state of now, with the slave's increments since it was valid (`RecordDelay`), as a replay uses a
  delay that is stated; one older than `longest_delay_s` is refused.
- **Blocks.** Between records a step is made each `recording.longest_block` at the latest.
- A gap longer than `recording.longest_gap` aligns the slave again, from the next complete record.
- The rate of the samples, which a replay finds from the log, is given to the constructor.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike, PyTree

from robins.errors import require
from robins.filters import Belief, Filter, FilterState, Model
from robins.filters.machine import usual
from robins.filters.online import WatchedStep
from robins.filters.run import Step
from robins.ins.mechanise import POLAR_LAT_RAD
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
    refuse_units,
    stamp,
    with_outcomes,
)
from robins.systems.transfer_alignment.product.log import contender
from robins.systems.transfer_alignment.product.model import RECORDS
from robins.systems.transfer_alignment.product.parameters import PairReplay
from robins.systems.transfer_alignment.product.path import WIDTH, PairPath, PairSteps
from robins.systems.transfer_alignment.product.world import PairRun

_PATIENCE_S, _UNITS_S, _AHEAD_S = 0.1, 1.0, 10.0
_UNIT = 1e-3  # largest departure of the norm of a quaternion from one
_STATES = 18  # components of the error without flexure
_WIDTH = 19 + _STATES  # of the vector: the estimate and its sigmas


class SlaveAlignment(NamedTuple):
    """Answer to a sample or a record: the slave at the newest sample; NaN while `STARTING`."""

    time_ns: int
    q_nb: np.ndarray  # (4,) slave's forward-right-down to north-east-down, scalar first
    v_n: np.ndarray  # (3,) m/s
    lat_rad: float
    lon_rad: float
    alt_m: float
    gyro_bias: np.ndarray  # (3,) rad/s, slave axes
    accel_bias: np.ndarray  # (3,) m/s^2
    mounting_rad: np.ndarray  # (3,) mounting error
    # (18,) attitude [rad], velocity [m/s], position [m], each NED, gyro bias, accelerometer bias,
    # mounting
    sigma: np.ndarray
    flags: Flag
    wrong: Mapping[str, float] = {}  # probability that each suspect of a bank is at fault
    seen: Mapping[str, MeasurementOutcome] = {}  # by sensor, in the last step of the filter


def predicted_vector(filter_: Filter, model: Model, state: FilterState, u: ImuBlock) -> jax.Array:
    """Predicted estimate and standard deviations after a block, as one vector."""
    return _vector(filter_.predict(state, model.motion, u)[1].belief)


def posterior_vector(step: Step) -> WatchedStep:
    """Posterior as in `predicted_vector`, then sensor outcomes and probabilities of suspects."""
    return with_outcomes(step, _vector(step.posterior))


def _vector(belief: Belief) -> jax.Array:
    ins, p = belief.mean.ins, belief.mean.ins.position
    place = jnp.stack([p.lat, p.lon, p.alt])
    parts = ins.q_nb.wxyz, ins.v_n, place, ins.gyro_bias, ins.accel_bias
    return jnp.concatenate([*parts, belief.mean.mounting_rad, belief.sigma[:_STATES]])


def answer_of(time_ns: int, x: np.ndarray, flags: Flag) -> SlaveAlignment:
    """Unpack a vector of `predicted_vector` or `posterior_vector` into an answer."""
    lat, lon, alt = x[7:10].tolist()
    biases = x[10:13], x[13:16], x[16:19]
    return SlaveAlignment(time_ns, x[:4], x[4:7], lat, lon, alt, *biases, x[19:_WIDTH], flags)


class LiveAlignment(Live):
    """Alignment of a slave at each sample (the module lists differences from a replay).

    Attributes:
        counts: `imu_...` and `master_...`, refused ones by reason; `begun_anew`,
            `imu_gaps_declared`, `blocks_over_imu_gaps`; `records_late`, used after their time;
            `outliers_...` by sensor, measurements that the filter refused (`Flag.OUTLIER`).
        epoch: answer at the last step of the filter; None before the first.
        passed: such answers of all steps made by the last sample or record, in order.
    """

    _parameters: ClassVar[type[PairReplay]] = PairReplay
    _kept: ClassVar[tuple[str, ...]] = ("_last_step", "_at", "_checked")
    _parts: ClassVar[tuple[str, ...]] = ("_gate", "_path")
    _declares_gaps = True

    def __init__(
        self,
        parameters: PairReplay,
        rate_hz: float,
        filter: str = "product",
        longest_delay_s: float = 1.0,
        machine: str | None = None,
    ):
        """Create the object, and build its programs before the first sample.

        Args:
            parameters: as for a replay: noise, mounting, lever arm, delay of the records.
            rate_hz: of the slave's samples.
            filter: name of a filter of replays.
            longest_delay_s: oldest record that is used, in addition to `master.delay`.
            machine: machine that steps the filter, as for `OnlineFilter`; default: `usual()`.

        Raises:
            ValueError: a rate or delay is not positive, `recording.longest_gap` is too short for
                the rate, or there is no such machine or filter.
        """
        for what, value in {"rate_hz": rate_hz, "longest_delay_s": longest_delay_s}.items():
            require(value > 0.0, f"{what} must be positive", value)
        longest_s = parameters.recording.longest_gap
        what = f"recording.longest_gap, {longest_s:g} s, must be 1.5 sampling intervals or more, at"
        require(rate_hz * longest_s > 1.5, f"{what} {rate_hz:g} Hz {1.5 / rate_hz:.3g} s")
        made_with = {"rate_hz": rate_hz, "filter": filter, "longest_delay_s": longest_delay_s}
        patience = max(3, round(_PATIENCE_S * rate_hz))
        super().__init__(parameters, longest_s, patience, **made_with, machine=machine or usual())
        asked = contender(parameters, filter)
        self._on = partial(online, asked.filter, asked.model, machine=machine or usual())
        self._case, self._suspects = asked.case, asked.filter.suspects
        self._matched, self._usual_s = sorted(asked.model.dims), 1.0 / rate_hz
        self.start_over()
        self._compile()

    def _restart(self) -> None:
        """Reset all but the counts and the stamps."""
        self._path = PairPath(self.parameters, self._usual_s)
        self._at = math.nan, math.nan  # last epoch, and last record or the start [s]
        self._checked = False  # units of the samples
        self._last_step: tuple[int, np.ndarray] | None = None
        self._online, self.epoch = None, None
        self.passed: list[SlaveAlignment] = []

    def push_imu(
        self, time_ns: int | np.integer, gyro_rad_s: ArrayLike, accel_m_s2: ArrayLike
    ) -> SlaveAlignment:
        """Process a sample of the slave; return its state at the stamp.

        Args:
            time_ns: stamp, integer nanoseconds, on the clock of the records.
            gyro_rad_s: (3,) rate along the slave's forward, right and down; NaN if missing.
            accel_m_s2: (3,) specific force.

        Raises:
            LiveError: a malformed stamp or vector, or values of another unit; the object continues
                with the next sample.
        """
        self.passed, time = [], stamp(time_ns)
        values = np.concatenate([numbers("gyro", gyro_rad_s, 3), numbers("accel", accel_m_s2, 3)])
        if not self._accepts("imu", time, values):
            return self._answer(time, Flag.REFUSED)
        self._path.push(self._path.imu.push(np.array([time]), values[None]))
        self._advance()
        return self._answer(time, Flag(0))

    def push_record(
        self,
        time_ns: int | np.integer,
        lat_rad: float,
        lon_rad: float,
        alt_m: float,
        v_n: ArrayLike,
        q_nb: ArrayLike,
        omega_ib_b: ArrayLike | None = None,
    ) -> SlaveAlignment:
        """Process a record of the master, late or not; return the slave at the newest sample.

        Args:
            time_ns: stamp, integer nanoseconds: time of validity plus `master.delay`.
            lat_rad: latitude of the master; NaN if missing, as in all that follow.
            lon_rad: longitude.
            alt_m: height above the ellipsoid.
            v_n: (3,) m/s, north, east, down.
            q_nb: (4,) attitude, forward-right-down to north-east-down, scalar first.
            omega_ib_b: (3,) rad/s, angular rate along the master's axes; None: the slave's gyros
                stand in for it.

        Raises:
            LiveError: a malformed stamp or vector, angles in another unit, or a quaternion that is
                not of unit norm; the object remains usable.
        """
        self.passed, time = [], stamp(time_ns)
        nav = _checked_record((lat_rad, lon_rad, alt_m), v_n, q_nb)
        rate = np.full(3, np.nan) if omega_ib_b is None else numbers("omega_ib_b", omega_ib_b, 3)
        seconds = (time - self._path.imu.origin_ns) * 1e-9
        row = np.concatenate([[seconds], nav, rate])
        newest_ns = int([time, *self._path.imu.time_ns][-1])
        if why := self._refused(row):
            self.counts[f"master_{why}"] += 1
            return self._answer(newest_ns, Flag.REFUSED)
        self._path.push_records(row[None])
        if self._online is not None and seconds <= self._at[0]:
            self.counts["records_late"] += 1
            self._step(self._at, self._path.late(row, self._at[0]), 0)
        self._advance()
        return self._answer(newest_ns, Flag(0))

    def _refused(self, row: np.ndarray) -> str:
        """Reason for refusing a record; "" if it is accepted."""
        path, newest = self._path, self._path.imu.newest
        if not np.any(np.isfinite(row[1:11])):
            return "nan"
        if not len(path.imu.time_ns) or row[0] - self.parameters.master.delay < 0.0:
            return "too_old"  # valid before the first sample
        oldest_s = self._at[0] - self._made_with["longest_delay_s"]
        if row[0] <= (oldest_s if self._online is not None else -math.inf):
            return "too_old"
        if np.any(np.abs(path.records[:, 0] - row[0]) < 1e-9):
            return "duplicate"
        newest_s = float(newest[0, 0]) if len(newest) else 0.0
        return "ahead" if row[0] > newest_s + _AHEAD_S else ""

    def _advance(self) -> None:
        """Make all filter steps that the samples allow."""
        if self._online is None and not self._begin():
            return
        due = self._path.due(*self._at)
        if not due:
            return
        steps = self._path.steps(self._at[0], np.array([edge_s for edge_s, _ in due]))
        for k, epoch in enumerate(due):
            self._step(epoch, steps, k)
        self._path.forget(self._at[0] - self._made_with["longest_delay_s"])

    def _begin(self) -> bool:
        """Start the filter from the first complete record; True if it runs."""
        path = self._path
        if not self._checked and path.known_s < _UNITS_S:
            return False
        if not self._checked:
            self._check_units()
        if (found := path.start()) is None:
            path.forget(path.known_s - self._made_with["longest_delay_s"])
            return False
        begin_s, start = found
        none = np.array([begin_s + self.parameters.master.delay, *np.full(WIDTH - 1, np.nan)])
        block, master, lag = path.late(none, begin_s)
        world = PairRun(*block, start, np.zeros(9), master, lag.omega_m, None, lag)
        self._online = self._on(self._case(jax.tree.map(jnp.asarray, world)).start)
        self._at = begin_s, begin_s
        return True

    def _check_units(self) -> None:
        """Refuse samples of another unit.

        Raises:
            LiveError: the samples show it.
        """
        dt, theta, dv, _ = self._path.increments
        try:
            refuse_units(theta / dt[:, None], dv / dt[:, None])
        except LiveError:
            self._restart()
            raise
        self._checked = True

    def _step(self, epoch: tuple[float, float], steps: PairSteps, k: int) -> None:
        """Step the filter to an epoch, the k-th of some steps."""
        assert self._online is not None
        block, master, lag = jax.tree.map(lambda a: np.asarray(a)[k], steps)
        y = {name: getattr(master, RECORDS[name].field) for name in self._matched}
        found = self._online.step(
            y, block, dict.fromkeys(self._matched, lag), keep=posterior_vector
        )
        self._last_step = round(epoch[0] * 1e9) + self._path.imu.origin_ns, np.asarray(found)
        self._at, self.epoch = epoch, self._epoch()
        self.passed.append(self.epoch)
        refused = outliers_of(self.epoch.seen, self.epoch.wrong)
        self.counts.update(f"outliers_{name}" for name in refused)
        self.counts.update(["blocks_over_imu_gaps"] * int(block.noise_scale > 1.0))

    def _epoch(self) -> SlaveAlignment:
        """Answer of the last step of the filter."""
        assert self._last_step is not None
        time_ns, found = self._last_step
        seen, wrong = outcomes_of(found[_WIDTH:], self._matched, self._suspects)
        flags = Flag.OUTLIER if outliers_of(seen, wrong) else Flag(0)
        return answer_of(time_ns, found, flags)._replace(wrong=wrong, seen=seen)

    def _answer(self, time_ns: int, mark: Flag) -> SlaveAlignment:
        if self._online is None:
            return answer_of(time_ns, np.full(_WIDTH, np.nan), mark | Flag.STARTING)
        u = jax.tree.map(lambda a: np.asarray(a)[0], self._path.since(self._at[0]))
        found = self._online.look(predicted_vector, u)
        answer = answer_of(time_ns, np.asarray(found), mark)
        if self.epoch is None:
            return answer
        flags = mark | self.epoch.flags
        for one in self.passed:
            flags |= one.flags
        return answer._replace(wrong=self.epoch.wrong, seen=self.epoch.seen, flags=flags)

    def _compile(self) -> None:
        """Compile all programs by running through a standstill, which is discarded."""
        step_ns, still = round(1e9 * self._usual_s), np.array([0.0, 0.0, -9.8])
        q_nb, none = np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(3)
        delay_ns = round(1e9 * self.parameters.master.delay)
        for k in range(4 + math.ceil((1.5 * _UNITS_S * 1e9 + delay_ns) / step_ns)):
            self.push_imu(k * step_ns, none, still)
            if k == 2 + delay_ns // step_ns:
                self.push_record(k * step_ns, 0.7, 0.1, 100.0, none, q_nb)
        self._compiled_state = None if self._online is None else self._online.state
        self.start_over()

    def _resume_from(self, states: list[PyTree]) -> None:
        super()._resume_from(states)
        self.epoch = None if self._last_step is None else self._epoch()


def _checked_record(
    place: tuple[float, float, float], v_n: ArrayLike, q_nb: ArrayLike
) -> np.ndarray:
    """Navigation state (10,) of a record: attitude, velocity, latitude, longitude, height.

    Raises:
        LiveError: a malformed vector, angles beyond those in radians, a latitude near a pole, or a
            quaternion that is not of unit norm.
    """
    where, v = numbers("lat_rad, lon_rad, alt_m", place, 3), numbers("v_n", v_n, 3)
    q = numbers("q_nb", q_nb, 4)
    if abs(where[0]) > np.pi / 2 or abs(where[1]) > 2.0 * np.pi:
        what = f"latitude {where[0]:.4g} and longitude {where[1]:.4g} are no radians"
        raise LiveError(what, "push_record", "of degrees give np.radians")
    if abs(where[0]) > POLAR_LAT_RAD:
        what = f"latitude {np.degrees(where[0]):.2f} deg: north is not defined at a pole"
        raise LiveError(what, "lat_rad", "stay 0.1 deg away from the poles")
    size = float(np.linalg.norm(q))
    if abs(size - 1.0) > _UNIT:
        what = f"has the norm {size:.4g}, not one"
        raise LiveError(what, "q_nb", "give a unit quaternion, scalar first")
    return np.concatenate([q / size, v, where])
