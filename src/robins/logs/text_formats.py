"""Table of all formats of text logs, by which they are recognised, read, written and documented.

A new format is a row here and a sample in `tests/logs/log_samples.py`. Formats that are no table of
numbers have a reader of their own, see `robins.logs.registry`.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from typing import Any

from robins.logs.text_format import ANY, Column, Looks, TextFormat

_CLOCKS = ("s", "ms", "us", "ns")
_RATE, _FORCE, _TURN, _ANGLE = ("rad/s", "deg/s"), ("m/s^2", "g"), ("rad", "deg"), ("deg", "rad")


def _columns(names: str, holds: str, *units: str) -> tuple[Column, ...]:
    """Columns in these units; @ stands for x, y, z, and % in a name for X, Y, Z."""
    pairs = [
        (name.replace("@", axis).replace("%", axis.upper()), quantity.replace("@", axis))
        for name, quantity in zip(names.split(", "), holds.split(), strict=True)
        for axis in ("xyz" if "@" in quantity else " ")
    ]
    return tuple(Column(quantity, name, units) for name, quantity in pairs)


def _format(name: str, looks: Looks | None = None, rows: Looks | None = None, **how: Any):
    """Row of a format: arguments of `TextFormat`, then a line for people and groups of columns.

    With `looks`, columns are found by their order. `rows` recognises rows of numbers if a header,
    by whose names columns are found, is missing.
    """

    def of(about: str, *groups: Iterable[Column]) -> TextFormat:
        columns = itertools.chain.from_iterable(groups)
        if looks is not None:
            columns = (column._replace(place=k) for k, column in enumerate(columns, start=1))
        return TextFormat(name, about, tuple(columns), looks=looks or rows, **how)

    return of


# ---------------------------------------------------- recognition of rows without names

Rows = list[list[float]]


def _gnss_imu(rows: Rows) -> bool:
    """True for seconds since 1970 within 1990 to 2100, and specific force of about one g."""
    size = sorted(sum(a * a for a in row[1:4]) for row in rows)[len(rows) // 2]
    return all(6e8 < row[0] < 4.2e9 for row in rows) and size < 25.0


def _kfgins_imu(rows: Rows) -> bool:
    """True for increments of one sample, less than 0.2 s apart."""
    steps = sorted(abs(b[0] - a[0]) for a, b in itertools.pairwise(rows))
    spacing = steps[len(steps) // 2] if steps else 0.0
    small = all(abs(x) < 10.0 for row in rows for x in row[1:])
    return len(rows[0]) == 7 and small and 0.0 < spacing < 0.2


def _kfgins_gnss(rows: Rows) -> bool:
    """True for degrees that hardly change, and sigmas."""
    return (
        len(rows[0]) == 7
        and not _kfgins_imu(rows)
        and all(abs(r[1]) <= 90 and abs(r[2]) <= 360 and min(r[4:7]) >= 0 for r in rows)
        and all(abs(a - b) < 0.1 for a, b in zip(rows[0][1:3], rows[-1][1:3], strict=True))
    )


def _kfgins_nav(rows: Rows) -> bool:
    """True for a week, its second, a latitude."""
    return (
        len(rows[0]) == 11
        and all(0 <= row[0] < 5000 and row[0] == int(row[0]) for row in rows)
        and all(0 <= row[1] < 700_000 and abs(row[2]) <= 90 for row in rows)
    )


def _poses(first: int, stamps: tuple[float, float], widths: range) -> Looks:
    """Test for rows of these widths, stamps in a range and a unit quaternion from `first` on."""

    def looks(rows: Rows) -> bool:
        return len(rows[0]) in widths and all(
            stamps[0] <= row[0] < stamps[1]
            and abs(sum(q * q for q in row[first : first + 4]) - 1.0) < 5e-3
            for row in rows
        )

    return looks


# ----------------------------------------------------------------------------------- the table

_PLACE = (
    *_columns("latitude [deg], longitude [deg]", "lat lon", "deg"),
    *_columns("height [m]", "height", "m"),
)
_EULER = "roll pitch heading"
_POSE = (
    _columns("tx, ty, tz", "east north up", "m"),
    _columns("qx, qy, qz, qw", "q_x q_y q_z q_w"),
)
_SECOND = _columns("time of week [s]", "time_of_week", "s")
_NAMED = _columns("time_{unit_}", "time", *_CLOCKS)

TEXT_FORMATS: tuple[TextFormat, ...] = (
    _format("gnss-imu", looks=_gnss_imu)(
        "GNSS_IMU: CSV without header; seconds since 1970 in GPS time, axes of the sensor",
        _columns("time [s]", "time", "s"),
        _columns("acc_@ [g]", "accel_@", "g"),
        _columns("gyro_@ [rad/s]", "gyro_@", "rad/s"),
    ),
    _format("kfgins-imu", separator=" ", looks=_kfgins_imu)(
        "KF-GINS: increments, forward-right-down",
        _SECOND,
        _columns("dtheta_@ [rad]", "dtheta_@", "rad"),
        _columns("dv_@ [m/s]", "dv_@", "m/s"),
    ),
    _format("kfgins-gnss", separator=" ", whole=True, looks=_kfgins_gnss)(
        "KF-GINS: fixes, which lack no component",
        _SECOND,
        _PLACE,
        _columns("sigma_N [m], sigma_E [m], sigma_D [m]", "sigma_north sigma_east sigma_down", "m"),
    ),
    _format("kfgins-nav", separator=" ", looks=_kfgins_nav)(
        "KF-GINS: navigation result; counted from the week of the first line",
        _columns("week", "week"),
        _SECOND,
        _PLACE,
        _columns("vN [m/s], vE [m/s], vD [m/s]", "v_north v_east v_down", "m/s"),
        _columns("roll [deg], pitch [deg], yaw [deg]", _EULER, "deg"),
    ),
    _format("pyins-imu", choice=True)(
        "pyins: CSV of Imu or Increments, a DataFrame whose index is the time",
        _columns(f"time | {ANY}", "time", "s"),
        _columns("gyro_@", "gyro_@", "rad/s"),
        _columns("accel_@", "accel_@", "m/s^2"),
        _columns("dt", "dt", "s"),
        _columns("theta_@", "dtheta_@", "rad"),
        _columns("dv_@", "dv_@", "m/s"),
    ),
    _format("pyins-trajectory")(
        "pyins: CSV of Trajectory, a DataFrame whose index is the time",
        _columns(f"time | {ANY}", "time", "s"),
        _columns("lat, lon", "lat lon", "deg"),
        _columns("alt", "height", "m"),
        _columns("VN, VE, VD", "v_north v_east v_down", "m/s"),
        _columns("roll, pitch, heading", _EULER, "deg"),
    ),
    _format("euroc-imu", commented=True)(
        "EuRoC and ASL: imu0/data.csv, axes of the sensor",
        _columns("timestamp [ns] | timestamp", "time", "ns"),
        _columns("w_RS_S_@ [rad s^-1] | w_RS_S_@", "gyro_@", "rad/s"),
        _columns("a_RS_S_@ [m s^-2] | a_RS_S_@", "accel_@", "m/s^2"),
    ),
    _format("euroc-truth", nav="ENU", commented=True, choice=True)(
        "EuRoC and ASL: ground truth in local metres, taken as east, north, up",
        _columns("timestamp [ns] | timestamp", "time", "ns"),
        _columns(
            "p_RS_R_x [m] | p_RS_R_x, p_RS_R_y [m] | p_RS_R_y, p_RS_R_z [m] | p_RS_R_z",
            "east north up",
            "m",
        ),
        _columns(
            "q_RS_w [] | q_RS_w, q_RS_x [] | q_RS_x, q_RS_y [] | q_RS_y, q_RS_z [] | q_RS_z",
            "q_w q_x q_y q_z",
        ),
        (Column("v_east", "v_RS_R_x [m s^-1] | v_RS_R_x"),),
        (Column("v_north", "v_RS_R_y [m s^-1] | v_RS_R_y"),),
        (Column("v_down", "v_RS_R_z [m s^-1] | v_RS_R_z", scale=-1.0),),
    ),
    _format(
        "tum", separator=" ", nav="ENU", commented=True, rows=_poses(4, (-1e9, 1e11), range(8, 9))
    )(
        "TUM, evo, ORB-SLAM, ov_eval: metres east, north, up of an origin, the scalar last",
        _columns("timestamp | timestamp(s)", "time", "s"),
        *_POSE,
    ),
    _format("orbslam-euroc", separator=" ", nav="ENU", looks=_poses(4, (1e14, 1e19), range(8, 9)))(
        "ORB-SLAM3 SaveTrajectoryEuRoC, Basalt: as tum, in nanoseconds and without a header",
        _columns("timestamp [ns]", "time", "ns"),
        *_POSE,
    ),
    _format(
        "openvins-state", separator=" ", nav="ENU", looks=_poses(1, (-1e9, 1e11), range(11, 1000))
    )(
        "OpenVINS save_total_state: time, rotation with the scalar last, place, velocity",
        _columns("timestamp(s)", "time", "s"),
        _columns("q_x, q_y, q_z, q_w", "q_x q_y q_z q_w"),
        _columns("p_x [m], p_y [m], p_z [m]", "east north up", "m"),
        _columns("v_x [m/s], v_y [m/s]", "v_east v_north", "m/s"),
        (Column("v_down", "v_z [m/s]", ("m/s",), scale=-1.0),),
    ),
    _format("named-imu", states_frames=True, choice=True)(
        "anyone: CSV with units in its header; rates, or increments since the line before",
        _NAMED,
        _columns("gyro_@_{unit_}", "gyro_@", *_RATE),
        _columns("accel_@_{unit_}", "accel_@", *_FORCE),
        _columns("dtheta_@_{unit_}", "dtheta_@", *_TURN),
        _columns("dv_@_{unit_}", "dv_@", "m/s"),
    ),
    _format("named-path", states_frames=True, choice=True)(
        "anyone: CSV with units in its header; with angles or quaternions, maybe turn rates",
        _NAMED,
        _columns("lat_{unit_}, lon_{unit_}", "lat lon", *_ANGLE),
        _columns("height_{unit_}", "height", "m"),
        _columns("v_north_{unit_}, v_east_{unit_}, v_down_{unit_}", "v_north v_east v_down", "m/s"),
        _columns("roll_{unit_}, pitch_{unit_}, heading_{unit_}", _EULER, *_ANGLE),
        _columns("q_w, q_x, q_y, q_z", "q_w q_x q_y q_z"),
        _columns("omega_@_{unit_}", "omega_@", *_RATE),
    ),
    _format("xsens-mt", separator="\t", others=True)(
        "Xsens MT Manager: tab-separated text, ticks of 0.1 ms, axes of the sensor",
        (Column("time", "SampleTimeFine", ("ms",), scale=0.1),),
        _columns("Acc_%", "accel_@", "m/s^2"),
        _columns("Gyr_%", "gyro_@", "rad/s"),
    ),
    _format("xsens-dot", others=True)(
        "Xsens DOT: CSV below lines about the device, microseconds, axes of the sensor",
        _columns("SampleTimeFine", "time", "us"),
        _columns("Acc_%", "accel_@", "m/s^2"),
        _columns("Gyr_%", "gyro_@", "deg/s"),
    ),
    _format("microstrain-csv", others=True, choice=True)(
        "MicroStrain MIP Monitor: CSV below DATA_START, week and second of GPS",
        _columns("GPS Week", "week"),
        _columns("GPS TOW", "time_of_week", "s"),
        _columns("% Accel [x8004]", "accel_@", "g"),
        _columns("% Gyro [x8005]", "gyro_@", "rad/s"),
        _columns("% Mag [x8006]", "mag_@", "G"),
    ),
    _format("vectornav-csv", others=True, choice=True)(
        "VectorNav: CSV of its uncompensated sensors, as INSTINCT writes it too",
        _columns("TimeStartup | TimeStartup [ns]", "time", "ns"),
        _columns("UncompAcc% | UnCompAcc% | UnCompAcc% [m/s^2]", "accel_@", "m/s^2"),
        _columns("UncompGyro% | UnCompGyro% | UnCompGyro% [rad/s]", "gyro_@", "rad/s"),
        _columns("UncompMag% | UnCompMag% | UnCompMag% [Gauss]", "mag_@", "G"),
    ),
    _format("xio-csv", choice=True)(
        "x-io sensors and Fusion: CSV with any units in its header, axes of the sensor",
        _columns("Time ({unit}) | Timestamp ({unit})", "time", *_CLOCKS),
        (
            Column(f"{stem}_{axis}", f"{sensor} {axis.upper()} ({{unit}})", (symbol, ANY))
            for sensor, stem, symbol in (
                ("Gyroscope", "gyro", "deg/s"),
                ("Accelerometer", "accel", "g"),
                ("Magnetometer", "mag", "uT"),
            )
            for axis in "xyz"
        ),
    ),
)
"""All formats of text logs."""
