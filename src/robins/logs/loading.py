"""Several files, one `Dataset`: an IMU with GNSS, or with the master INS it is aligned to."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from pathlib import Path

from robins.dataset import Dataset, GnssTable, ImuTable, Trajectory
from robins.logs.findings import Finding, LogError
from robins.logs.mounting import Mounting
from robins.logs.registry import FORMATS, Table, open_log
from robins.logs.text import peek


def load_dataset(
    paths: Iterable[str | os.PathLike[str]],
    *,
    name: str | None = None,
    mounting: Mounting | None = None,
    formats: Mapping[str, str] | None = None,
) -> Dataset:
    """Read IMU, and where given GNSS and truth, as they are in the files; see `clean`.

    Args:
        paths: one IMU log, at most one GNSS log and one trajectory (the truth), in any order.
        name: of the dataset; by default the IMU file's name.
        mounting: turns the IMU's axes to forward-right-down and says where the antenna is.
        formats: path -> name of its format, for files that are not recognised by content.

    Returns:
        The dataset. ``meta["files"]`` maps imu, gnss, truth to paths, ``meta["findings"]`` lists
        what the readers left out, ``meta["lever_arm_b_m"]`` is that of the mounting.

    Raises:
        LogError: as `open_log`; no IMU log, or two files of one kind.
    """
    paths = [os.fspath(p) for p in paths]
    if unknown := set(formats or {}) - set(paths):
        raise LogError(
            ", ".join(sorted(unknown)), "a format is given, but not the file", "check its path"
        )
    findings: list[Finding] = []
    imu: ImuTable | None = None
    gnss: GnssTable | None = None
    truth: Trajectory | None = None
    for path in paths:
        table = open_log(path, (formats or {}).get(path), findings)
        earlier: Table | None
        if isinstance(table, ImuTable):
            earlier, imu = imu, table
        elif isinstance(table, GnssTable):
            earlier, gnss = gnss, table
        else:
            earlier, truth = truth, table
        if earlier is not None:
            raise LogError(
                path, f"is a second file of the kind of {earlier.source}", "give one of the two"
            )
    if imu is None:
        raise LogError(
            ", ".join(paths) or "(no file)", "no IMU log among the files", "give one IMU log"
        )
    files = {"imu": imu, "gnss": gnss, "truth": truth}
    return Dataset(
        name=name or Path(imu.source).name.split(".")[0],
        imu=mounting.turn(imu) if mounting else imu,
        gnss=gnss,
        truth=truth,
        meta={
            "files": {kind: table.source for kind, table in files.items() if table is not None},
            "findings": findings,
            "lever_arm_b_m": mounting.lever_arm_b_m if mounting else (0.0, 0.0, 0.0),
        },
    )


def load_pair(
    master: str | os.PathLike[str], slave: str | os.PathLike[str], *, name: str | None = None
) -> Dataset:
    """Read what a master INS reported and the samples of the IMU to be aligned to it.

    Args:
        master: a path in any known format; `named_csv` can also hold turn rates.
        slave: inertial samples in any known format, along the axes of that IMU.
        name: of the dataset; by default the IMU file's name.

    Returns:
        The dataset, as it is in the files; see `clean`. ``meta["files"]`` maps imu and master to
        paths, ``meta["findings"]`` lists what the readers left out.

    Raises:
        LogError: as `open_log`; or a file holds something else.
    """
    findings: list[Finding] = []
    path = _open_as(master, "trajectory", findings)
    imu = _open_as(slave, "imu", findings)
    if not isinstance(path, Trajectory):
        raise _exchanged(master, "no path of a master INS", "--master")
    if not isinstance(imu, ImuTable):
        raise _exchanged(slave, "no inertial samples", "--slave")
    return Dataset(
        name=name or Path(imu.source).name.split(".")[0],
        imu=imu,
        master=path,
        meta={"files": {"imu": imu.source, "master": path.source}, "findings": findings},
    )


def _open_as(path: str | os.PathLike[str], kind: str, findings: list[Finding]) -> Table:
    """A file that holds several kinds of columns is read for the kind that is wanted."""
    head = peek(path)
    fitting = [f.name for f in FORMATS if f.holds == kind and f.recognise(head)]
    return open_log(path, fitting[0] if len(fitting) == 1 else None, findings)


def _exchanged(path: str | os.PathLike[str], what: str, option: str) -> LogError:
    return LogError(
        os.fspath(path),
        f"holds {what}",
        f"give {option} the right file; were master and slave exchanged?",
    )
