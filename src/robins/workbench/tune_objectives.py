"""Objectives of tuning: the errors of simulated runs, or the prediction of a log.

Both are measured on independent parts, runs or segments, in the columns `DENSITY` (log density of
all measurements), `COMPONENTS` (how many were measured), and of simulated runs by block the mean
square of the error's length and the variance that the filter states for it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from robins import scenario
from robins.campaign.machine import one_by_one
from robins.campaign.many_runs import ManyRuns
from robins.campaign.monte_carlo import Blocks, blocks_of, one_record
from robins.campaign.sensitivity import courses_differ
from robins.campaign.tuning import Data, Objective, Tree, Trial, UndeterminedError
from robins.filters import Filter, run
from robins.filters.analysis.predictive import predicted, scored
from robins.filters.values import as_data, content, kind, value
from robins.results import Progress
from robins.systems.study import Contender, StateBlock
from robins.workbench.errors import InputError, refusing
from robins.workbench.replay import Findings, OpenLog
from robins.workbench.scenarios import check_filters, read_scenario

ERROR, INNOVATIONS = "error", "innovations"
SEGMENTS = 24  # of a log; every third is held out
_FEWEST = 10  # components measured in a segment of a log, on average
DENSITY, COMPONENTS = 0, 1
FIRST_BLOCK = 2


class TunedParameter(NamedTuple):
    """A parameter to be tuned, and where it begins, as a scenario writes it."""

    key: str
    start: Any

    def setting(self, factor: float) -> str:
        """The text that sets it to so many times its start."""
        return scenario.setting(self.key, scenario.scaled(self.key, self.start, factor))


def tuned_parameters(texts: Sequence[str], parameters: Any, text: str) -> list[TunedParameter]:
    """Read texts ``key`` or ``key=value``.

    Raises:
        InputError: none is named, or one twice.
        robins.scenario.ScenarioError: there is none, or it is not a number.
    """
    if not texts:
        raise InputError("nothing to tune", "--vary", "name a parameter, as --vary imu.gyro_noise.")
    found = []
    for one in texts:
        key, equals, value = (part.strip() for part in one.partition("="))
        here = scenario.override({}, [f"at={value}"])["at"] if equals else None
        start = here if equals else scenario.written(parameters, scenario.mapping_of(text), key)
        scenario.scaled(key, start, 2.0)  # it must be a number
        found.append(TunedParameter(key, start))
    if len({v.key for v in found}) < len(found):
        raise InputError("names a parameter twice", "--vary", "name each once.")
    return found


class TuningRequest(NamedTuple):
    """Request of a tuning and its data: the same for simulated runs and for a log."""

    filter: str
    vary: list[TunedParameter]
    objective: Objective
    chosen_on: Data
    judged_on: Data
    parts: str  # what the parts are called
    blocks: Sequence[StateBlock]  # whose errors are known
    by: str  # what is to be small, in words
    text: str  # TOML of the scenario or configuration
    settings: Sequence[str]
    label: str
    data_note: str  # a sentence on the data
    checked: Callable[[Sequence[str]], Any]  # settings -> parameters; raises where they do not fit


def total_of(by: str, names: Sequence[str]) -> Callable[[np.ndarray], float]:
    """The objective, of the mean over parts."""
    if by == INNOVATIONS:
        return lambda mean: -float(mean[DENSITY] / mean[COMPONENTS])
    which = [k for k, name in enumerate(names) if by in (ERROR, name)]
    return lambda mean: 0.5 * float(np.mean(np.log(mean[FIRST_BLOCK:][which])))


def objective_in_words(by: str) -> str:
    """Objective in words."""
    if by == INNOVATIONS:
        return "log density of a measured component"
    return "geometric mean of the RMS errors of all blocks" if by == ERROR else f"RMS error of {by}"


# --------------------------------------------------------------------------------- simulated runs


def on_runs(
    name: str,
    filter_name: str,
    vary: Sequence[str],
    runs: int,
    seed: int,
    by: str,
    settings: Sequence[str],
    progress: Progress,
) -> TuningRequest:
    """Request for simulated runs; arguments as of `robins.workbench.tune`.

    Raises:
        InputError, robins.scenario.ScenarioError: it cannot be done.
    """
    read = read_scenario(name, settings)
    wanted = filter_name or read.own[0]
    (chosen,) = check_filters(read.source, read.study.filters, [wanted])
    overriding = scenario.text_of(overridden(read.text, settings))
    tuned = tuned_parameters(vary, read.parameters, overriding)
    problem = read.problem((chosen,), seed)
    names, by = [b.name for b in problem.blocks], by or ERROR
    if by not in (ERROR, INNOVATIONS, *names):
        known = ", ".join([ERROR, INNOVATIONS, *names])
        raise InputError(f"is none of {known}", f"--by {by}", "choose one of these.")
    measured = RunMeasure(blocks_of(problem), problem.count_from, problem.count_to)
    progress(0.0, "simulating")
    worlds = ManyRuns(lambda _, k: problem.simulate(k))([()], np.arange(2 * runs))

    def parsed(more: Sequence[str]) -> Any:
        return read.parsed((*settings, *more))

    lay_out = read.study.lay_out
    ends = [parsed(settings_at(tuned, x)) for x in np.outer((0.0, 1.0), np.ones(len(tuned)))]
    course = lay_out(ends[0])
    # a filter's assumptions on the course, such as its process noise, are its inputs
    moves = courses_differ(course, *map(lay_out, ends))

    def trial(x: np.ndarray) -> Trial:
        given = parsed(settings_at(tuned, x))
        c = read.study.contender(given, lay_out(given) if moves else course, chosen)
        return _trial(c.filter, c.model, as_data(c.case), c.reported)

    return TuningRequest(
        filter=chosen,
        vary=tuned,
        objective=Objective(trial, measured, total_of(by, names)),
        chosen_on=Data(jax.tree_util.tree_map(lambda x: x[0, :runs], worlds)),
        judged_on=Data(jax.tree_util.tree_map(lambda x: x[0, runs:], worlds)),
        parts="runs",
        blocks=problem.blocks,
        by=objective_in_words(by),
        text=read.text,
        settings=settings,
        label=read.label,
        data_note=f"Chosen on runs 0 to {runs - 1}, judged on runs {runs} to {2 * runs - 1}, which "
        "tuning did not see. The simulated world stays as the scenario says it; only what the "
        "filter believes is tuned.",
        checked=parsed,
    )


def _trial(filter_: Filter, *others: Tree) -> Trial:
    """Trial of a filter and its data; its kind is the filter's content, such as a threshold."""
    filter_ = scored(filter_)
    return Trial(content(filter_), (filter_, *others))


def overridden(text: str, settings: Sequence[str]) -> dict[str, Any]:
    """The tables of a scenario with its settings."""
    return scenario.override(scenario.mapping_of(text), settings)


def settings_at(tuned: Sequence[TunedParameter], x: np.ndarray) -> list[str]:
    """Texts that set the parameters to their values at given log factors."""
    return [v.setting(math.exp(one)) for v, one in zip(tuned, x, strict=True)]


@value
class RunMeasure:
    """Measures of a simulated run, in the columns of this module."""

    blocks: Blocks = kind()
    count_from: int = kind()
    count_to: int | None = kind()

    def __call__(self, numbers: Any, world: Any) -> Array:
        """(k,) measures of one run."""
        found = one_record(self.blocks, Contender(*numbers), world, over=one_by_one)
        notes = [update.notes for update in found["updates"].values()]
        density = sum(jnp.sum(n["predicted.log_density"]) for n in notes)
        count = sum(jnp.sum(n["predicted.components"]) for n in notes)
        rows = [jnp.asarray([density, count], float)]
        for what in ("error", "sigma"):
            square = found[what][self.count_from : self.count_to] ** 2
            each = [square[:, first:last] for _, first, last in self.blocks]
            rows.append(jnp.stack([jnp.mean(jnp.sum(one, axis=1)) for one in each]))
        return jnp.concatenate(rows)


# ------------------------------------------------------------------------------------ recorded log


def on_log(
    opened: OpenLog,
    filter_name: str,
    vary: Sequence[str],
    by: str,
    settings: Sequence[str],
    findings: Findings,
) -> TuningRequest:
    """Request for a recorded log; arguments as of `robins.workbench.tune`.

    Raises:
        InputError, robins.scenario.ScenarioError: it cannot be done.
        UndeterminedError: there are too few measurements to hold some out.
    """
    system = opened.system
    if system.recorded is None:
        raise InputError(f"{system.name} cannot be tuned on a log")
    if by not in ("", INNOVATIONS):
        raise InputError("a log has no truth", f"--by {by}", f"leave it out, or say {INNOVATIONS}.")
    wanted = filter_name or opened.parameters.filters[0]
    (chosen,) = check_filters(system.name, system.replay_filters, [wanted])
    tuned = tuned_parameters(
        vary, opened.parameters, scenario.text_of(overridden(opened.text, settings))
    )
    dataset = opened.read(findings)

    def parsed(more: Sequence[str]) -> Any:
        of, text, source = system.replay_parameters, opened.text, opened.source
        return scenario.parse(of, text, (*settings, *more), source=source)

    def trial(x: np.ndarray) -> Trial:
        taken = system.recorded(dataset, parsed(settings_at(tuned, x)))
        c = taken.contender(chosen)
        cases = [c.case(piece.world) for piece in taken.pieces]
        return _trial(c.filter, c.model, [(it.start, it.y, it.u, it.aux) for it in cases])

    with refusing(opened.source):
        first = trial(np.zeros(len(tuned)))
    held = _held_out(first)
    segments = len(held)
    label = f"{system.name}/{dataset.name}"
    return TuningRequest(
        filter=chosen,
        vary=tuned,
        objective=Objective(trial, SegmentMeasure(segments), total_of(INNOVATIONS, ())),
        chosen_on=Data(np.zeros(1), np.flatnonzero(~held)),
        judged_on=Data(np.zeros(1), np.flatnonzero(held)),
        parts="segments",
        blocks=(),
        by=objective_in_words(INNOVATIONS),
        text=opened.text,
        settings=settings,
        label=label,
        data_note=f"The log is cut into {segments} segments of equally many steps. The filter runs "
        "through all; every third is held out: its innovations say nothing for tuning and alone "
        "judge.",
        checked=parsed,
    )


def _held_out(first: Trial) -> np.ndarray:
    """(segments,) true for every third, held out; few components make fewer segments."""
    _, model, cases = first.numbers
    count = sum(_components(y, model.dims[s]) for case in cases for s, y in case[1].items())
    held = np.arange(min(SEGMENTS, count // _FEWEST)) % 3 == 2
    if np.sum(held) < 3:
        raise UndeterminedError(
            f"the log says too little: {count} components are measured, and {9 * _FEWEST} are the "
            "least that can be parted into what is chosen on and what is held out"
        )
    return held


def _components(y: Tree, dim: int) -> int:
    """Number of measured components of a sensor, of which a quaternion has three."""
    leaves = map(np.asarray, jax.tree_util.tree_leaves(y))
    each = sum(np.sum(np.isfinite(x.reshape(len(x), -1)), axis=1) for x in leaves)
    return int(np.sum(np.minimum(each, dim)))


@value
class SegmentMeasure:
    """Measures of a log by segments of equally many steps."""

    segments: int = kind()

    def __call__(self, numbers: Any, _: Any) -> Array:
        """(segments, 2) log density and number of components."""
        filter_, model, pieces = numbers
        rows = []
        for start, y, u, aux in pieces:
            of = run(filter_, model, start, y, u, aux, keep=predicted).steps
            rows.append(jnp.stack([of.log_density, of.components.astype(float)], axis=1))
        steps = jnp.concatenate(rows)
        place = jnp.arange(len(steps)) * self.segments // len(steps)
        return jax.ops.segment_sum(steps, place, self.segments)
