"""The command `doctor`."""

from __future__ import annotations

import shlex
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import click

from robins.cli.frame import BadInput, Status

_COLOURS = {"error": "red", "warning": "yellow", "note": "cyan"}
_KINDS = {
    "imu": "inertial samples",
    "gnss": "GNSS fixes",
    "truth": "path",
    "mag": "magnetic field",
    "attitude": "true attitude",
}


class Examined(NamedTuple):
    """What the files hold, and what the doctor says of it."""

    tables: list[dict[str, Any]]  # "kind", "file", "samples", "span_s", "rate_hz"
    findings: list[Any]  # errors first


def examined(log: Sequence[Path], columns: Sequence[Path] = ()) -> Examined:
    """Have the files of a log examined.

    Raises:
        BadInput: there is only a configuration.
        robins.logs.LogError: a file cannot be read.
    """
    from robins import logs
    from robins.logs.findings import by_severity
    from robins.logs.mounting import turned
    from robins.logs.tables import tables_of

    files = [path for path in log if path.suffix != ".toml"]
    if not files:
        raise BadInput(f"{log[0]}: is a configuration; give the files of the log beside it.")
    mounting = mounting_of([path for path in log if path.suffix == ".toml"])
    formats = logs.formats_of(files, columns)
    findings: list[Any] = []
    opened = []
    for path in files:
        part = logs.open_log(path, formats.get(str(path)), findings)
        opened.append(turned(part, mounting) if mounting else part)
    tables = [_described(table) for part in opened for table in tables_of(part)]
    return Examined(tables, by_severity(findings + logs.examine(opened)))


def _described(table: Any) -> dict[str, Any]:
    from robins.logs.quiet import usual_step_s
    from robins.logs.tables import kind_of

    step_s = usual_step_s(table.time_ns)
    return {
        "kind": kind_of(table),
        "file": table.source,
        "samples": len(table),
        "span_s": float(table.time_ns.max() - table.time_ns.min()) * 1e-9 if len(table) else 0.0,
        "rate_hz": 1.0 / step_s if step_s > 0.0 else None,
    }


def mounting_of(configurations: Sequence[Path]) -> Any:
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


def told(answer: Examined, log: Sequence[Path], columns: Sequence[Path], as_json: bool) -> Status:
    """Print what there is and the findings; bad input if a run on this log would be wrong."""
    findings = answer.findings
    count = Counter(finding.severity for finding in findings)
    if as_json:
        from robins.results.summary import dumps, plain

        content = {
            "files": [str(path) for path in log],
            "tables": answer.tables,
            "findings": [asdict(finding) for finding in findings],
            **{f"{severity}s": count[severity] for severity in _COLOURS},
        }
        click.echo(dumps(plain(content)), nl=False)
    else:
        for table in answer.tables:
            rate = f" at {table['rate_hz']:.4g} Hz" if table["rate_hz"] else ""
            held = f"{table['samples']} rows{rate}, {table['span_s']:.1f} s"
            click.echo(f"{_KINDS[table['kind']]:<17}{held}  ({Path(table['file']).name})")
        for finding in findings:
            click.secho(f"{finding.severity}:", fg=_COLOURS[finding.severity], bold=True, nl=False)
            click.echo(f" {finding.sentence}")
        told = ", ".join(f"{count[s]} {s}{'' if count[s] == 1 else 's'}" for s in _COLOURS)
        click.echo(f"{told}.")
        if count["error"]:
            click.echo("Next:   mend the errors; a run on this log would be wrong or meaningless")
        else:
            # Without fixes there is no position, but with a magnetic field an attitude.
            kinds = {table["kind"] for table in answer.tables}
            system = " --system marg" if "mag" in kinds and "gnss" not in kinds else ""
            declared = [word for path in columns for word in ("--columns", path)]
            words = shlex.join(map(str, [*log, *declared]))
            click.echo(f"Next:   robins replay {words}{system}")
    return Status.BAD_INPUT if count["error"] else Status.DONE
