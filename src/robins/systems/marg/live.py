"""Live orientation: each sample is answered at once with the attitude at its stamp.

`LiveMarg` is the filter "marg" of a replay: both take their samples through `marg.path`, here in
chunks of one sample. Its latencies show in the flags of an answer:

- `STARTING`, without numbers: the start is not known. Samples are kept, and the filter then takes
  two blocks per sample until it has caught up. From there on the answers are those of the replay.
- `BEHIND`: a block waits for the far flank of a clipped gyro peak, or for the stamp after a long
  interval; until then the attitude is propagated by the gyros as they read.

Differences from a replay of the whole log:

- The ends of the ranges of gyros are found from the samples so far, unless `gyro.range` states
  them.
- A gap of more than ten seconds, or a clock that was set, causes a new start; a replay bridges it.
- `DOUBTFUL` is set once the monitor detects a contradiction. A replay also marks the measurements
  that led to it.
- True north is given to the object (`declination_rad`); a replay takes it from the fixes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from robins.errors import require
from robins.filters import Code
from robins.filters.kalman import WRONG
from robins.filters.machine import usual
from robins.filters.online import WatchedStep
from robins.filters.run import Step
from robins.linalg.scalars import product
from robins.systems.marg import model, monitor
from robins.systems.marg.filters import filter_of
from robins.systems.marg.log import earth_field
from robins.systems.marg.parameters import MargReplay
from robins.systems.marg.path import MargSteps, SamplePath
from robins.systems.marg.replay import stated_sigma
from robins.systems.replaying import kept_step
from robins.systems.streaming import (
    Flag,
    Live,
    LiveError,
    numbers,
    online,
    refuse_field_unit,
    refuse_units,
    stamp,
)
from robins.systems.tables import SensorUpdates

_STEPS = 2  # most filter steps per sample, while it catches up
_LONGEST_GAP_S, _PATIENCE_S = 10.0, 0.1
_FAR = 10  # implausible fields in a row after which their unit is checked
_MONITORED_S = 60.0  # window of the monitor


class Attitude(NamedTuple):
    """Attitude at the stamp of a sample."""

    time_ns: int
    q_nb: np.ndarray  # (4,) body to NED, scalar first; NaN while `STARTING`
    sigma_rad: np.ndarray  # (3,) about north, east, down, at the last step of the filter
    flags: Flag


class _Step(NamedTuple):
    """Results of a filter step that the live object reads."""

    q_nb: np.ndarray  # (4,)
    gyro_bias: np.ndarray  # (3,)
    gyro_gain: np.ndarray  # (9,)
    declination: np.ndarray  # (1,)
    sigma: np.ndarray  # (DIM,)
    code: np.ndarray  # (1,) of the prediction
    bare: np.ndarray  # (1,) 1 if the gyros are taken for those of an uncalibrated chip
    travel: np.ndarray  # (8,) innovation, degrees of freedom, code
    magnetometer: np.ndarray  # (2,) degrees of freedom, code; 0, `MISSING` if there is none


_SIZES = np.cumsum([4, 3, 9, 1, model.DIM, 1, 1, 8])


def _kept(step: Step) -> WatchedStep:
    """A `_Step` as one vector."""
    mean, sigma, seen = kept_step(step)
    parts = [mean.q_nb.wxyz, mean.gyro_bias, mean.gyro_gain.reshape(9), mean.declination[None]]
    parts += [sigma, step.prediction.code[None]]
    travel = seen[model.TRAVEL]
    parts += [travel.notes[WRONG], travel.innovation]
    for name in (model.TRAVEL, model.MAGNETOMETER):
        update = seen.get(name)
        code = [0.0, int(Code.MISSING)] if update is None else [update.dof, update.code]
        parts.append(jnp.stack([jnp.asarray(x, float) for x in code]))
    return WatchedStep.of(step, jnp.concatenate([jnp.asarray(part, float) for part in parts]))


class LiveMarg(Live):
    """Live attitude at each sample (the module lists differences from a replay).

    Attributes:
        counts: `imu_nan`, `imu_inf`, `imu_absurd`, `imu_duplicate`, `imu_backward`, `imu_ahead`
            (refused), `begun_anew`, `field_missing`, `field_implausible`, `imu_saturated`,
            `imu_bridged`, `imu_frozen`, `imu_gaps`, `blocks_in_free_fall`, `steps_not_taken`.
    """

    _parameters: ClassVar[type[MargReplay]] = MargReplay
    _kept: ClassVar[tuple[str, ...]] = (
        "_field", "_far", "_pending", "_looks", "_since", "_q", "_sigma", "_bias", "_gain",
        "_marks", "_starting", "_open",
    )  # fmt: skip
    _parts: ClassVar[tuple[str, ...]] = ("_gate", "_path")
    _assumed = tuple(model.SENSORS)

    def __init__(
        self,
        parameters: MargReplay,
        rate_hz: float,
        declination_rad: float = 0.0,
        machine: str | None = None,
    ):
        """Create the object, and build its programs before the first sample.

        Args:
            parameters: as for a replay.
            rate_hz: nominal sampling rate, by which lost samples are detected.
            declination_rad: of the Earth's field here, clockwise from true north.
            machine: machine that steps the filter, as for `OnlineFilter`; default: `usual()`.
                Programs of "vm" are kept in the user's cache; "c" needs minutes to compile once.

        Raises:
            ValueError: the rate is not positive, or there is no such machine.
        """
        require(rate_hz > 0.0, "rate_hz must be positive", rate_hz)
        machine = machine or usual()
        made_with = {"rate_hz": rate_hz, "declination_rad": declination_rad, "machine": machine}
        patience = max(3, round(_PATIENCE_S * rate_hz))
        super().__init__(parameters, _LONGEST_GAP_S, patience, **made_with)
        p, self._usual_s = parameters, 1.0 / rate_hz
        half = 0.5 * declination_rad
        self._turn_north = (math.cos(half), 0.0, 0.0, math.sin(half))
        self._on = partial(online, filter_of(p), model.model_of(p), machine=machine)
        self.start_over()
        self._compile()

    def _restart(self) -> None:
        """Reset all but the counts and the stamps."""
        self._field = np.full(3, np.nan)  # reading not yet used, as its sample was refused
        self._far: list[float] = []  # sizes of implausible readings in a row
        self._pending: list[Any] = []  # (leaves, still) of each waiting step
        self._looks = np.zeros((0, 8))  # rows of the monitor's window
        self._since: list[Any] = []  # (dt, turn) of the samples after the last step
        self._q = (math.nan,) * 4
        self._sigma, self._bias, self._gain = np.full(3, np.nan), np.zeros(3), np.zeros((3, 3))
        self._marks = 0  # flags of the last block, valid until the next
        self._starting = True  # until the filter has caught up with the newest sample
        self._open = 0  # samples not in a block, up to the last with a gyro at the end of its range
        self._online = None
        self._path = SamplePath(self.parameters, self._usual_s)
        self._path.counts = self.counts

    def _compile(self) -> None:
        """Compile all programs by running a few blocks, which are discarded."""
        count = 2 + math.ceil(self.parameters.start.still / self._usual_s) + 2 * self._path.n
        gravity = self.parameters.accelerometer.gravity
        rows = np.tile([0.0, 0.0, 0.0, 0.0, 0.0, -gravity, 2e-5, 2e-5, 2e-5], (count, 1))
        time_ns = (np.arange(count) * 1e9 * self._usual_s).astype(np.int64)
        self._wait(self._path.push(time_ns, rows))
        found = self._path.start(is_complete=True)
        assert found is not None
        self._online = self._on(found[1])
        self._compiled_state = self._online.state
        self._step()
        self.start_over()

    # ------------------------------------------------------------------------------ a sample

    def push(self, time_ns: Any, gyro_rad_s: Any, accel_m_s2: Any, field_t: Any = None) -> Attitude:
        """Process a sample; return the attitude at its stamp.

        Args:
            time_ns: stamp, integer nanoseconds of any clock.
            gyro_rad_s: (3,) rate in body axes, forward-right-down; NaN if missing.
            accel_m_s2: (3,) specific force, in the same axes.
            field_t: (3,) T, magnetometer in the same axes; None if not read since the last sample.

        Raises:
            LiveError: a malformed stamp or vector, or values of another unit; the object continues
                with the next sample.
        """
        time = stamp(time_ns)
        gyro, accel = numbers("gyro", gyro_rad_s, 3), numbers("accel", accel_m_s2, 3)
        self._read_field(field_t)
        values = np.concatenate([gyro, accel])
        if not self._accepts("imu", time, values):
            return self._answer(time, Flag.REFUSED)
        row = np.concatenate([values, self._field])
        self._field = np.full(3, np.nan)
        before = self._path.waiting
        steps = self._path.push(np.array([time]), row[None])
        self._wait(steps)
        mark = self._saturated(gyro, accel, before)
        self._open = max(0, self._open - self._path.n * sum(len(s.still) for s in steps))
        if len(self._path.rows) > 1:
            self._propagate()
        self._catch_up()
        return self._answer(time, mark)

    def _read_field(self, field_t: Any) -> None:
        """Calibrate a reading, and keep it if its magnitude is plausible for the Earth's field."""
        if field_t is None or self.parameters.use_magnetometer == "never":
            return
        raw = numbers("field", field_t, 3)
        found = earth_field(raw[None], self.parameters.magnetometer)
        field, is_missing, is_implausible = (one[0] for one in found)
        if is_missing:
            self.counts["field_missing"] += 1
            return
        if not is_implausible:
            self._field, self._far = field, []
            return
        self.counts["field_implausible"] += 1
        self._far.append(float(np.linalg.norm(raw)))
        if len(self._far) == _FAR:
            strength, self._far = float(np.median(self._far)), []
            refuse_field_unit(strength)

    def _saturated(self, gyro: np.ndarray, accel: np.ndarray, before: int) -> Flag:
        """Flag of a sample at the end of a range; `before` samples were waiting for a block."""
        full = bool(np.any(self._path.full(gyro[None])))
        if full:
            self._open = before + 1
        hard = bool(self._path.hard(accel[None])[0])
        return Flag.SATURATED if full or hard else Flag(0)

    def _propagate(self) -> None:
        """Propagate the last attitude to the newest sample by the gyros."""
        rows = self._path.rows[-3:]
        made = self._path.increments(self._path.time_ns[-3:], rows[:, :3], rows[:, 3:6])
        since = float(made.dt[-1]), np.asarray(made.theta[-1])
        self._since.append(since)
        if not self._starting:
            self._q = self._rotated(self._q, *since)

    def _rotated(self, q: Sequence[float], dt: float, theta: np.ndarray) -> tuple[float, ...]:
        true = theta + self._gain @ theta - self._bias * dt
        angle = math.sqrt(float(true @ true))
        share = math.sin(0.5 * angle) / angle if angle > 1e-9 else 0.5
        x, y, z = (share * true).tolist()
        return product(q, (math.cos(0.5 * angle), x, y, z))

    def _answer(self, time_ns: int, mark: Flag) -> Attitude:
        flags = mark | Flag(self._marks)
        if self._starting:
            nothing = np.full(4, np.nan)
            return Attitude(time_ns, nothing, nothing[:3], mark | Flag.STARTING)
        if self._open > 0 or self._pending or self._path.waiting >= self._path.n:
            flags |= Flag.BEHIND
        q = np.array(product(self._turn_north, self._q))
        return Attitude(time_ns, q / np.linalg.norm(q), self._sigma, flags)

    def _wait(self, made: list[MargSteps]) -> None:
        """Queue steps."""
        for steps in made:
            rows = steps.u, steps.y, steps.aux
            self._like = jax.tree_util.tree_structure(rows)
            leaves = [np.asarray(a) for a in jax.tree_util.tree_leaves(rows)]
            for k, still in enumerate(steps.still):
                self._pending.append(([a[k] for a in leaves], bool(still)))

    def _catch_up(self) -> None:
        """Process queued steps, once the start is known."""
        if self._online is None:
            self._seek()
        for _ in range(_STEPS):
            if self._online is not None and self._pending:
                self._step()
        self._starting = self._starting and (self._online is None or bool(self._pending))

    # ------------------------------------------------------------------------ start and steps

    def _seek(self) -> None:
        """Start the filter as soon as the initial belief is known."""
        if not self._pending:
            return
        increments, _ = self._path.until_start
        found = self._path.start()
        if found is None:
            return
        rate, force = (a / increments.dt[:, None] for a in (increments.theta, increments.dv))
        try:
            refuse_units(rate, force)
        except LiveError:
            self._restart()
            raise
        self._online = self._on(found[1])

    def _step(self) -> None:
        """Step the filter by the next block, and propagate its attitude to the newest sample."""
        assert self._online is not None
        p = self.parameters
        leaves, still = self._pending.pop(0)
        u, y, aux = jax.tree_util.tree_unflatten(self._like, leaves)
        found = _Step(*np.split(np.asarray(self._online.step(y, u, aux, keep=_kept)), _SIZES))
        self.counts["steps_not_taken"] += int(found.code[0] != Code.DONE)
        turned, lasted = u.samples.angle[None], u.samples.dt_s[None]
        self._sigma = stated_sigma(found.sigma[None], turned, lasted, p)[0, :3]
        self._bias, self._gain = found.gyro_bias, found.gyro_gain.reshape(3, 3)
        self._q = tuple(found.q_nb.tolist())
        self._since = self._since[self._path.n :]
        for since in self._since:
            self._q = self._rotated(self._q, *since)
        self._marks = int(self._doubts(found) | (Flag.REST if still else Flag(0)))

    def _doubts(self, found: _Step) -> Flag:
        """Flags of the monitor over its window of the last blocks."""
        most = math.ceil(_MONITORED_S / (self._path.n * self._usual_s))
        gain = [np.max(np.abs(found.gyro_gain))]
        square = [monitor.squared(found.travel[:6], self.parameters)]
        row = [found.declination, gain, square, found.travel[6:], found.magnetometer, found.bare]
        self._looks = np.concatenate([self._looks, np.concatenate(row)[None]])[-most:]
        looks, none = self._looks, np.zeros(len(self._looks))
        updates = {
            name: SensorUpdates(none, none, looks[:, 2], looks[:, k], looks[:, k + 1])
            for name, k in ((model.TRAVEL, 3), (model.MAGNETOMETER, 5))
        }
        bare = looks[:, 7] > 0.0
        doubt = monitor.doubts_of(looks[:, 0], looks[:, 1], updates, self.parameters, bare)
        doubtful = bool(doubt.declination[-1] or doubt.gain[-1])
        for column, k in ((doubt.tilt, 3), (doubt.refused, 5)):
            refused = looks[:, k + 1] == Code.REFUSED
            asked = np.flatnonzero((looks[:, k] == np.max(looks[:, k])) | refused)
            doubtful |= bool(len(asked)) and bool(column[asked[-1]])
        flags = Flag.DOUBTFUL if doubtful else Flag(0)
        asked = np.flatnonzero((looks[:, 5] > 0) | (looks[:, 6] == Code.REFUSED))
        disturbed = len(asked) > 0 and looks[asked[-1], 6] == Code.REFUSED
        return flags | (Flag.DISTURBED if disturbed else Flag(0))
