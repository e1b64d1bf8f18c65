"""Logs that several tests look at, and who found what in them."""

import pytest
from made_spoilt import drive as make_drive

from robins.logs.doctor import Check


@pytest.fixture(scope="session")
def drive():
    """12 s at rest, a minute of figures of eight; 100 Hz IMU of a consumer, 5 Hz RTK."""
    return make_drive()


@pytest.fixture(scope="session")
def walk_files(data_dir):
    """The GNSS_IMU walk: IMU and GNSS file."""
    return [data_dir / "gnssimu_walk_imu.csv.xz", data_dir / "gnssimu_walk_gnss.pos.xz"]


@pytest.fixture(autouse=True)
def told(monkeypatch):
    """Which check found what in this test; one that its row does not declare fails the test."""
    heard = []
    ask = Check.run

    def checked(check, things):
        found = ask(check, things)
        for f in found:
            assert any(f.code == code.name and f.severity in code.severity for code in check.codes)
        heard.extend((check.find.__name__, f) for f in found)
        return found

    monkeypatch.setattr(Check, "run", checked)
    return heard
