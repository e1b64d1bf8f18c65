"""The commands `run` and `demo`: a scenario simulated with several filters.

Examples::

    robins run ins-gnss/drive --runs 50 --filters ekf,ukf --out drive
    robins run my.toml --set gnss.sigma="2 m" --json
    robins run my_system.py:study --runs 100
    robins run transfer-alignment/replay --master master.csv --slave slave.csv
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated

from robins import _float64
from robins.campaign import check_machine, simulate
from robins.campaign.machine import machine_for
from robins.results import Outcome, Progress, ignore_progress
from robins.systems.judgement import judge_filters
from robins.workbench.options import Option, Runs, Scenario
from robins.workbench.scenarios import (
    Simulated,
    check_filters,
    read_scenario,
    request_fields,
    with_default_filter,
)


def run(
    name: Scenario,
    *,
    runs: Runs = None,
    machine: str = "",
    seed: int = 0,
    settings: Sequence[str] = (),
    filters: Sequence[str] = (),
    progress: Progress = ignore_progress,
) -> Outcome:
    """Simulate SCENARIO with several filters.

    SCENARIO is a name from `robins list`, a TOML file, or FILE.py:STUDY of your own.

    All filters get the same random numbers; run k of seed S is the same whatever N is.

    With --master and --slave a recorded pair replaces the simulation.

    Args:
        name: "system/name", the path of a TOML file, or "file.py:study" of the user's own.
        runs: their number; by default that of the scenario.
        seed: of the random streams.
        filters: names; by default those of the scenario, on which its claims are judged, and the
            default of its system.
        settings: "path=value" texts that change the scenario.
        machine: "vm", "c" or "jax"; not given, the interpreter where it can be.
        progress: called with the fraction done and the current activity.

    Raises:
        InputError, robins.scenario.ScenarioError: the request cannot be run.
        robins.errors.RobinsError: the machine is not available.
    """
    _float64.require()
    check_machine(machine)
    one = read_scenario(name, settings if runs is None else (*settings, f"runs={runs}"))
    chosen = check_filters(one.source, one.study.filters, filters or with_default_filter(one))
    progress(0.0, "setting up the simulation")
    problem = one.problem(chosen, seed)
    if not filters:  # the default was not there when the claims were stated
        problem = replace(problem, claims=judge_filters(one.own, problem.claims))
    total = one.parameters.runs
    found = simulate(problem, total, progress=progress, machine=machine_for(problem, machine))
    return replace(
        found,
        scenario=one.label,
        seed=seed,
        runs=total,
        warnings=[*found.warnings, *_not_kept(one)],
        last_lines=[
            f"Machine: {found.machine}   --machine chooses another",
            f"Next:   robins run {name} --seed {seed + 1}   repeats it with other noise",
        ],
        **request_fields(one.text, settings),
    )


DEMO = "ins-gnss/drive"
_DEMO_RUNS = 16
_STORY = (
    *("track", "error_position", "error_attitude", "rms_position"),
    *("anees", "innovation_gnss_position"),
)


def demo(
    *,
    runs: Runs = None,
    filters: Annotated[
        Sequence[str], Option("Which filters. [default: ekf]", metavar="a,b", names=True)
    ] = (),
    progress: Progress = ignore_progress,
) -> Outcome:
    """Simulate a drive with a GNSS outage and navigate it: a first look, which needs no data.

    Args:
        runs: how many.
        filters: names; by default those on which the claims of the scenario are judged.
        progress: called with the fraction done and the current activity.

    Raises:
        InputError: there is no such filter.
    """
    chosen = filters or read_scenario(DEMO, ()).own
    found = run(DEMO, runs=runs or _DEMO_RUNS, filters=chosen, progress=progress)
    whole = f"Next:   robins run {DEMO}   all its runs and figures, with the default filter"
    return replace(found, figures=_STORY, last_lines=[whole])


def _not_kept(one: Simulated) -> list[str]:
    """A sentence where a scenario requests histories that only a campaign in a folder keeps."""
    if not (one.parameters.keep or one.parameters.keep_diverged):
        return []
    return ["keep and keep_diverged are for `robins campaign run`: here run 0 alone has histories"]
