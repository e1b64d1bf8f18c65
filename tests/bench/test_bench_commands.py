"""The commands as people use them: a run that is looked at, and interrupted."""

import json
import os
import signal
import subprocess
import sys
import time

from clockwork import CLOCKWORK
from stations import Station, alive, on_threads

from robins.bench.recording import read_record
from robins.cli import main

ROBINS = [sys.executable, "-c", "from robins.cli import main; raise SystemExit(main())"]


def test_a_run_that_fails_before_its_first_step_is_a_result(tmp_path, monkeypatch, capsys):
    class Mute(Station):
        def hello(self):
            return b""

    on_threads(monkeypatch, counter=Mute)
    monkeypatch.setattr("robins.bench.run.session.FIRST_HELLO_S", 0.2)
    out = tmp_path / "out"
    assert main(["bench", "up", CLOCKWORK, "--out", str(out), "--json"]) == 1
    told = json.loads(capsys.readouterr().out)
    assert told["failure"].startswith("no hello from counter in 0.2 s: is it connected, ")
    assert (told["steps"], told) == (0, json.loads((out / "bench.json").read_text()))
    record = read_record(out / "record.mcap")
    assert (record.complete, record.events[-1].text) == (True, told["failure"])


def test_a_run_is_in_the_status_and_ctrl_c_ends_every_process(tmp_path, monkeypatch, capsys):
    def status(*options):
        assert main(["bench", "status", *options]) == 0
        return capsys.readouterr().out

    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    out = tmp_path / "out"
    command = [*ROBINS, "bench", "up", CLOCKWORK, "--set", "wait=1 s", "--baud", "9600"]
    command += ["--out", str(out)]
    bench = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, start_new_session=True)
    until, found = time.monotonic() + 120.0, []
    states = []
    while states[-1:] != ["running"] and time.monotonic() < until:
        time.sleep(0.2)
        found = json.loads(status("--json"))["benches"]
        states += [one["state"] for one in found]
        if states == ["starting"]:  # it is there before its parts are
            assert found[0]["parts"] == {}
            assert ": starting, 0.0 s" in status()
    assert states[0] == "starting"
    (one,) = found
    assert (one["name"], one["filter"], one["state"]) == ("clockwork:rig", "exact", "running")
    pids = [part["process"] for part in one["parts"].values()]
    assert len(pids) == 2
    assert all(alive(pid) for pid in pids)
    assert "clockwork:rig (exact, lockstep), process" in status()
    os.killpg(bench.pid, signal.SIGINT)  # as the terminal does it
    _, said = bench.communicate(timeout=30.0)
    assert bench.returncode == 3, said
    assert "interrupted" in said
    assert f"what was flown is in {out}.record.mcap" in said
    assert not any(alive(pid) for pid in pids)
    assert not out.exists()
    record = read_record(f"{out}.record.mcap")  # what was flown is not lost
    assert record.complete
    assert len(record.entries) > 10
    assert status().startswith("No bench runs.")
