"""The doctor: examination of tables before a run, with findings in sentences.

Errors mean that a run would be wrong; a healthy log has none. All checks are rows of two tables,
`ALONE` and `TOGETHER`, with their arguments, conditions and possible findings. The order of the
rows is that of the examination. A new check is a row and its function; the table in the documents
is made from these, and a test requires a way to cause each code.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np

from robins.dataset import Dataset, GnssTable, ImuTable, Trajectory
from robins.errors import require_kind
from robins.logs.batches import spread, spread_like
from robins.logs.checks_attitude import check_attitude
from robins.logs.checks_gnss import check_gnss, check_velocity
from robins.logs.checks_imu import check_columns, check_imu
from robins.logs.checks_mag import check_mag, check_mag_axes
from robins.logs.checks_master import check_master
from robins.logs.checks_motion import check_motion
from robins.logs.checks_time import check_span, check_time
from robins.logs.checks_turning import check_turning
from robins.logs.findings import Finding, by_severity
from robins.logs.limits import check_limits
from robins.logs.tables import KINDS, Table, checked, kind_of, tables_of


class FindingCode(NamedTuple):
    """Meaning of one finding."""

    name: str
    severity: str  # "error", or several, "error or warning"
    says: str


@dataclass(frozen=True)
class Check:
    """A function that yields findings, with the conditions under which it runs."""

    topic: str  # heading in the documents
    find: Callable[..., Iterable[Finding]]
    needs: str  # its arguments, in order; it does not run if one is missing
    codes: tuple[FindingCode, ...]
    silenced_by: str = ""  # codes after which it would find a wrong cause
    unless: str = ""  # tables; it does not run if one, better evidence, is there ...
    but_after: str = ""  # ... unless this code states that it was inconclusive
    proves: str = ""  # codes that, if found here, replace earlier findings
    overrules: str = ""  # earlier codes about which it is more reliable ...
    undecided: str = ""  # ... unless this code states that it was inconclusive

    def applies(self, things: Mapping[str, Any], found: set[str]) -> bool:
        """True if the check runs on these things and after these codes."""
        there = things.keys() >= set(self.needs.split())
        kept_out = set(self.unless.split()) & things.keys() and self.but_after not in found
        return there and not kept_out and not set(self.silenced_by.split()) & found

    def run(self, things: Mapping[str, Any]) -> list[Finding]:
        """Findings of the check."""
        return list(self.find(*(things[need] for need in self.needs.split())))

    def outdated(self, found: set[str]) -> set[str]:
        """Codes of earlier findings that are superseded by those of this check."""
        judged = "" if self.undecided in found else self.overrules
        return set(self.proves.split()) & found | set(judged.split())


def _check(topic: str, find: Callable[..., Iterable[Finding]], needs: str, **when: str):
    """Row of a check from its arguments and conditions, completed by its codes."""
    return lambda *codes: Check(topic, find, needs, _codes(*codes), **when)


def _codes(*rows: tuple[str, str, str]) -> tuple[FindingCode, ...]:
    return tuple(FindingCode(*row) for row in rows)


# Findings of readers: omissions and doubts.
OF_READERS = _codes(
    ("ends_early", "warning", "the recording or the copy was interrupted"),
    ("begins_midway", "warning", "the recording began in the middle of a line"),
    ("no_place", "note", "the path is in local metres; it was put at latitude 0, longitude 0"),
    ("no_velocity", "note", "RTKLIB did not solve for velocities"),
    ("height_above_geoid", "warning", "heights are above the geoid, not the ellipsoid"),
    ("dt_disagrees", "warning", "the column dt is not the time that has passed"),
    ("several_instances", "note", "a recording holds several sensors of one kind"),
    ("angle_range", "warning", "single angles that cannot be; they are taken as missing"),
    ("quaternion_length", "warning", "single quaternions of another length; likewise"),
    ("other_kinds", "note", "a file holds lines of kinds that are not read"),
    ("damaged_frames", "warning", "messages without a right checksum, or bytes of none"),
    ("undated", "note", "fixes from before the receiver knew the date"),
    ("sigma_assumed", "note", "a receiver states no sigmas; those of its kind of fix are used"),
    ("height_assumed", "warning", "a receiver states no heights, as with RMC alone"),
    ("sensors_merged", "note", "gyros and accelerometers were recorded apart"),
    ("table_replaced", "note", "a file of its own replaces what a recording holds"),
    ("clock_aligned", "note", "samples are put on GPS time by the arrival of the fixes"),
    ("velocity_taken", "note", "velocities of fixes come from a topic of their own"),
    ("lines_left_out", "warning", "lines that fail their checksum, or of an idle receiver"),
    ("fixes_of_truth", "note", "fixes and path are one solution, of the same receiver"),
)

_OF_VELOCITY = (
    ("velocity_unit", "error", "velocities that fit the positions in another unit"),
    ("velocity_axes", "error", "velocities that fit with axes exchanged or reversed"),
    ("velocity_disagrees", "warning", "velocities that fit the positions in no way"),
    ("velocity_late", "warning", "velocities that fit only with a delay"),
)

_NO_PLACE = "position_unit no_fix_as_zero"

# Run on each table by itself; silenced only by findings on that table.
ALONE = (
    _check("In time", check_time, "stamps unit_known")(
        ("too_short", "error", "fewer than two samples; nothing can be run on that"),
        ("time_stands", "error", "a time column that is constant, or another one"),
        ("time_unit", "error", "the rate tells that time is in ms, us or ns"),
        ("time_slow", "warning", "inertial samples too far apart to navigate by"),
        ("stamps_shared", "error or warning", "stamps of batches; `clean` spreads the samples"),
        ("time_duplicate", "warning", "samples that repeat a time; `clean` refuses them"),
        ("clock_set_back", "error", "a counter ran over, a time zone, a restart"),
        ("time_backward", "warning", "samples that step back; `clean` refuses them"),
        ("time_jump", "warning", "a gap, or a clock set by a leap second, a time zone"),
        ("gap_short", "warning or note", "samples are missing, for less than a second"),
        ("gap_long", "warning or note", "samples are missing, for a second or more"),
        ("stamps_rounded", "note", "digits of stamps were lost"),
        ("time_jitter", "warning or note", "stamps taken on arrival, not by the sensor"),
    ),
    _check("In the numbers of any table", check_limits, "table")(
        ("absurd", "warning", "single numbers no vehicle has: a bit or a digit was lost"),
    ),
    _check("In the inertial samples", check_columns, "imu")(
        ("column_missing", "error", "a column without a number"),
        ("not_finite", "warning or error", "samples without a number; an error if most are"),
        ("axis_stuck", "error", "a value that never changes"),
        ("axis_stuck_for_a_while", "warning", "a value that hung for a while"),
        ("saturated", "warning", "the range was too small"),
        ("coarse", "warning", "the bits or the decimals were too few"),
    ),
    _check("In the inertial samples", check_imu, "imu in_vehicle")(
        ("no_samples", "error", "fewer than ten samples have all six numbers"),
        ("gravity_bias", "note", "the unit is right, the accelerometers are a little off"),
        ("rates_as_increments", "error", "gravity tells that rates are read as increments"),
        ("increments_as_rates", "error", "gravity tells that increments are read as rates"),
        ("gravity_unit", "error", "gravity tells that the unit is g, mg, cm/s^2, ft/s^2"),
        ("gravity_missing", "error", "gravity was taken off"),
        ("gravity_unknown", "error", "gravity is not there, and no usual unit makes it"),
        ("gravity_not_seen", "warning", "the same, in a log without a second at rest"),
        ("sensor_axes", "note", "gravity is not along z: attitude will be the sensor's"),
        ("z_axis_reversed", "error", "gravity points the wrong way"),
        ("not_level", "warning", "gravity points along another axis"),
        ("gyro_unit", "error or warning", "too fast, or the Earth's rate in deg/h, deg/s"),
    ),
    _check("In the GNSS fixes", check_gnss, "gnss")(
        ("gnss_missing", "error, warning or note", "components; the others are used"),
        ("position_unit", "error", "degrees for radians, longitude for latitude"),
        ("no_fix_as_zero", "error", '"no fix" was written as latitude 0, longitude 0'),
        ("position_in_radians", "warning", "radians were read as degrees"),
        ("height", "error or warning", "nobody drives, sails or flies by air there"),
        ("sigma_not_positive", "warning", "zero, which means unknown, not exact"),
        ("sigma_missing", "note", "there is none in any fix; a replay assumes the usual ones"),
        ("sigma_absurd", "warning", "they are in another unit, or variances"),
        ("float_sigma", "warning", "float solutions claim to be as good as fixed ones"),
        ("position_resolution", "note", "too few decimals for so good a fix"),
    ),
    _check("In the GNSS fixes", check_velocity, "gnss", silenced_by=_NO_PLACE)(
        *_OF_VELOCITY,
        ("velocity_sign", "error", "a vertical velocity of the other sign"),
    ),
    _check("In the magnetic field", check_mag, "mag")(
        ("field_missing", "warning", "samples without a number"),
        ("field_zero", "error or warning", "0 0 0 where there was no measurement"),
        ("field_stuck", "error", "an axis that never changes"),
        ("field_unit", "error or warning", "the Earth's field of 20 to 70 uT tells it"),
        ("field_stuck_for_a_while", "warning", "the sensor hung"),
        ("field_repeated", "note", "more rows than the sensor took measurements"),
        ("field_saturated", "warning", "a magnet drove it to its stop"),
        ("field_offset", "warning", "hard iron: run `robins calibrate`"),
        ("field_varies", "warning", "hard or soft iron, or steel and magnets around"),
        ("field_disturbed", "note", "single stretches of another field than the Earth's"),
    ),
)

# With these, sensors seem to have two motions.
_SPOILT = (
    f"{_NO_PLACE} no_overlap rates_as_increments increments_as_rates time_unit time_slow "
    "velocity_axes velocity_unit velocity_sign"
)
# With these, a comparison with the gyros would blame the other sensor.
_GYROS_WRONG = "gyro_unit gyro_scale gyro_axes gyro_reversed left_handed"

# Run on all tables of a log together.
TOGETHER = (
    _check("In time", check_span, "imu others")(
        ("no_overlap", "error", "the files share no time; names the offset that would fit"),
        ("leap_seconds", "note", "one file may be in UTC, one in GPS time"),
        ("little_overlap", "warning", "the files share little of their time"),
    ),
    # An IMU alone is checked near rest; a master gives better evidence, in any motion.
    _check(
        "In a master and the IMU to be aligned to it",
        check_master,
        "imu master delay_s",
        overrules="gravity_unit gravity_unknown gravity_bias gravity_not_seen gravity_missing "
        "z_axis_reversed not_level rates_as_increments increments_as_rates",
        undecided="force_not_checked",
    )(
        ("master_missing", "error or warning", "position, velocity or attitude"),
        *_OF_VELOCITY,
        ("velocity_sign", "error", "it changes against positions or specific forces"),
        ("turning_not_checked", "note", "the vehicle hardly turns"),
        ("attitude_sign", "error", "heading, pitch or roll reversed, or all inverted"),
        ("gyro_axes", "error", "the gyros turn as the attitudes with other axes"),
        ("gyro_unit", "error", "the gyros turn as the attitudes in another unit"),
        ("turning_disagrees", "error", "gyros and attitudes show two turnings"),
        ("master_late", "error or warning", "attitudes older or younger than stated"),
        ("force_not_checked", "note", "too few seconds of both"),
        ("gravity_unit", "error", "accelerometers fit the velocities in another unit"),
        ("rates_as_increments", "error", "likewise"),
        ("increments_as_rates", "error", "likewise"),
        ("accel_reversed", "error", "they fit with the opposite sign"),
        ("accel_axes", "error", "they fit with axes exchanged or reversed"),
        ("force_disagrees", "error", "they feel something else than the velocities ask"),
    ),
    _check(
        "In IMU and GNSS together",
        check_motion,
        "imu gnss",
        silenced_by=_SPOILT,
        unless="master",
        proves="gyro_unit",
        overrules="leap_seconds",
        undecided="motion_not_checked",
    )(
        ("motion_not_checked", "note", "too little motion to compare them"),
        ("motion_disagrees", "warning", "they do not describe one motion in any way"),
        ("time_offset", "error or warning", "they fit only if one file is shifted"),
        ("leap_seconds", "error", "likewise, by the 18 s between UTC and GPS time"),
        ("time_jump", "error", "they fit only if one file is shifted from there on"),
        ("clock_rate", "error", "the clocks of the two drift apart"),
        ("gyro_unit", "error", "turns fit those of the velocities in another unit or scale"),
        ("gyro_scale", "error", "they fit with another scale about one axis"),
        ("force_scale", "warning", "likewise specific forces along an axis"),
        ("left_handed", "error", "axes or signs of both triads"),
        ("accel_reversed", "error", "the accelerometers have the opposite sign"),
        ("accel_axes", "error", "axes or signs of the accelerometers"),
        ("gyro_reversed", "error", "the gyros have the opposite sense"),
        ("gyro_axes", "error", "axes or signs of the gyros"),
        ("lever_arm", "note", "the antenna is away from the IMU"),
        ("forward_axis", "warning", "the vehicle does not travel along its forward axis"),
    ),
    _check(
        "In an IMU that was turned about",
        check_turning,
        "imu",
        silenced_by=_SPOILT,
        unless="master gnss",
        but_after="motion_not_checked",
        proves="gyro_unit",
    )(
        ("gyro_unit", "error", "the gyros turn gravity as it was seen in another unit or scale"),
        ("left_handed", "error", "they do with the opposite sense, or triads reflected"),
        ("gyro_axes", "error", "they do with axes exchanged or reversed"),
    ),
    _check(
        "In the magnetic field",
        check_mag_axes,
        "imu mag",
        silenced_by=f"{_SPOILT} {_GYROS_WRONG} field_unit field_stuck",
        unless="master",
    )(
        ("field_axes", "error", "it turns as the gyros say only with other columns"),
        ("field_turns_back", "error", "it does only if the gyros have the opposite sense"),
        ("gyro_unit", "error", "it does only with the gyros in another unit"),
    ),
    _check(
        "In the attitudes",
        check_attitude,
        "imu attitude",
        silenced_by=f"{_SPOILT} {_GYROS_WRONG}",
        unless="master",
    )(
        ("attitude_missing", "warning", "there is none"),
        ("attitude_order", "error", "they are scalar last, or navigation to body"),
        ("attitude_axes", "error", "they are of a body with other axes"),
        ("attitude_disagrees", "warning", "they are of another body or another time"),
        ("attitude_frame", "error", "they are to NED where ENU is said, or not upright"),
    ),
)

# Reasons for refusal by `clean`, by the names of its counts.
REFUSALS = {
    "nan": "not a number",
    "inf": "not finite",
    "absurd": "a magnitude no vehicle has",
    "duplicate": "the time of the sample before",
    "backward": "time that steps back; as few samples as possible are refused",
    "ahead": "time far ahead of what follows, likewise",
    "spread": "not refused: stamped with others at once, its time is spread evenly",
    "sigma": "a sigma of a GNSS fix that is zero or negative",
}


Subject = Dataset | Table | Sequence[Table | Dataset]
Use = Literal["any", "attitude"]


def examine(subject: Subject, use: Use = "any") -> list[Finding]:
    """Examine a dataset, or tables by themselves.

    Args:
        subject: as it was read, before `clean`, so that all samples are examined. For a dataset,
            the findings of its readers, ``time_unit_known`` and ``master_delay_s`` are used too.
        use: "attitude" if only the attitude of the sensor matters, so that it may have any
            orientation; by default if neither fixes nor a path of a vehicle were recorded.

    Returns:
        Errors first, then warnings, then notes; empty for a log without a flaw.

    Raises:
        TypeError: the subject is no dataset or table.
        LogError: arrays of wrong length, type or shape.
    """
    parts = subject if isinstance(subject, Sequence) else [subject]
    for part in parts:
        require_kind(part, (Dataset, *KINDS), "examine")
    datasets = [part for part in parts if isinstance(part, Dataset)]
    findings = [finding for dataset in datasets for finding in dataset.findings]
    unit_known = {file for dataset in datasets for file in dataset.time_unit_known}
    with np.errstate(all="ignore"):  # invalid numbers are examined on purpose
        tables = [checked(table) for part in parts for table in _tables(part)]
        # a vehicle is upright; a sensor by itself may have any orientation
        moved = any(isinstance(table, GnssTable | Trajectory) for table in tables)
        in_vehicle = moved and use != "attitude"
        evens: list[Table] = []
        imu: ImuTable | None = None
        all_of_them: dict[str, Any] = {"others": evens}
        for table in tables:
            even = spread(table) if imu is None else spread_like(table, imu, all_of_them["imu"])
            things = {kind_of(table): even, "table": even, "in_vehicle": in_vehicle}
            if not _stamped_as(table, imu):  # one report suffices
                things |= {"stamps": table, "unit_known": table.source in unit_known}
            findings += _asked(ALONE, things, [])
            all_of_them[kind_of(table)] = even
            if isinstance(table, ImuTable):
                imu = table
            else:
                evens.append(even)
        if isinstance(subject, Dataset) and subject.master is not None:
            master, delay_s = checked(subject.master), subject.master_delay_s
            all_of_them |= {"master": master, "delay_s": delay_s}
        return by_severity(_asked(TOGETHER, all_of_them, findings))


def _asked(
    checks: Sequence[Check], things: Mapping[str, Any], findings: list[Finding]
) -> list[Finding]:
    """Findings, extended by those of the checks that apply."""
    for check in checks:
        if check.applies(things, {f.code for f in findings}):
            new = check.run(things)
            outdated = check.outdated({f.code for f in new})
            findings = [f for f in findings if f.code not in outdated] + new
    return findings


def _tables(part: Table | Dataset) -> list[Table]:
    master = part.master if isinstance(part, Dataset) else None
    return tables_of(part) + ([] if master is None else [master])


def _stamped_as(table: Table, imu: ImuTable | None) -> bool:
    """True if a table from the file of the IMU has the same stamps."""
    if imu is None or table.source != imu.source:
        return False
    return bool(np.array_equal(table.time_ns, imu.time_ns))
