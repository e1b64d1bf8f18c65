"""The doctor on an IMU alone that was turned about by hand: gravity must stand still."""

import numpy as np
import pytest
from made_logs import found, the
from scipy.spatial.transform import Rotation

from robins.dataset import ImuTable
from robins.logs import examine


@pytest.fixture(scope="module")
def by_hand():
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


def spoilt(imu, gyro, accel=None):
    return ImuTable(
        imu.time_ns, gyro, imu.accel if accel is None else accel, "rate", source=imu.source
    )


def errors(imu):
    return [f.code for f in examine(imu) if f.code not in ("not_level", "z_axis_reversed")]


def test_a_healthy_imu_is_silent(by_hand):
    assert errors(by_hand) == []


@pytest.mark.parametrize(
    ("factor", "words"),
    [(180 / np.pi, "deg/s: multiply by pi/180"), (np.pi / 180, "rad/s converted to radians once")],
)
def test_gyros_of_another_unit(by_hand, factor, words):
    f = the(spoilt(by_hand, factor * by_hand.gyro), "gyro_unit")
    assert f.severity == "error"
    assert words in f.sentence


def test_gyros_of_the_opposite_sense_and_left_handed_triads(by_hand):
    assert errors(spoilt(by_hand, -by_hand.gyro)) == ["left_handed"]
    mirror = np.array([1, -1, 1])
    assert errors(spoilt(by_hand, by_hand.gyro * mirror, by_hand.accel * mirror)) == ["left_handed"]


def test_gyro_columns_exchanged(by_hand):
    f = the(spoilt(by_hand, by_hand.gyro[:, [1, 0, 2]]), "gyro_axes")
    assert "The gyros fit as (gyro_y, gyro_x, gyro_z)" in f.sentence


@pytest.mark.parametrize("trial", [1, 7, 15, 24, 28])
def test_real_recordings_by_hand(data_dir, trial):
    """BROAD, with its z up turned down: no error as it is, the fault found where one is put in."""
    (path,) = data_dir.glob(f"broad_{trial:02d}_*.npz")
    with np.load(path) as file:
        rate_hz = float(file["sampling_rate"])
        gyro, accel = (file[k].astype(float) * [1, -1, -1] for k in ("imu_gyr", "imu_acc"))
    time_ns = (np.arange(len(gyro)) * 1e9 / rate_hz).astype(np.int64)
    imu = ImuTable(time_ns, gyro, accel, "rate", source="drive_imu.csv")
    assert found(imu, "error") == []
    assert found(spoilt(imu, -gyro), "error") == ["left_handed"]
