"""The command `sensitivity`: the variance of the error by uncertain parameter.

Examples::

    robins sensitivity transfer-alignment/s0 --filter kf-flexure --vary "slave.gyro_bias=1 deg/h to 10 deg/h" --vary "flexure.sigma=1 arcmin to 5 arcmin"
    robins sensitivity airship/s1 --filter product --vary "sar.position=10 m to 50 m" --vary "barometer.height=5 m to 30 m" --samples 128 --out budget
"""  # noqa: E501

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated, NamedTuple

import jax
import numpy as np
import xarray as xr

from robins import _float64
from robins.campaign.sensitivity import (
    SensitivityRuns,
    between,
    changes_belief,
    courses_differ,
    indices,
    interpolated,
    labelled,
    simulate_points,
    sobol_points,
    untraceable,
)
from robins.report import sensitivity as page
from robins.results import Outcome, Progress, ignore_progress
from robins.workbench.errors import InputError, refusing
from robins.workbench.options import MOST_OF_SEED, Filter, Option, Scenario
from robins.workbench.scenarios import Simulated, check_filters, read_scenario, request_fields

MOST = 1 << 14  # samples
_TRACED = 0.1  # share of the progress at which batches begin
_RANGE = re.compile(r"(.+?)\s+to\s+(.+)")
_NUMBER = re.compile(r"([-+0-9.eE]+)\s*(.*)")


class UncertainParameter(NamedTuple):
    """An uncertain parameter and the ends of its range."""

    key: str
    low: float
    high: float
    unit: str  # of both, as it was written

    def text(self, number: float) -> str:
        """A value as `--set` takes it."""
        return f"{repr(number).removesuffix('.0')} {self.unit}".strip()

    @property
    def ends(self) -> tuple[str, str]:
        """Both ends as settings."""
        return f"{self.key}={self.text(self.low)}", f"{self.key}={self.text(self.high)}"


def uncertain(text: str) -> UncertainParameter:
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
        fix = 'write --vary "slave.gyro_bias=1 deg/h to 10 deg/h" or the like.'
        raise InputError("is not key=low to high", f"--vary {text}", fix)
    (low, first), (high, unit) = found
    if first not in ("", unit):
        raise InputError("has two units", f"--vary {text}", "write both ends in one unit.")
    return UncertainParameter(key.strip(), low, high, unit)


def sensitivity(
    name: Scenario,
    *,
    filter_name: Filter = "",
    vary: Annotated[Sequence[str], Option("May be repeated.", metavar="key=low to high")],
    runs: Annotated[int, Option("At each point.", least=1, shown=True)] = 10,
    samples: Annotated[
        int,
        Option(
            "Of each parameter; a power of two. There are samples x (parameters + 2) points.",
            shown=True,
        ),
    ] = 256,
    settings: Sequence[str] = (),
    seed: Annotated[int, Option("Of all noise and points.", least=0, most=MOST_OF_SEED)] = 0,
    progress: Progress = ignore_progress,
) -> Outcome:
    """Attribute the variance of a filter's error to the parameters of SCENARIO.

    An error budget: the simulated world varies between the ends, independently in each parameter,
    and the filter goes on believing the scenario as written. For each block of the state there are
    Sobol indices of first order (alone) and in total (with others), with their 95 % bounds.

    Args:
        name: "system/name", the path of a TOML file, or "file.py:study" of the user's own.
        vary: texts ``key=low to high``.
        filter_name: of the filter; by default the first of the scenario.
        runs: number at each point, the same runs at all.
        samples: a power of two; there are ``samples * (parameters + 2)`` points.
        seed: of the random streams and of the points.
        settings: "path=value" texts that change the scenario.
        progress: called with the fraction done and the current activity.

    Raises:
        InputError, robins.scenario.ScenarioError: the request cannot be computed.
    """
    _float64.require()
    every = _checked(vary, samples)
    read = read_scenario(name, settings)
    wanted = filter_name or read.own[0]
    check_filters(read.source, read.study.filters, [wanted])
    progress(0.0, "setting up the simulation")
    budget = _budget(name, read, wanted, every, settings, seed)
    points = sobol_points(len(every), samples, seed)
    squares, follow, jax_parts = _simulated(budget, every, points, runs, progress)
    ends = [(one.key, one.text(one.low), one.text(one.high)) for one in every]
    blocks = budget.view.blocks
    solution = labelled(wanted, ends, points, squares, blocks, indices(squares, seed))
    return replace(
        _outcome(solution, follow, every, points, budget, jax_parts),
        scenario=read.label,
        seed=seed,
        runs=runs,
        machine="vm",
        last_lines=[
            "Table:  {out}/sensitivity.csv   all indices with their bounds; points.csv has samples",
            *_next(name, wanted, every, page.greatest(solution)),
        ],
        **request_fields(read.text, settings),
    )


def _budget(
    name: str,
    read: Simulated,
    wanted: str,
    every: Sequence[UncertainParameter],
    settings: Sequence[str],
    seed: int,
) -> SensitivityRuns:
    study, given = read.study, read.parameters
    with refusing(name):
        course, again = study.lay_out(given), study.lay_out(given)
        view, contender = study.view(given, course), study.contender(given, course, wanted)
    ranges = []
    for one in every:
        low, high = (read.parsed((*settings, end)) for end in one.ends)
        with refusing(f"--vary {one.key}"):
            ranges.append(between(low, high))
            laid = [study.lay_out(end) for end in (low, high)]
        if any(courses_differ(course, again, end) for end in laid):
            raise InputError(
                "decides the motion or what else all runs share, so it cannot vary with the rest "
                "of the world",
                f"--vary {one.key}",
                "`robins sweep` lays out the scenario again for each of its values.",
            )
    return SensitivityRuns(study, given, course, view, contender, seed, tuple(ranges))


def _simulated(
    budget: SensitivityRuns,
    every: Sequence[UncertainParameter],
    points: np.ndarray,
    runs: int,
    progress: Progress,
) -> tuple[np.ndarray, list[bool], list[str]]:
    """Squared errors (d + 2, samples, runs, s), `changes_belief`, and parts that JAX computed."""
    count = points.shape[0] * points.shape[1]

    def done(share: float) -> None:
        words = f"{round(share * count)} of {count} points"
        progress(_TRACED + (1.0 - _TRACED) * share, words)

    progress(0.01, f"tracing {count} points of {runs} runs")
    try:
        found, believed, jax_parts = simulate_points(budget, points.reshape(count, -1), runs, done)
    except jax.errors.JAXTypeError as error:
        raise _refused(budget, every) from error
    squares = found.reshape(*points.shape[:2], *found.shape[1:])
    return squares, changes_belief(believed.reshape(*points.shape[:2], runs)), jax_parts


def _outcome(
    solution: xr.Dataset,
    follow: Sequence[bool],
    every: Sequence[UncertainParameter],
    points: np.ndarray,
    budget: SensitivityRuns,
    jax_parts: list[str],
) -> Outcome:
    laws = [one.law for one in budget.ranges]
    shares = points[:2].reshape(-1, len(every)).T
    drawn = [
        interpolated(share, one.low, one.high, range_.by_logarithm)
        for one, range_, share in zip(every, budget.ranges, shares, strict=True)
    ]
    return Outcome(
        solution=solution,
        metrics=page.metrics(solution),
        files={
            "sensitivity.csv": page.csv(solution, laws),
            "points.csv": page.points(solution, drawn),
        },
        notes=[*page.sentences(solution, laws), *budget.view.notes, *jax_parts],
        warnings=page.doubts(solution, follow),
        tables=[page.table(solution)],
    )


def _checked(vary: Sequence[str], samples: int) -> list[UncertainParameter]:
    every = [uncertain(text) for text in vary]
    keys = [one.key for one in every]
    if not every or len(set(keys)) < len(keys):
        raise InputError("name one parameter or more, each once", "--vary")
    nested = [b for a in keys for b in keys if b.startswith(f"{a}.")]
    if nested:
        raise InputError("is part of another that varies", f"--vary {nested[0]}", "name one.")
    if not 2 <= samples <= MOST or samples & (samples - 1):
        below = 1 << max(min(samples, MOST).bit_length() - 1, 1)
        fix = f"take {below} or {min(2 * below, MOST)}."
        raise InputError(f"must be a power of two from 2 to {MOST}", f"--samples {samples}", fix)
    return every


def _refused(budget: SensitivityRuns, every: Sequence[UncertainParameter]) -> InputError:
    """Error for worlds that cannot be traced, with the reason."""
    names = [every[k].key for k in untraceable(budget)] or [one.key for one in every]
    return InputError(
        "decides a shape or a branch of the simulation, or goes through NumPy there, so that it "
        "cannot be varied within one program",
        " and ".join(f"--vary {name}" for name in names),
        "`robins sweep` traces each value; in a world of your own compute with jax.numpy.",
    )


def _next(
    name: str, filter_: str, every: Sequence[UncertainParameter], greatest: int | None
) -> list[str]:
    """Suggestion for the next step: the parameter that counts most somewhere."""
    if greatest is None:
        return []
    one = every[greatest]
    ends = f"{one.text(one.low)},{one.text(one.high)}"
    return [
        f'Next:   robins sweep {name} --vary "{one.key}={ends}" --filters {filter_} --out sweep'
        "   shows the error over it"
    ]
