"""What the commands do: from a scenario or a log to a result folder with figures and a page.

Everything below knows one thing; here they meet: scenario text, system, campaign, result, report.
"""

from __future__ import annotations

import difflib
import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import numpy as np

from robins import _float64, logs, report, results, scenario, units
from robins.campaign import simulate
from robins.campaign.bound import bound
from robins.dataset import Dataset
from robins.ins.frames import to_ned_frd
from robins.logs import Finding
from robins.report import bounds
from robins.systems import SYSTEMS, Outcome, Study, System
from robins.systems.catalogue import configurations, listed

Progress = Callable[[float, str], None]


class InputError(ValueError):
    """Something the user gave cannot be used; the message names it, says why and what to do."""


@dataclass(frozen=True)
class Done:
    """A finished command: where its result is and what its summary says."""

    path: Path
    summary: dict[str, Any]
    notes: tuple[str, ...] = ()


def _hint(word: str, among: Iterable[str]) -> str:
    near = difflib.get_close_matches(word, list(among), 1)
    return f"; did you mean '{near[0]}'?" if near else "."


def find_scenario(name: str, recorded: bool = False) -> tuple[System, str, str]:
    """System, name and text of a packaged scenario "system/name", or of a TOML file.

    A file says its system in the key ``system``.

    Args:
        name: of the scenario, or a path that ends in .toml.
        recorded: a recorded pair takes the place of the simulation.

    Raises:
        InputError: there is no such scenario or file, the file names no system, or only a
            recorded pair fits it.
    """
    packaged = {f"{s}/{k}": (s, one.path) for s in SYSTEMS for k, one in listed(s).items()}
    others = {f"{s}/{k}": (s, path) for s in SYSTEMS for k, path in configurations(s).items()}
    if recorded:
        packaged |= others
    elif name in others:
        path = others[name][1]
        raise InputError(
            f"{name} describes what is recorded and simulates nothing. A recorded pair is given "
            f"with --master and --slave, another log with `robins replay LOG... {path}`. To "
            "simulate a pair, put your units into a copy of that file and run the copy"
        )
    if name in packaged:
        system, path = packaged[name]
        return SYSTEMS[system], name, path.read_text("utf-8")
    if not name.endswith(".toml"):
        raise InputError(
            f"no scenario '{name}'{_hint(name, packaged)} `robins list` names those there are; "
            "a path must end in .toml"
        )
    text = scenario.read_text(name)
    chosen = scenario.mapping_of(text).get("system")
    if not isinstance(chosen, str) or chosen not in SYSTEMS:
        raise InputError(
            f'{name}: write system = "..." into its first lines, one of {", ".join(SYSTEMS)}; '
            f"it says {chosen!r}"
        )
    return SYSTEMS[chosen], Path(name).stem, text


def _study_of(system: System, text: str, source: str) -> Study:
    """The study that a scenario is of."""
    names = ", ".join(system.studies)
    chosen = scenario.mapping_of(text).get("study")
    if chosen is None and len(system.studies) == 1:
        return next(iter(system.studies.values()))
    if not isinstance(chosen, str) or chosen not in system.studies:
        raise InputError(
            f'{source}: write study = "..." into its first lines, one of {names}; it says '
            f"{chosen!r}"
        )
    return system.studies[chosen]


def _check_filters(where: str, known: Sequence[str], wanted: Sequence[str]) -> tuple[str, ...]:
    for name in wanted:
        if name not in known:
            raise InputError(
                f"no filter '{name}' in {where}{_hint(name, known)} It has {', '.join(known)}"
            )
    return tuple(dict.fromkeys(wanted))


def _write(
    outcome: Outcome,
    writer: results.ResultWriter,
    tell: Progress,
    keep: Callable[[Any], None],
    *,
    name: str,
    seed: int,
    runs: int = 1,
) -> Done:
    variables = outcome.solution.variables.items()
    keep({"solution": {k: v.values for k, v in variables}, "metrics": outcome.metrics})
    writer.save_summary(
        {
            "scenario": name,
            "seed": seed,
            "runs": runs,
            "filters": outcome.metrics,
            "claims": outcome.claims,
            "counts": outcome.counts,
            "warnings": outcome.warnings,
        }
    )
    writer.save_solution(outcome.solution)
    for file, content in outcome.files.items():
        writer.save_file(file, content)

    def drawing(done: int, total: int, what: str) -> None:
        tell(0.85 + 0.15 * done / max(total, 1), what)

    report.add(writer, drawing, outcome.notes)
    return Done(writer.path, {}, tuple(outcome.notes))


def run_scenario(
    name: str,
    *,
    out: str | os.PathLike[str],
    runs: int | None = None,
    seed: int = 0,
    filters: Sequence[str] = (),
    settings: Iterable[str] = (),
    command: str = "",
    progress: Progress | None = None,
) -> Done:
    """Simulate a scenario with several filters on the same random numbers.

    Args:
        name: "system/name" or the path of a TOML file.
        out: the result folder.
        runs: how many; by default what the scenario says.
        seed: of the random streams.
        filters: names; by default those of the scenario.
        settings: "path=value" texts that change the scenario.
        command: how to make the result again, for its report.
        progress: called with the share done and what is being done.

    Raises:
        InputError, robins.scenario.ScenarioError: what was asked for cannot be run.
        robins.results.ResultError: the folder cannot be written.
    """
    _float64.require()
    tell = progress or (lambda share, what: None)
    system, label, text = find_scenario(name)
    settings = tuple(settings)
    study = _study_of(system, text, name)
    asked = settings if runs is None else (*settings, f"runs={runs}")
    parameters = scenario.parse(study.parameters, text, asked, source=name)
    chosen = _check_filters(label, study.filters, filters or parameters.filters)
    count = parameters.runs
    with results.rescued(out) as keep, _writer(out, text, settings, command) as writer:
        tell(0.0, "setting up the simulation")
        try:
            problem = study.problem(parameters, chosen, seed)
        except ValueError as error:
            raise InputError(f"{name}: {error}") from error
        outcome = simulate(problem, count, progress=lambda s, w: tell(0.85 * s, w), keep=keep)
        done = _write(outcome, writer, tell, keep, name=label, seed=seed, runs=count)
    return _finished(done)


def bound_scenario(
    name: str,
    *,
    out: str | os.PathLike[str],
    filter_name: str = "",
    runs: int = 1,
    seed: int = 0,
    without: Sequence[str] = (),
    at: Sequence[str] = (),
    settings: Iterable[str] = (),
    command: str = "",
    progress: Progress | None = None,
) -> tuple[Done, Any]:
    """Tell what the sensors of a scenario allow at best, with the model of one of its filters.

    Args:
        name: "system/name" or the path of a TOML file.
        out: the result folder.
        filter_name: whose model; by default that of the scenario's first filter.
        runs: over how many simulated trajectories to average.
        seed: of the random streams.
        without: sensors to leave out altogether.
        at: times to tell, such as "200 s"; by default the quarters.
        settings: "path=value" texts that change the scenario.
        command: how to make the result again, for its report.
        progress: called with the share done and what is being done.

    Returns:
        The finished result, and a table for a terminal.

    Raises:
        InputError, robins.scenario.ScenarioError, robins.units.UnitError: what was asked for cannot
            be computed.
        robins.results.ResultError: the folder cannot be written.
    """
    _float64.require()
    tell = progress or (lambda share, what: None)
    system, label, text = find_scenario(name)
    settings = tuple(settings)
    study = _study_of(system, text, name)
    parameters = scenario.parse(study.parameters, text, (*settings, f"runs={runs}"), source=name)
    wanted = filter_name or next(iter(parameters.filters or study.filters))
    chosen = _check_filters(label, study.filters, [wanted])
    times = [units.parse(time, "time") for time in at]
    with results.rescued(out) as keep, _writer(out, text, settings, command) as writer:
        tell(0.0, "linearising along the truth")
        try:
            problem = study.problem(parameters, chosen, seed)
            solution = bound(problem, wanted, runs, without)
            epochs = bounds.epochs(solution, times)
        except ValueError as error:
            raise InputError(f"{name}: {error}") from error
        outcome = Outcome(
            solution,
            {wanted: bounds.metrics(solution)},
            files={"bound.csv": bounds.csv(solution).encode()},
            notes=bounds.sentences(solution),
        )
        done = _write(outcome, writer, tell, keep, name=label, seed=seed, runs=runs)
    return _finished(done), bounds.table(solution, epochs)


def replay_log(
    paths: Sequence[str | os.PathLike[str]],
    *,
    out: str | os.PathLike[str],
    system: str = "ins-gnss",
    filters: Sequence[str] = (),
    settings: Iterable[str] = (),
    columns: Sequence[str | os.PathLike[str]] = (),
    seed: int = 0,
    command: str = "",
    progress: Progress | None = None,
    findings: Callable[[Sequence[Finding]], None] | None = None,
) -> Done:
    """Navigate a recorded log: doctor, clean, align, filter, smooth, measure.

    Args:
        paths: the log's files; one that ends in .toml is the configuration.
        out: the result folder.
        system: which system navigates it.
        filters: names; by default those of the configuration.
        settings: "path=value" texts that change the configuration.
        columns: TOML files that declare formats of the files, see `robins.logs.columns_from`.
        seed: recorded in the result; a replay draws nothing.
        command: how to make the result again.
        progress: called with the share done and what is being done.
        findings: called with what the doctor says.

    Raises:
        InputError: the log or what was asked of it cannot be used.
        robins.logs.LogError, robins.scenario.ScenarioError: a file cannot be used.
        robins.results.ResultError: the folder cannot be written.
    """
    _float64.require()
    tell = progress or (lambda share, what: None)
    if system not in SYSTEMS:
        raise InputError(f"no system '{system}'; there are {', '.join(SYSTEMS)}")
    chosen_system = SYSTEMS[system]
    if chosen_system.replay is None or chosen_system.replay_parameters is None:
        raise InputError(f"{system} does not replay logs")
    configurations = [os.fspath(p) for p in paths if os.fspath(p).endswith(".toml")]
    files = [p for p in paths if not os.fspath(p).endswith(".toml")]
    if len(configurations) > 1:
        raise InputError(f"one configuration is wanted, got {', '.join(configurations)}")
    chosen_path = configurations[0] if configurations else chosen_system.replay_default
    text = scenario.read_text(chosen_path) if chosen_path is not None else ""
    settings = tuple(settings)
    source = configurations[0] if configurations else "the default configuration"
    parameters = scenario.parse(chosen_system.replay_parameters, text, settings, source=source)
    chosen = _check_filters(system, chosen_system.replay_filters, filters)
    with results.rescued(out) as keep, _writer(out, text, settings, command) as writer:
        tell(0.0, "reading")
        angles = np.degrees(chosen_system.orientation(parameters))
        formats = logs.formats_of(files, columns)
        dataset = logs.load_dataset(files, mounting=logs.Mounting(*angles), formats=formats)
        _examine(dataset, findings)
        dataset = logs.clean(dataset)
        try:
            outcome = chosen_system.replay(
                dataset, parameters, chosen, lambda s, w: tell(0.1 + 0.75 * s, w)
            )
        except ValueError as error:
            raise InputError(f"{dataset.name}: {error}") from error
        done = _write(outcome, writer, tell, keep, name=f"{system}/{dataset.name}", seed=seed)
    return _finished(done)


def align_pair(
    name: str,
    master: str | os.PathLike[str],
    slave: str | os.PathLike[str],
    *,
    out: str | os.PathLike[str],
    filters: Sequence[str] = (),
    settings: Iterable[str] = (),
    columns: Sequence[str | os.PathLike[str]] = (),
    seed: int = 0,
    command: str = "",
    progress: Progress | None = None,
    findings: Callable[[Sequence[Finding]], None] | None = None,
) -> Done:
    """Align a recorded slave to its recorded master: doctor, clean, filter, measure.

    Args:
        name: "system/name" or the path of a TOML file: what is believed of the two units.
        master: what the master reported, a path in any format of `robins.logs`.
        slave: inertial samples, along the axes of the slave.
        out: the result folder.
        filters: names; by default those of the scenario.
        settings: "path=value" texts that change the scenario.
        columns: TOML files that declare formats of the files, see `robins.logs.columns_from`.
        seed: recorded in the result; nothing is drawn.
        command: how to make the result again.
        progress: called with the share done and what is being done.
        findings: called with what the doctor says.

    Raises:
        InputError: the pair or what was asked of it cannot be used.
        robins.logs.LogError, robins.scenario.ScenarioError: a file cannot be used.
        robins.results.ResultError: the folder cannot be written.
    """
    _float64.require()
    tell = progress or (lambda share, what: None)
    system, label, text = find_scenario(name, recorded=True)
    settings = tuple(settings)
    alignment = system.alignment
    study = scenario.mapping_of(text).get("study")
    if alignment is None or study != alignment.study:
        able = [f"{s.name}, study {s.alignment.study!r}" for s in SYSTEMS.values() if s.alignment]
        raise InputError(
            f"{label} cannot be given a recorded master and slave: it is of {system.name}, study "
            f"{study!r}; what can is {', '.join(able) or 'nothing'}"
        )
    parameters: Any = scenario.parse(alignment.parameters, text, settings, source=name)
    chosen = _check_filters(label, alignment.filters, filters or parameters.filters)
    with results.rescued(out) as keep, _writer(out, text, settings, command) as writer:
        tell(0.0, "reading")
        formats = logs.formats_of((master, slave), columns)
        delay_s = parameters.master.delay
        dataset = logs.load_pair(master, slave, delay_s=delay_s, formats=formats)
        # the doctor looks along the master's axes, the filter along those of the slave
        turn = logs.Mounting(*np.degrees(system.orientation(parameters)))
        _examine(replace(dataset, imu=turn.turn(to_ned_frd(dataset.imu))), findings)
        dataset = logs.clean(dataset)
        try:
            outcome = alignment.align(
                dataset, parameters, chosen, lambda s, w: tell(0.1 + 0.75 * s, w)
            )
        except ValueError as error:
            raise InputError(f"{dataset.name}: {error}") from error
        done = _write(outcome, writer, tell, keep, name=f"{system.name}/{dataset.name}", seed=seed)
    return _finished(done)


def _examine(dataset: Dataset, findings: Callable[[Sequence[Finding]], None] | None) -> None:
    """Ask the doctor.

    Raises:
        InputError: there are errors; the message has all of them.
    """
    found = logs.examine(dataset)
    if findings is not None:
        findings(found)
    errors = [f for f in found if f.severity == "error"]
    if errors:
        raise InputError("\n".join(f.sentence for f in errors))


def _writer(out, text: str, settings: Sequence[str], command: str) -> results.ResultWriter:
    """The result is refused before anything is computed where it could not be written."""
    effective = scenario.text_of(scenario.override(scenario.mapping_of(text), settings))
    device = jax.devices()[0].device_kind
    return results.ResultWriter(
        out, scenario_text=effective if settings else text, device=device, command=command
    )


def _finished(done: Done) -> Done:
    return Done(done.path, results.read(done.path).summary, done.notes)
