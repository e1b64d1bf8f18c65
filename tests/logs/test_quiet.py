"""What the doctor looks at: an IMU table as rates."""

import dataclasses

import numpy as np
from made_logs import rows_of

from robins.logs.quiet import signal_of


def test_an_increment_after_lost_ones_is_the_rate_of_its_own_interval(drive):
    imu = drive.imu
    sums = dataclasses.replace(imu, gyro=imu.gyro * 0.01, accel=imu.accel * 0.01, kind="increment")
    keep = np.delete(np.arange(len(imu)), [500, 900, 901, 902])
    signal = signal_of(rows_of(sums, keep))
    np.testing.assert_allclose(signal.accel, imu.accel[keep], atol=1e-9)
    np.testing.assert_allclose(signal.gyro, imu.gyro[keep], atol=1e-9)
