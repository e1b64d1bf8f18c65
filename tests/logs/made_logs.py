"""A healthy synthetic log, made here with NumPy alone, in closed form but for its noise."""

import dataclasses

import numpy as np

from robins.dataset import Dataset, GnssTable, ImuTable
from robins.logs import examine

IMU_HZ, GNSS_HZ = 100, 5
REST_S, TOTAL_S = 12.0, 80.0
LAT_DEG, LON_DEG, ALT_M = 47.0, 8.0, 430.0
START_NS = 1_700_000_000_000_000_000


def motion(t):
    """Speed, roll, pitch, heading over time: rest, then figures of eight over hills."""
    s = np.maximum(t - REST_S, 0.0)
    begin = s**2 / (s**2 + 25.0)  # smooth: speed and its first derivative start at zero
    speed = begin * (9.0 + 3.0 * np.sin(0.31 * s))
    roll = begin * 0.06 * np.sin(0.57 * s)
    pitch = begin * 0.08 * np.sin(0.23 * s + 1.0)
    heading = 0.4 + begin * 1.9 * np.sin(0.17 * s)
    return speed, roll, pitch, heading


def velocity_ned(t):
    speed, _, pitch, heading = motion(t)
    level = speed * np.cos(pitch)
    return np.stack(
        [level * np.cos(heading), level * np.sin(heading), -speed * np.sin(pitch)], axis=-1
    )


def slope(f, t, h=1e-4):
    """Central difference; its error, about 1e-8, is far below the noise."""
    return (f(t + h) - f(t - h)) / (2 * h)


def ideal_imu(t):
    """Angular rate and specific force, forward-right-down, over a flat Earth that stands still."""
    _, roll, pitch, heading = motion(t)
    roll_rate, pitch_rate, heading_rate = (slope(lambda u, k=k: motion(u)[k], t) for k in (1, 2, 3))
    gyro = np.stack(
        [
            roll_rate - heading_rate * np.sin(pitch),
            pitch_rate * np.cos(roll) + heading_rate * np.sin(roll) * np.cos(pitch),
            heading_rate * np.cos(roll) * np.cos(pitch) - pitch_rate * np.sin(roll),
        ],
        axis=-1,
    )
    a_n = slope(velocity_ned, t) - [0.0, 0.0, 9.807]
    cr, sr, cp, sp = np.cos(roll), np.sin(roll), np.cos(pitch), np.sin(pitch)
    ch, sh = np.cos(heading), np.sin(heading)
    rows = (  # C_bn
        (cp * ch, cp * sh, -sp),
        (sr * sp * ch - cr * sh, sr * sp * sh + cr * ch, sr * cp),
        (cr * sp * ch + sr * sh, cr * sp * sh - sr * ch, cr * cp),
    )
    C_bn = np.stack([np.stack(r, -1) for r in rows], -2)
    return gyro, np.einsum("nij,nj->ni", C_bn, a_n)


def make_drive(seed=7):
    rng = np.random.default_rng(seed)
    t = np.arange(round(TOTAL_S * IMU_HZ) + 1) / IMU_HZ
    gyro, accel = ideal_imu(t)
    gyro = gyro + [2e-3, -1e-3, 3e-3] + 1e-3 * rng.standard_normal(gyro.shape)
    accel = accel + [0.02, -0.03, 0.01] + 0.02 * rng.standard_normal(accel.shape)
    imu = ImuTable(
        time_ns=START_NS + np.round(t * 1e9).astype(np.int64),
        gyro=gyro,
        accel=accel,
        kind="rate",
        source="drive_imu.csv",
        rows=np.arange(2, len(t) + 2),
    )
    fine = np.arange(round(TOTAL_S * 1000) + 1) / 1000.0
    v = velocity_ned(fine)
    steps = 0.5 * (v[1:] + v[:-1]) / 1000.0
    path = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])[:: 1000 // GNSS_HZ]
    at = fine[:: 1000 // GNSS_HZ]
    r = path + 0.02 * rng.standard_normal(path.shape)
    lat0 = np.deg2rad(LAT_DEG)
    # Radii of curvature at 47 deg (meridian, prime vertical) from the textbook formula.
    w = 1.0 - 0.00669437999014 * np.sin(lat0) ** 2
    transverse = 6378137.0 / np.sqrt(w)
    meridian = transverse * (1.0 - 0.00669437999014) / w
    gnss = GnssTable(
        time_ns=START_NS + np.round(at * 1e9).astype(np.int64),
        lat_rad=lat0 + r[:, 0] / (meridian + ALT_M),
        lon_rad=np.deg2rad(LON_DEG) + r[:, 1] / ((transverse + ALT_M) * np.cos(lat0)),
        alt_m=ALT_M - r[:, 2],
        sigma_m=np.full(r.shape, 0.02),
        v_n=velocity_ned(at) + 0.03 * rng.standard_normal(r.shape),
        sigma_v=np.full(r.shape, 0.03),
        quality=np.ones(len(at), int),
        source="drive_gnss.pos",
        rows=np.arange(3, len(at) + 3),
    )
    return Dataset("drive", imu, gnss)


def with_imu(data, **changes):
    """The dataset with columns of its IMU table replaced."""
    return dataclasses.replace(data, imu=dataclasses.replace(data.imu, **changes))


def with_gnss(data, **changes):
    """The dataset with columns of its GNSS table replaced."""
    return dataclasses.replace(data, gnss=dataclasses.replace(data.gnss, **changes))


def rows_of(table, keep):
    """The table with some rows only, by a plain loop over its fields."""
    arrays = {
        f.name: getattr(table, f.name)[keep]
        for f in dataclasses.fields(table)
        if isinstance(getattr(table, f.name), np.ndarray)
    }
    return dataclasses.replace(table, **arrays)


def found(subject, severity=None):
    """Codes of all findings, or of those of one severity."""
    return [f.code for f in examine(subject) if severity in (None, f.severity)]
