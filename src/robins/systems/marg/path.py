"""Conversion of samples to filter steps, chunk by chunk, for replays and live objects.

Samples are integrated over blocks, and each block gets the measurements at its end. The result does
not depend, to the bit, on the division into chunks: a replay is one chunk, a live object has chunks
of one sample. Each stage uses later samples, within its latency:

- a gyro peak clipped at the end of its range is restored from both flanks: up to `LONGEST_S` and
  `FLANK` samples;
- if the ends of the ranges are given (`saturation.levels` of a whole log), all peaks are restored;
  otherwise the ends are found from the samples so far, so earlier peaks stay clipped;
- the rotation over a gap that may exceed `_LOST_RAD` is found from gravity and field on both sides
  of it, over `start.moving`;
- samples that are values at an instant need the next one, and so does a stamp after a long
  interval, which may be late rather than follow a gap;
- the start needs `start.still` of rest or `start.moving` of motion, and `rest.after` of rest.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal, NamedTuple

import jax
import numpy as np
from jaxtyping import PyTree

from robins.dataset import ImuTable
from robins.filters import Belief
from robins.ins.increments import Increments, after_gap, from_imu, usual_interval
from robins.manifold import Angle
from robins.systems.marg import model
from robins.systems.marg.parameters import MargReplay
from robins.systems.marg.rest import RestDetector
from robins.systems.marg.saturation import FLANK, LONGEST_S, GyroRange, beyond, bridged
from robins.systems.marg.sites import Look, Sites
from robins.systems.marg.start import FilterStart, first_belief, initial_alignment, turn_across

_FALLING = 0.3  # of gravity: less specific force is free fall, where tilt is not observable
_LOST_RAD = math.radians(30.0)  # rotation in a gap that the rates at its ends cannot bridge


class MargSteps(NamedTuple):
    """Steps of the filter; leading axis K blocks of n samples."""

    u: model.Block
    y: dict[str, Any]
    aux: dict[str, Any]
    still: np.ndarray  # (K,) bool
    samples: model.Samples  # a short block is padded with increments of zero duration


class SamplePath:
    """Converter of samples to steps of the filter (see the module).

    Attributes:
        n: number of samples in a block.
        counts: `imu_saturated`, `imu_bridged`, `imu_frozen`, `imu_gaps`,
            `blocks_in_free_fall`.
        range: ends of the ranges of the gyros.
    """

    def __init__(
        self,
        parameters: MargReplay,
        usual_s: float,
        kind: Literal["rate", "increment"] = "rate",
        levels: np.ndarray | None = None,
    ):
        """Create a converter without samples.

        Args:
            parameters: as for a replay.
            usual_s: s, sampling interval, by which lost samples are detected.
            kind: of the samples, as in `ImuTable`.
            levels: (3, 2) rad/s, ends of the ranges; None: found from the samples so far.
        """
        self._parameters, self._usual_s = parameters, usual_s
        self._kind: Literal["rate", "increment"] = kind
        self.n = max(1, round(parameters.update.block / usual_s))
        # a peak that ends in a block may have started in earlier ones
        self._most_context = math.ceil(LONGEST_S / usual_s) + 2 * FLANK
        self._side = math.ceil(parameters.start.moving / usual_s)  # samples on each side of a gap
        self._by_sample = levels is None and kind == "rate"
        self.range = GyroRange(levels)
        self._watch, self._pace = RestDetector(self.n * usual_s, parameters.rest), MeasurementPace()
        self._sites = Sites(model.SITES)
        self.counts: Counter[str] = Counter()
        self.time_ns = np.zeros(0, np.int64)  # (M,) of the samples kept
        self.rows = np.zeros((0, 9))  # (M, 9) their gyro, accel and field
        self._context = 0  # number of them already in blocks
        # increments and field until the start is found, then None
        self._begun: list[tuple[np.ndarray, ...]] | None = []
        self._in_motion = False  # the log starts in motion

    @property
    def waiting(self) -> int:
        """Number of samples not yet in a block."""
        return len(self.rows) - self._context

    def push(self, time_ns: np.ndarray, rows: np.ndarray) -> list[MargSteps]:
        """Add samples; return the steps that they complete.

        Args:
            time_ns: (M,) int64, increasing.
            rows: (M, 9) gyro [rad/s], accel [m/s^2], or their increments, and field [T] in body
                axes; the field is NaN if it was not read since the previous sample.
        """
        made = []
        for at in range(0, len(rows), 1 if self._by_sample else max(len(rows), 1)):
            new = slice(at, at + 1 if self._by_sample else None)
            if self._by_sample:
                self.range.read(rows[at, :3])
            self.time_ns = np.concatenate([self.time_ns, time_ns[new]])
            self.rows = np.concatenate([self.rows, rows[new]])
            self._context = max(self._context, 1)  # the first sample of all begins the first block
            if blocks := self._complete_blocks():
                made.append(self._cut(self._context + blocks * self.n))
        return made

    def finish(self) -> list[MargSteps]:
        """Steps of the remaining samples; the last block may be short."""
        return [self._cut(len(self.rows))] if self.waiting > 0 else []

    def start(self, is_complete: bool = False) -> tuple[FilterStart, Belief] | None:
        """Start and initial belief, once later samples cannot change them; None before.

        Args:
            is_complete: True if no samples follow.
        """
        p = self._parameters
        if not self._begun:
            return None
        increments, field = self.until_start
        lasted = float(np.sum(increments.dt))
        if not is_complete:
            if lasted <= (p.start.moving if self._in_motion else p.start.still):
                return None
            if not self._watch.settled:
                return None
            if not self._in_motion and not initial_alignment(increments, field, p).still:
                self._in_motion = True
                return None
        look, self._begun = initial_alignment(increments, field, p), None
        return look, first_belief(look, p, self._watch)

    @property
    def until_start(self) -> tuple[Increments, np.ndarray]:
        """Increments and field (N, 3) of all blocks until the start is found."""
        dt, theta, dv, field = map(np.concatenate, zip(*(self._begun or ()), strict=True))
        return Increments(dt, theta, dv), field

    def increments(self, time_ns: np.ndarray, rate: np.ndarray, accel: np.ndarray) -> Increments:
        """Increments (M - 1,) between samples (M,), in body axes."""
        table = ImuTable(time_ns, rate, accel, self._kind)
        if self._parameters.update.samples == "means":
            table = as_increments(table, self._usual_s)
        return from_imu(table, self._usual_s)[0]

    # ------------------------------------------------------------------------ samples to blocks

    def _complete_blocks(self) -> int:
        """Number of blocks whose samples are complete, including the flanks of their peaks."""
        count, full = 0, self.full(self.rows[:, :3])
        while self._is_complete(self._context + count * self.n, full):
            count += 1
        return count

    def full(self, rate: np.ndarray) -> np.ndarray:
        """Mask (M, 3) of rates (M, 3) [rad/s] at the end of the range."""
        if self._kind != "rate":  # increments have no range
            return np.zeros(rate.shape, bool)
        return beyond(rate, self.range.levels, self._parameters.gyro.range)

    def hard(self, accel: np.ndarray) -> np.ndarray:
        """Mask (M,) of specific forces (M, 3) [m/s^2] at the end of the range."""
        if self._kind != "rate":
            return np.zeros(len(accel), bool)
        return np.any(np.abs(accel) >= 0.99 * self._parameters.accelerometer.range, axis=1)

    def _is_complete(self, begin: int, full: np.ndarray) -> bool:
        """True if all samples needed by a block are there; it begins after sample `begin - 1`."""
        end, time_ns = begin + self.n, self.time_ns
        needed = end + (self._parameters.update.samples == "instants")
        more = len(time_ns) - end
        if len(time_ns) < needed:
            return False
        if more == 0 and after_gap(np.diff(time_ns[-2:]) * 1e-9, self._usual_s)[-1]:
            return False  # the next stamp shows whether samples are missing
        if len(lost := self._lost(begin, end)):
            reach = int(lost[-1]) + 1 + self._side + self._most_context
            if len(time_ns) <= reach:
                return False
        for axis in np.flatnonzero(np.any(full[begin:needed], axis=0)):
            last = begin + int(np.flatnonzero(full[begin:needed, axis])[-1])
            # longer peaks are not restored, so no more samples are needed
            low, high = max(0, last - self._most_context), last + self._most_context + FLANK
            column = full[:high, axis]
            below = low + np.flatnonzero(~column[low:last])
            first = int(below[-1]) + 1 if len(below) else low
            after = last + np.flatnonzero(~column[last:])
            if len(after) == 0:
                if (time_ns[len(column) - 1] - time_ns[first]) * 1e-9 <= LONGEST_S:
                    return False
            elif len(column) < after[0] + FLANK and not np.any(column[after[0] :]):
                return False
        return True

    def _cut(self, end: int) -> MargSteps:
        """Steps of the samples before index `end`; keep those that later blocks need as context."""
        p, n, context = self._parameters, self.n, self._context
        accel, field = self.rows[:, 3:6], self.rows[:, 6:]
        full, hard = self.full(self.rows[:, :3]), self.hard(accel)
        rate, doubt = bridged(self.time_ns, self.rows[:, :3], full)
        made = self.increments(self.time_ns, rate, accel)
        block, own, ends = slice(context, end), slice(context - 1, end - 1), slice(context - 1, end)
        dt, theta, dv = (np.array(a, float)[own] for a in made[:3])
        turn, lost_s = self._not_sampled(dt, full[ends], doubt[ends], hard[ends])
        for at in self._lost(context, end):
            across = self._across(int(at), made, field)
            if across is not None:
                k = at - context + 1
                theta[k], up_b, spread = across
                dv[k] = p.accelerometer.gravity * dt[k] * up_b
                turn[k] = np.minimum(turn[k], spread)
        turn += p.update.gap_rate * (self._hung(end)[block] * dt)[:, None]
        self.counts["imu_saturated"] += int(np.sum((np.any(full, axis=1) | hard)[block]))
        self.counts["imu_bridged"] += int(np.sum(np.any(np.isfinite(doubt), axis=1)[block]))
        if self._begun is not None:
            self._begun.append((dt, theta, dv, field[block]))
        parts = (dt, 0.0), (theta, 0.0), (dv, 0.0), (field[block], np.nan)
        samples = model.Samples(*(_in_blocks(a, n, blank) for a, blank in parts))
        lost = (_in_blocks(a, n, 0.0).sum(axis=1) for a in (turn, lost_s))
        drop = max(0, end - self._most_context - self._side)
        self.time_ns, self.rows = self.time_ns[drop:], self.rows[drop:]
        self._context = end - drop
        return self._steps(samples, *lost)

    def _lost(self, begin: int, end: int) -> np.ndarray:
        """Last samples (indices) before gaps too long to bridge, from `begin - 1` to `end - 1`."""
        p = self._parameters.update
        dt = np.diff(self.time_ns[max(begin - 1, 0) : end]) * 1e-9
        lost = (dt > p.gap * self._usual_s) & (p.gap_rate * dt > _LOST_RAD)
        return max(begin - 1, 0) + np.flatnonzero(lost)

    def _across(
        self, at: int, made: Increments, field: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, float] | None:
        """Rotation over the gap after sample `at` by `turn_across`; None if a side is too short."""
        low, high = max(at - self._side, 0), min(at + 1 + self._side, len(self.time_ns) - 1)
        first = max([low, *(self._lost(low + 1, at + 1) + 1)])
        last = min([high, *self._lost(at + 2, high + 1)])
        if not first < at < at + 1 < last:
            return None
        before, after = (
            (Increments(*(np.asarray(a)[side] for a in made[:3])), field[1:][side])
            for side in (slice(first, at), slice(at + 1, last))
        )
        return turn_across(before, np.asarray(made.theta)[at], after, self._parameters)

    def _hung(self, end: int) -> np.ndarray:
        """Factor (M,) on the uncertainty of rotation of kept samples up to `end` where gyros hang.

        The errors of successive hanging blocks are fully correlated, so their sigmas add, not their
        variances: the sigma of the k-th is sqrt(2 k - 1) times that of the first.
        """
        out = np.zeros(len(self.rows))
        if self._kind != "rate":
            return out
        for at in range(self._context, end, self.n):
            rows = self.rows[at - 1 : min(at + self.n, end)]
            row = self.range.hanging(rows[:, :3], rows[:, 3:6])
            out[at : at + self.n] = math.sqrt(2.0 * row - 1.0) if row else 0.0
        self.counts["imu_frozen"] += int(np.sum(out > 0.0))
        return out

    def _steps(
        self, samples: model.Samples, lost_turn: np.ndarray, lost_s: np.ndarray
    ) -> MargSteps:
        """Integrate blocks, and add the measurements at their ends."""
        p = self._parameters
        integrals, field_b = model.integrate(samples)
        times, rate = np.asarray(integrals.dt_s).tolist(), mean_rate(integrals)
        force = mean_force(integrals)
        still, sigma, looks = np.zeros(len(times), bool), np.zeros(len(times)), []
        for k, dt in enumerate(times):
            still[k], sigma[k] = self._watch.process_block(dt, rate[k], force[k], field_b[k])
            starts_at_rest = self._watch.first is not None
            looks.append(
                self._sites.process_block(dt, bool(still[k]), starts_at_rest, force[k], field_b[k])
            )
        weight = p.accelerometer.gravity * np.asarray(integrals.dt_s)
        falling = np.linalg.norm(np.asarray(integrals.dv), axis=1) < _FALLING * weight
        self.counts["blocks_in_free_fall"] += int(np.sum(falling))
        lost_dv = np.hypot(p.update.gap_accel * lost_s, np.where(falling, weight, 0.0))
        u = model.Block(integrals, still.astype(float), np.minimum(lost_turn, np.pi), lost_dv)
        return MargSteps(u, *self._measurements(u, field_b, sigma, looks), still, samples)

    def _not_sampled(
        self, dt: np.ndarray, full: np.ndarray, doubt: np.ndarray, accel_full: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Sigma (N, 3) [rad] of unmeasured rotation, and time (N,) [s] without specific force.

        Args:
            dt: (N,) s, intervals between N + 1 samples.
            full: (N + 1, 3) bool, gyro at the end of its range.
            doubt: (N + 1, 3) rad/s, sigma of restored rates; NaN where not restored.
            accel_full: (N + 1,) bool, accelerometer at the end of its range.
        """
        p = self._parameters.update
        gap = np.where(dt > p.gap * self._usual_s, dt, 0.0)
        self.counts["imu_gaps"] += int(np.sum(gap > 0.0))
        known = np.isfinite(doubt)
        unknown = full & ~known
        lost = gap + dt * (accel_full[1:] | accel_full[:-1])
        # a saturated gyro misses rotation about its own axis, a gap about all three
        turn = p.gap_rate * (gap[:, None] + dt[:, None] * (unknown[1:] | unknown[:-1]))
        return turn + dt[:, None] * np.where(known, doubt, 0.0)[1:], lost

    def _measurements(
        self, u: model.Block, field_b: np.ndarray, sigma: np.ndarray, looks: Sequence[Look]
    ) -> tuple[dict[str, PyTree], dict[str, PyTree]]:
        """Measurements y and inputs aux at the end of each of K blocks; y is NaN where missing.

        Args:
            u: the blocks.
            field_b: (K, 3) T, mean field in body axes at the end of each.
            sigma: (K,) rad/s, of the mean rate at rest.
            looks: K results of `Sites.process_block`.
        """
        p, pace, time = self._parameters, self._pace, np.asarray(u.samples.dt_s)
        clock = np.cumsum(np.concatenate([[pace.clock_s], time]))[1:]
        pace.clock_s = float(clock[-1])
        whole, at_rest = time > 0.0, np.asarray(u.still) > 0.0
        moves, still = whole & ~at_rest, whole & at_rest
        # Errors of travel are correlated in time: thin out its measurements, as the filter takes
        # their noise as white.
        travels = pace.take(model.TRAVEL, clock, moves, p.travel.every)
        y: dict[str, Any] = {
            model.TRAVEL: _zeros_where(travels, 6),
            model.REST: _zeros_where(still, 6),
        }
        aux: dict[str, Any] = {
            model.REST: np.concatenate([mean_rate(u.samples), sigma[:, None]], axis=1)
        }
        if p.use_magnetometer != "never":
            there = np.all(np.isfinite(field_b), axis=1)
            look = pace.take(model.MAGNETOMETER, clock, there & ~still, p.travel.every)
            y[model.MAGNETOMETER] = Angle(np.where(look, 0.0, np.nan)), _zeros_where(look, 2)
            aux[model.MAGNETOMETER] = np.where(there[:, None], field_b, np.array([1e-5, 0.0, 0.0]))
            number = np.array([site for site, *_ in looks])
            y[model.REVISIT] = Angle(np.where(number >= 0, 0.0, np.nan))
            aux[model.REVISIT] = np.array([_of_site(look, p) for look in looks])
        return y, aux


def _zeros_where(known: np.ndarray, size: int) -> np.ndarray:
    """Measurements (K, size): zero where `known` (K,), else NaN."""
    return np.where(known[:, None], np.zeros((len(known), size)), np.nan)


def joined(steps: Sequence[MargSteps]) -> MargSteps:
    """Concatenate the steps of chunks."""
    return jax.tree_util.tree_map(lambda *rows: np.concatenate(rows), *steps)


def _in_blocks(values: np.ndarray, n: int, blank: float) -> np.ndarray:
    """Rows (M, ...) as blocks (K, n, ...), the last padded with `blank`."""
    blocks = -(-len(values) // n)
    pad = np.full((blocks * n - len(values), *values.shape[1:]), blank)
    return np.concatenate([values, pad]).reshape(blocks, n, *values.shape[1:])


def as_increments(imu: ImuTable, usual_s: float | None = None) -> ImuTable:
    """Rates as increments over the sampling intervals that they end.

    A MEMS chip outputs the mean over its last sampling interval, or older still due to its filters;
    taken as the rate at that instant, the attitude would lag the motion by half an interval.

    Args:
        imu: rates; increments are returned unchanged.
        usual_s: s, sampling interval; None: that of the table.
    """
    if imu.kind == "increment":
        return imu
    dt = np.diff(imu.time_ns) * 1e-9
    usual_s = usual_interval(dt) if usual_s is None else usual_s
    own = np.where(after_gap(dt, usual_s), usual_s, dt)
    own = np.concatenate([own[:1], own])[:, None]
    return replace(imu, gyro=imu.gyro * own, accel=imu.accel * own, kind="increment")


class MeasurementPace:
    """Scheduler that limits measurements of travel and field to one per interval."""

    def __init__(self) -> None:
        """Create a scheduler without a past measurement."""
        self.clock_s = 0.0  # end of the last block [s]
        self.due_s = {model.TRAVEL: -np.inf, model.MAGNETOMETER: -np.inf}

    def take(self, name: str, clock_s: np.ndarray, able: np.ndarray, every_s: float) -> np.ndarray:
        """Mask (K,) of the usable blocks (`able`) to measure in, at least about `every_s` apart."""
        out = np.zeros(len(clock_s), dtype=bool)
        for k in np.flatnonzero(able):
            if clock_s[k] >= self.due_s[name]:
                out[k] = True
                self.due_s[name] = clock_s[k] + every_s * (1.0 - 1e-9)
        return out


def _of_site(look: Look, parameters: MargReplay) -> np.ndarray:
    """Input aux of "revisit" (4 + SITES,): field in body axes, sigma of azimuth, site as 0/1."""
    site, field_b, dip = look
    leaning = np.tan(min(abs(dip), 1.5)) * parameters.stated.tilt
    sigma = np.hypot(parameters.magnetometer.site, leaning)
    return np.concatenate([field_b, [sigma], (np.arange(model.SITES) == site).astype(float)])


def mean_rate(integrals: model.Integrals) -> np.ndarray:
    """Mean rate (K, 3) [rad/s] of each block, from its rotation; for small angles, as at rest."""
    q, dt = np.asarray(integrals.turn), np.asarray(integrals.dt_s)[:, None]
    vector = 2.0 * q[:, 1:] * np.sign(q[:, :1])
    return np.where(dt > 0.0, vector / np.where(dt > 0.0, dt, 1.0), 0.0)


def mean_force(integrals: model.Integrals) -> np.ndarray:
    """Mean specific force (K, 3) [m/s^2] of each block, in body axes at its start."""
    dt = np.asarray(integrals.dt_s)[:, None]
    return np.asarray(integrals.dv) / np.where(dt > 0.0, dt, 1.0)
