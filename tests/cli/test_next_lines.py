"""The line that the doctor ends with is run, and so is what an error says to do."""

import re
import shlex

import numpy as np
import pytest
from log_samples import SAMPLES
from made_rosbag import FIX, IMU, NS, fix, imu, rosbag

from robins.cli import main

ENDS = {"phone-csv": "csv", "px4-ulog": "ulg", "ros-mcap": "mcap"}  # with an IMU and positions


def bag(speed, seconds=14):
    """A level vehicle that drives evenly, with a receiver that states no velocity and no sigma."""
    rng, begin, out = np.random.default_rng(1), 1_756_402_219 * NS, []
    for k in range(50 * seconds):
        now = begin + k * NS // 50
        shake = (0.3 if speed else 0.01) * rng.normal(size=3)
        gyro = rng.normal(0.0, 1e-3, 3)
        out.append(("/imu", IMU, imu(now, tuple(gyro), (*shake[:2], shake[2] + 9.81))))
        if k % 25 == 5:
            way = speed * k / 50 / 6.37e6 * np.array([0.8, 0.6 / np.cos(np.radians(48.0))])
            north, east = np.degrees(way + 0.2 / 6.37e6 * rng.normal(size=2))
            place = (48.0 + north, 11.0 + east, 500.0)
            out.append(("/fix", FIX, fix(now, place, (1.0, 1.0, 4.0), kind=0)))
    return rosbag(out)


@pytest.fixture
def robins(tmp_path, monkeypatch, capsys):
    """Run words in an empty folder: status and what was printed."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setattr("jaxtyping.config.jaxtyping_disable", True)

    def run(*words):
        status = main(list(words))
        return status, *capsys.readouterr()

    return run


@pytest.mark.parametrize("name", ENDS)
def test_of_a_sample_with_errors_it_says_to_mend_them(robins, tmp_path, name):
    """These few rows are too short to navigate; the replay refuses them by the same sentences."""
    content = SAMPLES[name]
    path = tmp_path / f"log.{ENDS[name]}"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    status, out, _ = robins("doctor", path.name)
    assert status == 2
    assert "Next:   mend the errors" in out
    error = next(line for line in out.splitlines() if line.startswith("error: "))
    status, _, told = robins("replay", path.name)
    assert status == 2
    assert error.removeprefix("error: ") in told


def test_of_a_log_that_begins_in_motion_it_navigates(robins, tmp_path):
    (tmp_path / "drive.mcap").write_bytes(bag(speed=10.0))
    status, out, _ = robins("doctor", "drive.mcap")
    (line,) = [one for one in out.splitlines() if one.startswith("Next:")]
    assert status == 0
    command, *words = shlex.split(line.removeprefix("Next:"))
    assert command == "robins"
    status, out, told = robins(*words, "--filters", "ekf")
    assert status == 0
    assert out.startswith(("Consistent: ekf", "With care: ekf"))
    found = re.search(r"heading ([0-9.]+) deg from the course of positions", out)
    assert float(found[1]) == pytest.approx(36.87, abs=5.0)
    assert "that of the kind is assumed" in out
    assert "[gnss] sigma" in told
    (line,) = [one for one in out.splitlines() if one.startswith("Next:")]
    assert line.endswith("   fixes scatter by less than assumed")
    command, *words = shlex.split(line.removeprefix("Next:").rsplit("   ", 1)[0])
    assert command == "robins"
    status, out, _ = robins(*words)
    assert status == 0
    assert "north, east, down, from gnss.sigma." in out
    assert "--export csv   writes the estimates as a table" in out


def test_what_the_doctor_writes_is_in_the_line(robins, tmp_path):
    """A file that could not be written is not named."""
    lines = {}
    for name, speed, status in (("rest", 0.0, 0), ("drive", 10.0, 2)):
        (tmp_path / f"{name}.mcap").write_bytes(bag(speed))
        found = robins("doctor", f"{name}.mcap", "--write", f"{name}.toml")
        assert found[0] == status
        (lines[name],) = [one for one in found[1].splitlines() if one.startswith("Next:")]
    assert lines["rest"] == "Next:   robins replay rest.mcap rest.toml"
    assert 'system = "ins-gnss"' in (tmp_path / "rest.toml").read_text()
    assert lines["drive"] == "Next:   robins replay drive.mcap"
    assert "the log tells nothing of its unit" in found[2]


def test_where_no_heading_is_known_the_mend_of_the_error_navigates(robins, tmp_path):
    (tmp_path / "rest.mcap").write_bytes(bag(speed=0.0))
    status, _, told = robins("replay", "rest.mcap")
    assert status == 2
    assert "give start.known_heading" in told
    words = ["--filters", "ekf", "--set", "start.known_heading=30 deg", "--set", "gnss.sigma=0.3 m"]
    status, out, _ = robins("replay", "rest.mcap", *words)
    assert status == 0
    assert "heading given as 30.0 deg" in out
    assert "from gnss.sigma" in out
