"""The command `calibrate`: from a magnetometer that is turned about to its hard and soft iron."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import click
import numpy as np
import xarray as xr

from robins import report, results
from robins.cli.examine import mounting_of
from robins.cli.frame import BadInput, command_line, only_json
from robins.cli.progress import Progress
from robins.dataset import MagTable
from robins.ins.frames import to_ned_frd
from robins.ins.magnetometer_calibration import (
    Calibration,
    CalibrationError,
    calibrate,
    calibrated,
)
from robins.logs import formats_of, open_log
from robins.logs.clean_mag import clean_mag
from robins.logs.mounting import turned
from robins.logs.tables import tables_of
from robins.results import array, variable
from robins.units import UnitError, parse

FILE = "calibration.toml"
_AXES = ("x", "y", "z")
_UT = 1e6  # of a tesla
_WIDE = np.deg2rad(60.0)  # a gap of directions that is worth a word
_MANY = 0.02  # outliers, likewise


class Turned(NamedTuple):
    """Samples of a magnetometer, forward-right-down as a replay of the log has them."""

    time_s: np.ndarray  # (N,) since the first sample of the log
    field_t: np.ndarray  # (N, 3)
    counts: dict[str, int]  # refused samples
    notes: list[str]


def samples(
    log: Sequence[Path], begin_s: float, end_s: float, columns: Sequence[Path] = ()
) -> Turned:
    """Read and clean the field of a log between two times from its first sample.

    Raises:
        robins.logs.LogError: a file cannot be read.
        BadInput: no file or more than one holds a magnetic field, or none of it lies in between.
    """
    mounting = mounting_of([path for path in log if path.suffix == ".toml"])
    files = [path for path in log if path.suffix != ".toml"]
    formats = formats_of(files, columns)
    findings: list[Any] = []
    tables = [
        table
        for path in files
        for table in tables_of(open_log(path, formats.get(str(path)), findings))
        if isinstance(table, MagTable)
    ]
    names = ", ".join(map(str, log))
    if len(tables) != 1:
        held = "hold magnetic field more than once" if tables else "holds no magnetic field"
        raise BadInput(f"{names}: {held}; give the log of one magnetometer.")
    table, counts = clean_mag(tables[0])
    table = to_ned_frd(turned(table, mounting) if mounting else table)
    time_s = (table.time_ns - table.time_ns[:1]) * 1e-9
    inside = (time_s >= begin_s) & (time_s <= end_s)
    if not inside.any():
        last = time_s[-1] if len(time_s) else 0.0
        until = f"to {end_s:g} s" if np.isfinite(end_s) else "on"
        raise BadInput(
            f"{names}: no sample from {begin_s:g} s {until}; the log ends at {last:g} s."
        )
    told = {reason: count for reason, count in counts.items() if count}
    return Turned(time_s[inside], table.field_t[inside], told, [str(f) for f in findings])


def advice(found: Calibration) -> list[str]:
    """What to do next, in sentences."""
    notes = []
    if not found.soft_iron:
        notes.append(
            "The directions in this log tell the offset only, not the soft iron: the matrix is the "
            "identity. Turn the sensor so that each of its axes points up and down once."
        )
    if found.gap_rad > _WIDE:
        way = int(np.argmax(np.abs(found.gap)))
        sign = "+" if found.gap[way] > 0.0 else "-"
        notes.append(
            f"No sample is within {np.degrees(found.gap_rad):.0f} deg of the field along "
            f"{sign}{_AXES[way]} (direction {np.round(found.gap, 2).tolist()}): there the "
            "calibration is a guess. Turn that axis "
            "along the field too; it points down steeply in the north, up in the south."
        )
    if found.outliers > _MANY:
        notes.append(
            f"{found.outliers:.1%} of the samples are far off: something magnetic was near for a "
            "while. See when in the figure of the field's size; --begin and --end leave it out."
        )
    if np.linalg.norm(found.offset_t) < 3.0 * np.linalg.norm(found.offset_sigma_t):
        notes.append("The offset is within its uncertainty: it may as well be zero.")
    elif found.after_t > 0.8 * found.before_t:
        notes.append(
            "The calibration makes the size of the field hardly steadier: what is left comes from "
            "the place, not from the sensor. It is of little use here."
        )
    return notes


def as_toml(found: Calibration, command: str) -> str:
    """A configuration for `robins replay`."""
    offset = ", ".join(f'"{value:.4f} uT"' for value in found.offset_t * _UT)
    rows = ", ".join(f"[{', '.join(f'{x:.6f}' for x in row)}]" for row in found.matrix)
    return (
        f"# Hard and soft iron, forward-right-down; made by: {command}\n"
        'system = "marg"\n\n'
        "[magnetometer]\n"
        f"offset = [{offset}]\n"
        f"matrix = [{rows}]\n"
    )


def analysed(given: Turned, found: Calibration, name: str) -> tuple[xr.Dataset, dict[str, Any]]:
    """Solution and summary of a calibration."""
    about: dict[str, Any] = {"frame": "FRD", "axes": _AXES, "display_unit": "uT"}
    after = calibrated(given.field_t, found.offset_t, found.matrix)
    solution = xr.Dataset(
        array("field_measured", given.field_t, **about)
        | array("field_calibrated", after, strength=found.field_t, **about),
        {"time": variable("time", given.time_s, "s", "time since the first sample")},
    )
    columns: dict[str, dict[str, Any]] = {
        axis: {
            "offset_ut": found.offset_t[k] * _UT,
            "offset_sigma_ut": found.offset_sigma_t[k] * _UT,
            "matrix_row": found.matrix[k],
            "matrix_sigma_row": found.matrix_sigma[k],
        }
        for k, axis in enumerate(_AXES)
    }
    columns["field"] = {
        "size_ut": found.field_t * _UT,
        "rms_before_ut": found.before_t * _UT,
        "rms_after_ut": found.after_t * _UT,
        "noise_ut": found.noise_t * _UT,
        "directions_covered_percent": 100.0 * found.covered,
        "largest_gap_deg": np.degrees(found.gap_rad),
        "outliers_percent": 100.0 * found.outliers,
    }
    summary = {
        "scenario": f"calibrate/{name}",
        "seed": 0,
        "runs": 1,
        "filters": columns,
        "claims": [],
        "counts": given.counts,
    }
    return solution, summary


def magnetometer(
    log: Sequence[Path],
    first: Path,
    field: str | None,
    begin: str | None,
    end: str | None,
    out: Path,
    as_json: bool,
    columns: Sequence[Path] = (),
) -> None:
    """Calibrate the magnetometer of a log, named after its first file, write and print it."""
    try:
        strength = None if field is None else parse(field, "magnetic field")
        begin_s = 0.0 if begin is None else parse(begin, "time")
        end_s = np.inf if end is None else parse(end, "time")
    except UnitError as error:
        raise BadInput(f"{error}.") from error
    command = command_line()
    with (
        only_json(as_json),
        Progress() as progress,
        results.ResultWriter(out, command=command) as writer,
    ):
        progress(0.1, "reading")
        given = samples(log, begin_s, end_s, columns)
        progress(0.4, "fitting the ellipsoid")
        try:
            found = calibrate(given.field_t, strength)
        except CalibrationError as error:
            raise BadInput(f"{first}: {error}.") from error
        solution, summary = analysed(given, found, first.name.split(".")[0])
        notes = given.notes + advice(found)
        writer.save_solution(solution)
        writer.save_summary(summary)
        writer.save_file(FILE, as_toml(found, command).encode())
        report.add(writer, lambda done, total, what: progress(0.7, what), notes)
    if as_json:
        click.echo((out / "summary.json").read_text("utf-8"), nl=False)
        return
    from rich.console import Console

    Console().print(report.table(results.read(out).summary))
    for note in notes:
        click.echo(note)
    click.echo(f"\nResult: {out}\nReport: {out / 'report.html'}   (open it in a browser)")
    click.echo(f"Next:   robins replay {first} {out / FILE} --system marg   navigates with it")
