"""The filter of the satellite, exported as C, as the part that determines the attitude."""

import json
import shutil
import subprocess
from functools import partial
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from stations import Loop, config, on_threads, parts
from test_firmware import SANITISERS, Board, build, sanitised, unpacked

from robins.bench.ports.cable import cable
from robins.bench.ports.port import open_pair
from robins.bench.rigs.satellite.messages import HELD, SAFE, SHORT, SILENT, USED, WIRE
from robins.cli import main
from robins.filters import OnlineFilter
from robins.program import NativeState
from robins.systems.satellite.nodes import STAR, plausible_attitude
from robins.workbench.export import SMALL, export_filter

pytestmark = pytest.mark.skipif(shutil.which("gcc") is None, reason="needs a C compiler, gcc")
SETTINGS = "duration=60 s", "counted_from=10 s"
FLAGSHIP = "mixed-bias"
STEPS = 170
# Steps in which something does not reach the filter: one sample of the gyro, two in a row, frames
# of the star sensor for longer than it may be silent; and a frame of no length.
NO_GYRO, NO_STAR, NO_LENGTH = (30, 60, 61), range(90, 130), range(48, 53)
RESET = 147  # by the operator, before this step


@pytest.fixture(scope="module")
def of():
    return config("satellite/s1", "mekf", *SETTINGS)._replace(machine="vm")


@pytest.fixture(scope="module")
def program(tmp_path_factory):
    """The board, as docs/board.md builds it; every access to memory checked where that can be."""
    folder = tmp_path_factory.mktemp("adm")
    export_filter("satellite/s1", folder / "c", filter_name="mekf", settings=SETTINGS)
    unpacked(folder / "c")
    extra = SANITISERS if sanitised(folder) else []
    sources = "adm_board.c", "robins.c", "platform_posix.c"
    return build(folder / "c", *sources, extra=("-O0", "-ffp-contract=off", *extra))


def series(of, meddled):
    """Inputs of the filter in each step, and the answers of the part in Python."""
    reached = [{} for _ in range(STEPS)]

    def meddle(step, name, taker, payload):
        if taker == "adm":
            if meddled and (step in NO_GYRO if name == "gyro" else step in NO_STAR):
                return []
            if meddled and name == "star" and step in NO_LENGTH:
                said = WIRE.decode(name, payload)
                payload = WIRE.encode(name, {**said, "q_ib": 0.9 * said["q_ib"]})
            reached[step][name] = WIRE.decode(name, payload)
        return [((step + 1) * of.step_ns, payload)]

    loop = Loop(of, meddle).run(RESET)
    if meddled:
        reached[RESET]["mode"] = {"mode": 2, "reset": 1}
        payload = WIRE.encode("mode", reached[RESET]["mode"])
        loop.to("adm", "mode", payload, RESET * of.step_ns)
    return reached, loop.run(STEPS - RESET)


def answers(program, of, reached, first=0):
    """Answers of the board to the same inputs from a step on, by message."""
    told = {"estimate": [], "innovation": [], "done": []}
    with open_pair() as pair:
        board = Board(program, pair)
        try:
            board.begin(5, of.step_ns)
            for k, inputs in enumerate(reached[first:], first):
                time_ns = (k + 1) * of.step_ns
                for name, values in inputs.items():
                    board.send(name, time_ns - of.step_ns * (name == "mode"), **values)
                board.send("tick", time_ns, step=k)
                while len(told["done"]) <= k - first:
                    frame = board.frame()
                    assert frame is not None, f"no answer in step {k}"
                    name = WIRE.message(frame.header.type).name
                    told[name].append(WIRE.decode(name, frame.payload))
        finally:
            board.process.kill()
            board.process.communicate()
    return told


def all_of(rows, field):
    return np.array([row[field] for row in rows])


def test_it_says_what_the_part_says_whatever_is_missing(program, of):
    reached, loop = series(of, meddled=True)
    told = answers(program, of, reached)
    fields_of = {"estimate": ("q_ib", "gyro_bias", "sigma"), "innovation": ("ratio", "sigma")}
    for name, fields in fields_of.items():
        for field in fields:
            want, got = loop.all(name, field), all_of(told[name], field)
            np.testing.assert_allclose(got, want, rtol=1e-9, atol=1e-15, err_msg=field)
    want, got = (x for x in (loop.all("innovation", "innovation"), told["innovation"]))
    np.testing.assert_allclose(all_of(got, "innovation"), want, rtol=0.0, atol=1e-15)
    flags = all_of(told["estimate"], "flags").astype(int)
    np.testing.assert_array_equal(flags, loop.flags())
    for flag in (HELD, SAFE, SHORT, SILENT, USED):
        assert np.any(flags & flag)


def test_one_that_comes_late_waits_for_a_star_frame_as_the_part_does(program, of):
    """As after a loss of power: its state is not that of the run."""
    reached, _ = series(of, meddled=False)
    told, part = answers(program, of, reached, first=52)["estimate"], parts(of)["adm"]
    state, wanted = part.begin(), []
    for k in range(52, STEPS):
        state, said = part.act(state, k, {name: reached[k].get(name) for name in part.takes})
        wanted.append(dict(said)["estimate"])
    flags = all_of(told, "flags")
    np.testing.assert_array_equal(flags, all_of(wanted, "flags"))
    assert flags[0] & SAFE
    assert not flags[-1] & SAFE
    for field in ("q_ib", "gyro_bias", "sigma"):
        got, want = all_of(told, field), all_of(wanted, field)
        np.testing.assert_allclose(got, want, rtol=1e-9, atol=1e-15, err_msg=field)


def test_it_has_the_bits_of_the_same_filter_in_c_on_the_host(program, of):
    reached, loop = series(of, meddled=False)
    told = answers(program, of, reached)["estimate"]
    host = OnlineFilter(of.filter, of.model, of.start, partial(NativeState, unroll=SMALL))
    for k, inputs in enumerate(reached):
        host.predict(inputs["gyro"]["theta_b"])
        if "star" in inputs:
            host.update(plausible_attitude(jnp.asarray(inputs["star"]["q_ib"])), STAR)
        mean = host.belief.mean
        np.testing.assert_array_equal(told[k]["q_ib"], mean.attitude.wxyz)
        np.testing.assert_array_equal(told[k]["gyro_bias"], mean.gyro_bias)
    np.testing.assert_allclose(all_of(told, "q_ib"), loop.all("estimate", "q_ib"), atol=1e-14)


@pytest.mark.skipif(shutil.which("g++") is None, reason="needs a C++ compiler")
def test_it_compiles_as_c_plus_plus_too(program):
    flags = ["-std=c++11", "-Wall", "-Wextra", "-Werror", "-fsyntax-only", "-x", "c++"]
    command = ["g++", *flags, "adm_board.c", "robins.c"]
    where = Path(program).parent
    built = subprocess.run(command, cwd=where, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stderr


@pytest.mark.usefixtures("sketched")
def test_from_a_design_to_a_board_in_three_commands(tmp_path, capsys):
    """docs/from-design-to-board.md: exported and built, flown and recorded, heard again."""
    of = ["satellite/s1", "--filter", FLAGSHIP, *(f"--set={one}" for one in SETTINGS)]
    folder, out = tmp_path / "adm", tmp_path / "out"
    assert main(["export", *of, "--to", str(folder), "--board", "--json"]) == 0
    built = json.loads(capsys.readouterr().out)["program"]
    series = ["bench", "up", *of, "--node", f"adm={built}", "--seconds", "20"]
    assert main([*series, "--out", str(out), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert (said["steps"], said["failure"]) == (200, "")
    # the closed loop with the C on its line is that of the same filter inside one program
    assert 0.0 <= said["max_abs_difference_in_process"] < 1e-13
    assert said["attitude_rms_arcsec"] < 30.0
    assert (out / "report.html").exists()
    again = ["bench", "replay", str(out / "record.mcap"), "--node", "adm", "--json"]
    assert main(again) == 0
    heard = json.loads(capsys.readouterr().out)
    assert heard["same"]
    # who hears it is the program: another one in its place answers otherwise
    Path(built).write_text("#!/bin/sh\nexit 3\n")
    assert main(again) == 2  # the record names a program that has changed
    assert f"--trust {built}" in capsys.readouterr().err
    assert main([*again, "--trust", built]) != 0
    assert "died" in capsys.readouterr().err


def test_what_is_no_part_of_a_rig_is_not_built(tmp_path, capsys):
    of = ["export", "rocket/a1", "--filter", "ekf", "--to", str(tmp_path / "c"), "--board"]
    assert main(of) == 2
    assert "no part of the bench is made of a filter of rocket" in capsys.readouterr().err
    assert not (tmp_path / "c").exists()


@pytest.mark.usefixtures("sketched")
def test_the_satellite_flies_with_it_over_a_cable(program, tmp_path, capsys, monkeypatch):
    on_threads(monkeypatch)  # the other parts
    common = ["bench", "up", "satellite/s1", "--seconds", "20", "--json"]
    asked = [*common, *(f"--set={one}" for one in SETTINGS)]
    with cable() as ends, subprocess.Popen([program, ends.board]) as board:
        node = ["--node", f"adm={ends.bench}", "--filter", "mekf"]
        status = main([*asked, *node, "--out", str(tmp_path / "out")])
        board.kill()
    answer = capsys.readouterr()
    assert status == 0, answer.err
    said = json.loads(answer.out)
    counts = said["counts"]
    assert (said["steps"], said["failure"]) == (200, "")
    assert (counts["wrong_frames"], counts["lost_frames"], counts["silent_parts"]) == (0, 0, 0)
    assert (counts["steps_without_gyro"], counts["refused_frames"]) == (0, 0)
    assert said["attitude_rms_arcsec"] < 30.0
