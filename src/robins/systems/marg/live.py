"""The orientation of a unit while it moves: one sample in, its attitude out at once.

`LiveMarg` is the filter "marg" of a replay, by the same code, block after block. What a replay
takes from later samples, a live object waits for or does without:

- The start needs half a second of rest or three of motion, and rest at the start 1.5 s more or less
  (`rest.after`), for it shows the bias. Until then answers are `STARTING`, without numbers; the
  samples are kept, and the filter then goes through them, two blocks a sample. From there on the
  answers are those of the replay.
- A peak that the end of a gyro's range cut off is put back from both flanks. The filter waits for
  the second one, at most 0.2 s and three samples; until its block is whole the gyros carry the
  attitude on as they read, and answers are `BEHIND`. Then they are again those of the replay.
- The end of a range that nobody told (`gyro.range`) is known once it was reached twice by jumps.
  Peaks before that are put back by a replay, and not here; so are those of a chip that filters
  what it cuts off, where plateaus alone show the end.
- A stamp that comes late after a long interval is told from a gap by the next one: `BEHIND` for one
  sample, at the end of a block.
- A gap of more than ten seconds, or a clock that was set, is a new start; a replay bridges it.
- `DOUBTFUL` is told when the monitor knows it. It marks the looks that led to it in a replay.
- True north is told by who makes the object (`declination_rad`); a replay takes it from the fixes.
"""

from __future__ import annotations

import math
from functools import partial
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from robins.dataset import ImuTable
from robins.errors import require
from robins.filters import Belief, Code, OnlineFilter
from robins.filters.machine import usual
from robins.filters.run import Step
from robins.ins.increments import Increments, from_imu
from robins.linalg.scalars import product
from robins.systems.marg import model, monitor
from robins.systems.marg.log import (
    Pace,
    as_means,
    first_belief,
    first_look,
    inputs,
    mean_force,
    mean_rate,
    measurements,
    not_sampled,
)
from robins.systems.marg.parameters import Replay
from robins.systems.marg.replay import filter_of, stated_sigma
from robins.systems.marg.rest import RestFound, Watch
from robins.systems.marg.saturation import LONGEST_S, Range, bridged
from robins.systems.replaying import kept
from robins.systems.streaming import (
    Door,
    Flag,
    Live,
    LiveError,
    as_before,
    numbers,
    online,
    refuse_units,
    stamp,
)
from robins.systems.tables import Update

_FLANK = 3  # samples of a flank, by which a peak is put back
_STEPS = 2  # of the filter in a sample, where it has to catch up
_LONGEST_GAP_S, _PATIENCE_S = 10.0, 0.1
_MONITORED_S = 60.0  # of looks, that the monitor is shown


class Attitude(NamedTuple):
    """The answer to a sample."""

    time_ns: int
    q_nb: np.ndarray  # (4,) body to NED, scalar first; NaN while `STARTING`
    sigma_rad: np.ndarray  # (3,) about north, east, down, as of the last step of the filter
    flags: Flag


class _Block(NamedTuple):
    """A block of samples that the filter has not taken yet."""

    samples: int
    u: Any
    y: Any
    aux: Any
    still: bool


class _Step(NamedTuple):
    """Numbers of a step that are read."""

    q_nb: np.ndarray  # (4,)
    gyro_bias: np.ndarray  # (3,)
    gyro_gain: np.ndarray  # (9,)
    declination: np.ndarray  # (1,)
    sigma: np.ndarray  # (27,)
    code: np.ndarray  # (1,) of the prediction
    travel: np.ndarray  # (3,) NIS, degrees of freedom, code
    magnetometer: np.ndarray  # (3,) likewise; none, none, `MISSING` without one


_SIZES = np.cumsum([4, 3, 9, 1, model.DIM, 1, 3])


def _kept(step: Step) -> jax.Array:
    """A `_Step` as one vector, which leaves compiled code at once."""
    mean, sigma, seen = kept(step)
    parts = [mean.q_nb.wxyz, mean.gyro_bias, mean.gyro_gain.reshape(9), mean.declination[None]]
    parts += [sigma, step.prediction.code[None]]
    for name in (model.TRAVEL, model.MAGNETOMETER):
        update = seen.get(name)
        none = jnp.array([0.0, 0.0, float(Code.MISSING)])
        parts.append(none if update is None else jnp.stack(
            [jnp.asarray(x, float) for x in (update.nis, update.dof, update.code)]))  # fmt: skip
    return jnp.concatenate([jnp.asarray(part, float) for part in parts])


class LiveMarg(Live):
    """The attitude at each sample, at once (see the module for what differs from a replay).

    Attributes:
        counts: `imu_nan`, `imu_inf`, `imu_absurd`, `imu_duplicate`, `imu_backward`, `imu_ahead`
            (refused), `begun_anew`, `field_missing`, `field_implausible`, `imu_saturated`,
            `imu_bridged`, `imu_gaps`, `blocks_in_free_fall`, `steps_not_taken`.
        look: what the start was found from; None before.
    """

    _parameters: ClassVar[type[Replay]] = Replay
    _kept: ClassVar[tuple[str, ...]] = (
        "_time_ns", "_rows", "_context", "_field", "_pending", "_begun", "_looks", "_since",
        "_q", "_sigma", "_bias", "_gain", "_marks", "_stepped", "_in_motion", "_open",
    )  # fmt: skip
    _parts: ClassVar[tuple[str, ...]] = ("_door", "_range", "_watch", "_pace")

    def __init__(
        self,
        parameters: Replay,
        rate_hz: float,
        declination_rad: float = 0.0,
        machine: str | None = None,
    ):
        """Begin; programs are made before the first sample.

        Args:
            parameters: as of a replay.
            rate_hz: of the samples, as the data sheet says; lost ones are told by it.
            declination_rad: of the Earth's field here, clockwise from true north.
            machine: the machine that steps the filter, as for `OnlineFilter`; default: `usual()`.
                Programs of "vm" are kept in the user's cache, "c" is compiled for minutes once.

        Raises:
            ValueError: the rate is not positive, or there is no such machine.
        """
        require(rate_hz > 0.0, "rate_hz must be positive", rate_hz)
        made_with = {
            "rate_hz": rate_hz,
            "declination_rad": declination_rad,
            "machine": machine or usual(),
        }
        super().__init__(parameters, **made_with)
        p, self._usual_s = parameters, 1.0 / rate_hz
        self._n = max(1, round(p.update.block / self._usual_s))
        # a peak that ends in a block may have begun in those before
        self._most_context = math.ceil(LONGEST_S * rate_hz) + 2 * _FLANK
        half = 0.5 * declination_rad
        self._turn_north = (math.cos(half), 0.0, 0.0, math.sin(half))
        self._on = partial(online, filter_of(p), model.model_of(p), machine=machine or usual())
        self._online: OnlineFilter | None = None
        self._door = Door(_LONGEST_GAP_S, max(3, round(_PATIENCE_S * rate_hz)))
        self._begin_anew()
        self._compile()

    def _begin_anew(self) -> None:
        """Forget all but the counts and the stamps."""
        self._time_ns: list[int] = []
        self._rows: list[np.ndarray] = []  # (9,) gyro, accel, field of the samples kept
        self._context = 0  # of them, those that the filter has behind it
        self._field = np.full(3, np.nan)  # of a sample that was refused
        self._pending: list[Any] = []  # blocks as tuples, which wait for a step
        self._begun: list[Any] = []  # increments and field, until the start is found
        self._looks = np.zeros((0, 8))  # what the monitor is shown
        self._since: list[Any] = []  # (dt, turn) of the samples after the last step
        self._q = (math.nan,) * 4
        self._sigma, self._bias, self._gain = np.full(3, np.nan), np.zeros(3), np.zeros((3, 3))
        self._marks = 0  # flags that hold from a block to the next
        self._stepped = False  # whether the filter has begun
        self._open = 0  # samples without a step, up to the last with a gyro at its end
        self._in_motion = False  # whether it has to begin in motion
        self._online = None
        self._range, self._pace = Range(), Pace()
        self._watch = Watch(self._n * self._usual_s, self.parameters.rest)

    def _compile(self) -> None:
        """Have all compiled by a block that is thrown away."""
        step = np.full(self._n, self._usual_s)
        force = np.tile([0.0, 0.0, -self.parameters.accelerometer.gravity], (self._n, 1))
        field = np.full((self._n, 3), 2e-5)
        theta, dv = np.zeros((self._n, 3)), force * step[:, None]
        nothing = np.zeros((self._n, 3)), np.zeros(self._n)
        self._start(Increments(step, theta, dv), field)
        self._integrated(step, theta, dv, field, *nothing)
        self._step()
        counts = type(self.counts)()
        self._begin_anew()
        self.counts = counts

    # ------------------------------------------------------------------------------ a sample

    def push(self, time_ns: Any, gyro_rad_s: Any, accel_m_s2: Any, field_t: Any = None) -> Attitude:
        """Take a sample; the attitude at its stamp.

        Args:
            time_ns: stamp, whole nanoseconds of any clock.
            gyro_rad_s: (3,) rate in body axes, forward-right-down; NaN is missing.
            accel_m_s2: (3,) specific force.
            field_t: (3,) T of the magnetometer, or None where it has not read since the last one.

        Raises:
            LiveError: a stamp or vector of another kind, or numbers that are those of another unit;
                the object goes on with the next sample.
        """
        time = stamp(time_ns)
        gyro, accel = numbers("gyro", gyro_rad_s, 3), numbers("accel", accel_m_s2, 3)
        self._read_field(field_t)
        values = np.concatenate([gyro, accel])
        why = self._door.ask(time, values)
        if why == "anew":
            self.counts["begun_anew"] += 1
            self._begin_anew()
        elif why:
            self.counts[f"imu_{why}"] += 1
            return self._answer(time, Flag.REFUSED)
        self._range.read(gyro)
        self._time_ns.append(time)
        self._rows.append(np.concatenate([values, self._field]))
        self._field = np.full(3, np.nan)
        mark = self._saturated(gyro, accel)
        if len(self._rows) > 1:
            self._carry()
        self._catch_up()
        return self._answer(time, mark)

    def _read_field(self, field_t: Any) -> None:
        """Calibrate a reading and keep it, if it can be the field of the Earth."""
        m = self.parameters.magnetometer
        if field_t is None or self.parameters.use_magnetometer == "never":
            return
        raw = numbers("field", field_t, 3)
        if not np.all(np.isfinite(raw)):
            self.counts["field_missing"] += 1
            return
        field = (raw - np.array(m.offset)) @ np.array(m.matrix).T
        if m.least <= float(np.linalg.norm(field)) <= m.most:
            self._field = field
        else:
            self.counts["field_implausible"] += 1

    def _saturated(self, gyro: np.ndarray, accel: np.ndarray) -> Flag:
        p = self.parameters
        limit = np.minimum(self._range.levels, 0.99 * p.gyro.range)
        full = np.any((gyro <= -limit[:, 0]) | (gyro >= limit[:, 1]))
        if full:
            self._open = len(self._rows) - self._context
        hard = np.any(np.abs(accel) >= 0.99 * p.accelerometer.range)
        return Flag.SATURATED if full or hard else Flag(0)

    def _carry(self) -> None:
        """The last attitude, carried over the newest sample by the gyros."""
        last = slice(max(0, len(self._rows) - 3), None)
        rows = np.array(self._rows[last])
        made = self._increments(np.array(self._time_ns[last]), rows[:, :3], rows[:, 3:6])
        since = float(made.dt[-1]), np.asarray(made.theta[-1])
        self._since.append(since)
        if self._stepped:
            self._q = self._turned(self._q, *since)

    def _turned(self, q: Any, dt: float, theta: np.ndarray) -> tuple[float, ...]:
        true = theta + self._gain @ theta - self._bias * dt
        angle = math.sqrt(float(true @ true))
        share = math.sin(0.5 * angle) / angle if angle > 1e-9 else 0.5
        x, y, z = (share * true).tolist()
        return product(q, (math.cos(0.5 * angle), x, y, z))

    def _answer(self, time_ns: int, mark: Flag) -> Attitude:
        flags = mark | Flag(self._marks)
        if not self._stepped or self._pending:
            nothing = np.full(4, np.nan)
            return Attitude(time_ns, nothing, nothing[:3], mark | Flag.STARTING)
        if self._open > 0 or len(self._rows) - self._context >= self._n:
            flags |= Flag.BEHIND
        q = np.array(product(self._turn_north, self._q))
        return Attitude(time_ns, q / np.linalg.norm(q), self._sigma, flags)

    # ---------------------------------------------------------------------- samples to blocks

    def _increments(self, time_ns: np.ndarray, gyro: np.ndarray, accel: np.ndarray) -> Increments:
        table = ImuTable(time_ns, gyro, accel, "rate")
        if self.parameters.update.samples == "means":
            table = as_means(table, self._usual_s)
        return from_imu(table, self._usual_s)[0]

    def _catch_up(self) -> None:
        for _ in range(_STEPS):
            if self._ready():
                self._cut()
                if not self._stepped:
                    self._look()
            if self._stepped and self._pending:
                self._step()

    def _ready(self) -> bool:
        """True if all samples of a block are there, flanks of its peaks included."""
        if not self._context:  # the first sample of all begins the first block
            self._context = 1 if self._rows else 0
        end = self._context + self._n
        more = len(self._rows) - end
        if more < 0 or (self.parameters.update.samples == "instants" and more == 0):
            return False
        if more == 0 and self._time_ns[-1] - self._time_ns[-2] > 1.5e9 * self._usual_s:
            return False  # the next stamp tells whether samples are missing
        rate = np.array(self._rows)[:, :3]
        limit = np.minimum(self._range.levels, 0.99 * self.parameters.gyro.range)
        full = (rate <= -limit[:, 0]) | (rate >= limit[:, 1])
        for axis in np.flatnonzero(np.any(full[self._context : end], axis=0)):
            column = full[:, axis]
            last = end - 1 - int(np.argmax(column[self._context : end][::-1]))
            after = np.flatnonzero(~column[last:])
            begin = last - int(np.argmin(column[: last + 1][::-1])) if not column[0] else 0
            if len(after) == 0:
                if (self._time_ns[-1] - self._time_ns[begin]) * 1e-9 <= LONGEST_S:
                    return False
            elif len(rate) < last + after[0] + _FLANK and not np.any(column[last + after[0] :]):
                return False
        return True

    def _cut(self) -> None:
        """Make the next block; keep what is context of the one after it."""
        end, p = self._context + self._n, self.parameters
        time_ns, rows = np.array(self._time_ns), np.array(self._rows)
        seconds = (time_ns - time_ns[0]) * 1e-9
        rate, full, doubt = bridged(seconds, rows[:, :3], p.gyro.range, self._range.levels)
        hard = np.any(np.abs(rows[:, 3:6]) >= 0.99 * p.accelerometer.range, axis=1)
        made = self._increments(time_ns, rate, rows[:, 3:6])
        own = slice(self._context - 1, end - 1)  # increments that end with samples of the block
        ends = slice(self._context - 1, end)
        dt, theta, dv = (np.asarray(a, float)[own] for a in made[:3])
        lost = not_sampled(dt, full[ends], doubt[ends], hard[ends], self._usual_s, p)
        block = slice(self._context, end)
        self.counts["imu_saturated"] += int(np.sum(np.any(full, axis=1)[block] | hard[block]))
        back = np.any(full & np.isfinite(doubt), axis=1)
        self.counts["imu_bridged"] += int(np.sum(back[block]))
        self.counts["imu_gaps"] += lost[2]
        if not self._stepped:
            self._begun.append((dt, theta, dv, rows[block, 6:], rows[block, :6]))
        self._integrated(dt, theta, dv, rows[block, 6:], *lost[:2])
        drop = max(0, end - self._most_context)
        del self._time_ns[:drop], self._rows[:drop]
        self._context = end - drop
        self._open = max(0, self._open - self._n)

    def _integrated(
        self,
        dt: np.ndarray,
        theta: np.ndarray,
        dv: np.ndarray,
        field: np.ndarray,
        lost_turn: np.ndarray,
        lost_s: np.ndarray,
    ) -> None:
        """Add a block to those that wait for a step."""
        p = self.parameters
        samples = model.Samples(dt[None], theta[None], dv[None], field[None])
        integrals, field_b = model.integrate(samples)
        rate, force = mean_rate(integrals), mean_force(integrals)
        still, sigma = self._watch.look(
            float(np.asarray(integrals.dt_s)[0]), rate[0], force[0], field_b[0]
        )
        rest = RestFound(np.array([still]), np.array([sigma]), None, sigma)
        u, falling = inputs(integrals, rest.still, lost_turn.sum(0)[None], lost_s.sum()[None], p)
        y, aux = measurements(integrals, field_b, rest, p, self._pace)
        self.counts["blocks_in_free_fall"] += int(np.asarray(falling)[0])
        row = jax.tree_util.tree_map(lambda a: np.asarray(a)[0], (u, y, aux))
        leaves = jax.tree_util.tree_leaves(row)
        self._like = jax.tree_util.tree_structure(row)
        self._pending.append((leaves, bool(still)))

    # ------------------------------------------------------------------------ start and steps

    def _look(self) -> None:
        """Find the start as soon as a replay of the samples so far would find the same."""
        start = self.parameters.start
        dt, theta, dv, field, raw = map(np.concatenate, zip(*self._begun, strict=True))
        lasted = float(np.sum(dt))
        wait_s = start.moving if self._in_motion else start.still
        if lasted <= wait_s or not self._watch.settled:
            return
        increments = Increments(dt, theta, dv)
        if not (self._in_motion or first_look(increments, field, self.parameters).still):
            self._in_motion = True
            return
        try:
            refuse_units(raw[:, :3], raw[:, 3:6])
        except LiveError:
            self._begin_anew()
            raise
        self._start(increments, field)

    def _start(self, increments: Increments, field: np.ndarray) -> None:
        p = self.parameters
        look = first_look(increments, field, p)
        nothing = np.zeros(0)
        rest = RestFound(nothing, nothing, self._watch.first, self._watch.first_sigma)
        belief: Belief = first_belief(look, p, rest)
        self._online = self._on(belief)
        self._begun, self._stepped = [], True

    def _step(self) -> None:
        """Take the next block into the filter, and carry its attitude to the newest sample."""
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
        self._since = self._since[self._n :]
        for since in self._since:
            self._q = self._turned(self._q, *since)
        self._marks = int(self._doubts(found) | (Flag.REST if still else Flag(0)))

    def _doubts(self, found: _Step) -> Flag:
        """Flags of the monitor on the last looks."""
        most = math.ceil(_MONITORED_S / (self._n * self._usual_s))
        gain = [np.max(np.abs(found.gyro_gain))]
        row = np.concatenate([found.declination, gain, found.travel, found.magnetometer])
        self._looks = np.concatenate([self._looks, row[None]])[-most:]
        looks, none = self._looks, np.zeros(len(self._looks))
        updates = {
            name: Update(none, none, looks[:, k], looks[:, k + 1], looks[:, k + 2])
            for name, k in ((model.TRAVEL, 2), (model.MAGNETOMETER, 5))
        }
        doubt = monitor.doubts_of(looks[:, 0], looks[:, 1], updates, self.parameters)
        told = bool(doubt.declination[-1] or doubt.gain[-1])
        for column, k in ((doubt.tilt, 2), (doubt.refused, 5)):
            refused = looks[:, k + 2] == Code.REFUSED
            asked = np.flatnonzero((looks[:, k + 1] == np.max(looks[:, k + 1])) | refused)
            told |= bool(len(asked)) and bool(column[asked[-1]])
        flags = Flag.DOUBTFUL if told else Flag(0)
        asked = np.flatnonzero((looks[:, 6] > 0) | (looks[:, 7] == Code.REFUSED))
        disturbed = len(asked) > 0 and looks[asked[-1], 7] == Code.REFUSED
        return flags | (Flag.DISTURBED if disturbed else Flag(0))

    # ------------------------------------------------------------------------------- the file

    def _state_now(self) -> Any:
        return None if self._online is None else self._online.state

    def _go_on_from(self, state: Any) -> None:
        increments = Increments(np.ones(1), np.zeros((1, 3)), np.array([[0.0, 0.0, -9.81]]))
        belief = first_belief(first_look(increments, np.full((1, 3), np.nan), self.parameters),
                              self.parameters)  # fmt: skip
        self._online = self._on(belief)
        self._online.state = as_before(self._online.state, state)
