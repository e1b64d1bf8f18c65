"""Text format of libRSF (Pfeifer et al., TU Chemnitz): pseudoranges, odometry and truth of a car.

A line is a measurement, with its type as first word; fields are separated by blanks::

    pseudorange3  time, range, variance, satellite x y z (ECEF), number, system, elevation [deg],
                  C/N0 [dBHz]
    odom3         time, velocity x y z, turn rate x y z, their six variances; x forward, z up
    point3        time, x y z (ECEF), nine covariances

Lines of other types are counted and skipped. It is not in `robins.logs.FORMATS`, since its content
is no table of a `Dataset`: `load_ranges` combines the files of one drive.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from robins.dataset import OdometryTable, PlaceTable, RangeLog, RangeTable
from robins.logs.findings import AnyPath, Findings, LogError, finding_reporter, refused
from robins.logs.opening import Source
from robins.logs.tables import stem_of
from robins.logs.timebase import stamps_to_ns

_STAMP = "S40"  # wider than any stamp, as required by `stamps_to_ns`
WIDTH = {"pseudorange3": 10, "odom3": 13, "point3": 4}
"""Least number of fields in a line of each kind."""
RangeTables = dict[str, RangeTable | OdometryTable | PlaceTable]


class _Lines(NamedTuple):
    """Lines of one kind in a file: stamps as text, numbers, line numbers."""

    stamps: list[bytes]
    values: list[list[float]]
    rows: list[int]


def _lines_of(path: AnyPath) -> tuple[dict[str, _Lines], dict[str, int]]:
    """Lines of a file by kind, and counts of lines of other kinds."""
    file, kinds, others = str(path), {name: _Lines([], [], []) for name in WIDTH}, {}
    data = b"".join(Source(path))
    for row, line in enumerate(data.splitlines(), start=1):
        kind, *fields = line.split() or [b""]
        name = kind.decode("utf-8", "replace")
        if name not in kinds:
            if name:
                others[name] = others.get(name, 0) + 1
            continue
        if len(fields) < WIDTH[name]:
            cause = f"{name} has {len(fields)} numbers and needs {WIDTH[name]}"
            raise refused(file, f"line {row}")(cause, "was the file cut? Remove the line")
        into = kinds[name]
        into.stamps.append(fields[0])
        into.rows.append(row)
        try:
            into.values.append([float(x) for x in fields[1 : WIDTH[name]]])
        except ValueError:
            raise refused(file, f"line {row}", name, line.decode("utf-8", "replace")[:60])(
                "holds what is no number", "repair or remove the line"
            ) from None
    return kinds, others


def _columns(
    file: str, name: str, lines: _Lines, *variances: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Stamps [ns], numbers, roots of the variances in these columns, and line numbers.

    Raises:
        LogError: a stamp is no number, time decreases, or a number is invalid.
    """
    rows, values = np.asarray(lines.rows), np.array(lines.values)
    time_ns = stamps_to_ns(file, "time", np.array(lines.stamps, dtype=_STAMP), rows)
    squares = values[:, list(variances)]
    back = np.diff(time_ns, prepend=time_ns[:1]) < 0
    for good, cause, fix in (
        (~back, "is earlier than the one before it", "sort the lines by their time"),
        (np.isfinite(values), "holds a number that is not finite", "repair or remove the line"),
        (squares > 0.0, "states a variance that is not positive", "state how noisy it is"),
    ):
        bad = ~good.reshape(len(rows), -1).all(axis=1)
        if bad.any():
            raise refused(file, f"line {rows[np.argmax(bad)]}")(f"{name} {cause}", fix)
    return time_ns, values, np.sqrt(squares), rows


def read_librsf(path: AnyPath, findings: Findings = None) -> RangeTables:
    """Read a file of libRSF.

    Args:
        path: the file, plain or compressed.
        findings: receives omissions.

    Returns:
        Tables "ranges", "odometry" and "truth", as far as the file has them.

    Raises:
        LogError: the file has none of these, or a line is invalid.
    """
    file = str(path)
    kinds, others = _lines_of(path)
    out: RangeTables = {}
    if (lines := kinds["pseudorange3"]).rows:
        time_ns, v, sigma, rows = _columns(file, "pseudorange3", lines, 1)
        number, system = v[:, 5].astype(np.int64), v[:, 6].astype(np.int64)
        sky = v[:, 2:5], number, system, np.radians(v[:, 7]), v[:, 8]
        out["ranges"] = RangeTable(time_ns, v[:, 0], sigma[:, 0], *sky, file, rows)
    if (lines := kinds["odom3"]).rows:
        time_ns, v, sigma, rows = _columns(file, "odom3", lines, 6, 11)
        down = -v[:, 5]  # the file's z is up
        noise = sigma[:, 0], sigma[:, 1]
        out["odometry"] = OdometryTable(time_ns, v[:, 0], down, *noise, file, rows)
    if (lines := kinds["point3"]).rows:
        time_ns, v, _, rows = _columns(file, "point3", lines)
        out["truth"] = PlaceTable(time_ns, v[:, :3], file, rows)
    if not out:
        remedy = "give text of libRSF: a word that says what is measured, then its numbers"
        raise LogError(file, "holds no pseudorange3, odom3 or point3", remedy)
    if others and findings is not None:
        listed = ", ".join(f"{count} of {name!r}" for name, count in others.items())
        finding_reporter(findings, "note", "other_kinds", file, value=sum(others.values()))(
            f"lines of other kinds were left out: {listed}."
        )
    return out


def load_ranges(paths: Iterable[AnyPath], findings: Findings = None) -> RangeLog:
    """Read pseudoranges and odometry of a drive, and its true positions if a file has them.

    Raises:
        LogError: as `read_librsf`; two files have the same table, or one of the two is missing.
    """
    held: RangeTables = {}
    given, heard = [os.fspath(path) for path in paths], [] if findings is None else findings
    for path in given:
        for kind, table in read_librsf(path, heard).items():
            if kind in held:
                cause = f"is a second file of the kind of {held[kind].source} ({kind})"
                raise LogError(path, cause, "give one")
            held[kind] = table
    files = ", ".join(given) or "(no file)"
    for kind, word in (("ranges", "pseudoranges"), ("odometry", "odometry")):
        if kind not in held:
            raise LogError(files, f"no {word} among the files", f"give a file with {word}")
    ranges, odometry, truth = (held.get(kind) for kind in ("ranges", "odometry", "truth"))
    assert isinstance(ranges, RangeTable)
    assert isinstance(odometry, OdometryTable)
    assert truth is None or isinstance(truth, PlaceTable)
    return RangeLog(stem_of(ranges.source), ranges, odometry, truth, findings=list(heard))
