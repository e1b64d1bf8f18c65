"""The command `sensitivity`: the variance of the error by uncertain parameter."""

from __future__ import annotations

import itertools
import re
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
import xarray as xr

from robins import _float64, units
from robins.campaign.sensitivity import (
    Between,
    Budget,
    Indices,
    between,
    depends,
    indices,
    simulate_points,
    sobol_points,
    untraceable,
)
from robins.report.sensitivity import table
from robins.results import Outcome, Progress, array, silent
from robins.systems.study import StateBlock
from robins.workbench.errors import InputError, refusing
from robins.workbench.publication import csv_of
from robins.workbench.scenarios import asked, check_filters, read_scenario

RUNS, SAMPLES = 10, 256
MOST = 1 << 14  # samples
WIDE = 0.2  # width of a bound from which on an order is doubted
NOTHING = 1e-12  # total index of a parameter that does nothing
_TRACED = 0.1  # share of the time after which batches are computed
_RANGE = re.compile(r"(.+?)\s+to\s+(.+)")
_NUMBER = re.compile(r"([-+0-9.eE]+)\s*(.*)")


class Uncertain(NamedTuple):
    """A parameter, and the quantities between which it may be anything."""

    key: str
    low: float
    high: float
    unit: str  # of both, as it was written

    def text(self, number: float) -> str:
        """A value as `--set` takes it."""
        return f"{repr(number).removesuffix('.0')} {self.unit}".strip()

    @property
    def ends(self) -> tuple[str, str]:
        """Both as settings."""
        return f"{self.key}={self.text(self.low)}", f"{self.key}={self.text(self.high)}"


def uncertain(text: str) -> Uncertain:
    """Read ``key=low to high``; the unit of the high end serves for both.

    Raises:
        InputError: it is not of this form.
    """
    key, equals, rest = text.partition("=")
    ends = _RANGE.fullmatch(rest.strip())
    parts = [_NUMBER.fullmatch(end.strip()) for end in ends.groups()] if ends else []
    try:
        found = [(float(part[1]), part[2]) for part in parts if part]
    except ValueError:
        found = []
    if not equals or not key.strip() or len(found) != 2:
        raise InputError(
            "is not key=low to high",
            f"--vary {text}",
            'write --vary "slave.gyro_bias=1 deg/h to 10 deg/h" or the like.',
        )
    (low, first), (high, unit) = found
    if first not in ("", unit):
        raise InputError("has two units", f"--vary {text}", "write both ends in one unit.")
    return Uncertain(key.strip(), low, high, unit)


def sensitivity(
    name: str,
    *,
    vary: Sequence[str],
    filter_name: str = "",
    runs: int = RUNS,
    samples: int = SAMPLES,
    seed: int = 0,
    settings: Sequence[str] = (),
    progress: Progress = silent,
) -> Outcome:
    """Attribute the variance of the error to the uncertain parameters.

    The world varies; the filter believes the scenario as written. The output is the RMS of the
    length of the error of each block, over runs and epochs that count: requirements are stated
    for it, in a unit, and unlike its logarithm it has a variance where it may become zero.

    Args:
        name: "system/name", the path of a TOML file, or "file.py:study" of the user's own.
        vary: texts ``key=low to high``.
        filter_name: of the filter; by default the first of the scenario.
        runs: number at each point, the same runs at all.
        samples: a power of two; there are ``samples * (parameters + 2)`` points.
        seed: of the random streams and of the points.
        settings: "path=value" texts that change the scenario.
        progress: called with the share done and what is being done.

    Raises:
        InputError, robins.scenario.ScenarioError: the request cannot be computed.
    """
    _float64.require()
    every = _checked(vary, samples)
    read = read_scenario(name, settings)
    study, given = read.study, read.parameters
    wanted = filter_name or read.own[0]
    check_filters(read.label, study.filters, [wanted])
    progress(0.0, "setting up the simulation")
    with refusing(name):
        course, again = study.lay_out(given), study.lay_out(given)
        view, contender = study.view(given, course), study.contender(given, course, wanted)
    ranges = []
    for one in every:
        low, high = (read.parsed((*settings, end)) for end in one.ends)
        with refusing(f"--vary {one.key}"):
            ranges.append(between(low, high))
            laid = [study.lay_out(end) for end in (low, high)]
        if any(depends(course, again, end) for end in laid):
            raise InputError(
                "decides the motion or what else all runs share, so it cannot vary with the rest "
                "of the world",
                f"--vary {one.key}",
                "`robins sweep` lays out the scenario again for each of its values.",
            )
    budget = Budget(study, given, course, view, contender, seed, tuple(ranges))
    points = sobol_points(len(every), samples, seed)
    count = points.shape[0] * samples

    def told(share: float) -> None:
        done = round(share * count)
        progress(_TRACED + (1.0 - _TRACED) * share, f"{done} of {count} points")

    progress(0.01, f"tracing {count} points of {runs} runs")
    try:
        found, believed, jax_parts = simulate_points(budget, points.reshape(count, -1), runs, told)
    except jax.errors.JAXTypeError as error:
        raise _refused(budget, every) from error
    squares = found.reshape(*points.shape[:2], *found.shape[1:])
    computed = indices(squares, seed)
    told_of = believed.reshape(*points.shape[:2], runs)
    solution = _solution(wanted, every, points, squares, view.blocks, computed)
    return Outcome(
        solution=solution,
        metrics=_metrics(every, view.blocks, computed),
        files={
            "sensitivity.csv": _table(wanted, every, ranges, squares, view.blocks, computed),
            "points.csv": _points(every, ranges, points, squares, view.blocks),
        },
        notes=[*_notes(wanted, every, ranges, squares, view.blocks), *view.notes, *jax_parts],
        warnings=_warnings(wanted, every, squares, told_of, view.blocks, computed),
        scenario=read.label,
        seed=seed,
        runs=runs,
        machine="vm",
        tables=[table(solution)],
        last_lines=[
            "Table:  {out}/sensitivity.csv   all indices with their bounds; points.csv has samples",
            *_next(name, wanted, every, computed),
        ],
        **asked(read.text, settings),
    )


def _checked(vary: Sequence[str], samples: int) -> list[Uncertain]:
    every = [uncertain(text) for text in vary]
    keys = [one.key for one in every]
    if not every or len(set(keys)) < len(keys):
        raise InputError("name one parameter or more, each once", "--vary")
    nested = [b for a in keys for b in keys if b.startswith(f"{a}.")]
    if nested:
        raise InputError("is part of another that varies", f"--vary {nested[0]}", "name one.")
    if not 2 <= samples <= MOST or samples & (samples - 1):
        below = 1 << max(min(samples, MOST).bit_length() - 1, 1)
        raise InputError(
            f"must be a power of two from 2 to {MOST}",
            f"--samples {samples}",
            f"take {below} or {min(2 * below, MOST)}.",
        )
    return every


def _refused(budget: Budget, every: Sequence[Uncertain]) -> InputError:
    """Error for worlds that cannot be traced, with the reason."""
    names = [every[k].key for k in untraceable(budget)] or [one.key for one in every]
    return InputError(
        "decides a shape or a branch of the simulation, or goes through NumPy there, so that it "
        "cannot be varied within one program",
        " and ".join(f"--vary {name}" for name in names),
        "`robins sweep` traces each value; in a world of your own compute with jax.numpy.",
    )


# -------------------------------------------------------------------------------- of the report


def _law(one: Between) -> str:
    return "log-uniform" if one.by_logarithm else "uniform"


def _values(one: Uncertain, range_: Between, share: np.ndarray) -> np.ndarray:
    """A parameter at shares of its way, in its unit."""
    if range_.by_logarithm:
        return one.low * (one.high / one.low) ** share
    return one.low + (one.high - one.low) * share


def _spread(squares: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(s,) mean and standard deviation of the RMS over the independent points."""
    rms = np.sqrt(np.mean(squares[:2], axis=2)).reshape(-1, squares.shape[3])
    with np.errstate(invalid="ignore"):  # an infinite RMS has no spread
        return np.mean(rms, axis=0), np.std(rms, axis=0)


def _metrics(
    every: Sequence[Uncertain], blocks: Sequence[StateBlock], found: Indices
) -> dict[str, dict[str, Any]]:
    """Indices with their bounds, by parameter."""
    out: dict[str, dict[str, Any]] = {one.key: {} for one in every}
    for j, one in enumerate(every):
        for k, b in enumerate(blocks):
            for order in ("first", "total"):
                value, low, high = (
                    float(getattr(found, f"{order}{end}")[k, j]) for end in ("", "_low", "_high")
                )
                out[one.key] |= {
                    f"{b.name}_{order}_order": value,
                    f"{b.name}_{order}_order_bounds": [low, high],
                }
    return out


def _solution(
    name: str,
    every: Sequence[Uncertain],
    points: np.ndarray,
    squares: np.ndarray,
    blocks: Sequence[StateBlock],
    found: Indices,
) -> xr.Dataset:
    data: dict[str, Any] = {"parameter": ("parameter", [one.key for one in every])}
    about = {"of_filter": name, "samples": points.shape[1], "runs": squares.shape[2]}
    rms = np.sqrt(np.mean(squares, axis=2)).reshape(-1, len(blocks))
    for k, b in enumerate(blocks):
        for field in Indices._fields:
            more = about if field == "first" else {}
            data |= array(f"sobol_{field}", getattr(found, field)[k], b.name, **more)
        shown = {"unit": b.units, "display_unit": b.display_unit}
        data |= array("sobol_rms", rms[:, k], b.name, **shown)
    ends = "; ".join(f"{one.text(one.low)} to {one.text(one.high)}" for one in every)
    return xr.Dataset(data | array("sobol_share", points.reshape(len(rms), -1), ends=ends))


def _table(
    name: str,
    every: Sequence[Uncertain],
    ranges: Sequence[Between],
    squares: np.ndarray,
    blocks: Sequence[StateBlock],
    found: Indices,
) -> bytes:
    mean, spread = _spread(squares)
    head = "filter block unit rms_mean rms_std parameter low high parameter_unit distribution"
    rows: list[list[Any]] = [[*head.split(), *Indices._fields, "samples", "runs"]]
    for k, b in enumerate(blocks):
        pair = [float(units.convert(x[k], b.units, b.display_unit)) for x in (mean, spread)]
        for j, one in enumerate(every):
            ends = [one.key, one.low, one.high, one.unit, _law(ranges[j])]
            index = [float(x[k, j]) for x in found]
            counts = [squares.shape[1], squares.shape[2]]
            rows.append([name, b.name, b.display_unit, *pair, *ends, *index, *counts])
    return csv_of(rows)


def _points(
    every: Sequence[Uncertain],
    ranges: Sequence[Between],
    points: np.ndarray,
    squares: np.ndarray,
    blocks: Sequence[StateBlock],
) -> bytes:
    """Samples A and B, which are independent, with the RMS of each."""
    shares = points[:2].reshape(-1, len(every))
    rms = np.sqrt(np.mean(squares[:2], axis=2)).reshape(-1, len(blocks))
    columns = [_values(one, ranges[j], shares[:, j]) for j, one in enumerate(every)]
    columns += [units.convert(rms[:, k], b.units, b.display_unit) for k, b in enumerate(blocks)]
    named = [(one.key, one.unit) for one in every]
    named += [(f"{b.name} RMS", b.display_unit) for b in blocks]
    head = [f"{name} [{unit}]" if unit not in ("", "1") else name for name, unit in named]
    return csv_of([head, *np.transpose(columns).tolist()])


def _notes(
    name: str,
    every: Sequence[Uncertain],
    ranges: Sequence[Between],
    squares: np.ndarray,
    blocks: Sequence[StateBlock],
) -> list[str]:
    sets, samples, runs, _ = squares.shape
    laws = "; ".join(
        f"{one.key} {_law(r)} from {one.text(one.low)} to {one.text(one.high)}"
        for one, r in zip(every, ranges, strict=True)
    )
    mean, spread = _spread(squares)
    sizes = []
    for k, b in enumerate(blocks):
        pair = (float(units.convert(x[k], b.units, b.display_unit)) for x in (mean, spread))
        size, std = (f"{x:.3g}" for x in pair)
        sizes.append(f"{b.name} {size} {b.display_unit}, standard deviation {std}")
    return [
        f"The world varies, '{name}' believes the scenario as written. {sets * samples} points: "
        f"{samples} samples x (2 + {len(every)} parameters), each of the same {runs} runs.",
        f"Parameters are independent: {laws}. The logarithm is uniform where the ends are more "
        "than a factor of 10 apart.",
        "First order: the share of the variance of the RMS error that would go if this parameter "
        "alone were known. Total: the share that would stay if all the others were known; what it "
        "exceeds the first order by comes from acting together with others.",
        f"RMS error over the points, mean: {'; '.join(sizes)}. Bounds are of 95 % confidence, by "
        "drawing points and runs again (bootstrap).",
    ]


def _warnings(
    name: str,
    every: Sequence[Uncertain],
    squares: np.ndarray,
    believed: np.ndarray,
    blocks: Sequence[StateBlock],
    found: Indices,
) -> list[str]:
    told = []
    lost = np.sum(~np.all(np.isfinite(squares), axis=(2, 3)))
    still = [b.name for k, b in enumerate(blocks) if np.all(np.isnan(found.total[k]))]
    if lost:
        told.append(
            f"at {lost} of {squares.shape[0] * squares.shape[1]} points '{name}' diverged in a "
            "run: their RMS is infinite and there are no indices; bring the ends nearer together "
            "or name another filter"
        )
    elif still:
        told.append(f"the RMS error of {', '.join(still)} does not vary, so it has no indices")
    for j, one in enumerate(every):
        if not np.allclose(believed[2 + j], believed[0], rtol=1e-9, atol=1e-12):
            told.append(
                f"{one.key}: what '{name}' believes at the start follows it, since the world of "
                "this study brings the start along; its index is that of both"
            )
        acts = np.nan_to_num(found.total[:, j]) > NOTHING
        if len(still) < len(blocks) and not np.any(acts):
            told.append(f"{one.key}: changes no error; the simulated world does not depend on it")
    for k, b in enumerate(blocks):
        low, high = found.total_low[k], found.total_high[k]
        width = high - low
        unsure = [
            (i, j)
            for i, j in itertools.pairwise(np.argsort(-found.total[k]))
            if low[i] < high[j] and max(width[i], width[j]) > WIDE
        ]
        if unsure:
            i, j = unsure[0]
            told.append(
                f"{b.name}: the bounds of {every[i].key} and {every[j].key} are too wide to say "
                "which counts more; take more --samples, or more --runs"
            )
    return told


def _next(name: str, filter_: str, every: Sequence[Uncertain], found: Indices) -> list[str]:
    """Suggestion for the next step: the parameter that counts most somewhere."""
    known = np.nan_to_num(found.total, nan=-np.inf)
    if not np.any(np.isfinite(known)):
        return []
    one = every[int(np.unravel_index(np.argmax(known), known.shape)[1])]
    ends = f"{one.text(one.low)},{one.text(one.high)}"
    return [
        f'Next:   robins sweep {name} --vary "{one.key}={ends}" --filters {filter_} --out sweep'
        "   shows the error over it"
    ]
