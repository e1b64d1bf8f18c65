"""Logs that several tests look at."""

import pytest
from made_logs import make_drive


@pytest.fixture(scope="session")
def drive():
    """12 s at rest, a minute of figures of eight; 100 Hz IMU of a consumer, 5 Hz RTK."""
    return make_drive()


@pytest.fixture(scope="session")
def walk_files(data_dir):
    """The GNSS_IMU walk: IMU and GNSS file."""
    return [data_dir / "gnssimu_walk_imu.csv.xz", data_dir / "gnssimu_walk_gnss.pos.xz"]
