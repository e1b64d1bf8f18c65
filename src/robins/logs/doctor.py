"""The doctor: reads tables as an engineer would before a run, and says what is wrong in sentences.

Each check is a generator of findings in a module of its own. Errors mean that a run would be wrong;
a healthy log has none.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from robins.dataset import Dataset, GnssTable, ImuTable, Trajectory
from robins.logs.arrays import checked_gnss, checked_imu, checked_truth
from robins.logs.checks_columns import check_columns
from robins.logs.checks_gnss import check_gnss
from robins.logs.checks_imu import check_imu
from robins.logs.checks_master import BY_REST, check_master
from robins.logs.checks_motion import check_motion
from robins.logs.checks_span import check_span
from robins.logs.checks_time import check_time
from robins.logs.checks_turning import check_turning
from robins.logs.checks_velocity import check_velocity
from robins.logs.findings import Finding, by_severity

Table = ImuTable | GnssTable | Trajectory

# After these, checks that build on what they found wrong would only repeat it in other words.
_NO_PLACE = {"position_unit", "no_fix_as_zero", "gnss_missing"}
_SPOILT = {
    *("no_overlap", "rates_as_increments", "increments_as_rates", "time_unit"),
    *("position_unit", "no_fix_as_zero"),
    *("velocity_axes", "velocity_unit", "velocity_sign"),
}


def examine(subject: Dataset | Table | Sequence[Table]) -> list[Finding]:
    """Judge a dataset, or tables by themselves.

    Args:
        subject: as it was read, before `clean`, so that everything is seen. A dataset brings the
            findings of its readers along (``meta["findings"]``).

    Returns:
        Errors first, then warnings, then notes; empty for a log without a flaw.

    Raises:
        LogError: arrays that are no tables: other lengths, types, shapes.
    """
    with np.errstate(all="ignore"):  # nonsense is looked at on purpose here
        return by_severity(_examined(*_tables(subject), _master_of(subject)))


def _master_of(subject: Dataset | Table | Sequence[Table]) -> Trajectory | None:
    return subject.master if isinstance(subject, Dataset) else None


def _examined(
    tables: list[Table], findings: list[Finding], master: Trajectory | None
) -> list[Finding]:
    imu = gnss = None
    for table in tables:
        if isinstance(table, ImuTable):
            imu = checked_imu(table)
            findings += check_time(imu)
            findings += check_columns(imu)
            findings += check_imu(imu)
        elif isinstance(table, GnssTable):
            gnss = checked_gnss(table)
            findings += check_time(gnss)
            of_place = list(check_gnss(gnss))
            findings += of_place
            if not any(f.severity == "error" and f.code in _NO_PLACE for f in of_place):
                findings += check_velocity(gnss)
        else:
            findings += check_time(checked_truth(table))
    if imu is not None:
        for table in tables:
            if table is not imu and not isinstance(table, ImuTable):
                findings += check_span(imu, table)
    if imu is not None and master is not None:
        of_both = list(check_master(imu, checked_truth(master)))
        if not any(f.code == "force_not_checked" for f in of_both):
            findings = [f for f in findings if f.code not in BY_REST]
        return findings + of_both
    if imu is not None and not _SPOILT & {f.code for f in findings}:
        of_motion = list(check_motion(imu, gnss)) if gnss is not None else []
        if gnss is None or any(f.code == "motion_not_checked" for f in of_motion):
            of_motion += check_turning(imu)
        if any(f.code == "gyro_unit" for f in of_motion):  # with proof; once is enough
            findings = [f for f in findings if f.code != "gyro_unit"]
        findings += of_motion
    return findings


def _tables(subject: Dataset | Table | Sequence[Table]) -> tuple[list[Table], list[Finding]]:
    if isinstance(subject, Dataset):
        tables = [subject.imu, subject.gnss, subject.truth, subject.master]
        return [t for t in tables if t is not None], list(subject.meta.get("findings", []))
    if isinstance(subject, ImuTable | GnssTable | Trajectory):
        return [subject], []
    return list(subject), []
