"""The commands of `robins campaign`: many runs, kept in a store that any number of workers fill."""

from __future__ import annotations

import json
import os
import random
import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import numpy as np

from robins import _float64, scenario
from robins.campaign import check_machine, retention
from robins.campaign.bound import bound_sigma
from robins.campaign.gather import CampaignState, example_of, gather
from robins.campaign.machine import first_run, first_worlds, machine_for
from robins.campaign.outcome import outcome_of
from robins.campaign.plan import (
    KEPT,
    NAME,
    CampaignPlan,
    Chunk,
    Shard,
    check_code,
    code_of,
    read,
    require_plan,
    write,
)
from robins.campaign.retention import by_stem, content_of, kept
from robins.campaign.shards import DamagedShardError, unpack
from robins.campaign.statistics import Statistics
from robins.campaign.store import Store, open_store
from robins.campaign.work import Worker, missing
from robins.foreign import decoding
from robins.results import Outcome, Progress, ignore_progress
from robins.systems.judgement import judge_filters
from robins.systems.study import Problem
from robins.workbench.errors import InputError
from robins.workbench.scenarios import check_filters, read_scenario, with_default_filter

Where = str | os.PathLike[str]
SWEEP = "sweep.json"  # in the folder of several campaigns
_POINT = re.compile(r"points/\d+(-\d+)?")


def _check_same(where: Where, before: CampaignPlan, text: str, seed: int, machine: str) -> None:
    for what, was, now in (
        ("scenario", _of_runs(before.text), _of_runs(text)),
        ("seed", before.seed, seed),
        ("machine", before.machine, machine or before.machine),
    ):
        if was != now:
            shown = "" if what == "scenario" else f": {was} there, {now} asked for"
            fix = "ask for the same to go on with it, or choose another folder."
            raise InputError(f"holds a campaign of another {what}{shown}", where, fix)


def plan_campaign(
    where: Where,
    name: str,
    *,
    runs: int | None = None,
    seed: int = 0,
    filters: Sequence[str] = (),
    settings: Sequence[str] = (),
    machine: str = "",
) -> CampaignPlan:
    """Start a campaign in a store, or extend the one that is there by more runs or filters.

    Args:
        where: a folder, or an address such as "s3://bucket/campaign".
        name: "system/name", the path of a TOML file, or "file.py:study" of the user's own.
        runs: their number; by default that of the scenario.
        seed: of the random streams.
        filters: names; by default those of the scenario and the default of its system.
        settings: "path=value" texts that change the scenario.
        machine: "vm", "c" or "jax"; not given, the interpreter where it can be.

    Raises:
        InputError, robins.scenario.ScenarioError: the request cannot be run, or another
            campaign is there.
        robins.errors.RobinsError: the machine is not there, or the store cannot be used.
    """
    _float64.require()
    check_machine(machine)
    store = open_store(where)
    one = read_scenario(name, settings if runs is None else (*settings, f"runs={runs}"))
    text = scenario.text_of(scenario.override(scenario.mapping_of(one.text), settings))
    chosen = check_filters(one.source, one.study.filters, filters or with_default_filter(one))
    wanted: int = one.parameters.runs
    before = read(store)
    if before is None:
        by = machine_for(one.problem(chosen, seed), machine)
        plan = CampaignPlan(
            asked=name,
            scenario=one.label,
            text=text,
            seed=seed,
            runs=wanted,
            filters=chosen,
            machine=by.name,
            width=by.width(wanted),
            code=code_of(name, text),
        )
    else:
        check_code(store, before)
        _check_same(where, before, text, seed, machine)
        plan = replace(before.with_more(wanted, chosen), text=text)
    if beyond := [run for run in plan.keep if run >= plan.runs]:
        fix = f"keep = {beyond} names none of them."
        raise InputError(f"has runs 0 to {plan.runs - 1}", where, fix)
    if plan != before:
        write(store, plan)
    store.sweep()
    return plan


def _of_runs(text: str) -> str:
    """Scenario text without the keys that decide what is kept, which may change at any time."""
    tables = scenario.mapping_of(text)
    return scenario.text_of({k: v for k, v in tables.items() if k not in KEPT})


def problem_of(plan: CampaignPlan, filters: Sequence[str] = ()) -> Problem:
    """The problem of a campaign, with its filters or some of them.

    Raises:
        robins.errors.RobinsError: it names code that the user has not confirmed.
    """
    one = read_scenario(plan.asked, (), plan.text, named_in=NAME)
    problem = one.problem(filters or plan.filters, plan.seed)
    return replace(problem, claims=judge_filters(one.own, problem.claims))


def ready(where: Where) -> tuple[Store, CampaignPlan]:
    """A campaign that this code may continue.

    Raises:
        robins.errors.RobinsError: there is none, or other code began it.
    """
    _float64.require()
    store, plan = opened(where)
    check_code(store, plan)
    return store, plan


def opened(where: Where) -> tuple[Store, CampaignPlan]:
    """An existing campaign, whatever code began it.

    Raises:
        robins.errors.RobinsError: there is none, or there are several.
    """
    if sweep := sweep_of(where):
        fix = f"name one, such as {where}/{sweep[1][0]}."
        raise InputError(f"holds the {len(sweep[1])} campaigns of a sweep", where, fix)
    store = open_store(where)
    return store, require_plan(store)


def campaign_work(where: Where) -> Iterator[tuple[int, int]]:
    """Compute until nothing is missing; yields the numbers of shards done and in total."""
    every = [ready(one) for one in campaigns_of(where)]
    total, done = sum(len(some) for _, plan in every for some in plan.shards.values()), 0
    for store, plan in every:
        mine = sum(map(len, plan.shards.values()))
        if missing(store, plan.shards):
            for lacking in Worker(store, plan, problem_of(plan)).work():
                yield done + mine - lacking, total
        done += mine
    yield total, total


def campaigns_of(where: Where) -> list[str]:
    """The campaigns of a sweep, or a single one."""
    sweep = sweep_of(where)
    return [str(where)] if sweep is None else [f"{where}/{point}" for point in sweep[1]]


def sweep_of(where: Where) -> tuple[list[str], list[str]] | None:
    """Texts ``key=a,b,c`` and folders of the points of a sweep; None where there is none.

    Raises:
        robins.errors.RobinsError: its file is damaged.
    """
    content = open_store(where).get(SWEEP)
    if content is None:
        return None

    def refuse(why: str) -> InputError:
        fix = "run the same `robins sweep` again: what is there is not computed again."
        return InputError(f"{SWEEP} is damaged ({why})", where, fix)

    with decoding(refuse):
        data = json.loads(content)
        vary, points = list(map(str, data["vary"])), list(map(str, data["points"]))
    if not points or not all(map(_POINT.fullmatch, points)):
        raise refuse("its points are not folders of its own")
    return vary, points


class CampaignStatus(NamedTuple):
    """Progress of a campaign; runs are counted by filter."""

    scenario: str
    seed: int
    machine: str
    filters: list[str]
    wanted: int
    done: dict[str, int]
    shards: int
    missing: int
    damaged: list[str]
    diverged: dict[str, list[int]]
    kept: dict[str, list[int]]  # runs whose histories are there
    digest: str | None


def campaign_status(where: Where) -> CampaignStatus:
    """Read and check all shards of a campaign, and report its progress."""
    store, plan = opened(where)
    found, there = gather(store, plan), kept(store, by_stem(plan.shards))
    shards, damaged = sum(map(len, plan.shards.values())), [shard.name for shard in found.damaged]
    diverged = {name: diverged_of(found, name) for name in plan.filters}
    runs = {name: there.get(name, []) for name in plan.filters}
    asked = plan.scenario, plan.seed, plan.machine, list(plan.filters), plan.runs
    lacking = found.lacking - len(damaged)
    return CampaignStatus(
        *asked, found.done, shards, lacking, damaged, diverged, runs, found.digest
    )


def diverged_of(found: CampaignState, name: str) -> list[int]:
    """Numbers of the runs in which a filter diverged, of a campaign without gaps."""
    one = found.found[name]
    if found.lacking or not one.runs:
        return []
    return np.flatnonzero(one.lost).tolist()


def campaign_report(where: Where) -> Outcome:
    """Outcome of all finished runs; a warning states if there are fewer than planned.

    Args:
        where: folder or address.

    Raises:
        InputError: the first run of some filter is not there.
    """
    store, plan = ready(where)
    problem = problem_of(plan)
    found = gather(store, plan, problem)
    # the figures show the first run of each filter
    if any(one.example is None for one in found.found.values()):
        fix = "the same `robins campaign run` computes it."
        raise InputError("some filter has no first run", where, fix)
    outcome = outcome_of(problem, found.found, _bound(problem, plan.machine))
    short = {name: n for name, n in found.done.items() if n < plan.runs}
    warnings = [f"{name}: {n} of {plan.runs} runs are done" for name, n in short.items()]
    return replace(
        outcome,
        **fields_of(plan),
        warnings=[*outcome.warnings, *warnings],
        last_lines=[
            f"Digest: {found.digest or 'none, as long as runs are missing'}",
            f"Next:   robins campaign show {where} --run 0   one run with all its histories",
        ],
    )


def fields_of(plan: CampaignPlan) -> dict[str, Any]:
    """Fields of an outcome: those of a plan, and the machine that computes."""
    own = {name: getattr(plan, name) for name in ("machine", "scenario", "seed", "runs")}
    return own | {"parameters": plan.text, "device": jax.devices()[0].device_kind}


def _bound(problem: Problem, machine: str) -> np.ndarray | None:
    of = problem.bound_of
    if of is None or of not in problem.contenders:
        return None
    return bound_sigma(problem, of, first_run(first_worlds(problem, 1)), machine)


def campaign_show(where: Where, run: int, *, progress: Progress = ignore_progress) -> Outcome:
    """Outcome of one run with its histories, kept or computed again with the same bits.

    Raises:
        InputError: there is no such run.
    """
    store, plan = ready(where)
    if not 0 <= run < plan.runs:
        raise InputError(f"has runs 0 to {plan.runs - 1}", where, f"--run {run} is none of them.")
    problem, chunk = problem_of(plan), plan.chunk_of(run)
    progress(0.0, f"runs {chunk.begin} to {chunk.begin + chunk.runs - 1}, of which {run} is shown")
    alone = {name: _kept(store, plan.shard(chunk, name), run, problem) for name in plan.filters}
    if lacking := [name for name, one in alone.items() if one is None]:
        again = Worker(store, plan, problem).run_statistics(chunk, lacking, [run])
        alone |= {name: of[run] for name, of in again.items()}
    outcome = outcome_of(problem, {name: one for name, one in alone.items() if one}, None)
    return replace(
        outcome,
        claims=[],  # of one run there is nothing to be claimed
        **fields_of(plan) | {"runs": 1},
        notes=[f"Run {run} of {plan.runs}, alone.", *outcome.notes],
        last_lines=[f"Next:   robins campaign report {where}   all runs"],
    )


def _kept(store: Store, shard: Shard, run: int, problem: Problem) -> Statistics | None:
    """A run with its histories as they were kept; None where they are not, or are damaged."""
    content, one = content_of(store, shard, run), Statistics.of(problem)
    if content is None:
        return None
    try:
        unpack(content, one, example_of(problem, shard.filter))
    except DamagedShardError:
        return None
    return one


class CampaignVerification(NamedTuple):
    """Result of the verification of a campaign."""

    shards: int
    damaged: list[str]
    recomputed: list[str]
    different: list[str]


def campaign_verify(
    where: Where, share: float = 0.01, *, progress: Progress = ignore_progress
) -> CampaignVerification:
    """Check all shards and histories; compute a random share again and compare the bits.

    Raises:
        InputError: there is nothing to compare.
    """
    store, plan = ready(where)
    damaged = [shard.name for shard in gather(store, plan).damaged]
    there = store.names("shards")
    whole: list[tuple[Chunk, Shard]] = [
        (chunk, shard)
        for chunk, shards in plan.shards.items()
        for shard in shards
        if shard.name.partition("/")[2] in there and shard.name not in damaged
    ]
    if not whole:
        raise InputError("has no shard to verify yet", where, "compute some first.")
    drawn = random.sample(whole, max(1, round(share * len(whole))))
    problem = problem_of(plan, tuple(dict.fromkeys(shard.filter for _, shard in drawn)))
    worker, different = Worker(store, plan, problem), []
    for k, (chunk, shard) in enumerate(drawn):
        progress(k / len(drawn), f"{shard.filter}: runs from {chunk.begin} again")
        statistics: Statistics = worker.found(chunk, [shard.filter])[shard.filter]
        if worker.packed(shard, chunk, statistics) != store.get(shard.name):
            different.append(shard.name)
    spoilt = [*damaged, *retention.damaged(store, by_stem(plan.shards))]
    return CampaignVerification(
        len(whole) + len(damaged), spoilt, [s.name for _, s in drawn], different
    )


def remove_damaged(where: Where) -> int:
    """Remove damaged shards and those of damaged histories; return the number of shards."""
    store, plan = ready(where)
    spoilt = retention.damaged(store, by_stem(plan.shards))
    shards = {shard.name for shard in (*gather(store, plan).damaged, *spoilt.values())}
    for name in (*spoilt, *shards):
        store.drop(name)
    return len(shards)
