"""Outcome of a campaign: all filters of a problem on the same random numbers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import xarray as xr
from jaxtyping import PyTree

from robins.campaign.bound import bound_sigma
from robins.campaign.histogram import WORST
from robins.campaign.machine import JaxMachine, LaneMachine, machine_for
from robins.campaign.statistics import PERCENTS, Statistics, thinned
from robins.filters import Code, Tally, doubts
from robins.results import (
    Outcome,
    Probability,
    Progress,
    Variables,
    array,
    ignore_progress,
    keep_on_error,
    variable,
)
from robins.systems.judgement import RUNS, Metrics, Verdicts
from robins.systems.study import Contender, Problem, StateBlock
from robins.systems.suspects import probability_array, sentences, words
from robins.systems.tables import block_array, innovation_tables


def simulate(
    problem: Problem,
    runs: int,
    chunk: int = 0,
    progress: Progress = ignore_progress,
    machine: str | JaxMachine | LaneMachine = "",
) -> Outcome:
    """Run every filter of a problem over the same runs and compare them.

    Args:
        problem: what to simulate.
        runs: number of runs of each filter.
        chunk: runs at a time; not given, by the memory that they need.
        progress: called with the share done in 0..1 and what is being done.
        machine: one of `robins.campaign.MACHINES`, or made already; not given, as `machine_for`.

    Raises:
        RobinsError: the machine is not available.

    An error in the evaluation of the statistics carries their arrays, by filter, for
    `robins.results.rescued` to write.
    """
    names = list(problem.contenders)
    found = {name: Statistics.of(problem) for name in names}
    done, bound = 0, None
    by = machine_for(problem, machine) if isinstance(machine, str) else machine
    chunk = chunk or by.width(runs)

    def taken(name: str, record: dict[str, PyTree]) -> Statistics:
        """The statistics of a chunk, in the thread that computed it."""
        of_chunk = found[name].blank()
        of_chunk.add(record)
        return of_chunk

    def stage(what: str, step: int) -> None:
        """Report a step of a chunk: its worlds are simulated first, then every filter is run."""
        last = min(done + chunk, runs)
        share = (done + (last - done) * step / (1 + len(names))) / max(runs, 1)
        verb = "compiling, " if done == 0 else ""
        progress(share, f"{what}: {verb}runs {done + 1} to {last} of {runs}")

    stage("simulation", 0)
    for first, count, statistics in by.chunks(runs, chunk, taken):
        of = problem.bound_of
        if bound is None and of is not None and of in problem.contenders:
            stage("covariance bound", 1)
            bound = bound_sigma(problem, of, first, by.name)
        for step, name in enumerate(names, 1):
            stage(name, step)
            found[name].merge(statistics(name))
        done += count
        if done < runs:
            stage("simulation", 0)
    with keep_on_error({name: vars(s) for name, s in found.items()}):
        outcome = outcome_of(problem, found, bound)
    return replace(outcome, machine=by.name, notes=[*outcome.notes, *by.notes])


def outcome_of(problem: Problem, found: dict[str, Statistics], bound: np.ndarray | None) -> Outcome:
    """Outcome of the statistics of all filters; bound: (E, r) covariance bound, if there is one."""
    metrics = {name: _metrics(problem, name, s, bound) for name, s in found.items()}
    claims = _claims(problem, found, bound, metrics)
    return Outcome(
        solution=campaign_solution(problem, found, bound),
        metrics=metrics,
        claims=claims,
        counts=_counts(found),
        notes=[
            *problem.notes,
            *(
                sentence
                for name, s in found.items()
                for sentence in _fault_sentences(problem, name, s)
            ),
            *(_undecided(c["id"], c["more_runs"]) for c in claims if c["verdict"] == "undecided"),
        ],
        warnings=[
            f"{name}: {sentence}"
            for name, s in found.items()
            for sentence in _doubts(problem.contenders[name], s.tally)
        ],
    )


def _fault_sentences(problem: Problem, name: str, s: Statistics) -> list[str]:
    """Sentences on the instruments that a filter finds faulty, with the time of the first alarm."""
    if s.runs == 1:
        return sentences(name, problem.epoch_s, s.first_run.get("wrong", {}))
    remarks, suspects = [], s.suspects
    for suspect in suspects:
        first = s.first_alarm(suspect)
        if count := int(np.sum(first >= 0)):
            since = np.median(problem.epoch_s[first[first >= 0]])
            remarks.append(
                f"{name} finds {words(suspect)} wrong in {count} of {s.runs} runs, "
                f"first at {since:.1f} s in the median."
            )
    if suspects and not remarks:
        listed = ", ".join(map(words, suspects))
        return [f"{name} finds nothing wrong with {listed} in any of {s.runs} runs."]
    return remarks


def _detection_metrics(problem: Problem, s: Statistics) -> dict[str, float]:
    """Detected share and detection delay of faults, and false alarms, by suspect or fault."""
    if not s.suspects or problem.faults is None:
        return {}
    out: dict[str, float] = {}
    real = [name for name, true in problem.faults.items() if np.any(true)]
    for name in dict.fromkeys([*s.suspects, *real]):
        if name in real:
            delays = s.delays(name) if name in s.suspects else np.array([[-1]])
            found = delays[delays >= 0]
            out[f"{name}_faults_detected_share"] = float(np.mean(delays >= 0))
            if len(found):
                step_s = float(np.median(np.diff(problem.epoch_s)))
                out[f"{name}_detection_delay_s"] = float(np.median(found)) * step_s
        if name in s.suspects:
            out[f"{name}_false_alarm_share"] = float(np.mean(s.false_alarms(name)))
    return out


def _doubts(contender: Contender, tally: Tally) -> list[str]:
    return doubts(tally, contender.bounds, tuple(tally.updates) if contender.lasting else ())


DRAWS, SEED = 200, 1993  # of the bootstrap


def _metrics(
    problem: Problem, name: str, s: Statistics, bound: np.ndarray | None
) -> dict[str, Any]:
    out = problem.metrics(s) | dict(problem.contenders[name].facts)
    if s.runs > 1:  # one run alone has no share
        out["diverged_share"] = Probability.among(s.lost)
    out |= _detection_metrics(problem, s)
    return out if bound is None else out | _over_bound(problem, s, bound)


def _claims(
    problem: Problem, found: dict[str, Statistics], bound: np.ndarray | None, metrics: Metrics
) -> Verdicts:
    """Verdicts with bootstrap intervals; the draws of runs are the same for all filters."""
    claims, runs = problem.claims(metrics), {s.runs for s in found.values()}
    if not claims or len(runs) > 1 or (count := runs.pop()) < 2:
        return claims
    random = np.random.default_rng(SEED).integers(0, count, (DRAWS, count))
    draws = np.vstack([np.arange(count), random])
    drawn: list[dict[str, Any]] = [{} for _ in draws]
    for name, s in found.items():
        for one, again in zip(drawn, s.resampled(draws), strict=True):
            one[name] = _metrics(problem, name, again, bound) | {RUNS: count}
    return problem.claims(metrics, drawn)


def _undecided(key: str, more: int | None) -> str:
    how = f"about {more} more runs decide it" if more else "more runs will hardly decide it"
    return f"The claim {key} is undecided: its interval reaches an edge of its band; {how}."


def _over_bound(problem: Problem, s: Statistics, bound: np.ndarray) -> dict[str, float]:
    """RMS error of each block over the covariance bound, pooled over the epochs that count."""
    rms, least = s.pooled_rms, np.sqrt(np.mean(bound[s.counted] ** 2, axis=0))
    return {
        f"{b.name}_over_bound": float(np.linalg.norm(rms[b.where]) / np.linalg.norm(least[b.where]))
        for b in problem.blocks
    }


def _counts(found: dict[str, Statistics]) -> dict[str, int]:
    """Predictions and updates by outcome, and runs that diverged, over all filters."""
    out: dict[str, int] = {}
    for name, s in found.items():
        if s.diverged:
            out[f"{name}_diverged_runs"] = s.diverged
        for what in (None, *s.tally.updates):
            for code, number in s.tally.counts(what).items():
                if code not in (Code.DONE, Code.MISSING):
                    out[f"{name}_{what or 'prediction'}_{code.name.lower()}"] = number
    return out


def _stack(found: dict[str, Statistics], pick: Callable[[Statistics], np.ndarray]) -> np.ndarray:
    return np.stack([np.asarray(pick(s), dtype=float) for s in found.values()])


def campaign_solution(
    problem: Problem, found: dict[str, Statistics], bound: np.ndarray | None = None
) -> xr.Dataset:
    """Statistics of all filters over time, and the first run as an example.

    Args:
        problem: that was run.
        found: by filter.
        bound: (E, r) covariance bound of the reported components, where there is one.
    """
    runs = next(iter(found.values())).runs
    data: dict[str, Any] = {str(k): v for k, v in problem.context.variables.items()}
    data["filter"] = ("filter", list(found))
    data["time"] = variable("time", problem.epoch_s, "s", "time since the start")
    if runs > 1:
        some = problem.epoch_s[thinned(len(problem.epoch_s))]
        data["thinned_time"] = variable("thinned_time", some, "s", "time since the start")
    for b in problem.blocks:
        words = b.name.replace("_", " ")
        for role, text, pick, about in (
            ("error", f"error of {words}, first run", lambda s: s.first_run["error"], {}),
            ("sigma", f"stated sigma of {words}, first run", lambda s: s.first_run["sigma"], {}),
            ("rms", "", lambda s: s.rms, {"runs": runs}),
            ("mean_sigma", "", lambda s: s.sigma, {"runs": runs}),
        ):
            values = _stack(found, pick)[:, :, b.where]
            data |= block_array(role, b, values, text, **about)
        if bound is not None:
            data |= block_array("bound", b, bound[:, b.where])
        if runs > 1:
            data |= _scatter(b, found)
    # what an H-infinity filter states is no covariance, so no chi-square test applies to it
    bound = np.array([problem.contenders[name].bounds for name in found])
    data |= array("bounds", bound.astype(np.int8), long_name="states bounds, not sigmas")
    blank = np.where(bound, np.nan, 1.0)[:, None]
    anees = blank * _stack(found, lambda s: s.anees())
    data |= array("consistency", anees, "anees", long_name="ANEES", runs=runs, normalised=1)
    dof = np.array([[s.n] for s in found.values()]) + np.zeros_like(anees)
    data |= array("consistency_dof", blank * dof, "anees")
    for limit in problem.limits:
        share = _stack(found, lambda s, name=limit.name: s.share_within(name))
        text = f"runs with {limit.block} within {limit.name}".replace("_", " ")
        data |= array("within", share, limit.name, long_name=text, runs=runs)
    for o in problem.outputs:
        words = o.name.replace("_", " ")
        first = _stack(found, lambda s, name=o.name: s.first_run["outputs"][name])
        data |= block_array("error" if o.is_error else "value", o, first, words, comment=o.text)
        if o.is_error:
            rms = _stack(found, lambda s, name=o.name: s.output_rms(name))
            data |= block_array("rms", o, rms, f"RMS {words}", comment=o.text, runs=runs)
    data |= _notes(found) | _fault_probabilities(problem, found)
    data |= problem.shown({name: s.first_run["mean"] for name, s in found.items()})
    seen = [s.first_run["updates"] for s in found.values()]
    return xr.Dataset(data | innovation_tables(seen, problem.sensors, problem.epoch_s))


def _scatter(b: StateBlock, found: dict[str, Statistics]) -> Variables:
    """Spread of the errors of a block over the runs: their mean, covariance, percentiles."""
    runs = next(iter(found.values())).runs
    mean = _stack(found, lambda s: s.mean)[:, :, b.where]
    covariance = _stack(found, lambda s: s.covariance(b))
    whole = {"unit": f"({b.units})^2", "frame": b.frame, "axes": b.axes, "runs": runs}
    lengths = _stack(found, lambda s: s.percentiles(b))
    shown = {"unit": b.units, "display_unit": b.display_unit, "runs": runs, "bins": WORST}
    return (
        block_array("mean_error", b, mean, runs=runs)
        | array("covariance", covariance, b.name, **whole)
        | array("percentile", lengths, b.name, axes=[f"{p} %" for p in PERCENTS], **shown)
    )


def _fault_probabilities(problem: Problem, found: dict[str, Statistics]) -> dict[str, xr.Variable]:
    """Fault probability of each suspect, in the first run and over all runs, and the truth."""
    data = probability_array("wrong", [s.first_run.get("wrong", {}) for s in found.values()])
    if not data:
        return {}
    runs = next(iter(found.values())).runs
    if runs > 1:
        mean = [{name: s.fault_probability(name) for name in s.suspects} for s in found.values()]
        data |= probability_array("mean_wrong", mean, runs=runs)
    if problem.faults is not None:
        none = np.zeros(len(problem.epoch_s), bool)
        true = [problem.faults.get(str(name), none) for name in data["suspect"].values]
        data |= array("truly_wrong", np.stack(true, axis=1).astype(np.int8))
    return data


def _notes(found: dict[str, Statistics]) -> dict[str, Any]:
    """Notes of rules in the first run, NaN for filters that have no such rule.

    With several sensors, the notes of the last one stand for the step.
    """
    of: dict[str, dict[str, np.ndarray]] = {}
    for name, s in found.items():
        for update in s.first_run["updates"].values():
            for note, value in update.notes.items():
                if np.ndim(value) == 1:
                    of.setdefault(note, {})[name] = np.asarray(value, dtype=float)
    epochs = next(iter(found.values())).rms.shape[0]
    none = np.full(epochs, np.nan)
    data: dict[str, Any] = {}
    for note, by in of.items():
        text = f"{note.replace('.', ': ').replace('_', ' ')}, first run"
        values = np.stack([by.get(name, none) for name in found])
        data |= array("note", values, note.replace(".", "_"), long_name=text)
    return data
