"""Statistics of many runs, with their confidence.

A chunk of runs becomes sums over its runs and a few numbers of each; `Statistics.merge` joins
chunks, so that a campaign of any size needs the memory of the chunks at work. All that is joined
are plain arrays by name.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import jax
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import PyTree
from scipy.special import stdtrit

from robins.campaign.histogram import histogram_of, merged_histograms, percentiles
from robins.filters import Tally
from robins.filters.analysis.consistency import Verdict, grand_mean_nis
from robins.filters.chi_square import chi2_band
from robins.filters.consistency_limits import LEVEL
from robins.systems.study import Limit, Norm, StateBlock, View
from robins.systems.suspects import HELD, edges


@dataclass
class Statistics:
    """Running statistics of one filter: `add` chunks, or `merge` those of each chunk in order.

    Attributes:
        runs: added so far.
        diverged: runs whose error or covariance stopped being finite; they stay in the count, and
            every statistic that they touch is infinite rather than flattered.
        n: tangent dimension of the filter's state, which may exceed the reported components.
        example: the record of the first run, for figures.
        sums: over the runs, arrays by name.
        each: of every run, by name arrays with a leading axis of runs, one per chunk.
        bins: by block, tables of `robins.campaign.histogram`: lengths of the error at the epochs of
            `thinned`.
    """

    blocks: Sequence[StateBlock]
    count_from: int = 0  # first epoch that counts for per-run figures
    limits: Sequence[Limit] = ()
    count_to: int | None = None  # epoch after the last that counts
    norms: Sequence[Norm] = ()
    windows: Sequence[slice] = ()  # spans of epochs whose largest errors are kept
    faults: Mapping[str, np.ndarray] | None = None  # as of a `View`
    runs: int = 0
    diverged: int = 0
    n: int = 0
    example: dict[str, Any] | None = None
    sums: dict[str, Any] = field(default_factory=dict)
    each: dict[str, list[np.ndarray]] = field(default_factory=dict)
    bins: dict[str, np.ndarray] = field(default_factory=dict)

    @classmethod
    def of(cls, view: View | Statistics) -> Statistics:
        """Statistics of no runs yet, with the settings of a problem or of other statistics."""
        return cls(**{name: getattr(view, name) for name in _WANTED})

    def add(self, record: dict[str, PyTree]) -> None:
        """Add a chunk of records of `robins.campaign.record`."""
        error, sigma = record["error"], record["sigma"]
        if self.example is None:
            self.example = jax.tree_util.tree_map(lambda x: np.array(x[0]), record)
        bad = ~np.all(np.isfinite(error) & np.isfinite(sigma), axis=(1, 2))
        self.runs += len(error)
        self.diverged += int(np.sum(bad))
        self.n = int(record["dim"][0])
        error = _infinite(error, bad)
        self._sum("error", error)
        self._sum("square", error**2)
        self._sum("variance", sigma**2)
        nees = {"nees": record["nees"]}
        nees |= {f"nees of {name}": value for name, value in record["block_nees"].items()}
        for name, value in nees.items():
            self._each(name, np.mean(_infinite(value, bad)[:, self.counted], axis=1))
        self._sum("nees", _infinite(record["nees"], bad))
        for name, update in record["updates"].items():
            for what, value in (("nis", update.nis), ("dof", update.dof)):
                self._sum(f"{what} of {name}", value)
                self._each(f"{what} of {name}", np.sum(value, axis=1))
        self._outputs(record.get("outputs", {}), bad)
        self._scatter(error)
        self._lengths(error)
        self._within(error)
        self._suspected(record.get("wrong", {}))
        self._each("lost", bad)
        self._each("rms", np.sqrt(np.mean(error[:, self.counted] ** 2, axis=1)))
        self._each("variance", np.mean(sigma[:, self.counted] ** 2, axis=1))
        if self.windows:
            worst = [np.max(np.abs(error[:, span]), axis=1) for span in self.windows]
            self._each("peaks", np.stack(worst, axis=1))
        if "tally" in record:
            tally = record["tally"].with_innovations(record["updates"], record.get("readings"))
            for name, value in _by_name(tally).items():
                self._each(name, value)

    def merge(self, other: Statistics) -> None:
        """Join the statistics of the runs that follow, as if their records had been added here.

        Chunks that are joined in one order give the same bits on every worker, at any time.
        """
        self.runs += other.runs
        self.diverged += other.diverged
        self.n = other.n or self.n
        if self.example is None:
            self.example = other.example
        for name, value in other.sums.items():
            self.sums[name] = self.sums[name] + value if name in self.sums else value
        for name, values in other.each.items():
            self.each.setdefault(name, []).extend(values)
        for name, table in other.bins.items():
            self._count(name, table)

    def blank(self) -> Statistics:
        """Statistics of no runs yet, with the settings of these: for a chunk, to be merged."""
        return Statistics.of(self)

    def resampled(self, draws: np.ndarray) -> Iterator[Statistics]:
        """Statistics of resampled runs, for a bootstrap.

        Sums over the runs at each epoch cannot be formed again, and are NaN there: figures pooled
        over the epochs are those of the runs drawn.

        Args:
            draws: (B, runs) numbers of runs.
        """
        each = {name: self._all(name) for name in self.each}
        sums = {name: np.full(np.shape(x), np.nan) for name, x in self.sums.items()}
        for at in draws:
            one = self.blank()
            one.runs, one.n, one.example = len(at), self.n, self.example
            one.sums, one.each = sums, {name: [x[at]] for name, x in each.items()}
            one.diverged = int(np.sum(one.lost))
            yield one

    def _sum(self, name: str, values: np.ndarray) -> None:
        total = np.sum(values, axis=0)
        self.sums[name] = self.sums[name] + total if name in self.sums else total

    def _each(self, name: str, values: ArrayLike) -> None:
        self.each.setdefault(name, []).append(np.array(values))

    def _count(self, name: str, table: np.ndarray) -> None:
        self.bins[name] = merged_histograms(self.bins[name], table) if name in self.bins else table

    def _all(self, name: str) -> np.ndarray:
        return np.concatenate(self.each[name])

    def _outputs(self, outputs: dict[str, np.ndarray], bad: np.ndarray) -> None:
        for name, value in outputs.items():
            value = _infinite(value, bad)
            self._sum(f"square of {name}", value**2)
            squares = np.mean(value[:, self.counted] ** 2, axis=1)
            self._each(f"rms of {name}", np.sqrt(squares))
            worst = np.max(np.linalg.norm(value[:, self.counted], axis=2), axis=1)
            self._each(f"worst of {name}", worst)

    def _scatter(self, error: np.ndarray) -> None:
        """Add products and lengths of the errors of each block, at some epochs."""
        some = error[:, thinned(error.shape[1])]
        for block in self.blocks:
            of = some[:, :, block.where]
            i, j = np.tril_indices(of.shape[2], -1)
            self._sum(f"product of {block.name}", of[:, :, i] * of[:, :, j])
            self._count(block.name, histogram_of(np.linalg.norm(of, axis=2)))

    def _lengths(self, error: np.ndarray) -> None:
        for norm in self.norms:
            whole = np.sqrt(np.sum(error[:, :, list(norm.components)] ** 2, axis=2))
            length = whole[:, self.counted]
            with np.errstate(invalid="ignore"):  # the spread of an infinite error
                pair = np.stack([np.mean(length, axis=1), np.std(length, axis=1)], axis=1)
            self._each(f"norm {norm.name}", pair)
            if self.windows:
                worst = [np.max(whole[:, span], axis=1) for span in self.windows]
                self._each(f"peaks of {norm.name}", np.stack(worst, axis=1))

    def _suspected(self, wrong: Mapping[str, np.ndarray]) -> None:
        """Add probabilities of suspects; by run first alarm, false alarms, and detection delays.

        An alarm is a probability above `HELD`. A fault is a span of epochs, detected by an alarm
        within it.
        """
        for name, chance in wrong.items():
            held = chance > HELD
            self._sum(f"wrong {name}", chance)
            self._each(f"first wrong {name}", _first(held))
            if self.faults is None:
                continue
            true = np.zeros(held.shape[1], bool) | self.faults.get(name, False)
            right = np.flatnonzero(~true[self.counted]) + self.count_from
            self._each(
                f"false alarms of {name}", np.sum(held[:, right], axis=1) / max(len(right), 1)
            )
            delays = [_first(held[:, a:b]) for a, b in edges(true)]
            self._each(f"delay {name}", np.transpose(delays).reshape(len(held), len(delays)))

    def _within(self, error: np.ndarray) -> None:
        for limit in self.limits:
            where = next(b.where for b in self.blocks if b.name == limit.block)
            over = np.max(np.abs(error[:, :, where]), axis=2) > limit.value
            self._sum(f"within {limit.name}", ~over)
            last = over.shape[1] - np.argmax(over[:, ::-1], axis=1)
            self._each(f"settled {limit.name}", np.where(np.any(over, axis=1), last, 0))

    @property
    def first_run(self) -> dict[str, PyTree]:
        """The record of the first run.

        Raises:
            ValueError: nothing was added yet.
        """
        if self.example is None:
            raise ValueError("there is no run yet: add the records of a campaign first")
        return self.example

    @property
    def lost(self) -> np.ndarray:
        """(runs,) flags of those that diverged."""
        return self._all("lost")

    @property
    def rms(self) -> np.ndarray:
        """(E, r) root mean square error over the runs."""
        return np.sqrt(self.sums["square"] / self.runs)

    @property
    def mean(self) -> np.ndarray:
        """(E, r) mean error over the runs, the bias of a filter."""
        return self.sums["error"] / self.runs

    @property
    def thinned(self) -> np.ndarray:
        """(T,) indices of the epochs of `covariance` and `percentiles`."""
        return thinned(len(self.sums["error"]))

    def covariance(self, block: StateBlock) -> np.ndarray:
        """(T, k, k) covariance of the errors of a block; NaN of one run, infinite if one diverged.

        It is computed from sums of products, and loses digits where the mean far exceeds the
        scatter.
        """
        k, at = len(block.axes), self.thinned
        if self.diverged or self.runs < 2:
            return np.full((len(at), k, k), np.inf if self.diverged else np.nan)
        i, j = np.tril_indices(k, -1)
        mean = self.mean[at, block.where]
        products = np.zeros((len(at), k, k))
        products[:, i, j] = products[:, j, i] = self.sums[f"product of {block.name}"]
        products[:, range(k), range(k)] = self.sums["square"][at, block.where]
        mean_products = mean[:, :, None] * mean[:, None, :]
        return (products - self.runs * mean_products) / (self.runs - 1)

    def percentiles(self, block: StateBlock) -> np.ndarray:
        """(T, 4) lengths of the error of a block that `PERCENTS` of the runs do not exceed.

        They are accurate to a bin of `robins.campaign.histogram`; a diverged run is beyond all.
        """
        return percentiles(self.bins[block.name], len(self.thinned), PERCENTS)

    @property
    def sigma(self) -> np.ndarray:
        """(E, r) root of the mean variance that the filter states."""
        return np.sqrt(self.sums["variance"] / self.runs)

    @property
    def counted(self) -> slice:
        """The epochs that count for figures pooled over time."""
        return slice(self.count_from, self.count_to)

    def norm(self, name: str) -> np.ndarray:
        """(runs, 2) mean and standard deviation over time of a norm of the error, by run."""
        return self._all(f"norm {name}")

    @property
    def peaks(self) -> np.ndarray:
        """(runs, windows, r) largest error of each run in each window."""
        return self._all("peaks")

    def norm_peaks(self, name: str) -> np.ndarray:
        """(runs, windows) largest value of a norm of the error in each window."""
        return self._all(f"peaks of {name}")

    def output_rms(self, name: str) -> np.ndarray:
        """(E, k) root mean square of an output over the runs."""
        return np.sqrt(self.sums[f"square of {name}"] / self.runs)

    def run_output_rms(self, name: str) -> np.ndarray:
        """(runs, k) root mean square of an output over the epochs counted."""
        return self._all(f"rms of {name}")

    def run_output_worst(self, name: str) -> np.ndarray:
        """(runs,) greatest length of an output over the epochs counted."""
        return self._all(f"worst of {name}")

    @property
    def run_rms(self) -> np.ndarray:
        """(runs, r) root mean square error of each run over the epochs counted."""
        return self._all("rms")

    @property
    def pooled_rms(self) -> np.ndarray:
        """(r,) root mean square error over the runs and the epochs counted."""
        return np.sqrt(np.mean(self.run_rms**2, axis=0))

    @property
    def pooled_sigma(self) -> np.ndarray:
        """(r,) root of the mean variance stated over the runs and the epochs counted."""
        return np.sqrt(np.mean(self._all("variance"), axis=0))

    def mean_nees(self) -> dict[str, float]:
        """Mean NEES over runs and epochs counted, over its degrees of freedom: ``nees_all_states``
        of the whole state, which may have more than is reported, ``nees_attitude`` and the like.
        """
        of = {"all_states": float(np.mean(self._all("nees"))) / self.n}
        for block in self.blocks:
            if (name := f"nees of {block.name}") in self.each:
                of[block.name] = float(np.mean(self._all(name))) / len(block.axes)
        return {f"nees_{name}": value for name, value in of.items()}

    def share_within(self, limit: str) -> np.ndarray:
        """(E,) share of the runs whose largest error in the block is within a limit."""
        return self.sums[f"within {limit}"] / self.runs

    def settled(self, limit: str) -> np.ndarray:
        """(runs,) index of the epoch from which on a run is within a limit; E: never."""
        return self._all(f"settled {limit}")

    @property
    def suspects(self) -> list[str]:
        """Names of what the filter may find wrong."""
        names = [name for name in self.sums if name.startswith("wrong ")]
        return [name.removeprefix("wrong ") for name in names]

    def fault_probability(self, suspect: str) -> np.ndarray:
        """(E,) mean fault probability of a suspect."""
        return self.sums[f"wrong {suspect}"] / self.runs

    def first_alarm(self, suspect: str) -> np.ndarray:
        """(runs,) epoch of its first alarm; -1: none."""
        return self._all(f"first wrong {suspect}")

    def false_alarms(self, suspect: str) -> np.ndarray:
        """(runs,) share of alarms among the counted epochs without its fault."""
        return self._all(f"false alarms of {suspect}")

    def delays(self, suspect: str) -> np.ndarray:
        """(runs, faults) epochs from the start of each fault to its detection; -1: none."""
        return self._all(f"delay {suspect}")

    @property
    def tally(self) -> Tally:
        """Tally of the steps; leading axis of runs."""
        found: dict[str, dict[str, np.ndarray]] = {field: {} for field in Tally._fields}
        for name in self.each:
            what, _, sensor = name.partition(TALLY)
            if what in found:
                found[what][sensor] = self._all(name)
        if not found["predictions"]:
            return Tally.blank(())
        return Tally(found.pop("predictions")[""], **found)

    def overall_ratio(self) -> np.ndarray:
        """(r,) RMS error over stated sigma, both pooled over the epochs counted; ideally 1."""
        return self.pooled_rms / self.pooled_sigma

    def ratio_bounds(self, level: float = 0.99) -> np.ndarray:
        """(r, 2) bounds of `overall_ratio` that hold for all states at once at this level.

        Runs are independent, the epochs of one are not, so the spread between runs is what counts;
        the level is shared out over the states (Bonferroni).
        """
        squares = (self.run_rms / self.pooled_sigma) ** 2
        each = 1.0 - (1.0 - level) / squares.shape[1]
        _, low, high = rms_with_bounds(squares, each)
        return np.column_stack([np.asarray(low), np.asarray(high)])

    def anees(self) -> np.ndarray:
        """(E,) average NEES over n."""
        return self.sums["nees"] / (self.runs * self.n)

    def anees_band(self, level: float = LEVEL) -> np.ndarray:
        """(2,) chi-square band of `anees` at this level."""
        return chi2_band(self.n, self.runs, level) / self.n

    def anees_share_inside(self, level: float = LEVEL) -> float:
        """Share of the epochs counted whose ANEES is inside its band."""
        low, high = self.anees_band(level)
        value = self.anees()[self.counted]
        if np.any(np.isnan(value)):
            return float("nan")
        return float(np.mean((value >= low) & (value <= high)))

    def nis(self, sensor: str, level: float = LEVEL) -> Verdict:
        """Grand mean NIS of a sensor per degree of freedom, all runs and epochs, and its band."""
        return grand_mean_nis(self._all(f"nis of {sensor}"), self._all(f"dof of {sensor}"), level)

    @property
    def sensors(self) -> list[str]:
        """Sensors that were used at all."""
        names = [name for name in self.each if name.startswith("dof of ")]
        return [name.removeprefix("dof of ") for name in names if np.sum(self._all(name)) > 0]


_WANTED = ("blocks", "count_from", "limits", "count_to", "norms", "windows", "faults")
Numbers = float | np.ndarray
TALLY = " counted of "
PERCENTS = (5, 50, 95, 99)
THIN = 128  # epochs at which the scatter is kept: its memory does not grow with the steps


def thinned(epochs: int) -> np.ndarray:
    """Indices of at most `THIN` evenly spaced epochs from the first to the last."""
    return np.unique(np.rint(np.linspace(0, epochs - 1, min(THIN, epochs))).astype(int))


def _first(holds: np.ndarray) -> np.ndarray:
    """(runs,) first epoch at which something holds (runs, E); -1 where it never does."""
    return np.where(np.any(holds, axis=1), np.argmax(holds, axis=1), -1)


def _by_name(tally: Tally) -> dict[str, ArrayLike]:
    """The arrays of a tally by names of their own."""
    of = {name: getattr(tally, name) for name in Tally._fields[1:]}
    by = {f"{what}{TALLY}{sensor}": v for what, some in of.items() for sensor, v in some.items()}
    return {"predictions": tally.predictions, **by}


def _infinite(values: np.ndarray, bad: np.ndarray) -> np.ndarray:
    """Values whose bad runs are infinite throughout."""
    if not np.any(bad):
        return values
    return np.where(bad.reshape(-1, *[1] * (values.ndim - 1)), np.inf, values)


def mean_with_bounds(values: np.ndarray, level: float = 0.95) -> tuple[Numbers, Numbers, Numbers]:
    """Mean of independent numbers, or of each column, with its Student-t confidence bounds."""
    values = np.asarray(values, dtype=float)
    mean, count = np.mean(values, axis=0), len(values)
    if count < 2:
        return mean, mean * np.nan, mean * np.nan
    quantile = stdtrit(count - 1, 0.5 + level / 2.0)
    half = quantile * np.std(values, axis=0, ddof=1) / np.sqrt(count)
    return mean, mean - half, mean + half


def rms_with_bounds(
    square_means: np.ndarray, level: float = 0.95
) -> tuple[Numbers, Numbers, Numbers]:
    """Root of the mean of per-run mean squares, with bounds from the spread between runs.

    Epochs of one run are correlated, runs are not, so the spread between runs is what counts.
    """
    mean, low, high = mean_with_bounds(square_means, level)
    return np.sqrt(mean), np.sqrt(np.maximum(low, 0.0)), np.sqrt(high)
