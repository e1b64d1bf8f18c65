"""A simulated day on the bench: recorded, watched, replayed, in memory that does not grow."""

import json
import os
import re
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from browsing import a_browser, browse

from robins.bench.recording import open_record
from robins.workbench import bench_replay

EXAMPLE = Path(__file__).parents[2] / "docs" / "examples" / "pendulum.py"
STEPS = 24 * 3600
SETTINGS = ("duration=24 h", "step=1 s", "length=1 km")  # a period of 63 s
MORE_MB = 24  # that a process may take at the end more than after an hour


def private_mb(process: Path) -> float:
    """Memory that is this process's alone."""
    (line,) = (x for x in (process / "status").read_text().splitlines() if x.startswith("RssAnon"))
    return int(line.split()[1]) / 1024


class Memories(threading.Thread):
    """Looks at a process and its children, each second."""

    def __init__(self, of: int):
        super().__init__(daemon=True)
        self.parent, self.over = str(of), threading.Event()
        self.of: dict[str, list[float]] = {}

    def run(self):
        while not self.over.wait(1.0):
            for process in Path("/proc").glob("[0-9]*"):
                try:
                    parent = (process / "stat").read_text().rsplit(")", 1)[1].split()[1]
                    if self.parent in (parent, process.name):
                        words = (process / "cmdline").read_bytes().split(b"\0")
                        name = b" ".join(words[1:6]).decode()
                        self.of.setdefault(name, []).append(private_mb(process))
                except (OSError, ValueError):  # it has ended
                    continue

    def growth(self, begin: float) -> dict[str, float]:
        """From a share of the life of the camera to its end [MB], by process."""
        self.over.set()
        self.join()
        (many,) = (len(x) for name, x in self.of.items() if "rig camera" in name)
        of = {name: x[:many] for name, x in self.of.items() if len(x) > 0.5 * many}
        return {name: max(x) - x[round(begin * many)] for name, x in of.items()}


@pytest.fixture(scope="module")
def day(tmp_path_factory):
    """A run of a day that has begun."""
    out = tmp_path_factory.mktemp("day") / "out"
    robins = [sys.executable, "-c", "from robins.cli import main; raise SystemExit(main())"]
    robins += ["bench", "up", f"{EXAMPLE}:rig", "--out", str(out)]
    settings = [word for one in SETTINGS for word in ("--set", one)]
    command = [*robins, *settings, "--live", "--port", "0", "--json"]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, start_new_session=True, **pipes) as process:
        memories = Memories(process.pid)
        memories.start()
        yield process, memories, out
        process.kill()


def test_the_page_is_there_all_day(day):
    """A page opened in the afternoon shows the morning, and its commands are obeyed."""
    process, _, _ = day
    told = ""
    while not (url := re.search(r"http://127.0.0.1:\d+\S*", told)):
        line = process.stderr.readline()
        assert line, told
        told += line
    with a_browser() as chromium:
        with browse(chromium, url.group(), viewport={"width": 1280, "height": 800}) as page:
            page.wait_for_function("() => bench.time > 40000", timeout=600_000)
        with browse(chromium, url.group(), viewport={"width": 1280, "height": 800}) as page:
            page.wait_for_function("() => bench.time > 40000")
            page.get_by_test_id("span").select_option("whole run")
            page.wait_for_function("() => bench.plots[0].span[0] === 0")
            first = page.evaluate("bench.plots[0].chart.data[0][0]")
            assert 0.0 <= first < 600.0
            for button, state in (("pause", "paused"), ("start", "running")):
                page.get_by_test_id(button).click()
                page.wait_for_function(f"() => document.body.dataset.bench === '{state}'")
            assert page.evaluate("performance.memory.usedJSHeapSize") < 100e6


def test_memory_does_not_grow_and_the_record_is_whole(day):
    process, memories, out = day
    said, _ = process.communicate(timeout=1200)
    assert process.returncode == 0
    figures = json.loads(said)
    assert figures["steps"] == STEPS
    assert figures["counts"]["frames"] == 2 * STEPS
    assert 0.0 < figures["angle_rms_deg"] < 0.6
    growth = memories.growth(1.0 / 24.0)
    for which in ("bench.live", "rig camera", "rig pendulum", "robins.cli"):
        assert any(which in name for name in growth), growth
    assert max(growth.values()) < MORE_MB, growth
    (bench,) = (x for name, x in memories.of.items() if "robins.cli" in name)
    assert max(bench) - bench[len(bench) // 24] < 100.0  # with figures and report, in the end
    record = open_record(out / "record.mcap")
    assert (record.complete, record.why) == (True, "")
    heard = Memories(os.getpid())
    heard.start()
    compared = bench_replay(out / "record.mcap", node="camera")
    assert compared.same
    assert compared.frames == STEPS
    growth = heard.growth(0.1)
    assert any("rig camera" in name for name in growth), growth
    assert max(growth.values()) < MORE_MB, growth
