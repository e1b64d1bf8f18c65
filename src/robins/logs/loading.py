"""One `Dataset` from several files: an IMU with GNSS, or with the master INS it is aligned to."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from robins.dataset import Dataset, ImuTable, Trajectory
from robins.logs.findings import AnyPath, Finding, LogError, finding_reporter
from robins.logs.merging import are_halves, merged
from robins.logs.mounting import Mounting, turned
from robins.logs.registry import matching_formats, open_log
from robins.logs.tables import Table, kind_of, stem_of, tables_of
from robins.logs.text_format import TextFormat

Formats = Mapping[str, str | TextFormat]
_WORDS = {
    "gnss": "GNSS fixes",
    "truth": "path",
    "mag": "magnetic field",
    "attitude": "attitudes",
    "odometry": "wheel speeds",
}
_OF_FIXES = ("sigma_assumed", "height_above_geoid", "height_assumed", "undated")


def load_dataset(
    paths: AnyPath | Iterable[AnyPath],
    *,
    name: str | None = None,
    mounting: Mounting | None = None,
    formats: Formats | None = None,
) -> Dataset:
    """Read IMU and other tables, unchanged from the files; see `clean`.

    Args:
        paths: one, or several in any order; one IMU table in all, or one with rates and one with
            specific forces, and at most one of each other kind; a separate file replaces the table
            of its kind in a recording. A trajectory in a separate file is the truth.
        name: of the dataset; by default the name of the file with the IMU.
        mounting: rotation from sensor axes to forward-right-down, and lever arm of the antenna.
        formats: path -> its format, for files that are not recognised by content.

    Returns:
        The dataset, with the findings of the readers; the ``source`` of a table is its file.

    Raises:
        LogError: as `open_log`; no IMU log, two tables of one kind, or a lever arm without GNSS.
    """
    several = [paths] if isinstance(paths, (str, os.PathLike)) else paths
    paths = [os.fspath(p) for p in several]
    if unknown := set(formats or {}) - set(paths):
        given = ", ".join(sorted(unknown))
        raise LogError(given, "a format is given, but not the file", "check its path")
    findings: list[Finding] = []
    opened = [open_log(path, (formats or {}).get(path), findings) for path in paths]
    opened = without_replaced(opened, findings)
    known = [file for one in opened if isinstance(one, Dataset) for file in one.time_unit_known]
    held: dict[str, Any] = by_kind(paths, opened, findings)
    if "imu" not in held:
        given = ", ".join(paths) or "(no file)"
        raise LogError(given, "no IMU log among the files", "give one IMU log")
    dataset = Dataset(
        name=name or stem_of(held["imu"].source),
        **held,
        findings=findings,
        time_unit_known=tuple(known),
    )
    return turned(dataset, mounting)


def without_replaced(
    opened: Iterable[Table | Dataset], findings: list[Finding]
) -> list[Table | Dataset]:
    """Contents of files, without the tables of a recording that a separate file replaces.

    Args:
        opened: contents of the files.
        findings: receives a note for each such table; those about the replaced fixes are dropped.
    """
    opened = list(opened)
    own = {kind_of(one): one for one in opened if not isinstance(one, Dataset)}
    for number, one in enumerate(opened):
        if not isinstance(one, Dataset):
            continue
        replaced = [kind for kind in _WORDS if kind in own and getattr(one, kind) is not None]
        for kind in replaced:
            file = getattr(one, kind).source
            if kind == "gnss":
                findings[:] = [f for f in findings if (f.file, f.code in _OF_FIXES) != (file, True)]
            finding_reporter(findings, "note", "table_replaced", file, value=len(own[kind]))(
                f"its {_WORDS[kind]} are not used; those of {Path(own[kind].source).name}, a file "
                "of their own, replace them."
            )
        opened[number] = dataclasses.replace(one, **dict.fromkeys(replaced))
    return opened


def by_kind(
    paths: Iterable[AnyPath], opened: Iterable[Table | Dataset], findings: list[Finding]
) -> dict[str, Table]:
    """One table of each kind; separately recorded gyros and accelerometers are merged.

    Args:
        paths: the files.
        opened: their contents.
        findings: receives a note if two tables are merged.

    Raises:
        LogError: two tables are of one kind.
    """
    held: dict[str, Any] = {}
    for path, one in zip(paths, opened, strict=True):
        for table in tables_of(one):
            kind = kind_of(table)
            if isinstance(table, ImuTable) and kind in held and are_halves(held[kind], table):
                table = merged(held.pop(kind), table, findings)
            if kind in held:
                cause = f"is a second file of the kind of {held[kind].source} ({kind})"
                raise LogError(os.fspath(path), cause, "give one of the two")
            held[kind] = table
    return held


def load_pair(
    master: AnyPath,
    slave: AnyPath,
    *,
    name: str | None = None,
    delay_s: float = 0.0,
    formats: Formats | None = None,
) -> Dataset:
    """Read the records of a master INS and the samples of the IMU to be aligned to it.

    Args:
        master: a trajectory in any known format; ``named-path`` can also hold turn rates.
        slave: inertial samples in any known format, in the axes of that IMU.
        name: of the dataset; by default the IMU file's name.
        delay_s: age of the records of the master at their stamps [s], for comparison by the
            doctor; the stamps are not changed.
        formats: as `load_dataset`.

    Returns:
        The dataset, unchanged from the files, with the findings of the readers; see `clean`.

    Raises:
        LogError: as `open_log`; or a file holds another kind of data.
    """
    findings: list[Finding] = []
    path = _open_as(master, "trajectory", findings, formats)
    imu = _open_as(slave, "imu", findings, formats)
    if not isinstance(path, Trajectory):
        raise _exchanged(master, "no path of a master INS", "--master")
    if not isinstance(imu, ImuTable):
        raise _exchanged(slave, "no inertial samples", "--slave")
    name = name or stem_of(imu.source)
    return Dataset(name, imu, master=path, findings=findings, master_delay_s=delay_s)


def _open_as(
    path: AnyPath, kind: str, findings: list[Finding], formats: Formats | None
) -> Table | Dataset | None:
    """Read a file; if it holds several kinds of columns, read those of the wanted kind."""
    format = (formats or {}).get(os.fspath(path))
    if format is None and not os.path.isdir(path):
        names = [f.name for f in matching_formats(path)[1] if f.holds == (kind,)]
        format = names[0] if len(names) == 1 else None
    opened = open_log(path, format, findings)
    if isinstance(opened, Dataset):
        return opened.imu if kind == "imu" else opened.truth
    return opened


def _exchanged(path: AnyPath, what: str, option: str) -> LogError:
    remedy = f"give {option} the right file; were master and slave exchanged?"
    return LogError(os.fspath(path), f"holds {what}", remedy)
