"""The command `doctor`."""

from __future__ import annotations

import shlex
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import click

from robins.cli.frame import BadInput, Status

_COLOURS = {"error": "red", "warning": "yellow", "note": "cyan"}


def examined(log: Sequence[Path]) -> list[Any]:
    """Findings on the files of a log, errors first.

    Raises:
        BadInput: there is only a configuration.
        robins.logs.LogError: a file cannot be read.
    """
    from robins import logs
    from robins.dataset import ImuTable
    from robins.logs.findings import by_severity

    files = [path for path in log if path.suffix != ".toml"]
    if not files:
        raise BadInput(f"{log[0]}: is a configuration; give the files of the log beside it.")
    mounting = _mounting([path for path in log if path.suffix == ".toml"])
    findings: list[Any] = []
    tables = []
    for path in files:
        table = logs.open_log(path, None, findings)
        tables.append(mounting.turn(table) if mounting and isinstance(table, ImuTable) else table)
    return by_severity(findings + logs.examine(tables))


def _mounting(configurations: Sequence[Path]) -> Any:
    """How the sensor sits in the vehicle, as a replay would read it from the same file."""
    if not configurations:
        return None
    if len(configurations) > 1:
        raise BadInput(f"one configuration is wanted, got {', '.join(map(str, configurations))}.")
    import numpy as np

    from robins import logs, scenario
    from robins.systems import SYSTEMS

    (path,) = configurations
    text = scenario.read_text(path)
    system = SYSTEMS.get(str(scenario.mapping_of(text).get("system")))
    if system is None or system.replay_parameters is None:
        raise BadInput(f'{path}: write system = "..." into it, one of {", ".join(SYSTEMS)}.')
    parameters = scenario.parse(system.replay_parameters, text, (), source=str(path))
    return logs.Mounting(*np.degrees(system.orientation(parameters)).tolist())


def told(findings: Sequence[Any], log: Sequence[Path], as_json: bool) -> Status:
    """Print the findings; bad input if a run on this log would be wrong."""
    count = Counter(finding.severity for finding in findings)
    if as_json:
        from robins.results.summary import dumps, plain

        answer = {
            "files": [str(path) for path in log],
            "findings": [asdict(finding) for finding in findings],
            **{f"{severity}s": count[severity] for severity in _COLOURS},
        }
        click.echo(dumps(plain(answer)), nl=False)
    else:
        for finding in findings:
            click.secho(f"{finding.severity}:", fg=_COLOURS[finding.severity], bold=True, nl=False)
            click.echo(f" {finding.sentence}")
        told = ", ".join(f"{count[s]} {s}{'' if count[s] == 1 else 's'}" for s in _COLOURS)
        click.echo(f"{told}.")
        if count["error"]:
            click.echo("Next:   mend the errors; a run on this log would be wrong or meaningless")
        else:
            click.echo(f"Next:   robins replay {shlex.join(map(str, log))}")
    return Status.BAD_INPUT if count["error"] else Status.DONE
