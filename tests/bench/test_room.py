"""Numbers of a long run on disk: the same numbers, little memory, nothing left behind."""

import gc
import os
import resource
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from stations import config, on_threads

from robins.bench.rigs.satellite import RIG
from robins.bench.run import number_store
from robins.bench.run.session import Session
from robins.bench.run.setup import changed, read
from robins.bench.run.telemetry import Telemetry
from robins.results import ResultError

STEP_NS, LOOP = 100_000_000, ("duration=60 s", "counted_from=10 s")


@pytest.fixture
def on_disk(monkeypatch):
    monkeypatch.setattr(number_store, "LARGE", 0)


def maps(folder):
    """Resident memory [kB] of this process for files of a folder, by mapping."""
    lines = Path("/proc/self/smaps").read_text().splitlines()
    found = [k for k, line in enumerate(lines) if f" {folder}/" in line]
    return [next(int(x.split()[1]) for x in lines[k:] if x.startswith("Rss:")) for k in found]


def payload(k):
    rng = np.random.default_rng(k)
    q = rng.normal(size=4)
    said = {"q_ib": q / np.linalg.norm(q), "gyro_bias": rng.normal(size=3)}
    return RIG.wire.encode("estimate", {**said, "sigma": np.ones(6), "flags": k % 8})


def heard(steps, record, said=()):
    telemetry = Telemetry(RIG, steps, STEP_NS, record)
    for k in said:
        telemetry.observe("estimate", (k + 1) * STEP_NS, payload(k))
    return telemetry


def test_on_disk_are_the_same_arrays_and_no_file(tmp_path, monkeypatch):
    said = [0, 3, 4, 98]
    wanted = heard(100, None, said).series
    monkeypatch.setattr(number_store, "LARGE", 0)
    it = heard(100, tmp_path / "record.mcap", said)
    assert len(maps(tmp_path)) == 1
    assert list(it.series) == list(wanted)
    for name, array in wanted.items():
        assert it.series[name].dtype == array.dtype
        np.testing.assert_array_equal(it.series[name], array)
    assert np.all(np.isnan(wanted["estimate.q_ib"][1]))
    assert not list(tmp_path.iterdir())  # while it is used
    part = it.series.until(50)["estimate.q_ib"]
    del it
    gc.collect()
    np.testing.assert_array_equal(part, wanted["estimate.q_ib"][:50])  # it goes with the last array
    del part
    gc.collect()
    assert not maps(tmp_path)


def test_small_runs_stay_in_memory(tmp_path):
    it = heard(1000, tmp_path / "record.mcap")
    assert not maps(tmp_path)
    assert it.series["estimate.q_ib"].base is None


def test_the_memory_of_a_long_run_does_not_grow(on_disk, tmp_path):
    steps, one = 60_000, payload(1)
    it = heard(steps, tmp_path / "record.mcap")
    size = sum(x.nbytes for x in it.series.values())
    assert size > 15e6
    most = 0
    for k in range(steps):
        it.observe("estimate", (k + 1) * STEP_NS, one)
        if k % 5000 == 4999:
            most = max(most, *maps(tmp_path))
    assert most < 2e3  # kB; the estimates alone are 7 MB
    assert np.all(it.series["estimate.flags"] == 1)


def test_a_disk_without_room_is_told_with_its_folder(on_disk, tmp_path):
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, hard))
    try:
        with pytest.raises(ResultError, match=rf"^{tmp_path}: cannot keep 3 MB .* \(`ulimit -f`\)"):
            heard(10_000, tmp_path / "record.mcap")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert not list(tmp_path.iterdir())


def test_a_folder_that_is_not_there_is_told(on_disk, tmp_path):
    with pytest.raises(ResultError, match="no: cannot keep"):
        heard(10, tmp_path / "no" / "record.mcap")


def test_an_interrupted_process_leaves_nothing(tmp_path):
    code = (
        "import sys; from robins.bench.run import number_store as s; from pathlib import Path\n"
        "import time; import numpy; s.LARGE = 0\n"
        "r = s.NumberStore({'x': ((1000, 3), numpy.nan)}, Path(sys.argv[1]))\n"
        "print('ready', flush=True); time.sleep(60)"
    )
    command = [sys.executable, "-c", code, str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"ready\n"
        os.kill(process.pid, signal.SIGINT)
    assert process.returncode != 0
    assert not list(tmp_path.iterdir())


def test_a_run_on_disk_is_that_in_memory(on_disk, tmp_path, monkeypatch):
    on_threads(monkeypatch)
    of = changed(read("satellite/s1", LOOP), {"seconds": 4.0})
    made = config("satellite/s1", "mekf", *LOOP)
    result = Session(of, tmp_path / "record.mcap", config=made).run()
    assert [path.name for path in tmp_path.iterdir()] == ["record.mcap"]
    monkeypatch.setattr(number_store, "LARGE", 64 << 20)
    again = Session(of, config=made).run()
    assert result.failure == again.failure == ""
    for name, array in again.series.items():
        np.testing.assert_array_equal(result.series[name], array)
