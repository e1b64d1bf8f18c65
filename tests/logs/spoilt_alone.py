"""Ways to spoil one table of a healthy log; what a row holds is told in `spoilt`."""

from functools import partial

import numpy as np
import pytest
from made_logs import GNSS_HZ, START_NS, velocity_ned
from made_spoilt import (
    M,
    N,
    S,
    bump,
    drive,
    gnss,
    good_gyro,
    imu,
    in_bursts,
    known_slow,
    mag,
    magnet,
    plus,
    put,
    read_at_once,
    shift,
    since_start,
    times,
    tumble,
    turned,
    with_imu,
    without,
)

near = pytest.approx
G = 9.80665
ALL = slice(None)
FLOAT = 1 + (np.arange(M) > 300)
STOP = np.deg2rad(250.0)  # rad/s
VIBRATION = (
    1.5 * G * np.sin(np.arange(N) * 2.7458)[:, None] * [0, 0, 1] * (np.arange(N)[:, None] > 3000)
)
JITTER = np.random.default_rng(0).integers(-3_000_000, 3_000_000, N)

TIME = {
    "too_short": [(imu(rows=slice(0, 1)), "error: only 1 sample(s)", 1, "no_samples")],
    "time_stands": [(imu(time_ns=times(0)), "error: never goes forward", 0, "no_samples")],
    "time_unit": [
        *(
            (table(time_ns=since_start(k)), f"error: is in {unit}", None, beside)
            for table, beside in ((imu, ""), (gnss, "velocity_unit"))
            for unit, k in (("milliseconds", 1000), ("microseconds", 10**6))
        ),
        (imu(time_ns=lambda t: (t - START_NS) // 1000), "error: unit than seconds"),
    ],
    "time_slow": [(known_slow, "warning: samples are 0.5 s apart", 0.5)],
    "time_duplicate": [
        (imu(time_ns=shift([100, 200], -S // 100)), "warning line 102", 2),
        (imu(rows=np.arange(2 * N) // 2), "warning: faster than the sensor", N),
    ],
    "stamps_shared": [
        *(
            (imu(time_ns=read_at_once, kind=kind, gyro=times(k), accel=times(k)), says, 10.0)
            for kind, k in (("rate", 1.0), ("increment", 0.01))
            for says in ("warning line 3: 10 samples share each stamp ... evenly, 10 ms apart",)
        ),
        (imu(time_ns=in_bursts), "warning: in bursts of 10, one burst every 0.1 s", 10.0),
        (imu(time_ns=lambda t: t // 10**10 * 10**10), "error line 3: nothing can be timed", 1000.0),
    ],
    "stamps_rounded": [
        (
            imu(time_ns=lambda t: (t + 3_500_000) // 7_000_000 * 7_000_000),
            "note: of 0.007 s ... 100",
        )
    ],
    "time_backward": [
        (imu(time_ns=shift([500, 900], -back)), "warning line 502", 2)
        for back in (15_000_000, S, 3600 * S)
    ],
    "clock_set_back": [
        (imu(time_ns=shift(slice(5000, None), -round(back_s * 1e9))), f"error line 5002: {cause}")
        for back_s, cause in {
            1.0: "It fits a leap second",
            7200.0: "a change of time zone",
            86_400.0: "at midnight",
            604_800.0: "the second of the GPS week",
            1024 * 604_800.0: "the GPS week, which begins again after 1024 weeks",
            2**16 * 1e-3: "a 16-bit counter of milliseconds",
            2**32 * 1e-6: "a 32-bit counter of microseconds",
            2**32 * 1e-3: "a 32-bit counter of milliseconds",
            31.4: "The clock was set, or the logger restarted",
        }.items()
    ],
    "time_jump": [
        (imu(time_ns=shift(slice(5000, None), ahead_s * S)), says)
        for ahead_s, says in {
            1: "warning line 5002: a leap second",
            18: "warning line 5002: a gap, or a clock set ahead by 18 s. It fits the 18 leap",
            3600: "warning line 5002: zone",
        }.items()
    ],
    "gap_short": [
        (imu(rows=without(5000, 3, N)), "note line 5005", near(0.04)),
        (imu(rows=without(5000, 50, N)), "warning line 5052", near(0.51)),
        (
            imu(rows=np.delete(np.arange(N), np.r_[5000:5020, 6000:6040])),
            "warning: (2 gaps, 0.62 s in all, the first at line 5001)",
        ),
        (mag(rows=without(700, 20, 4000)), "note: is held by the gyros meanwhile"),
    ],
    "gap_long": [
        (imu(rows=without(5000, 1234, N)), "warning line 6236", near(12.35)),
        *((gnss(rows=without(200, n, M)), "note", near((n + 1) / 5)) for n in (40, 89, 94)),
    ],
    "time_jitter": [
        (imu(time_ns=shift(ALL, JITTER)), "note: 100 Hz"),
        (imu(time_ns=shift(slice(0, None, 2), 8_000_000)), "warning"),
    ],
}

LIMITS = {"absurd": [(imu(accel=put((50, 1), 1e308)), "warning line 52: accel is 1e+308", 1)]}

COLUMNS = {
    "column_missing": [(imu(gyro=put((ALL, 2), np.nan)), "error", N, "no_samples")],
    "not_finite": [
        (imu(gyro=put(([10, 20], 2), [np.nan, np.inf])), "warning line 12", 2),
        (imu(gyro=put((slice(10, None), 2), np.nan)), "error line 12: More than half of the log"),
    ],
    "axis_stuck": [
        (imu(gyro=put((ALL, 1), 0.0)), "error: gyro_y is 0 in every sample", 0.0),
        (imu(gyro=put((ALL, 1), 0.37)), "error: gyro_y is 0.37 in", 0.37, "gyro_unit"),
    ],
    "axis_stuck_for_a_while": [
        (imu(accel=put((slice(5000, 5300), 0), 0.25)), "warning line 5002: for 300 samples (3.0 s)")
    ],
    "saturated": [
        (
            imu(gyro=lambda gyro: np.clip(gyro * [1, 1, 40], -STOP, STOP)),
            "warning: a usual full scale (4.363 rad/s)",
            near([STOP, -STOP], abs=5e-4),
            "",
            2,
        ),
        (
            imu(accel=lambda accel: np.clip(accel + VIBRATION, -2 * G, 2 * G)),
            "warning: a usual full scale (19.61 m/s^2) ... shifts the mean of accel_z by +",
            near(-2 * G),
        ),
        (
            imu(accel=put((slice(3000, 3005), 2), 4 * G)),
            "warning line 3002: in 5 readings (0.1% of all), this one first",
        ),
    ],
    "coarse": [(imu(accel=np.round), "warning", None, "axis_stuck_for_a_while gravity_bias", 3)],
}

IMU = {
    "no_samples": [(imu(gyro=times(np.nan)), "error", N, "column_missing")],
    "gravity_unit": [
        (
            imu(accel=times(factor)),
            f"error line 2: where gravity is 9.8 ... {mend}",
            near(9.8 * factor, rel=0.01),
        )
        for factor, mend in {
            1 / G: "g: multiply by 9.80665",
            1e3 / G: "milli-g: multiply by 0.00980665",
            1 / 0.3048: "ft/s^2: multiply by 0.3048",
            1e3: "mm/s^2: divide by 1000",
        }.items()
    ],
    "gravity_unknown": [(imu(accel=times(3.5)), "error: no usual unit")],
    "gravity_missing": [(imu(accel=plus([0, 0, 9.75])), "error: 'linear accelerations'")],
    "gravity_bias": [(imu(accel=plus([0, 0, -0.15])), "note: off by +0.15 m/s^2 (+15 mg)")],
    "gravity_not_seen": [
        (imu(rows=slice(1800, None), accel=times(3.5)), "warning: the log has no second at rest")
    ],
    "rates_as_increments": [
        (
            imu(kind="increment", accel=times(factor)),
            f"error: rates in {unit}, not increments over 10 ms: multiply",
        )
        for unit, factor in (("m/s^2", 1.0), ("g", 1 / G))
    ],
    "increments_as_rates": [
        (
            imu(gyro=times(0.01), accel=times(factor)),
            f"error: increments over 10 ms in {unit}, not rates: divide",
        )
        for unit, factor in (("m/s", 0.01), ("g s", 0.01 / G))
    ],
    "z_axis_reversed": [
        *(
            (with_imu(**turned(C)), "error: +9.8 m/s^2 on accel_z", None, others)
            for C, others in (
                (np.diag([1, -1, -1]), ""),
                (np.diag([1, 1, -1]), "left_handed"),
                ([[0, 1, 0], [1, 0, 0], [0, 0, -1]], "forward_axis"),
            )
        ),
        (with_imu(body="RFU"), "error", None, "forward_axis"),
    ],
    "not_level": [
        (with_imu(**turned([[0, 0, -1], [0, 1, 0], [1, 0, 0]])), "warning", near(1.0, abs=0.01))
    ],
    "sensor_axes": [
        (tumble, "note: (-0.00, +0.00, +1.00) of x, y, z"),
        (imu(**turned(np.diag([1, -1, -1]))), "note: (+0.00, +0.00, +1.00) of x, y, z"),
    ],
    "gyro_unit": [
        *(
            (imu(rows=rows, gyro=times(k)), f"error: {says} ... not in rad/s ... data sheet")
            for rows, k, says in (
                (slice(1300, None), 60 * 180 / np.pi, "the gyros reach"),
                (ALL, 1e3, "at rest the gyros read 2.2"),
                (ALL, 131 * 180 / np.pi, "at rest the gyros read"),
            )
        ),
        (partial(good_gyro, 180 / np.pi), "warning: Earth's 15.04 deg/h in deg/s"),
        (partial(good_gyro, 648e3 / np.pi), "error: Earth's 15.04 deg/h in deg/h"),
    ],
}

GNSS = {
    "gnss_missing": [
        (gnss(alt_m=put(3, np.nan)), "warning line 6", 1),
        (gnss(lat_rad=times(np.nan)), "error", M),
        (gnss(alt_m=np.full(M, 1e300)), "error: is 1e+300 here", M, "height"),
        (gnss(v_n=times([1, 1, np.nan])), "note: velocity down is nan", M),
    ],
    "position_unit": [
        (gnss(lat_rad=lat, lon_rad=lon), f"error line 3: {cause}")
        for lat, lon, cause in (
            (np.rad2deg, np.rad2deg, "degrees where radians are needed"),
            (plus(np.deg2rad(-149)), plus(np.deg2rad(39)), "Latitude and longitude are exchanged"),
            (times(1e7), times(1), "scaled (1e-7 deg?)"),
        )
    ],
    "no_fix_as_zero": [
        (gnss(lat_rad=put([5, 6, 7], 0.0), lon_rad=put([5, 6, 7], 0.0)), "error line 8", 3)
    ],
    "position_in_radians": [
        (gnss(lat_rad=np.deg2rad, lon_rad=np.deg2rad), "warning", None, "velocity_unit")
    ],
    "height": [
        (gnss(alt_m=plus(430e3)), "warning"),
        (gnss(alt_m=plus(-20e3)), "error"),
        (gnss(alt_m=plus(-1e3)), "warning"),
    ],
    "sigma_not_positive": [
        (gnss(sigma_m=put((7, 1), 0.0)), "warning line 10", 1),
        (gnss(sigma_v=put((7, 1), 0.0)), "warning line 10", 1),
        (gnss(sigma_m=times(-1)), "warning line 3", M),
        (gnss(sigma_v=times(-1)), "warning line 3", M),
    ],
    "sigma_missing": [
        (gnss(sigma_m=times(np.nan)), "note: the position has no sigma"),
        (gnss(sigma_v=times(np.nan)), "note: the velocity has no sigma"),
    ],
    "sigma_absurd": [
        (gnss(sigma_m=times(1e-3)), "warning", near(2e-5)),
        (gnss(sigma_m=times(1e6)), "warning", near(2e4)),
    ],
    "float_sigma": [(gnss(quality=FLOAT), "warning line 304")],
    "position_resolution": [
        (
            gnss(lat_rad=lambda lat: np.deg2rad(np.round(np.rad2deg(lat), 6))),
            "note",
            near(0.111, rel=0.01),
        )
    ],
}

VELOCITY = {
    "velocity_unit": [
        (
            gnss(lat_rad=np.deg2rad, lon_rad=np.deg2rad),
            "error: The positions are radians that were read as degrees",
            None,
            "position_in_radians",
        ),
        *(
            (gnss(v_n=times(k)), f"error: probably in {unit}", near(k, rel=0.01))
            for unit, k in {
                **{"km/h": 3.6, "knots": 1 / 0.514444, "ft/s": 1 / 0.3048},
                **{"cm/s": 100, "mm/s": 1e3},
            }.items()
        ),
    ],
    "velocity_axes": [
        (
            gnss(v_n=lambda v: v[:, [1, 0, 2]] * [1, 1, -1]),
            "error: probably east, north, up, not north, east, down",
        ),
        (gnss(nav="ENU"), "error: probably north, east, down, not east, north"),
        (
            lambda: gnss(lat_rad=drive().gnss.lon_rad, lon_rad=drive().gnss.lat_rad)(),
            "error: Latitude and longitude are exchanged",
        ),
        (gnss(v_n=times([1, -1, 1])), "error: reversed east. A sign convention"),
        (gnss(v_n=times([-1, -1, 1])), "error: reversed north and east. A sign"),
    ],
    "velocity_sign": [(gnss(v_n=times([1, 1, -1])), "error: is probably up, not down")],
    "velocity_disagrees": [(gnss(v_n=partial(np.roll, shift=130, axis=0)), "warning")],
    "velocity_late": [
        (
            gnss(v_n=velocity_ned(np.maximum(np.arange(M) / GNSS_HZ - 0.1, 0.0))),
            "warning: half an epoch",
            near(0.1, abs=0.02),
        )
    ],
}

MAG = {
    "field_unit": [
        (mag(field_t=times(k)), says, near(48.6e-6 * k, rel=0.01))
        for k, says in {
            1e6: "error: probably in uT: multiply by 1e-6",
            1e9: "error: probably in nT: multiply by 1e-9",
            1e4: "error: probably in gauss: multiply by 1e-4",
            1e7: "error: probably in milligauss: multiply by 1e-7",
            1e3: "error: in nT where uT is said, or uT where mT: divide by 1000",
            1e2: "error: in uT where gauss is said: divide by 100",
            1e1: "warning: may be in mG where uT is said, or a magnet is near: divide by 10",
            1e-1: "warning: may be in uT where mG is said, or it is shielded: multiply by 10",
            1e-2: "error: probably in gauss where uT is said: multiply by 100",
            1e-3: "error: in uT where nT is said, or mT where uT: multiply by 1000",
            3e11: "error: no usual unit makes it that. These are counts of a converter",
        }.items()
    ],
    "field_missing": [
        (
            mag(field_t=put((slice(100, 140), 1), np.nan)),
            "warning 1.000 s after the start: 40 of 4000 samples (1.0%)",
            40,
        ),
        (mag(field_t=put((ALL, 2), np.nan)), "warning: of field_z there is"),
    ],
    "field_zero": [
        (mag(field_t=put(slice(25), 0.0)), "warning: 0 0 0 in 25 of 4000", 25),
        (mag(field_t=times(0.0)), "error", 4000),
    ],
    "field_stuck": [(mag(field_t=put((ALL, 1), 12e-6)), "error: field_y never changes (12 uT")],
    "field_stuck_for_a_while": [
        (
            mag(field_t=lambda field_t: put(slice(1200, 1500), field_t[1200])(field_t)),
            "warning 12.000 s after the start: for 300 samples (3.0 s)",
        )
    ],
    "field_repeated": [
        (
            mag(field_t=lambda field_t: np.repeat(field_t[::5], 5, axis=0)),
            "note: 80% of the samples ... about 20 times a second, the log has 100 rows",
        )
    ],
    "field_saturated": [
        (
            mag(field_t=magnet),
            "warning 20.000 s after the start: stops at -400 uT in 30 readings, 30 in a row",
            -400e-6,
            "field_offset",
        )
    ],
    "field_varies": [(mag(field_t=times([1.3, 0.8, 1.0])), "warning: `robins calibrate`")],
    "field_offset": [(mag(field_t=plus([3e-5, -1e-5, 5e-6])), "warning: `robins calibrate`")],
    "field_disturbed": [(mag(field_t=bump), "note 24.")],
}
