"""The doctor: reads tables as an engineer would before a run, and says what is wrong in sentences.

What it asks, in which order and when, stands in the table `robins.logs.checks`. Errors mean that a
run would be wrong; a healthy log has none.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from robins.dataset import AttitudeTable, Dataset, GnssTable, ImuTable, MagTable, Trajectory
from robins.logs.arrays import checked
from robins.logs.checks import ALONE, TOGETHER, Check
from robins.logs.findings import Finding, by_severity
from robins.logs.tables import Table, kind_of, tables_of

Subject = Dataset | Table | Sequence[Table | Dataset]


def examine(subject: Subject) -> list[Finding]:
    """Judge a dataset, or tables by themselves.

    Args:
        subject: as it was read, before `clean`, so that everything is seen. Of a dataset count too
            the findings of its readers, its ``time_unit_known`` and its ``master_delay_s``.

    Returns:
        Errors first, then warnings, then notes; empty for a log without a flaw.

    Raises:
        LogError: arrays that are no tables: other lengths, types, shapes.
    """
    parts = subject if isinstance(subject, Sequence) else [subject]
    datasets = [part for part in parts if isinstance(part, Dataset)]
    findings = [finding for dataset in datasets for finding in dataset.findings]
    unit_known = {file for dataset in datasets for file in dataset.time_unit_known}
    with np.errstate(all="ignore"):  # nonsense is looked at on purpose here
        tables = [checked(table) for part in parts for table in _tables(part)]
        all_of_them: dict[str, Any] = {"others": [t for t in tables if not isinstance(t, ImuTable)]}
        for table in tables:
            things = {kind_of(table): table, "table": table, "in_vehicle": _in_vehicle(tables)}
            if not _stamped_as(table, all_of_them.get("imu")):  # said once is enough
                things |= {"stamps": table, "unit_known": table.source in unit_known}
            findings += _asked(ALONE, things, [])
            all_of_them[kind_of(table)] = table
        if isinstance(subject, Dataset) and subject.master is not None:
            master, delay_s = checked(subject.master), subject.master_delay_s
            all_of_them |= {"master": master, "delay_s": delay_s}
        return by_severity(_asked(TOGETHER, all_of_them, findings))


def _asked(
    checks: Sequence[Check], things: Mapping[str, Any], findings: list[Finding]
) -> list[Finding]:
    """The findings, with those of the checks that are asked about these things."""
    for check in checks:
        if check.is_asked(things, {f.code for f in findings}):
            new = check.ask(things)
            outdated = check.outdated({f.code for f in new})
            findings = [f for f in findings if f.code not in outdated] + new
    return findings


def _tables(part: Table | Dataset) -> list[Table]:
    master = part.master if isinstance(part, Dataset) else None
    return tables_of(part) + ([] if master is None else [master])


def _in_vehicle(tables: list[Table]) -> bool:
    """What shall tell only how the sensor itself is turned may lie any way."""
    kinds = {type(table) for table in tables}
    return not kinds & {MagTable, AttitudeTable} or bool(kinds & {GnssTable, Trajectory})


def _stamped_as(table: Table, imu: ImuTable | None) -> bool:
    """Whether a table out of the file of the IMU has the same stamps."""
    if imu is None or table.source != imu.source:
        return False
    return bool(np.array_equal(table.time_ns, imu.time_ns))
