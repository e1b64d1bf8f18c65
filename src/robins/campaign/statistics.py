"""Statistics of many runs, with their confidence.

Sums are taken chunk by chunk, so a campaign of any size needs the memory of one chunk.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import jax
import numpy as np
from scipy import stats

from robins.filters import Tally
from robins.filters.analysis.consistency import Verdict, grand_mean_nis
from robins.filters.chi_square import chi2_band
from robins.systems.study import Limit, Norm, StateBlock


@dataclass
class Statistics:
    """Running sums over the runs of one filter; `add` a chunk at a time.

    Attributes:
        runs: added so far.
        diverged: runs whose error or covariance stopped being finite; they stay in the count, and
            every statistic that they touch is infinite rather than flattered.
        run_rms: (runs, r) root mean square of the error of each run over the epochs counted.
        example: the record of the first run, for figures.
    """

    blocks: Sequence[StateBlock]
    count_from: int = 0  # first epoch that counts for per-run figures
    limits: Sequence[Limit] = ()
    count_to: int | None = None  # epoch after the last that counts
    norms: Sequence[Norm] = ()
    windows: Sequence[slice] = ()  # spans of epochs whose largest errors are kept
    runs: int = 0
    diverged: int = 0
    n: int = 0  # tangent dimension of the filter's state, which may have more than is reported
    example: dict[str, Any] | None = None
    _square: Any = 0.0
    _variance: Any = 0.0
    _nees: Any = 0.0
    _block_nees: dict[str, Any] = field(default_factory=dict)
    _nis: dict[str, Any] = field(default_factory=dict)
    _dof: dict[str, Any] = field(default_factory=dict)
    _tallies: list[Tally] = field(default_factory=list)
    _run_rms: list[np.ndarray] = field(default_factory=list)
    _within: dict[str, Any] = field(default_factory=dict)
    _settled: dict[str, list[np.ndarray]] = field(default_factory=dict)
    _norms: dict[str, list[np.ndarray]] = field(default_factory=dict)
    _peaks: list[np.ndarray] = field(default_factory=list)
    _norm_peaks: dict[str, list[np.ndarray]] = field(default_factory=dict)
    _output_square: dict[str, Any] = field(default_factory=dict)
    _run_output_rms: dict[str, list[np.ndarray]] = field(default_factory=dict)
    _run_output_worst: dict[str, list[np.ndarray]] = field(default_factory=dict)

    def add(self, record: dict[str, Any]) -> None:
        """Take in a chunk as `robins.campaign.record` gives it."""
        error, sigma = record["error"], record["sigma"]
        if self.example is None:
            self.example = jax.tree_util.tree_map(lambda x: x[0], record)
        bad = ~np.all(np.isfinite(error) & np.isfinite(sigma), axis=(1, 2))
        error = np.where(bad[:, None, None], np.inf, error)
        self.runs += len(error)
        self.diverged += int(np.sum(bad))
        self._square = self._square + np.sum(error**2, axis=0)
        self._variance = self._variance + np.sum(sigma**2, axis=0)
        self._nees = self._nees + np.sum(np.where(bad[:, None], np.inf, record["nees"]), axis=0)
        for name, value in record["block_nees"].items():
            total = np.sum(np.where(bad[:, None], np.inf, value), axis=0)
            self._block_nees[name] = self._block_nees.get(name, 0.0) + total
        for name, update in record["updates"].items():
            self._nis[name] = self._nis.get(name, 0.0) + np.sum(update.nis, axis=0)
            self._dof[name] = self._dof.get(name, 0) + np.sum(update.dof, axis=0)
        self._tallies.append(record.get("tally", Tally.blank(())))
        for name, value in record.get("outputs", {}).items():
            value = np.where(bad[:, None, None], np.inf, value)
            self._output_square[name] = self._output_square.get(name, 0.0) + np.sum(value**2, 0)
            squares = np.mean(value[:, self.counted] ** 2, axis=1)
            self._run_output_rms.setdefault(name, []).append(np.sqrt(squares))
            worst = np.max(np.linalg.norm(value[:, self.counted], axis=2), axis=1)
            self._run_output_worst.setdefault(name, []).append(worst)
        self.n = int(record["dim"][0])
        counted = error[:, self.counted]
        for norm in self.norms:
            whole = np.sqrt(np.sum(error[:, :, list(norm.components)] ** 2, axis=2))
            length = whole[:, self.counted]
            with np.errstate(invalid="ignore"):  # the spread of an infinite error
                pair = np.stack([np.mean(length, axis=1), np.std(length, axis=1)], axis=1)
            self._norms.setdefault(norm.name, []).append(pair)
            if self.windows:
                worst = [np.max(whole[:, span], axis=1) for span in self.windows]
                self._norm_peaks.setdefault(norm.name, []).append(np.stack(worst, axis=1))
        self._run_rms.append(np.sqrt(np.mean(counted**2, axis=1)))
        if self.windows:
            worst = [np.max(np.abs(error[:, span]), axis=1) for span in self.windows]
            self._peaks.append(np.stack(worst, axis=1))
        for limit in self.limits:
            where = next(b.where for b in self.blocks if b.name == limit.block)
            over = np.max(np.abs(error[:, :, where]), axis=2) > limit.value
            self._within[limit.name] = self._within.get(limit.name, 0) + np.sum(~over, axis=0)
            last = over.shape[1] - np.argmax(over[:, ::-1], axis=1)
            settled = np.where(np.any(over, axis=1), last, 0)
            self._settled.setdefault(limit.name, []).append(settled)

    @property
    def first_run(self) -> dict[str, Any]:
        """The record of the first run.

        Raises:
            ValueError: nothing was added yet.
        """
        if self.example is None:
            raise ValueError("there is no run yet: add the records of a campaign first")
        return self.example

    @property
    def rms(self) -> np.ndarray:
        """(E, r) root mean square error over the runs."""
        return np.sqrt(self._square / self.runs)

    @property
    def sigma(self) -> np.ndarray:
        """(E, r) root of the mean variance that the filter states."""
        return np.sqrt(self._variance / self.runs)

    @property
    def counted(self) -> slice:
        """The epochs that count for figures pooled over time."""
        return slice(self.count_from, self.count_to)

    def norm(self, name: str) -> np.ndarray:
        """(runs, 2) mean and standard deviation over time of a norm of the error, by run."""
        return np.concatenate(self._norms[name])

    @property
    def peaks(self) -> np.ndarray:
        """(runs, windows, r) largest error of each run in each window."""
        return np.concatenate(self._peaks)

    def norm_peaks(self, name: str) -> np.ndarray:
        """(runs, windows) the same of a norm."""
        return np.concatenate(self._norm_peaks[name])

    def output_rms(self, name: str) -> np.ndarray:
        """(E, k) root mean square of an output over the runs."""
        return np.sqrt(self._output_square[name] / self.runs)

    def run_output_rms(self, name: str) -> np.ndarray:
        """(runs, k) root mean square of an output over the epochs counted."""
        return np.concatenate(self._run_output_rms[name])

    def run_output_worst(self, name: str) -> np.ndarray:
        """(runs,) greatest length of an output over the epochs counted."""
        return np.concatenate(self._run_output_worst[name])

    @property
    def run_rms(self) -> np.ndarray:
        """(runs, r)."""
        return np.concatenate(self._run_rms)

    def share_within(self, limit: str) -> np.ndarray:
        """(E,) share of the runs whose largest error in the block is within a limit."""
        return self._within[limit] / self.runs

    def settled(self, limit: str) -> np.ndarray:
        """(runs,) number of the epoch from which on a run is within a limit; E: never."""
        return np.concatenate(self._settled[limit])

    @property
    def tally(self) -> Tally:
        """How the steps went; leading axis of runs."""
        return jax.tree_util.tree_map(lambda *x: np.concatenate(x), *self._tallies)

    def overall_ratio(self) -> np.ndarray:
        """(r,) RMS error over stated sigma, both pooled over the epochs counted; one is right."""
        at = self.counted
        return np.sqrt(np.sum(self._square[at], 0) / np.sum(self._variance[at], 0))

    def ratio_bounds(self, level: float = 0.99) -> np.ndarray:
        """(r, 2) bounds of `overall_ratio` that hold for all states at once at this level.

        Runs are independent, the epochs of one are not, so the spread between runs is what counts;
        the level is shared out over the states (Bonferroni).
        """
        variance = np.mean(self._variance[self.counted] / self.runs, axis=0)
        squares = self.run_rms**2 / variance
        each = 1.0 - (1.0 - level) / squares.shape[1]
        return np.array([rms_with_bounds(column, each)[1:] for column in squares.T])

    def anees(self) -> np.ndarray:
        """(E,) average NEES over n."""
        return self._nees / (self.runs * self.n)

    def block_anees(self) -> dict[str, np.ndarray]:
        """(E,) average NEES of each block over its size."""
        size = {b.name: len(b.axes) for b in self.blocks}
        return {k: v / (self.runs * size[k]) for k, v in self._block_nees.items()}

    def anees_band(self, level: float = 0.95) -> np.ndarray:
        """(2,) band of `anees`."""
        return chi2_band(self.n, self.runs, level) / self.n

    def anees_share_inside(self, level: float = 0.95) -> float:
        """Share of the epochs counted whose ANEES is inside its band."""
        low, high = self.anees_band(level)
        value = self.anees()[self.counted]
        return float(np.mean((value >= low) & (value <= high)))

    def nis(self, sensor: str, level: float = 0.95) -> Verdict:
        """Grand mean NIS of a sensor per degree of freedom, all runs and epochs, and its band."""
        return grand_mean_nis(self._nis[sensor], self._dof[sensor], level)

    @property
    def sensors(self) -> list[str]:
        """Sensors that were used at all."""
        return [k for k, v in self._dof.items() if np.sum(v) > 0]


def mean_with_bounds(values: np.ndarray, level: float = 0.95) -> tuple[float, float, float]:
    """Mean of independent numbers with its Student-t confidence bounds."""
    values = np.asarray(values, dtype=float)
    mean = float(np.mean(values))
    if len(values) < 2:
        return mean, float("nan"), float("nan")
    half = stats.t.ppf(0.5 + level / 2.0, len(values) - 1) * np.std(values, ddof=1)
    half = float(half / np.sqrt(len(values)))
    return mean, mean - half, mean + half


def rms_with_bounds(square_means: np.ndarray, level: float = 0.95) -> tuple[float, float, float]:
    """Root of the mean of per-run mean squares, with bounds from the spread between runs.

    Epochs of one run are correlated, runs are not, so the spread between runs is what counts.
    """
    mean, low, high = mean_with_bounds(square_means, level)
    return float(np.sqrt(mean)), float(np.sqrt(max(low, 0.0))), float(np.sqrt(high))
