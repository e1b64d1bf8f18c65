"""The command `doctor`: contents of a log and findings on it, in colour."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from robins.cli.frame import ExitStatus, only_json
from robins.cli.printing import print_data
from robins.errors import RobinsError

if TYPE_CHECKING:
    from robins.dataset import Finding
    from robins.workbench.doctor import LogExamination

_COLOURS = {"error": "red", "warning": "yellow", "note": "cyan"}
_KINDS = {
    "imu": "inertial samples",
    "gnss": "GNSS fixes",
    "truth": "path",
    "mag": "magnetic field",
    "attitude": "true attitude",
    "odometry": "wheel speeds",
}


def warn(findings: Sequence[Finding]) -> None:
    """Print warnings and notes on a log at once; errors end the command and are printed there."""
    for finding in findings:
        if finding.severity != "error":
            click.echo(f"robins: {finding}", err=True)


def judge(
    paths: Sequence[Path], columns: Sequence[Path | str], as_json: bool, write: Path | None = None
) -> ExitStatus:
    """Print the contents of a log and the findings; bad input if a run on it would be wrong.

    The inertial unit's parameters as estimated from the log are written to `write`, if given.
    """
    with only_json(as_json):
        from robins.workbench import examine
        from robins.workbench.doctor import unit_file

        found = examine(paths, columns)
        given, failure = list(paths), None
        try:
            if write is not None:
                write.write_text(unit_file(paths, columns))
                given += [write] * any(table["kind"] == "gnss" for table in found.tables)
        except (RobinsError, OSError) as error:
            failure = error
    print_data(found.data if as_json else None, _text(found, given, columns), as_json)
    if failure is not None:  # after the findings, which may explain the failure
        raise failure
    return ExitStatus.BAD_INPUT if found.counts["error"] else ExitStatus.DONE


def _text(found: LogExamination, log: Sequence[Path], columns: Sequence[Path | str]) -> str:
    from robins.workbench.doctor import typed

    lines = []
    for table in found.tables:
        rate = f" at {table['rate_hz']:.4g} Hz" if table["rate_hz"] else ""
        held = f"{table['samples']} rows{rate}, {table['span_s']:.1f} s"
        lines.append(f"{_KINDS[table['kind']]:<17}{held}  ({Path(table['file']).name})")
    for finding in found.findings:
        severity = click.style(f"{finding.severity}:", fg=_COLOURS[finding.severity], bold=True)
        lines.append(f"{severity} {finding.sentence}")
    counts = [f"{n} {kind}{'' if n == 1 else 's'}" for kind, n in found.counts.items()]
    lines.append(f"{', '.join(counts)}.")
    kinds = {table["kind"] for table in found.tables}
    # Without fixes there is no position, but an attitude.
    then = f"robins replay {typed(log, columns)}{'' if 'gnss' in kinds else ' --system marg'}"
    if found.counts["error"]:
        then = "mend the errors; a run on this log would be wrong or meaningless"
    elif "imu" not in kinds:
        then = "give the log of an IMU too; a replay needs its samples"
    return "\n".join([*lines, f"Next:   {then}"])
