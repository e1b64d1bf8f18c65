"""The doctor: reads tables as an engineer would before a run, and says what is wrong in sentences.

Each check is a generator of findings in a module of its own. Errors mean that a run would be wrong;
a healthy log has none.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from robins.dataset import AttitudeTable, Dataset, GnssTable, ImuTable, MagTable, Trajectory
from robins.logs.arrays import (
    checked_attitude,
    checked_gnss,
    checked_imu,
    checked_mag,
    checked_truth,
)
from robins.logs.checks_attitude import check_attitude
from robins.logs.checks_columns import check_columns
from robins.logs.checks_gnss import check_gnss
from robins.logs.checks_imu import check_imu
from robins.logs.checks_limits import check_limits
from robins.logs.checks_mag import check_mag
from robins.logs.checks_mag_axes import check_mag_axes
from robins.logs.checks_master import BY_REST, check_master
from robins.logs.checks_motion import check_motion
from robins.logs.checks_span import check_span
from robins.logs.checks_time import check_time
from robins.logs.checks_turning import check_turning
from robins.logs.checks_velocity import check_velocity
from robins.logs.findings import Finding, by_severity
from robins.logs.tables import Table, tables_of

# After these, checks that build on what they found wrong would only repeat it in other words.
_NO_PLACE = {"position_unit", "no_fix_as_zero", "gnss_missing"}
_SPOILT = {
    *("no_overlap", "rates_as_increments", "increments_as_rates", "time_unit", "time_slow"),
    *("position_unit", "no_fix_as_zero"),
    *("velocity_axes", "velocity_unit", "velocity_sign"),
}
# With these, what is compared with the gyros would be blamed for them.
_GYROS_WRONG = {"gyro_unit", "gyro_axes", "gyro_reversed", "left_handed"}
_NO_FIELD = {"field_unit", "field_stuck"}

Subject = Dataset | Table | Sequence[Table | Dataset]


def examine(subject: Subject) -> list[Finding]:
    """Judge a dataset, or tables by themselves.

    Args:
        subject: as it was read, before `clean`, so that everything is seen. A dataset brings the
            findings of its readers along (``meta["findings"]``), the names of files that say in
            which unit their stamps are (``meta["time_unit_known"]``), and by how much the records
            of its master are older than their stamps (``meta["master_delay_s"]``).

    Returns:
        Errors first, then warnings, then notes; empty for a log without a flaw.

    Raises:
        LogError: arrays that are no tables: other lengths, types, shapes.
    """
    with np.errstate(all="ignore"):  # nonsense is looked at on purpose here
        return by_severity(_examined(*_tables(subject), *_context(subject)))


def _context(subject: Subject) -> tuple[Trajectory | None, float, frozenset[str]]:
    """The master to align to, if any, its delay [s], and files whose unit of time is known."""
    if isinstance(subject, Dataset):
        known = frozenset(subject.meta.get("time_unit_known", ()))
        return subject.master, float(subject.meta.get("master_delay_s", 0.0)), known
    parts = subject if isinstance(subject, Sequence) else ()
    return None, 0.0, frozenset().union(*(_context(p)[2] for p in parts if isinstance(p, Dataset)))


def _examined(
    tables: list[Table],
    findings: list[Finding],
    master: Trajectory | None,
    delay_s: float,
    unit_known: frozenset[str],
) -> list[Finding]:
    imu = gnss = mag = attitude = None
    kinds = {type(table) for table in tables}
    # What shall tell only how the sensor itself is turned may lie any way.
    in_vehicle = not kinds & {MagTable, AttitudeTable} or bool(kinds & {GnssTable, Trajectory})
    for table in tables:
        checked = _CHECKED[type(table)](table)
        if not _stamped_as(table, imu):  # said once is enough
            findings += check_time(checked, table.source in unit_known)
        findings += check_limits(checked)
        if isinstance(table, ImuTable):
            imu = checked_imu(table)
            findings += check_columns(imu)
            findings += check_imu(imu, in_vehicle)
        elif isinstance(table, GnssTable):
            gnss = checked_gnss(table)
            of_place = list(check_gnss(gnss))
            findings += of_place
            if not any(f.severity == "error" and f.code in _NO_PLACE for f in of_place):
                findings += check_velocity(gnss)
        elif isinstance(table, MagTable):
            mag = checked_mag(table)
            findings += check_mag(mag)
        elif isinstance(table, AttitudeTable):
            attitude = checked_attitude(table)
    if imu is not None:
        for table in tables:
            if table is not imu and not isinstance(table, ImuTable):
                findings += check_span(imu, table)
    if imu is not None and master is not None:
        of_both = list(check_master(imu, checked_truth(master), delay_s))
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
        gyros_wrong = bool(_GYROS_WRONG & {f.code for f in findings})
        if mag is not None and not gyros_wrong and not any(f.code in _NO_FIELD for f in findings):
            findings += check_mag_axes(imu, mag)
        if attitude is not None and not gyros_wrong:
            findings += check_attitude(imu, attitude)
    return findings


def _stamped_as(table: Table, imu: ImuTable | None) -> bool:
    """Whether a table out of the file of the IMU has the same stamps."""
    return imu is not None and table.source == imu.source and _same(table.time_ns, imu.time_ns)


def _same(one: np.ndarray, other: np.ndarray) -> bool:
    return np.shape(one) == np.shape(other) and bool(np.all(np.asarray(one) == other))


_CHECKED: dict[type, Callable[..., Table]] = {
    ImuTable: checked_imu,
    GnssTable: checked_gnss,
    Trajectory: checked_truth,
    MagTable: checked_mag,
    AttitudeTable: checked_attitude,
}


def _tables(subject: Subject) -> tuple[list[Table], list[Finding]]:
    if isinstance(subject, Dataset):
        tables = tables_of(subject) + ([subject.master] if subject.master is not None else [])
        return tables, list(subject.meta.get("findings", []))
    if not isinstance(subject, Sequence):
        return [subject], []
    parts = [_tables(part) for part in subject]
    return [t for tables, _ in parts for t in tables], [f for _, told in parts for f in told]
