"""Ways to spoil a healthy log: one table of it, some rows of that, some of their columns."""

import dataclasses
from functools import cache, partial

import numpy as np
from made_logs import GNSS_HZ, IMU_HZ, START_NS, TOTAL_S, make_drive, motion, rows_of
from made_nine_axis import level_dataset, tumble_dataset
from made_pair import attitudes, make_by_hand, make_pair
from scipy.spatial.transform import Rotation

from robins.dataset import Dataset, ImuTable, Trajectory

S = 1_000_000_000
N, M = round(TOTAL_S * IMU_HZ) + 1, round(TOTAL_S * GNSS_HZ) + 1
WEEK = START_NS // S - (START_NS // S - 315_964_800) % 604_800

drive, tumble, by_hand = cache(make_drive), cache(tumble_dataset), cache(make_by_hand)
pair, exact_pair = cache(partial(make_pair, 1)), cache(partial(make_pair, 1, noise_m=0.02))


def spoil(base, part="", whole=False, rows=None, **columns):
    """Makes a log with some rows of a table, its columns replaced or changed by a function.

    It is the base's log that is spoilt, or the one that is given.
    """

    def make(log=None):
        log = base() if log is None else log
        table = getattr(log, part) if part else log
        table = table if rows is None else rows_of(table, rows)
        new = {k: v(getattr(table, k)) if callable(v) else v for k, v in columns.items()}
        table = dataclasses.replace(table, **new)
        return dataclasses.replace(log, **{part: table}) if whole else table

    return make


imu, gnss = partial(spoil, drive, "imu"), partial(spoil, drive, "gnss")
with_imu, with_gnss = partial(imu, whole=True), partial(gnss, whole=True)
level = partial(spoil, cache(level_dataset), "imu", True)
mag, attitude, sensor = (partial(spoil, tumble, k, True) for k in ("mag", "attitude", "imu"))
master, slave = partial(spoil, pair, "master", True), partial(spoil, pair, "imu", True)
exact, hand = partial(spoil, exact_pair, "master", True), partial(spoil, by_hand)


def put(rows, value):
    """A change of some rows to a value."""

    def change(column):
        new = column.copy()
        new[rows] = value
        return new

    return change


def shift(rows, ns):
    """A change of some stamps."""
    return lambda time_ns: put(rows, time_ns[rows] + ns)(time_ns)


def times(factor):
    """A change by a factor, one for all or one for each column."""
    return lambda column: column * np.asarray(factor)


def plus(offset):
    """A change by an offset, one for all or one for each column."""
    return lambda column: column + np.asarray(offset)


def columns(*order):
    """Columns in another order."""
    return lambda column: column[:, list(order)]


def turned(C):
    """Both triads along other axes."""

    def turn(triad):
        return triad @ np.transpose(C)

    return {"gyro": turn, "accel": turn}


def about_vertical(degrees):
    """Both triads turned about z."""
    c, s = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    return turned([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def stretched(time_ns):
    """Stamps of a clock that is fast by 1 % and right in the middle."""
    middle = time_ns[len(time_ns) // 2]
    return middle + ((time_ns - middle) * 1.01).astype(np.int64)


def stood(column):
    """A value that stays as it was first."""
    return column * 0 + column[:1]


def antenna(ahead_m):
    """Velocities and positions of an antenna ahead of the IMU."""
    t = np.arange(M) / GNSS_HZ
    _, _, pitch, heading = motion(t)
    level = np.cos(pitch)
    arm = np.stack([level * np.cos(heading), level * np.sin(heading), -np.sin(pitch)], -1) * ahead_m
    g = drive().gnss
    return {
        "v_n": g.v_n + np.gradient(arm, t, axis=0),
        "lat_rad": g.lat_rad + arm[:, 0] / 6.37e6,
        "lon_rad": g.lon_rad + arm[:, 1] / 6.39e6 / np.cos(0.82),
        "alt_m": g.alt_m - arm[:, 2],
    }


def without(first, count, n):
    """All rows but some."""
    return np.delete(np.arange(n), np.arange(first, first + count))


def two(imu_ns=None, gnss_ns=None):
    """IMU at rest, so that motion has no say, and GNSS; their stamps changed by functions."""

    def make():
        tables = zip((drive().imu, drive().gnss), (imu_ns, gnss_ns), strict=True)
        return [
            dataclasses.replace(rest, time_ns=change(rest.time_ns)) if change else rest
            for table, change in tables
            for rest in [rows_of(table, slice(0, len(table) // 8))]
        ]

    return make


def since_start(factor=1, offset_ns=0):
    """Stamps counted from the start, in another unit."""
    return lambda time_ns: (time_ns - START_NS + offset_ns) * factor


def read_at_once(time_ns):
    """Stamps of a buffer of ten samples: each has that of its last one."""
    return time_ns[np.minimum(np.arange(len(time_ns)) // 10 * 10 + 9, len(time_ns) - 1)]


def in_bursts(time_ns):
    """Stamps of ten samples that arrive 0.2 ms after each other."""
    return read_at_once(time_ns) - 200_000 * (9 - np.arange(len(time_ns)) % 10)


def good_gyro(factor=1.0):
    """Two minutes of rest of a gyro that sees the Earth turn."""
    rng = np.random.default_rng(4)
    n = 12_000
    earth = 7.292115e-5 * np.array([np.cos(0.8), 0.0, -np.sin(0.8)])
    gyro = earth + 2e-6 * rng.standard_normal((n, 3))
    accel = np.array([0.0, 0.0, -9.81]) + 1e-3 * rng.standard_normal((n, 3))
    return ImuTable(np.arange(n) * S // 100, factor * gyro, accel, "rate", source="drive_imu.csv")


def known_slow():
    """A file that states its unit of time, with samples half a second apart."""
    table = rows_of(drive().imu, slice(None, None, 50))
    return Dataset("slow", table, time_unit_known=(table.source,))


def a_path(source="path.csv"):
    """The fixes of the drive as a path, level and to the north."""
    g = drive().gnss
    q_nb = np.tile([1.0, 0.0, 0.0, 0.0], (M, 1))
    return Trajectory(g.time_ns, g.lat_rad, g.lon_rad, g.alt_m, g.v_n, q_nb, source=source)


def with_signs(signs):
    """A change of attitudes: heading, pitch, roll with other signs."""

    def change(q_nb):
        angles = Rotation.from_quat(q_nb, scalar_first=True).as_euler("ZYX") * signs
        return attitudes(*angles.T[::-1])

    return change


def late(delay_s, stated_s=0.0):
    """A master that is late, and says by how much."""

    def make(log=None):
        log = master(time_ns=plus(round(1e9 * delay_s)))(log)
        return dataclasses.replace(log, master_delay_s=stated_s)

    return make


def magnet(field_t):
    """A field that a magnet drives to the stop of the sensor."""
    strong = put((slice(2000, 2030), 2), field_t[2000:2030, 2] - 500e-6)(field_t)
    return np.maximum(strong, -400e-6)


def bump(field_t):
    """A magnet that passes by."""
    near_by = np.exp(-(((np.arange(len(field_t)) - 2500) / 20.0) ** 2))
    return field_t + near_by[:, None] * [40e-6, 0.0, 0.0]


def walked():
    """Fixes of a slow walk that scatter by a third of its way in a second."""
    rng, t = np.random.default_rng(3), np.arange(M) / GNSS_HZ
    course = 0.8 * np.sin(0.3 * t)
    v = 1.4 * np.stack([np.cos(course), np.sin(course), 0.0 * t], axis=-1)
    r = np.cumsum(v, axis=0) / GNSS_HZ + 0.5 * rng.standard_normal(v.shape)
    place = {"lat_rad": 0.8 + r[:, 0] / 6.37e6, "lon_rad": 0.1 + r[:, 1] / (6.39e6 * np.cos(0.8))}
    sigmas = {"sigma_m": np.full(v.shape, 0.5), "sigma_v": np.full(v.shape, 0.05)}
    return gnss(**place, alt_m=100.0 - r[:, 2], v_n=v, **sigmas)()


def banked():
    """An aircraft that turns to the left and right, and never flies straight for a second."""
    rng, t = np.random.default_rng(3), np.arange(N) / IMU_HZ
    roll = 0.7 * np.sin(2 * np.pi * t / 40.0)  # steepest between two whole seconds
    down = -9.81 / np.cos(roll)
    force = np.stack([0.0 * t, 0.0 * t, down], axis=-1) + 0.01 * rng.standard_normal((N, 3))
    turn = 9.81 / 50.0 * np.tan(roll)
    gyro = np.stack([np.gradient(roll, t), turn * np.sin(roll), turn * np.cos(roll)], axis=-1)
    return imu(accel=force, gyro=gyro + 1e-3 * rng.standard_normal((N, 3)))()


def tipped(q_nb):
    """Attitudes to a frame that lies on its side: (1, 0, 1, 0) times each."""
    w, x, y, z = q_nb.T
    return np.sqrt(0.5) * np.stack([w - y, x + z, y + w, z - x], axis=1)


def yawed(q_nb):
    """Attitudes of a body whose x is the sensor's y, and y its -x."""
    w, x, y, z = q_nb.T
    return np.sqrt(0.5) * np.stack([w - z, x + y, y - x, z + w], axis=1)
