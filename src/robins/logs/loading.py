"""Several files, one `Dataset`."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from pathlib import Path

from robins.dataset import Dataset, GnssTable, ImuTable, Trajectory
from robins.logs.findings import Finding, LogError
from robins.logs.mounting import Mounting
from robins.logs.registry import Table, open_log


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
