"""Two more healthy logs: a master with its slave, and an IMU that was turned about by hand."""

import numpy as np
from made_logs import START_NS, TOTAL_S, ideal_imu, motion, velocity_ned
from scipy.spatial.transform import Rotation

from robins.dataset import Dataset, ImuTable, Trajectory

ARM = np.array([-6.0, 3.0, -1.5])
MOUNT = Rotation.from_rotvec(np.deg2rad([0.6, -0.4, 0.8]))
ARCMIN = np.deg2rad(1.0 / 60.0)


def attitudes(roll, pitch, heading):
    return Rotation.from_euler("ZYX", np.stack([heading, pitch, roll], -1)).as_quat(
        scalar_first=True
    )


def make_pair(seed, kind="rate", noise_m=2.0):
    """Figures of eight over hills: a slave off its mark and metres away, a noisy master."""
    rng = np.random.default_rng(seed)
    t = np.arange(100 * TOTAL_S + 1) / 100.0
    h = 1e-3
    (gyro, force), (before, _), (after, _) = (ideal_imu(t + k * h) for k in (0, -1, 1))
    force = force + np.cross((after - before) / (2 * h), ARM)
    force += np.cross(gyro, np.cross(gyro, ARM))
    gyro, force = MOUNT.inv().apply(gyro), MOUNT.inv().apply(force)
    gyro = gyro + [1e-4, -2e-4, 1e-4] + 1e-3 * rng.standard_normal(gyro.shape)
    force = force + [0.02, -0.03, 0.01] + 0.02 * rng.standard_normal(force.shape)
    ns = START_NS + np.round(t * 1e9).astype(np.int64)
    slave = ImuTable(ns, gyro, force, kind="rate", source="slave.csv")
    if kind == "increment":
        means = (np.concatenate([a[:1], 0.5 * (a[1:] + a[:-1])]) * 0.01 for a in (gyro, force))
        slave = ImuTable(ns, *means, kind="increment", source="slave.csv")
    at = np.arange(10 * TOTAL_S) / 10.0
    _, roll, pitch, heading = motion(at)
    v_n = velocity_ned(at)
    way = np.cumsum(v_n, axis=0) / 10.0 + noise_m * rng.standard_normal(v_n.shape)
    q = Rotation.from_quat(attitudes(roll, pitch, heading), scalar_first=True)
    q = q * Rotation.from_rotvec(ARCMIN * rng.standard_normal(v_n.shape))
    master = Trajectory(
        START_NS + np.round(at * 1e9).astype(np.int64),
        0.82 + way[:, 0] / 6.37e6,
        0.14 + way[:, 1] / 6.39e6 / np.cos(0.82),
        430.0 - way[:, 2],
        v_n + 0.03 * rng.standard_normal(v_n.shape),
        q.as_quat(scalar_first=True),
        source="master.csv",
    )
    return Dataset("pair", slave, master=master)


def make_by_hand():
    """70 s of turning through all attitudes with the wobble of a hand, then 10 s at rest."""
    t = np.arange(8001) / 100.0
    s = np.minimum(t, 70.0)
    h = 1e-5

    def attitude(s):
        angles = [1.5 * np.sin(0.31 * s), 1.1 * np.sin(0.23 * s), 2.5 * np.sin(0.17 * s)]
        return Rotation.from_euler("xyz", np.stack(angles, axis=-1))

    rate = (attitude(s - h).inv() * attitude(s + h)).as_rotvec() / (2 * h)
    rate[t > 70.0] = 0.0
    sway = 0.5 * np.sin(np.outer(t, [3.1, 2.7, 3.7])) * (t < 70.0)[:, None]
    force = attitude(s).inv().apply(sway - np.array([0.0, 0.0, 9.81]))
    rng = np.random.default_rng(2)
    return ImuTable(
        time_ns=np.arange(8001) * 10_000_000,
        gyro=rate + 1e-3 * rng.standard_normal(rate.shape) + 2e-3,
        accel=force + 0.02 * rng.standard_normal(force.shape),
        kind="rate",
        source="drive_imu.csv",
    )
