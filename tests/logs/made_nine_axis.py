"""A nine-axis sensor that tumbles in a steady field, and files that hold what it saw."""

import io

import numpy as np

from robins.dataset import AttitudeTable, Dataset, ImuTable, MagTable

HZ = 100.0
FIELD_ENU_UT = np.array([0.9, 20.5, -44.1])  # Berlin, about
AXIS = np.array([2.0, -1.0, 2.0]) / 3.0


def angles(t):
    """Turned about the vertical, and about AXIS of the sensor [rad]: rest for 5 s, then both."""
    s = np.maximum(t - 5.0, 0.0)
    begin = s**2 / (s**2 + 4.0)  # no step in the rate
    return 2.0 * begin * np.sin(0.4 * s), 2.5 * begin * np.sin(1.1 * s)


def matrices(axis, angle):
    """(n, 3, 3) rotations about an axis, by Rodrigues' formula."""
    x, y, z = axis
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return (
        np.eye(3)
        + np.sin(angle)[:, None, None] * K
        + (1.0 - np.cos(angle))[:, None, None] * (K @ K)
    )


def tumble(seconds=40.0, seed=3):
    """Arrays as BROAD names them."""
    rng = np.random.default_rng(seed)
    t = np.arange(round(seconds * HZ)) / HZ
    heading, angle = angles(t)
    about_axis = matrices(AXIS, angle)
    C_ns = matrices([0.0, 0.0, 1.0], heading) @ about_axis
    rates = [
        (after - before) / 2e-5
        for before, after in zip(angles(t - 1e-5), angles(t + 1e-5), strict=True)
    ]
    rate = about_axis[:, 2, :] * rates[0][:, None] + AXIS * rates[1][:, None]
    c, s = np.cos(heading / 2), np.sin(heading / 2)
    w, (x, y, z) = np.cos(angle / 2), AXIS[:, None] * np.sin(angle / 2)
    q = np.stack([c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w], axis=1)
    q[-50:-30] = np.nan

    def seen(vector, sigma):
        exact = np.einsum("nji,j->ni", C_ns, vector)
        return exact + sigma * rng.standard_normal(exact.shape)

    return {
        "imu_gyr": rate + 2e-3 * rng.standard_normal((len(t), 3)),
        "imu_acc": seen([0.0, 0.0, 9.81], 0.02),
        "imu_mag": seen(FIELD_ENU_UT, 0.3),
        "opt_quat": q,
        "opt_pos": np.zeros((len(t), 3)),
        "movement": t > 6.0,
        "sampling_rate": np.array(HZ),
    }


def archive(arrays):
    """The arrays as a compressed NumPy archive."""
    file = io.BytesIO()
    np.savez_compressed(file, **arrays)
    return file.getvalue()


def broad_bytes(seconds=3.0):
    """A short trial as a file."""
    return archive(tumble(seconds))


def tumble_dataset(seconds=40.0):
    """The same as tables, put together without a reader."""
    a = tumble(seconds)
    time_ns = np.round(np.arange(len(a["imu_gyr"])) / HZ * 1e9).astype(np.int64)
    name = "tumble.npz"
    return Dataset(
        "tumble",
        ImuTable(time_ns, a["imu_gyr"], a["imu_acc"], "rate", source=name),
        mag=MagTable(time_ns, a["imu_mag"] * 1e-6, source=name),
        attitude=AttitudeTable(time_ns, a["opt_quat"], "ENU", moving=a["movement"], source=name),
    )


def level_dataset():
    """Flat on a table, turned slowly by 90 degrees about the vertical and back; z up."""
    rng = np.random.default_rng(5)
    t = np.arange(round(50.0 * HZ)) / HZ
    rate_z = np.deg2rad(9.0) * ((t >= 10.0) & (t < 20.0)) - np.deg2rad(9.0) * (t >= 40.0)
    heading = np.cumsum(rate_z) / HZ
    field = np.einsum("nji,j->ni", matrices([0.0, 0.0, 1.0], heading), FIELD_ENU_UT)
    gyro = rate_z[:, None] * [0.0, 0.0, 1.0] + 2e-3 * rng.standard_normal((len(t), 3))
    force = np.array([0.0, 0.0, 9.81]) + 0.02 * rng.standard_normal((len(t), 3))
    field = field + 0.3 * rng.standard_normal((len(t), 3))
    time_ns, source = np.round(t * 1e9).astype(np.int64), "level.csv"
    return Dataset(
        "level",
        ImuTable(time_ns, gyro, force, "rate", source=source, body="RFU"),
        mag=MagTable(time_ns, field * 1e-6, source=source, body="RFU"),
    )
