"""The commands `replay` and `align`: a recorded log navigated, a recorded pair aligned.

Examples::

    robins replay imu.csv gnss.pos --out walk
    robins replay imu.csv gnss.pos unit.toml --set gnss.latency="-50 ms" --json
    robins replay my.csv --columns logger.toml --system marg
    robins replay imu.csv gnss.pos --out walk --export csv,kml
"""

from __future__ import annotations

import os
import shlex
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Annotated, Any, NamedTuple

import numpy as np

from robins import _float64, logs, scenario, systems
from robins.dataset import Dataset
from robins.ins.frames import to_ned_frd
from robins.logs import Finding
from robins.logs.doctor import Use
from robins.results import Outcome, Progress, ignore_progress
from robins.systems.finding import find_system
from robins.workbench.doctor import separate_files, typed
from robins.workbench.errors import InputError, refusing
from robins.workbench.formats import require_formats, with_exports
from robins.workbench.options import Logs, Option
from robins.workbench.publication import part
from robins.workbench.scenarios import check_filters, find_scenario, request_fields

Findings = Callable[[Sequence[Finding]], None]


def ignore_findings(findings: Sequence[Finding]) -> None:
    """Ignore the findings of the doctor."""


def replay(
    paths: Logs,
    *,
    system: Annotated[str, Option("The system that navigates the log.", shown=True)] = "ins-gnss",
    exports: Annotated[
        Sequence[str],
        Option(
            "Write the result for other programs too: csv, tum, kml, gpx.",
            "--export",
            "a,b",
            names=True,
        ),
    ] = (),
    columns: Sequence[str | os.PathLike[str]] = (),
    seed: int = 0,
    settings: Sequence[str] = (),
    filters: Sequence[str] = (),
    progress: Progress = ignore_progress,
    findings: Findings = ignore_findings,
) -> Outcome:
    """Navigate a recorded log: LOG... are its files, inertial samples and GNSS fixes.

    A file that ends in .toml adds what the log lacks: noise, mounting, lever arm. The file of
    --columns declares the columns of a log that is in no known format.

    --export writes files into exports/ of the result folder: csv has all estimates, tum is t x y z
    qx qy qz qw in east, north, up, kml and gpx are tracks with UTC. kml and gpx need positions.

    Args:
        paths: the log's files; one that ends in .toml is the configuration.
        system: that navigates it.
        filters: names; by default those of the configuration.
        settings: "path=value" texts that change the configuration.
        columns: TOML files that declare formats of the files, see `robins.logs.columns_from`.
        exports: formats of other programs, of `robins.workbench.formats.FORMATS`; the files are
            among those of the outcome.
        seed: recorded in the result; a replay draws nothing.
        progress: called with the fraction done and the current activity.
        findings: called with the findings of the doctor.

    Raises:
        InputError: the log or the request cannot be used.
        robins.logs.LogError, robins.scenario.ScenarioError: a file cannot be used.
    """
    _float64.require()
    opened = open_log(paths, system=system, settings=settings, columns=columns)
    chosen = check_filters(system, opened.system.replay_filters, filters)
    require_formats(exports, opened.system.replay_finds, f"a replay with {system}")
    progress(0.0, "reading")
    dataset = opened.read(findings)
    with refusing(dataset.name):
        found = opened.system.replay(dataset, opened.parameters, chosen, part(progress, 0.1, 1.0))
    label = f"{system}/{dataset.name}"
    again = _command(typed(paths, columns), system, filters, settings)
    lines = _next_lines(opened, found.setting, again, exports)
    labels = {"scenario": label, "seed": seed, "last_lines": lines}
    return with_exports(
        replace(found, **labels, **request_fields(opened.text, settings)), exports, label
    )


def _command(files: str, system: str, filters: Sequence[str], settings: Sequence[str]) -> str:
    """Command line of this replay."""
    words = ["robins", "replay", files]
    words += ["--system", system] * (system != "ins-gnss")
    words += ["--filters", ",".join(filters)] * bool(filters)
    return " ".join([*words, *(f"--set {shlex.quote(one)}" for one in settings)])


def _next_lines(opened: OpenLog, setting: str, again: str, exports: Sequence[str]) -> list[str]:
    """Last lines of a replay: a command to go on with.

    Args:
        opened: the log.
        setting: that the figures ask for, "" if none.
        again: the command of this replay.
        exports: formats that it wrote.
    """
    listed = f"Next:   robins list {opened.system.name}   tells what can be simulated of it"
    if opened.system.reads == "ranges":
        return [listed]
    noise = "Noise:  `robins allan` finds that of your unit, in a log at rest, if it is not set"
    if setting:
        what = "fixes scatter by less than assumed"
        return [noise, f"Next:   {again} --set {shlex.quote(setting)}   {what}"]
    if exports:
        return [noise, listed]
    return [noise, f"Next:   {again} --export csv   writes the estimates as a table"]


class OpenLog(NamedTuple):
    """A log with its configuration, ready to be read."""

    system: Any  # a `System` that replays logs
    files: Sequence[str | os.PathLike[str]]
    columns: Sequence[str | os.PathLike[str]]
    text: str  # TOML of the configuration
    source: str  # its file
    parameters: Any  # as read, with the settings

    def read(self, findings: Findings = ignore_findings) -> Any:
        """Contents of its files, examined and cleaned.

        Raises:
            InputError: the doctor finds errors, or the files are of another kind.
            robins.logs.LogError: a file cannot be read.
        """
        if self.system.reads == "ranges":
            if self.columns:
                name = self.system.name
                raise InputError(f"{name} reads text of libRSF: --columns declares other logs")
            ranges = logs.load_ranges(self.files)
            findings(ranges.findings)
            return ranges
        angles = np.degrees(self.system.orientation(self.parameters))
        formats = logs.formats_of(self.files, self.columns)
        dataset = logs.load_dataset(self.files, mounting=logs.Mounting(*angles), formats=formats)
        _examine(dataset, findings, self.system.use)
        return logs.clean(dataset)


def open_log(
    paths: Sequence[str | os.PathLike[str]],
    *,
    system: str,
    settings: Sequence[str] = (),
    columns: Sequence[str | os.PathLike[str]] = (),
) -> OpenLog:
    """Separate a log's files from the configuration and read the latter; see `replay`.

    Raises:
        InputError: the system replays no logs.
        robins.scenario.ScenarioError: the configuration cannot be used.
    """
    found = find_system(system)
    if found.replay is None or found.replay_parameters is None:
        raise InputError(f"{system} does not replay logs")
    files, configuration = separate_files(paths)
    path = configuration or found.replay_default
    text = scenario.read_text(path) if path is not None else ""
    source = os.fspath(configuration or "the default configuration")
    parameters = scenario.parse(found.replay_parameters, text, settings, source=source)
    return OpenLog(found, files, columns, text, source, parameters)


def align(
    name: str,
    master: str | os.PathLike[str],
    slave: str | os.PathLike[str],
    *,
    filters: Sequence[str] = (),
    settings: Sequence[str] = (),
    columns: Sequence[str | os.PathLike[str]] = (),
    seed: int = 0,
    progress: Progress = ignore_progress,
    findings: Findings = ignore_findings,
) -> Outcome:
    """Align a recorded slave to its recorded master: doctor, clean, filter, measure.

    The model of the two units is a scenario by name, "system/name" or the path of a TOML file. The
    outputs of the master and the inertial samples of the slave, along the axes of the slave, are
    paths in any format of `robins.logs`. All other arguments and errors are as of `replay`.
    """
    _float64.require()
    system, label, text = find_scenario(name, recorded=True)
    alignment = system.alignment
    study = scenario.mapping_of(text).get("study")
    if alignment is None or study != alignment.study:
        every = systems.SYSTEMS.values()
        able = [f"{s.name}, study {s.alignment.study!r}" for s in every if s.alignment]
        raise InputError(
            f"{label} cannot be given a recorded master and slave: it is of {system.name}, study "
            f"{study!r}; what can is {', '.join(able) or 'nothing'}"
        )
    parameters: Any = scenario.parse(alignment.parameters, text, settings, source=name)
    chosen = check_filters(label, alignment.filters, filters or parameters.filters)
    progress(0.0, "reading")
    formats = logs.formats_of((master, slave), columns)
    dataset = logs.load_pair(master, slave, delay_s=parameters.master.delay, formats=formats)
    # the doctor examines along the master's axes, the filter uses those of the slave
    turn = logs.Mounting(*np.degrees(system.orientation(parameters)))
    _examine(replace(dataset, imu=turn.turn(to_ned_frd(dataset.imu))), findings)
    dataset = logs.clean(dataset)
    with refusing(dataset.name):
        found = alignment.align(dataset, parameters, chosen, part(progress, 0.1, 1.0))
    then = f"robins run COPY   simulates such a pair; COPY is {name} with your units"
    label = f"{system.name}/{dataset.name}"
    labels = {"scenario": label, "seed": seed, "last_lines": [f"Next:   {then}"]}
    return replace(found, **labels, **request_fields(text, settings))


def _examine(dataset: Dataset, findings: Findings, use: Use = "any") -> None:
    """Examine a dataset by the doctor, for the use of a system.

    Raises:
        InputError: there are errors; the message has all of them.
    """
    found = logs.examine(dataset, use)
    findings(found)
    errors = [f for f in found if f.severity == "error"]
    if errors:
        raise InputError("\n".join(f.sentence for f in errors))
