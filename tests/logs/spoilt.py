"""For every code in the doctor's table a way to spoil a healthy log so that it is found.

A row is a log, "severity where: parts of ... the sentence", and, where they are known, the value,
the codes of all other findings in this log, and how many findings have this one.
"""

from dataclasses import replace
from functools import partial

import numpy as np
from made_pair import make_pair
from made_spoilt import (
    WEEK,
    S,
    a_path,
    about_vertical,
    antenna,
    attitude,
    banked,
    by_hand,
    columns,
    drive,
    exact,
    gnss,
    good_gyro,
    hand,
    imu,
    late,
    level,
    mag,
    master,
    pair,
    plus,
    put,
    shift,
    since_start,
    slave,
    spoil,
    stood,
    stretched,
    times,
    tipped,
    tumble,
    turned,
    two,
    walked,
    with_gnss,
    with_imu,
    with_signs,
    yawed,
)
from spoilt_alone import COLUMNS, FLOAT, GNSS, IMU, LIMITS, MAG, TIME, VELOCITY, G, near

UNCHECKED = "turning_not_checked force_not_checked"

SPAN = {
    "no_overlap": [
        *(
            (two(imu_ns=plus(seconds * S)), f"error: {words}")
            for seconds, words in {
                -WEEK: f"if GPS week 2288 ({WEEK} s) is added to the IMU's",
                -315_964_800: "counted from 1970, the IMU's from 1980",
                18: "in UTC, the IMU's in GPS time, 18 s ahead: they fit if +18 s is added",
                2 * 3600: "They fit if +2 h is added: one clock is in local time",
                -777_777: "No usual offset explains it",
            }.items()
        ),
        (
            two(gnss_ns=plus(-WEEK * S)),
            f"error: are seconds of the GPS week ... fit if GPS week 2288 ({WEEK} s) is added.",
        ),
        (
            two(since_start(1000, 20 * S), since_start(1, 20 * S)),
            "error: They fit if the IMU's times are milliseconds",
            None,
            "time_unit",
        ),
        (lambda: [imu(rows=slice(0, 1000))(), spoil(a_path, time_ns=plus(-(10**15)))()], "error"),
        (master(time_ns=plus(10**12)), "error", None, UNCHECKED),
    ],
    "little_overlap": [
        (two(imu_ns=plus(7 * S)), "warning", near(2.7, abs=0.3), "motion_not_checked")
    ],
    "leap_seconds": [
        (
            with_gnss(time_ns=plus(18 * S), **dict.fromkeys(("lat_rad", "lon_rad", "v_n"), stood)),
            "note: begins +18.000 s and ends",
            near(18.0),
            "motion_not_checked",
        )
    ],
}

MASTER = {
    "master_missing": [
        (master(lat_rad=put(5, np.nan)), "warning: position is not whole", 1),
        (master(q_nb=times(np.nan)), "error: attitude is not whole", 800, UNCHECKED),
    ],
    "velocity_unit": [
        (master(lat_rad=np.deg2rad, lon_rad=np.deg2rad), "error: radians that were read as degrees")
    ],
    "velocity_axes": [(exact(v_n=columns(1, 0, 2)), "error")],
    "velocity_disagrees": [(exact(v_n=partial(np.roll, shift=300, axis=0)), "warning")],
    "velocity_late": [(exact(v_n=partial(np.roll, shift=3, axis=0)), "warning")],
    "velocity_sign": [
        (
            master(v_n=times(1 - 2 * np.eye(3)[k])),
            f"error: It is probably positive {other}: turn its sign",
            name,
        )
        for k, (name, other) in enumerate((("north", "south"), ("east", "west"), ("down", "up")))
    ],
    "attitude_sign": [
        (master(q_nb=change), f"error: {words}")
        for change, words in (
            (with_signs([-1, 1, 1]), "Heading is probably counted counterclockwise: count it"),
            (with_signs([1, -1, 1]), "Pitch is probably positive with the nose down: turn its"),
            (with_signs([1, 1, -1]), "Roll is probably positive with the right wing up: turn its"),
            (times([1, -1, -1, -1]), "navigation to body axes: give their conjugates"),
        )
    ],
    "turning_not_checked": [(master(q_nb=lambda q_nb: q_nb * 0 + q_nb[:1]), "note")],
    "gyro_unit": [(slave(gyro=np.rad2deg), "error: deg/s: multiply by pi/180")],
    "gyro_axes": [
        (slave(gyro=columns(1, 2, 0)), "error: (gyro_z, gyro_x, gyro_y)"),
        (slave(gyro=times(-1)), "error: (-gyro_x, -gyro_y, -gyro_z)"),
    ],
    "turning_disagrees": [(slave(gyro=partial(np.roll, shift=700, axis=0)), "error")],
    "master_late": [
        *(
            (late(total_s), f"error: {mend}", near(total_s, abs=0.004))
            for total_s, mend in ((0.08, 'State that: master.delay = "0.08'), (-0.05, "Add 0.05"))
        ),
        (late(0.015), "warning"),
    ],
    "force_not_checked": [(master(v_n=times(np.nan)), "note", None, "master_missing")],
    "gravity_unit": [(slave(accel=times(1 / G)), "error: probably g: multiply by 9.80665")],
    "rates_as_increments": [(slave(kind="increment"), "error", None, "turning_disagrees")],
    "increments_as_rates": [(slave(accel=times(0.01)), "error: They are probably increments")],
    "accel_reversed": [(slave(accel=times(-1)), "error: opposite sign", None, "velocity_sign")],
    "accel_axes": [(slave(accel=columns(0, 2, 1)), "error: as (accel_x, accel_z, accel_y)")],
    "force_disagrees": [(slave(accel=plus([0, 0, 9.81])), "error: or gravity taken off")],
}

MOTION = {
    "gyro_unit": [
        (with_imu(gyro=times(factor)), f"error: turns by the gyros ... {words}")
        for factor, words in {
            180 / np.pi: "probably deg/s: multiply by pi/180",
            180 / np.pi * 3600: "probably deg/h: multiply by pi/180/3600",
            np.pi / 180: "probably rad/s converted to radians once more",
            0.01: "probably increments where rates are expected: divide by 0.01 s",
            1 / 1.87: "by 1.8 ... the gyros read 0.53 ... No usual unit",
        }.items()
    ],
    "gyro_scale": [
        (with_imu(gyro=times([1, 1, 0.5])), "error: about z reads 0.5", near(2.0, abs=0.05))
    ],
    "force_scale": [
        (with_imu(accel=times([1.3, 1, 1])), "warning: along x reads 1.3 +- ", near(0.77, abs=0.02))
    ],
    "clock_rate": [
        (with_imu(time_ns=stretched), "error: drift apart by +10", near(0.01, abs=5e-4))
    ],
    "time_jump": [
        (
            with_gnss(time_ns=shift(slice(220, None), 18 * S)),
            "error: only if -18.0 ... between UTC and GPS",
            near(-18.0, abs=0.1),
            "gap_long",
        )
    ],
    "lever_arm": [(with_gnss(**antenna(2.0)), "note: x +2.0", near(2.0, abs=0.3))],
    "left_handed": [
        (with_imu(**turned([[0, 1, 0], [1, 0, 0], [0, 0, 1]])), "error"),
        (with_imu(**turned(np.diag([1, -1, 1]))), "error"),
    ],
    "gyro_axes": [
        (with_imu(gyro=change), f"error: take them as {words}")
        for change, words in (
            (times([-1, 1, 1]), "(-gyro_x, gyro_y, gyro_z)"),
            (times([1, 1, -1]), "(gyro_x, gyro_y, -gyro_z)"),
            (columns(1, 0, 2), "(gyro_y, gyro_x, gyro_z)"),
            (columns(1, 2, 0), "(gyro_z, gyro_x, gyro_y)"),
        )
    ],
    "gyro_reversed": [(with_imu(gyro=times(-1)), "error")],
    "accel_axes": [(with_imu(accel=times([1, -1, 1])), "error: (accel_x, -accel_y, accel_z)")],
    "accel_reversed": [(with_imu(accel=times(-1)), "error", None, "z_axis_reversed")],
    "forward_axis": [
        (with_imu(**about_vertical(angle)), "warning", near(angle, abs=3.0))
        for angle in (90, 170, -50)
    ],
    "time_offset": [
        (with_imu(time_ns=plus(round(offset * S))), kind, near(offset, abs=0.06))
        for offset, kind in {0.3: "warning", -2.5: "error", 8.0: "error"}.items()
    ],
    "leap_seconds": [
        (
            with_imu(time_ns=plus(18 * S)),
            "error: only if +18.0 ... That is the leap seconds between UTC and GPS time",
        )
    ],
    "motion_disagrees": [
        (with_imu(gyro=lambda gyro: gyro[::-1], accel=lambda accel: accel[::-1]), "warning")
    ],
    "motion_not_checked": [(with_imu(rows=slice(0, 1100)), "note", 0, "little_overlap")],
}

TURNING = {
    "gyro_unit": [
        (hand(gyro=np.rad2deg), "error: deg/s: multiply by pi/180"),
        (hand(gyro=np.deg2rad), "error: rad/s converted to radians once"),
        (hand(gyro=times(0.4)), "error: read 0.4", near(2.5, abs=0.1)),
    ],
    "left_handed": [
        (hand(gyro=times(-1)), "error"),
        (hand(**turned(np.diag([1, -1, 1]))), "error"),
    ],
    "gyro_axes": [(hand(gyro=columns(1, 0, 2)), "error: fit as (gyro_y, gyro_x, gyro_z)")],
}

MAG_AXES = {
    "field_axes": [(mag(field_t=columns(1, 2, 0)), "error: (field_z, field_x, field_y)")],
    "field_turns_back": [(level(gyro=times([1, 1, -1])), "error: if they have the opposite sense")],
    "gyro_unit": [
        (level(gyro=np.rad2deg), "error: if the rates are multiplied by 0.01745 ... deg/s"),
        (level(gyro=np.deg2rad), "error: if the rates are multiplied by 57.3 ... radians once"),
    ],
}

ATTITUDE = {
    "attitude_missing": [(attitude(q_nb=times(np.nan)), "warning")],
    "attitude_order": [
        (attitude(q_nb=change), f"error: {words}")
        for change, words in (
            (columns(1, 2, 3, 0), "scalar last (x, y, z, w): put the last column first"),
            (times([1, -1, -1, -1]), "navigation to body: turn the sign of x, y and z"),
            (lambda q: q[:, [1, 2, 3, 0]] * [-1, -1, -1, 1], "scalar last and navigation to body"),
        )
    ],
    "attitude_axes": [(attitude(q_nb=yawed), "error: gyros (gyro_y, -gyro_x, gyro_z)")],
    "attitude_frame": [
        (attitude(nav="NED"), "error: where NED has up at ... to ENU."),
        (attitude(q_nb=tipped), "error: along (+1.00, ... not stand upright"),
    ],
    "attitude_disagrees": [(attitude(q_nb=lambda q: q[::-1]), "warning")],
}

SPOILT = {
    "check_time": TIME,
    "check_limits": LIMITS,
    "check_columns": COLUMNS,
    "check_imu": IMU,
    "check_gnss": GNSS,
    "check_velocity": VELOCITY,
    "check_mag": MAG,
    "check_span": SPAN,
    "check_master": MASTER,
    "check_motion": MOTION,
    "check_turning": TURNING,
    "check_mag_axes": MAG_AXES,
    "check_attitude": ATTITUDE,
}

HEALTHY = {
    "drive": drive,
    "tables": lambda: [drive().imu, drive().gnss],
    "imu": imu(),
    "increments": imu(kind="increment", gyro=times(0.01), accel=times(0.01)),
    "right-forward-up": imu(body="RFU", **turned([[0, 1, 0], [1, 0, 0], [0, 0, -1]])),
    "good gyro": good_gyro,
    "gnss": gnss(),
    "no velocities": gnss(v_n=None, sigma_v=None),
    "by positions": with_gnss(v_n=None, sigma_v=None),
    "east-north-up": gnss(nav="ENU", v_n=lambda v: v[:, [1, 0, 2]] * [1, 1, -1]),
    "honest floats": gnss(quality=FLOAT, sigma_m=times(np.where(FLOAT == 2, 5.0, 1.0)[:, None])),
    "field": lambda: tumble().mag,
    "path": lambda: replace(drive(), truth=a_path()),
    "path of motion capture": spoil(a_path, time_ns=lambda t: t[0] + (t - t[0]) // 200),
    "pair": pair,
    "pair of increments": partial(make_pair, 1, "increment"),
    "stated delay": late(0.1, stated_s=0.1),
    "small delay": late(0.004),
    "turned by hand": by_hand,
    "walked": walked,
    "banked": banked,
}
