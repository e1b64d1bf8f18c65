"""Text of libRSF (Pfeifer et al., TU Chemnitz): pseudoranges, odometry and true places of a car.

A line is a measurement, and its first word says of what; fields are separated by blanks::

    pseudorange3  time, range, variance, satellite x y z (ECEF), number, system, elevation [deg],
                  C/N0 [dBHz]
    odom3         time, velocity x y z, turn rate x y z, their six variances; x forward, z up
    point3        time, x y z (ECEF), nine covariances

Lines of other words are counted and left out. It is no format of `robins.logs.FORMATS`, since what
it holds is no table of a `Dataset`: `load_ranges` puts the files of one drive together.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from robins.dataset import OdometryTable, PlaceTable, RangeLog, RangeTable
from robins.logs.findings import AnyPath, Findings, LogError, make_finding, refused
from robins.logs.opening import Source
from robins.logs.timebase import stamps_to_ns

_STAMP = "S40"  # wider than any stamp, as `stamps_to_ns` wants it
WIDTH = {"pseudorange3": 10, "odom3": 13, "point3": 4}
"""Numbers in a line of each kind, at least."""


class _Lines:
    """The lines of one kind of a file: stamps as text, numbers, line numbers."""

    def __init__(self) -> None:
        self.stamps: list[bytes] = []
        self.values: list[list[float]] = []
        self.rows: list[int] = []


def _lines_of(path: AnyPath) -> tuple[dict[str, _Lines], dict[str, int]]:
    """Lines of a file by kind, and counts of lines of other kinds."""
    file, kinds, others = str(path), {name: _Lines() for name in WIDTH}, {}
    data = b"".join(Source(path))
    for row, line in enumerate(data.splitlines(), start=1):
        kind, *fields = line.split() or [b""]
        name = kind.decode("utf-8", "replace")
        if name not in kinds:
            if name:
                others[name] = others.get(name, 0) + 1
            continue
        if len(fields) < WIDTH[name]:
            raise refused(file, f"line {row}")(
                f"{name} has {len(fields)} numbers and needs {WIDTH[name]}",
                "was the file cut? Remove the line",
            )
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


def _times(file: str, lines: _Lines, name: str) -> np.ndarray:
    """(N,) ns.

    Raises:
        LogError: a stamp is no number, or time falls.
    """
    rows = np.asarray(lines.rows)
    stamps = np.array(lines.stamps, dtype=_STAMP)
    time_ns = stamps_to_ns(file, "time", stamps, rows)
    back = np.flatnonzero(np.diff(time_ns) < 0)
    if len(back):
        row = rows[back[0] + 1]
        raise refused(file, f"line {row}")(
            f"{name} is earlier than the one before it", "sort the lines by their time"
        )
    return time_ns


def _finite(file: str, lines: _Lines, name: str) -> np.ndarray:
    values = np.array(lines.values)
    bad = np.flatnonzero(~np.all(np.isfinite(values), axis=1))
    if len(bad):
        raise refused(file, f"line {lines.rows[bad[0]]}")(
            f"{name} holds a number that is not finite", "repair or remove the line"
        )
    return values


def _positive(file: str, lines: _Lines, name: str, variances: np.ndarray) -> np.ndarray:
    bad = np.flatnonzero(~np.all(variances.reshape(len(variances), -1) > 0.0, axis=1))
    if len(bad):
        raise refused(file, f"line {lines.rows[bad[0]]}")(
            f"{name} states a variance that is not positive", "state how noisy it is"
        )
    return np.sqrt(variances)


def _odometry(file: str, lines: _Lines) -> OdometryTable:
    name = "odom3"
    v = _finite(file, lines, name)
    sigma = _positive(file, lines, name, v[:, [6, 11]])
    return OdometryTable(
        time_ns=_times(file, lines, name),
        speed_mps=v[:, 0],
        yaw_rate=-v[:, 5],  # about down; the file's z is up
        sigma_speed=sigma[:, 0],
        sigma_yaw=sigma[:, 1],
        source=file,
        rows=np.asarray(lines.rows),
    )


def read_librsf(
    path: AnyPath, findings: Findings = None
) -> dict[str, RangeTable | OdometryTable | PlaceTable]:
    """Read a file of libRSF.

    Args:
        path: the file, plain or compressed.
        findings: receives what was left out.

    Returns:
        What there is of "ranges", "odometry" and "truth".

    Raises:
        LogError: the file holds none of these, or a line is not what it should be.
    """
    file = str(path)
    kinds, others = _lines_of(path)
    out: dict[str, RangeTable | OdometryTable | PlaceTable] = {}
    lines = kinds["pseudorange3"]
    if lines.rows:
        v, name = _finite(file, lines, "pseudorange3"), "pseudorange3"
        out["ranges"] = RangeTable(
            time_ns=_times(file, lines, name),
            range_m=v[:, 0],
            sigma_m=_positive(file, lines, name, v[:, 1]),
            satellite_e=v[:, 2:5],
            satellite=v[:, 5].astype(np.int64),
            system=v[:, 6].astype(np.int64),
            elevation_rad=np.radians(v[:, 7]),
            cn0_dbhz=v[:, 8],
            source=file,
            rows=np.asarray(lines.rows),
        )
    if (lines := kinds["odom3"]).rows:
        out["odometry"] = _odometry(file, lines)
    lines = kinds["point3"]
    if lines.rows:
        time_ns, v = _times(file, lines, "point3"), _finite(file, lines, "point3")
        out["truth"] = PlaceTable(time_ns, v[:, :3], file, np.asarray(lines.rows))
    if not out:
        raise LogError(
            file,
            "holds no pseudorange3, odom3 or point3",
            "give text of libRSF: a word that says what is measured, then its numbers",
        )
    if others and findings is not None:
        listed = ", ".join(f"{count} of {name!r}" for name, count in others.items())
        findings.append(
            make_finding("note", "other_kinds", file, value=sum(others.values()))(
                f"lines of other kinds were left out: {listed}."
            )
        )
    return out


def load_ranges(paths: Iterable[AnyPath], findings: Findings = None) -> RangeLog:
    """Read pseudoranges and odometry of a drive, and its true places where a file has them.

    Raises:
        LogError: as `read_librsf`; two files hold the same, or pseudoranges or odometry are absent.
    """
    held: dict[str, RangeTable | OdometryTable | PlaceTable] = {}
    given, heard = [os.fspath(path) for path in paths], [] if findings is None else findings
    for path in given:
        for kind, table in read_librsf(path, heard).items():
            if kind in held:
                raise LogError(
                    path,
                    f"is a second file of the kind of {held[kind].source} ({kind})",
                    "give one",
                )
            held[kind] = table
    files = ", ".join(given) or "(no file)"
    for kind, word in (("ranges", "pseudoranges"), ("odometry", "odometry")):
        if kind not in held:
            raise LogError(files, f"no {word} among the files", f"give a file with {word}")
    ranges, odometry, truth = (held.get(kind) for kind in ("ranges", "odometry", "truth"))
    assert isinstance(ranges, RangeTable)
    assert isinstance(odometry, OdometryTable)
    assert truth is None or isinstance(truth, PlaceTable)
    name = Path(ranges.source).name.split(".")[0]
    return RangeLog(name, ranges, odometry, truth, findings=list(heard))
