"""The command `calibrate`: from a magnetometer that is turned about to its hard and soft iron.

Examples::

    robins calibrate turned.csv
    robins calibrate turned.ulg --field "48.5 uT" --begin "20 s" --end "80 s" --json
    robins calibrate circle.csv --horizontal
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Annotated, Any, NamedTuple

import numpy as np
import xarray as xr

from robins.dataset import ImuTable, MagTable
from robins.ins.frames import to_ned_frd
from robins.ins.magnetometer_calibration import Calibration, calibrated
from robins.ins.magnetometer_calibration import calibrate as fitted
from robins.logs import formats_of, open_log
from robins.logs.clean import clean_mag
from robins.logs.mounting import Mounting, turned
from robins.logs.tables import tables_of
from robins.results import Outcome, Progress, array, ignore_progress, variable
from robins.units import parse
from robins.workbench.doctor import mounting_of, separate_files, typed
from robins.workbench.errors import InputError, refusing
from robins.workbench.options import Logs, Option

FILE = "calibration.toml"
_AXES = ("x", "y", "z")
_UT = 1e6  # microtesla in a tesla
_WIDE = np.deg2rad(60.0)  # a gap of directions that is reported
_MANY = 0.02  # share of outliers that is reported
_WAYS = {
    False: "the sensor so that each of its axes points up and down once",
    True: "the vehicle by a whole circle",
}


class MagnetometerSamples(NamedTuple):
    """Samples of a magnetometer, forward-right-down as a replay of the log has them."""

    time_s: np.ndarray  # (N,) since the first sample of the log
    field_t: np.ndarray  # (N, 3)
    counts: dict[str, int]  # refused samples
    notes: list[str]
    inertial: bool  # the log also has samples that a replay needs


def samples(
    log: Sequence[str | os.PathLike[str]],
    begin_s: float,
    end_s: float,
    columns: Sequence[str | os.PathLike[str]] = (),
) -> MagnetometerSamples:
    """Read and clean the field of a log between two times from its first sample.

    Raises:
        robins.logs.LogError: a file cannot be read.
        InputError: no file or more than one holds a magnetic field, or none of it lies in between.
    """
    files, configuration = separate_files(log)
    mounting = mounting_of(configuration)
    formats = formats_of(files, columns)
    findings: list[Any] = []
    held = [
        table
        for path in files
        for table in tables_of(open_log(path, formats.get(str(path)), findings))
    ]
    tables = [table for table in held if isinstance(table, MagTable)]
    names = ", ".join(map(str, log))
    if len(tables) != 1:
        cause = "hold magnetic field more than once" if tables else "holds no magnetic field"
        raise InputError(cause, names, "give the log of one magnetometer.")
    table, counts = clean_mag(tables[0])
    table = to_ned_frd(turned(table, mounting) if mounting else table)
    time_s = (table.time_ns - table.time_ns[:1]) * 1e-9
    inside = (time_s >= begin_s) & (time_s <= end_s)
    if not inside.any():
        last = time_s[-1] if len(time_s) else 0.0
        until = f"to {end_s:g} s" if np.isfinite(end_s) else "on"
        raise InputError(
            f"no sample from {begin_s:g} s {until}; the log ends at {last:g} s.", names
        )
    inertial = any(isinstance(table, ImuTable) for table in held)
    reasons = {reason: count for reason, count in counts.items() if count}
    return MagnetometerSamples(
        time_s[inside], table.field_t[inside], reasons, [str(f) for f in findings], inertial
    )


def advice(found: Calibration) -> list[str]:
    """Advice on the next step, in sentences."""
    notes = []
    if found.level:
        notes.append(
            "The horizontal axes alone were calibrated: the vertical one stays as it reads. "
            "Headings are right while the vehicle is level, and err with its tilt."
        )
    if not found.soft_iron:
        notes.append(
            "The directions in this log tell the offset only, not the soft iron: the matrix is the "
            f"identity. Turn {_WAYS[found.level]}."
        )
    if found.level and found.gap_rad > _WIDE:
        notes.append(
            f"A sector of {2.0 * np.degrees(found.gap_rad):.0f} deg of headings has no sample: "
            f"there the calibration is a guess. Turn {_WAYS[True]}."
        )
    elif found.gap_rad > _WIDE:
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


def as_toml(found: Calibration, source: str, mounting: Mounting | None) -> str:
    """A configuration for `robins replay`, with the mounting in whose axes the numbers are."""
    offset = ", ".join(f'"{value:.4f} uT"' for value in found.offset_t * _UT)
    rows = ", ".join(f"[{', '.join(f'{x:.6f}' for x in row)}]" for row in found.matrix)
    angles = () if mounting is None else (mounting.roll_deg, mounting.pitch_deg, mounting.yaw_deg)
    mount = ", ".join(f'"{angle:.9g} deg"' for angle in angles)
    mount = f"orientation = [{mount}]\n" if any(angles) else ""
    return (
        f"# Hard and soft iron, forward-right-down, of {source}\n"
        f'system = "marg"\n{mount}\n'
        "[magnetometer]\n"
        f"offset = [{offset}]\n"
        f"matrix = [{rows}]\n"
    )


def solution_of(given: MagnetometerSamples, found: Calibration) -> xr.Dataset:
    """The field before and after."""
    about: dict[str, Any] = {"frame": "FRD", "axes": _AXES, "display_unit": "uT"}
    after = calibrated(given.field_t, found.offset_t, found.matrix)
    return xr.Dataset(
        array("field_measured", given.field_t, **about)
        | array("field_calibrated", after, strength=found.field_t, **about),
        {"time": variable("time", given.time_s, "s", "time since the first sample")},
    )


def metrics_of(found: Calibration) -> dict[str, dict[str, Any]]:
    """Offset and matrix by axis, and how good they are."""
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
    return columns


def calibrate(
    log: Logs,
    *,
    field: Annotated[
        str | None, Option('Its strength at the place, "48.5 uT"; sets the scale.', metavar="FIELD")
    ] = None,
    begin: Annotated[
        str | None, Option('Use samples from "20 s" after the first one on.', metavar="TIME")
    ] = None,
    end: Annotated[
        str | None, Option('Use samples up to "80 s" after the first one.', metavar="TIME")
    ] = None,
    horizontal: Annotated[bool, Option("The vehicle cannot tilt: it turned about z only.")] = False,
    columns: Sequence[str | os.PathLike[str]] = (),
    progress: Progress = ignore_progress,
) -> Outcome:
    """Calibrate hard and soft iron from a log in which the sensor is turned about all its axes.

    It finds the offset and the matrix of ``matrix (measured - offset)``, whose size is that of the
    Earth's field wherever the sensor points. A .toml file among LOG... gives the mounting of the
    sensor, as for `robins replay`, which takes the calibration.toml of the result.

    Args:
        log: its files; one that ends in .toml gives the mounting of the sensor.
        field: its size at the place, "48.5 uT"; by default the mean scale of the sensor is kept.
        begin: use samples from "20 s" after the first one on.
        end: use samples up to "80 s" after the first one.
        horizontal: the vehicle turned about the vertical only; its z axis is not calibrated.
        columns: TOML files that declare formats of the files, see `robins.logs.columns_from`.
        progress: called with the fraction done and the current activity.

    Raises:
        InputError: the log cannot be calibrated with; the sentence gives the reason.
        robins.units.UnitError: a field or a time without its unit.
        robins.logs.LogError: a file cannot be read.
    """
    strength = None if field is None else parse(field, "magnetic field")
    begin_s = 0.0 if begin is None else parse(begin, "time")
    end_s = np.inf if end is None else parse(end, "time")
    progress(0.1, "reading")
    files, configuration = separate_files(log)
    first, shown = files[0], typed(files, columns)
    given = samples(log, begin_s, end_s, columns)
    progress(0.5, "fitting the ellipsoid")
    with refusing(first):
        found = fitted(given.field_t, strength, level=horizontal)
    return Outcome(
        solution_of(given, found),
        metrics_of(found),
        counts=given.counts,
        files={FILE: as_toml(found, first.name, mounting_of(configuration)).encode()},
        notes=given.notes + advice(found),
        scenario=f"calibrate/{first.name.split('.')[0]}",
        last_lines=[
            f"Next:   robins replay {shown} {{out}}/{FILE} --system marg   navigates with it"
        ]
        * given.inertial,
    )
