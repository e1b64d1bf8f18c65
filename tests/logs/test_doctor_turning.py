"""The doctor on an IMU alone that was turned about by hand: gravity must stand still."""

import dataclasses

import numpy as np
import pytest
from made_logs import found

from robins.dataset import ImuTable


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
    assert found(dataclasses.replace(imu, gyro=-gyro), "error") == ["left_handed"]
