"""The command `export`: a filter of a scenario as C, compiled and checked as its page says."""

import json
import subprocess

import pytest

SCENARIO = "transfer-alignment/s0", "--filter", "kf-flexure"


@pytest.fixture
def made(robins, tmp_path):
    return robins("export", *SCENARIO, "--to", "alignment", "--json"), tmp_path / "alignment"


def test_the_folder_compiles_and_agrees_with_jax(made):
    answer, folder = made
    assert answer.status == 0, answer.err
    said = json.loads(answer.out)
    assert said["folder"] == "alignment"
    assert sorted(said["files"]) == sorted(p.name for p in folder.iterdir())
    done = subprocess.run(["make", "-C", str(folder), "check"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "60 steps: 0 codes differ" in done.stdout
    header = (folder / "robins.h").read_text()
    assert "int robins_update_attitude_matching(robins_state *state," in header
    assert "rad" in header


def test_what_is_there_is_not_written_over(robins, tmp_path):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine.c").write_text("int main(void) { return 0; }")
    answer = robins("export", *SCENARIO, "--to", "full")
    assert answer.status == 2
    assert "not empty" in answer.err
    assert [p.name for p in (tmp_path / "full").iterdir()] == ["mine.c"]


def test_a_filter_that_is_not_there_is_refused(robins, tmp_path):
    answer = robins("export", "transfer-alignment/s0", "--filter", "kf-flexur", "--to", "x")
    assert answer.status == 2
    assert "kf-flexure" in answer.err
    assert not (tmp_path / "x").exists()
