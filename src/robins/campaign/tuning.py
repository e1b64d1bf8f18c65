"""Tuning of filter parameters on runs or a log, with the confidence that the data allow.

Parameters are tuned by a factor each: x is the natural logarithm of the factors, zero where they
are as written. The measures of a filter come in independent *parts*, the runs of a campaign or
the segments of a log; the objective is a function of their mean. The spread of the parts shows how
much of a difference is chance.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Hashable, Sequence
from functools import cached_property, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy import optimize
from scipy.special import ndtri, stdtrit

from robins.campaign.many_runs import ManyRuns
from robins.errors import RobinsError
from robins.results import Progress, ignore_progress

FARTHEST = math.log(1000.0)  # limit of |x|: a factor of 1000 either way
TOO_WIDE = math.log(3.0)  # half width of a 95 % interval: wider ones are undetermined
FEWEST_PARTS = 6
Tree = Any  # a pytree of arrays
Measure = Callable[[Tree, Tree], Array]
_STEP = 0.01  # of differences of runs
_COARSE = 0.1  # where a run may be discontinuous, or is traced again
_CURVED = 0.05  # of differences of gradients
_LOST = 1e6  # objective where a filter diverges


class Trial(NamedTuple):
    """Filter at given parameters x.

    Attributes:
        kind: where it differs, measures may be discontinuous, as by another threshold.
        numbers: pytree of arrays; of another structure it is traced again.
    """

    kind: Hashable
    numbers: Any


class Data(NamedTuple):
    """Data of the measurement: arrays with a leading axis of runs, and the parts that count."""

    arrays: Any
    rows: np.ndarray | None = None  # numbers of parts; None: all


class Objective(NamedTuple):
    """Objective to be minimised.

    Attributes:
        trial: ``x (p,) -> Trial``; raises a ValueError where there is no such filter.
        measure: ``(numbers, arrays of one run) -> (k,) or (parts, k)``, pure.
        total: ``(k,) mean of the parts -> objective``; smooth.
    """

    trial: Callable[[np.ndarray], Trial]
    measure: Measure
    total: Callable[[np.ndarray], float]


class Tuned(NamedTuple):
    """Result of the tuning.

    Attributes:
        x: (p,) log factors.
        sigma: (p,) their standard deviations, by the spread of the parts chosen on.
        gradient: true if found by gradient, false if by search.
        evaluations: of the objective, those of the gradient among them.
        before: (parts, k) of the data held out, as written.
        after: (parts, k) with the parameters found.
        gain: decrease of the objective on the data held out; negative: it is worse.
        gain_low: its one-sided lower bound of 95 % confidence.
        notes: parts that JAX computed, with the reason.
    """

    x: Float[np.ndarray, "p"]
    sigma: Float[np.ndarray, "p"]
    gradient: bool
    evaluations: int
    before: np.ndarray
    after: np.ndarray
    gain: float
    gain_low: float
    notes: list[str]

    @property
    def better(self) -> bool:
        """True if it is significantly better on the held-out data."""
        return self.gain_low > 0.0


class UndeterminedError(RobinsError, ValueError):
    """The data do not determine a parameter."""


def choose(
    objective: Objective,
    names: Sequence[str],
    chosen_on: Data,
    judged_on: Data,
    progress: Progress = ignore_progress,
) -> Tuned:
    """Find x on some data, and judge it on other data.

    By gradient (L-BFGS-B) where the parameters are numbers of the model, by search (Nelder & Mead
    1965) where they are of the filter itself, whose decisions are discontinuous, or determine a
    structure.

    Args:
        objective: to be minimised.
        names: (p,) of the parameters, for messages.
        chosen_on: at least `FEWEST_PARTS` parts.
        judged_on: other parts, of the same shapes.
        progress: called with the fraction done and the current activity.

    Raises:
        UndeterminedError: there are too few parts, a parameter changes nothing, runs away, or its
            interval of 95 % is wider than a factor of 3 either way.
    """
    slopes = ObjectiveGradient(objective, len(names), chosen_on, progress)
    x0 = np.zeros(len(names))
    first, jacobian = slopes.at(x0)
    if len(first) < FEWEST_PARTS:
        raise UndeterminedError(
            f"{len(first)} runs or segments of a log are too few to tell chance from a difference; "
            f"{FEWEST_PARTS} are the least"
        )
    if not np.isfinite(slopes.total(first)):
        raise UndeterminedError("the filter is lost as it is written: begin from other values")
    idle = [
        n for n, column in zip(names, np.moveaxis(jacobian, -1, 0), strict=True) if not column.any()
    ]
    if idle:
        raise UndeterminedError(
            f"{' and '.join(idle)} changes nothing that the filter says: leave it out"
        )
    x = _minimiser(slopes, len(names))
    for name, one in zip(names, x, strict=True):
        if abs(one) > 0.98 * FARTHEST:
            way = "large" if one > 0.0 else "small"
            raise UndeterminedError(
                f"{name} would become {way} without end: the data do not say what it is"
            )
    sigma = _sigma(slopes, x, names)
    progress(0.95, "judging on data held out")
    before, after = slopes.parts([x0, x], judged_on)
    gain, low = _improvement(objective.total, before, after)
    return Tuned(
        x, sigma, slopes.gradient, slopes.evaluations, before, after, gain, low, slopes.notes
    )


class ObjectiveGradient:
    """An objective and its gradient, on the data that x is chosen on.

    By central differences: all ends are computed at once, and the same noise makes the objective
    smooth. Differentiating a run (forward mode through the factorisations of 2 700 steps of
    INS/GNSS) took 20 times as long to compute and 5 times as long to compile as the run.
    """

    def __init__(
        self, objective: Objective, p: int, data: Data, progress: Progress = ignore_progress
    ):
        self._objective, self._p, self._data, self._progress = objective, p, data, progress
        self._measured: dict[Hashable, ManyRuns] = {}  # by structure
        self.evaluations = 0

    @cached_property
    def gradient(self) -> bool:
        """True if only numbers depend on the parameters, and measures are continuous."""
        try:
            near = [self._objective.trial(x) for x in (np.zeros(self._p), *_STEP * np.eye(self._p))]
        except ValueError:
            return False
        return all((one.kind, _form(one)) == (near[0].kind, _form(near[0])) for one in near)

    def parts(self, at: Sequence[np.ndarray], data: Data | None = None) -> list[np.ndarray]:
        """(parts, k) at each x, of the data to choose on or others; NaN if there is no filter."""
        data = data or self._data
        self.evaluations += len(at)
        share = 0.9 * self.evaluations / (self.evaluations + 40.0 * self._p)
        self._progress(share, f"evaluation {self.evaluations}")
        found = [np.full((1, 1), np.nan)] * len(at)
        every: dict[Hashable, dict[int, Trial]] = {}
        for k, x in enumerate(at):
            with contextlib.suppress(ValueError):
                trial = self._objective.trial(x)
                every.setdefault(_form(trial), {})[k] = trial
        for form, trials in every.items():
            measured = self._measured.setdefault(form, ManyRuns(self._objective.measure))
            of = measured([trial.numbers for trial in trials.values()], data.arrays)
            for k, some in zip(trials, of, strict=True):
                parts = some.reshape(-1, some.shape[-1])
                found[k] = parts if data.rows is None else parts[data.rows]
        return found

    @property
    def notes(self) -> list[str]:
        """Parts that JAX computed, with the reason."""
        return list(dict.fromkeys(note for one in self._measured.values() for note in one.notes))

    def total(self, parts: np.ndarray) -> float:
        """The objective of some parts; infinite where the filter diverges."""
        mean = np.mean(parts, axis=0)
        if not np.all(np.isfinite(mean)):
            return np.inf
        with np.errstate(divide="ignore", invalid="ignore"):
            found = self._objective.total(mean)
        return found if np.isfinite(found) else np.inf

    def at(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(parts, k) measures at x, and their derivatives by x (parts, k, p)."""
        step = _STEP if self.gradient else _COARSE
        steps = step * np.eye(self._p)
        here, *ends = self.parts([x, *(x + steps), *(x - steps)])
        above, below = ends[: self._p], ends[self._p :]
        with np.errstate(invalid="ignore"):  # of a filter that diverges
            slope = [(a - b) / (2.0 * step) for a, b in zip(above, below, strict=True)]
        return here, np.stack(slope, axis=-1)

    def gradients(self, x: np.ndarray) -> tuple[float, np.ndarray]:
        """The objective, and contributions of the parts (parts, p), whose mean is its gradient."""
        parts, by_x = self.at(x)
        total = self.total(parts)
        if not np.isfinite(total) or not np.all(np.isfinite(by_x)):
            return np.inf, np.zeros((len(parts), self._p))
        slope = _by_mean(self._objective.total, np.mean(parts, axis=0))
        return total, np.einsum("k,ukp->up", slope, by_x)


def _form(trial: Trial) -> Hashable:
    """Structure, shapes and types of the numbers of a trial; equal ones share a program."""
    leaves, tree = jax.tree_util.tree_flatten(trial.numbers)
    return tree, tuple((np.shape(x), jnp.result_type(x)) for x in leaves)


def _by_mean(total: Callable[[np.ndarray], float], mean: np.ndarray) -> np.ndarray:
    """(k,) derivative of the objective by the mean of the parts, by scaled differences."""
    steps = 1e-5 * np.maximum(np.abs(mean), 1e-300)
    ends = [(total(mean + e), total(mean - e)) for e in np.diag(steps)]
    return np.array([(a - b) / (2.0 * s) for (a, b), s in zip(ends, steps, strict=True)])


def _minimiser(slopes: ObjectiveGradient, p: int) -> np.ndarray:
    """Minimiser x of the objective."""
    edge = [(-FARTHEST, FARTHEST)] * p
    if slopes.gradient:

        def objective(x: np.ndarray) -> tuple[float, np.ndarray]:
            value, each = slopes.gradients(x)
            return (value, np.mean(each, axis=0)) if np.isfinite(value) else (_LOST, np.zeros(p))

        how = {"maxiter": 60, "ftol": 1e-9, "gtol": 1e-5}
        solve = partial(optimize.minimize, objective, jac=True, method="L-BFGS-B")
    else:

        def total(x: np.ndarray) -> float:
            return min(slopes.total(slopes.parts([x])[0]), _LOST)

        corners = np.vstack([np.zeros(p), 0.7 * np.eye(p)])
        how = {"initial_simplex": corners, "maxfev": 60 * p, "xatol": 0.01, "fatol": 1e-6}
        solve = partial(optimize.minimize, total, method="Nelder-Mead")
    return solve(np.zeros(p), bounds=edge, options=how).x


def _sigma(slopes: ObjectiveGradient, x: np.ndarray, names: Sequence[str]) -> np.ndarray:
    """(p,) standard deviations of x by the sandwich estimator.

    cov(x) = H^-1 cov(g) H^-1, from the curvature H and the parts' gradients g, holds for a wrong
    model too (Huber 1967).

    Raises:
        UndeterminedError: a parameter is not known within `TOO_WIDE`.
    """
    step = _CURVED if slopes.gradient else 2.0 * _COARSE
    _, each = slopes.gradients(x)
    ends = [[slopes.gradients(x + s * h)[1] for s in (1.0, -1.0)] for h in step * np.eye(len(x))]
    curve = np.array([(a.mean(axis=0) - b.mean(axis=0)) / (2.0 * step) for a, b in ends])
    curve = 0.5 * (curve + curve.T)
    value, axes = np.linalg.eigh(curve)
    # along an axis that is not curved upwards the data determine nothing
    scale = 1.0 / np.where(value > 1e-9 * max(value.max(), 0.0), value, np.nan)
    within = np.atleast_2d(np.cov(each, rowvar=False)) / len(each)
    turned = axes.T @ within @ axes * np.outer(scale, scale)
    lost = np.isnan(scale)
    spread = np.where(np.outer(lost, lost), np.inf, np.nan_to_num(turned))
    sigma = np.array([_component_sigma(row, spread) for row in axes])
    z = ndtri(0.975)
    wide = [
        f"{name} is known to a factor of {_factor_text(math.exp(min(z * s, 700.0)))} either way"
        for name, s in zip(names, sigma, strict=True)
        if z * s > TOO_WIDE
    ]
    if wide:
        raise UndeterminedError(
            f"the data say too little: {'; '.join(wide)}, at 95 %. Give more runs or a longer log, "
            "or tune fewer parameters: some act alike"
        )
    return sigma


def _component_sigma(row: np.ndarray, spread: np.ndarray) -> float:
    """Standard deviation of a component; infinite if an undetermined axis contributes to it."""
    endless = np.isinf(np.diag(spread))
    if np.any(endless & (np.abs(row) > 1e-6)):
        return math.inf
    return float(
        np.sqrt(max(row[~endless] @ spread[np.ix_(~endless, ~endless)] @ row[~endless], 0.0))
    )


def _factor_text(factor: float) -> str:
    return f"{factor:.3g}" if factor < 1e6 else "more than a million"


def _improvement(
    total: Callable[[np.ndarray], float], before: np.ndarray, after: np.ndarray
) -> tuple[float, float]:
    """Decrease of the objective, and its 95 % lower bound by the jackknife over the parts."""
    if not np.all(np.isfinite(after)):
        return -math.inf, -math.inf
    if not np.all(np.isfinite(before)):
        return math.inf, math.inf  # as written it diverges
    n = len(before)

    def fell(which: np.ndarray) -> float:
        return total(before[which].mean(axis=0)) - total(after[which].mean(axis=0))

    every = np.arange(n)
    gain = fell(every)
    # jackknife (Efron & Tibshirani 1993, ch. 11)
    without = np.array([fell(every != k) for k in every])
    sigma = math.sqrt((n - 1) / n * np.sum((without - without.mean()) ** 2))
    return gain, gain - float(stdtrit(n - 1, 0.95)) * sigma
