"""The command `export`: a filter of a scenario as C, compiled and checked as its page says."""

import json
import subprocess

import pytest
from exported import found, spoil

pytestmark = pytest.mark.usefixtures("unchecked")

SCENARIO = "transfer-alignment/s0", "--filter", "kf"


def test_the_folder_compiles_and_agrees_with_jax_in_every_output(robins, tmp_path):
    answer, folder = (
        robins("export", *SCENARIO, "--to", "alignment", "--json"),
        tmp_path / "alignment",
    )
    assert answer.status == 0, answer.err
    said = json.loads(answer.out)
    assert said["real"] == "double"
    assert said["cost"] is None
    assert said["folder"] == "alignment"
    assert sorted(said["files"]) == sorted(p.name for p in folder.iterdir())
    done = subprocess.run(["make", "-C", str(folder), "check"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "60 steps: 0 codes differ" in done.stdout
    header = (folder / "robins.h").read_text()
    assert "int robins_update_attitude_matching(robins_state *state," in header
    assert "robins_real sigma[3]; /* rad: its standard deviation;" in header
    assert "int robins_reset(robins_state *state, const robins_reset_belief *belief," in header
    outputs = spoil(folder, "robins")
    named = {name for entry, name in outputs if entry == "robins_update_attitude_matching"}
    assert named >= {f"result.{name}" for name in ("nis", "innovation", "sigma", "dof", "used")}
    whole, *statuses = found(folder, len(outputs))
    assert whole == 0
    assert not [one for one, status in zip(outputs, statuses, strict=True) if status == 0]


def test_single_precision_tells_what_it_costs(robins, tmp_path):
    answer = robins("export", *SCENARIO, "--to", "single", "--float32", "--json")
    assert answer.status == 0, answer.err
    said, folder = json.loads(answer.out), tmp_path / "single"
    cost = said["cost"]
    assert said["real"] == "float"
    assert cost["bearable"]
    assert cost["codes_off"] == 0
    assert cost["codes"] == 2 * cost["runs"] * cost["steps"] > 2 * 60
    assert [block["name"] for block in cost["blocks"]] == ["attitude", "gyro_bias", "mounting"]
    for block in cost["blocks"]:  # doubles are not floats, and floats are near
        assert block["rms"] != block["rms_single"]
        assert block["rms_single"] == pytest.approx(block["rms"], rel=0.01)
    # In a step a number goes through sums of n terms in the prediction, the innovation, the gain
    # and the correction. Each rounds by n units at most; at worst all steps add up.
    n, unit = 9, 2.0**-24
    most = cost["steps"] * 4 * n * unit
    assert all(unit / 4 < part < most for part in cost["fields"].values())
    page = (folder / "README.md").read_text()
    assert f"**{cost['verdict']}**" in page
    assert f"0 of {cost['codes']} codes differ" in page
    assert "typedef float robins_real;" in (folder / "robins.h").read_text()
    done = subprocess.run(
        ["make", "-C", str(folder), "check", "CC=cc -Werror"], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert "60 steps: 0 codes differ" in done.stdout


def test_a_filter_of_logs_compiles_and_agrees_with_jax(robins, tmp_path):
    """A configuration of the user's own, of a unit without a magnetometer."""
    (tmp_path / "unit.toml").write_text('system = "marg"\nuse_magnetometer = "never"\n')
    answer = robins("export", "unit.toml", "--to", "unit", "--set", "update.block=20 ms", "--json")
    assert answer.status == 0, answer.err
    assert json.loads(answer.out)["filter"] == "marg"
    folder = tmp_path / "unit"
    header = (folder / "robins.h").read_text()
    assert "Filter 'marg' of unit" in header
    assert "robins_real theta_b[2][3]; /* rad, body: rotation vector of each interval" in header
    assert "magnetometer" not in header
    assert "6 to 8: place [m], NED: north, east, down" in header
    quick = "CFLAGS=-std=c99 -O0 -Wall -Wextra -Wconversion -Wpedantic -Werror"
    done = subprocess.run(
        ["make", "-C", str(folder), "check", quick], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert "60 steps: 0 codes differ" in done.stdout


@pytest.mark.parametrize(
    ("name", "message"),
    [
        (("marg/replay", "--filter", "marg-smoothed"), "no filter 'marg-smoothed' in marg/replay"),
        (("ins-gnss/replay",), "ins-gnss/replay describes what is recorded and simulates nothing"),
        (("marg/replay", "--set", "gyro.bia=1 deg/s"), "gyro.bia"),
    ],
)
def test_what_cannot_be_tried_is_refused(robins, tmp_path, name, message):
    answer = robins("export", *name, "--to", "x")
    assert answer.status == 2
    assert message in answer.err
    assert not (tmp_path / "x").exists()


def test_what_is_there_is_not_written_over_and_nothing_of_it_is_run(robins, tmp_path):
    (tmp_path / "full").mkdir()
    runs = "open('ran', 'w')\n"
    files = {"mine.c": "", "json.py": runs, "robins.py": runs, "Makefile": "all:\n\ttouch ran\n"}
    for name, text in files.items():
        (tmp_path / "full" / name).write_text(text)
    answer = robins("export", *SCENARIO, "--to", "full")
    assert answer.status == 2
    assert "not empty" in answer.err
    for command in (["run", "full"], ["export", "full", "--to", "x"]):
        assert robins(*command).status == 2
    assert {p.name for p in (tmp_path / "full").iterdir()} == set(files)
    assert not (tmp_path / "ran").exists()


def test_a_filter_that_is_not_there_is_refused(robins, tmp_path):
    answer = robins("export", "transfer-alignment/s0", "--filter", "kf-flexur", "--to", "x")
    assert answer.status == 2
    assert "kf-flexure" in answer.err
    assert not (tmp_path / "x").exists()
