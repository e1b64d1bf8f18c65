"""The command `doctor`: a log examined before it is navigated.

Examples::

    robins doctor imu.csv gnss.pos
    robins doctor imu.csv unit.toml --json
    robins doctor imu.csv gnss.pos --write found.toml
"""

from __future__ import annotations

import os
import shlex
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from robins import logs, scenario, systems
from robins.dataset import Dataset
from robins.ins.frames import to_ned_frd
from robins.logs.batches import spread
from robins.logs.findings import SEVERITIES, by_severity
from robins.logs.loading import by_kind, without_replaced
from robins.logs.mounting import turned
from robins.logs.quiet import usual_step_s
from robins.logs.tables import kind_of, tables_of
from robins.logs.unit_file import find_unit, toml_of
from robins.workbench.errors import InputError
from robins.workbench.options import Logs


class LogExamination(NamedTuple):
    """Contents of the files of a log, and the findings of the doctor."""

    files: list[str]
    tables: list[dict[str, Any]]  # "kind", "file", "samples", "span_s", "rate_hz"
    findings: list[logs.Finding]  # errors first

    @property
    def counts(self) -> dict[str, int]:
        """Findings by severity."""
        return {s: sum(f.severity == s for f in self.findings) for s in SEVERITIES}

    @property
    def data(self) -> dict[str, Any]:
        """All of it in the types of JSON."""
        from robins.results.summary import plain  # imported late: people need no writer of results

        return {
            "files": self.files,
            "tables": plain(self.tables),
            "findings": plain([asdict(finding) for finding in self.findings]),
            **{f"{severity}s": count for severity, count in self.counts.items()},
        }


def examine(paths: Logs, columns: Sequence[str | os.PathLike[str]] = ()) -> LogExamination:
    """Examine a log as an engineer would: units, axes, gravity, rates, gaps, time, sigmas.

    The exit status is 2 if a run on it would be wrong, 0 otherwise. A .toml file among LOG... gives
    the mounting of the sensor, as for `robins replay`.

    With --write, what the log shows of the unit and the receiver (mounting, latency, window of the
    velocities, noise at rest) becomes a configuration for `robins replay`.

    Args:
        paths: the files.
        columns: TOML files that declare formats of the files, see `robins.logs.columns_from`.

    Raises:
        InputError: there is a configuration without a log, or more than one of these.
        robins.logs.LogError, robins.scenario.ScenarioError: a file cannot be read.
    """
    files, configuration = separate_files(paths)
    mounting = mounting_of(configuration)
    formats = logs.formats_of(files, columns)
    findings: list[logs.Finding] = []
    read = [logs.open_log(path, formats.get(str(path)), findings) for path in files]
    opened = without_replaced(read, findings)
    opened = [turned(log, mounting) for log in opened] if mounting else opened
    tables = [_described(table) for log in opened for table in tables_of(log)]
    findings += logs.examine(opened)
    try:
        by_kind(files, opened, [])
    except logs.LogError as error:
        findings.append(logs.Finding("error", "second_of_kind", error.file, "", "", f"{error}."))
    return LogExamination([str(path) for path in paths], tables, by_severity(findings))


def unit_file(
    paths: Sequence[str | os.PathLike[str]], columns: Sequence[str | os.PathLike[str]] = ()
) -> str:
    """Configuration for `robins replay` with what a log shows of its unit and its receiver.

    Args:
        paths: the files of the log, without a configuration, so that the values come from the log.
        columns: as of `examine`.

    Raises:
        InputError: there is a configuration among them, or nothing was found.
        robins.logs.LogError: a file cannot be read.
    """
    from robins.systems.ins_gnss import InsGnssReplay  # imported late: it needs JAX

    files, configuration = separate_files(paths)
    if configuration is not None:
        raise InputError(
            "a configuration is written from the log alone", configuration, "omit this file."
        )
    dataset = logs.load_dataset(files, formats=logs.formats_of(files, columns))
    found = find_unit(to_ned_frd(spread(dataset.imu)), dataset.gnss)
    found = found._replace(lasting_share=_lasting_share(dataset))
    if not any(value is not None for value in found):
        what = "the log tells nothing of its unit: there is too little motion, and no rest"
        fix = "drive a figure of eight and stand for ten seconds."
        raise InputError(what, dataset.name, fix)
    usual = InsGnssReplay().imu
    noise = {"gyro_noise": usual.gyro_noise, "accel_noise": usual.accel_noise}
    return toml_of(found, dataset.name, noise)


def _lasting_share(dataset: Dataset) -> float | None:
    """Share of the position variance that a replay takes as correlated; None if it finds none."""
    from robins.systems.ins_gnss import InsGnssReplay
    from robins.systems.ins_gnss.correlated_errors import with_correlated_share
    from robins.systems.ins_gnss.recording import on_one_clock

    try:
        log = on_one_clock(logs.clean(dataset), InsGnssReplay())
    except ValueError:  # no fix, or none within the log: nothing is known of their errors
        return None
    return with_correlated_share(InsGnssReplay(), log)[0].gnss.lasting_share or None


def _described(table: Any) -> dict[str, Any]:
    step_s = usual_step_s(spread(table).time_ns)
    return {
        "kind": kind_of(table),
        "file": table.source,
        "samples": len(table),
        "span_s": float(table.time_ns.max() - table.time_ns.min()) * 1e-9 if len(table) else 0.0,
        "rate_hz": 1.0 / step_s if step_s > 0.0 else None,
    }


def typed(
    paths: Sequence[str | os.PathLike[str]], columns: Sequence[str | os.PathLike[str]] = ()
) -> str:
    """Command-line words that pass these files and their formats to another command."""
    words = [str(path) for path in paths]
    for one in map(str, columns):
        named = one.startswith("format:")
        words += ("--format", one.removeprefix("format:")) if named else ("--columns", one)
    return shlex.join(words)


def separate_files(paths: Sequence[str | os.PathLike[str]]) -> tuple[list[Path], Path | None]:
    """The files of a log, and the configuration among them, if there is one.

    Raises:
        InputError: there is no log, or more than one configuration.
    """
    given = [Path(path) for path in paths]
    files = [path for path in given if path.suffix != ".toml"]
    configurations = [path for path in given if path.suffix == ".toml"]
    if not files:
        what = "is a configuration" if given else "no file is given"
        fix = "give the files of the log beside it." if given else "give those of a log"
        raise InputError(what, given[0] if given else "", fix)
    if len(configurations) > 1:
        raise InputError(f"one configuration is wanted, got {', '.join(map(str, configurations))}")
    return files, next(iter(configurations), None)


def mounting_of(configuration: Path | None) -> logs.Mounting | None:
    """Mounting of the sensor in the vehicle, as a replay would read it from the same file.

    Raises:
        InputError: the file names no system that replays logs.
        robins.scenario.ScenarioError: it cannot be used.
    """
    if configuration is None:
        return None
    text = scenario.read_text(configuration)
    name = str(scenario.mapping_of(text).get("system", "ins-gnss"))
    system = systems.SYSTEMS.get(name)
    if system is None or system.replay_parameters is None:
        known = ", ".join(systems.SYSTEMS)
        raise InputError(f'write system = "..." into it, one of {known}.', configuration)
    parameters = scenario.parse(system.replay_parameters, text, (), source=str(configuration))
    return logs.Mounting(*np.degrees(system.orientation(parameters)).tolist())
