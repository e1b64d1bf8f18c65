"""The example of a board in the place of the gyro: the satellite flies with it."""

import json
import shutil
import subprocess

import pytest
from stations import on_threads

from robins.bench.ports.cable import cable
from robins.bench.rigs.satellite.messages import WIRE
from robins.bench.wire.c_header import firmware
from robins.cli import main

pytestmark = pytest.mark.skipif(shutil.which("gcc") is None, reason="needs a C compiler, gcc")
SECONDS = 20
STEPS = 10 * SECONDS
STAR_ARCSEC = 10.0  # noise of the star sensor, across its axis


@pytest.mark.usefixtures("sketched")
def test_a_board_takes_the_place_of_the_gyro(tmp_path, capsys, monkeypatch):
    on_threads(monkeypatch)  # the other parts
    for name, text in firmware(WIRE).items():
        (tmp_path / name).write_text(text)
    command = ["gcc", "-std=c99", "-O0", "gyro_board.c", "platform_posix.c", "-lm", "-o", "board"]
    subprocess.run(command, cwd=tmp_path, check=True)
    with cable() as ends, subprocess.Popen([tmp_path / "board", ends.board]) as board:
        asked = ["--node", f"gyro={ends.bench}", "--seconds", str(SECONDS), "--json"]
        status = main(["bench", "up", "satellite/s1", *asked, "--out", str(tmp_path / "out")])
        board.kill()
    answer = capsys.readouterr()
    assert status == 0, answer.err
    said = json.loads(answer.out)
    counts = said["counts"]
    assert (said["steps"], said["failure"]) == (STEPS, "")
    assert (counts["wrong_frames"], counts["lost_frames"], counts["silent_parts"]) == (0, 0, 0)
    assert counts["steps_without_gyro"] == 1  # the first: no turn is known yet
    assert counts["steps_in_safe_mode"] == 0
    assert said["attitude_rms_arcsec"] < 3 * STAR_ARCSEC
