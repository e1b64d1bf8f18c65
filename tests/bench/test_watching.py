"""Observers see all that matters, however much else happens."""

import os
import re

import pytest

from robins.bench.live.feed import check, latest
from robins.bench.rigs.satellite.judging import signals
from robins.bench.run import watching
from robins.bench.run.spans import FaultSpans
from robins.bench.run.watching import PageObserver
from robins.bench.status import BenchStatus, running
from robins.errors import RobinsError
from robins.systems.satellite.parameters import AttitudeLoop


class Page:
    url = ""

    def __init__(self):
        self.shown = []

    def push(self, time_s, values):
        pass

    def status(self, status):
        pass

    def event(self, level, time_s, text):
        self.shown.append((level, text))

    def commands(self):
        return []

    def poll(self):
        pass


def test_a_flood_of_commands_hides_nothing_else(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(watching.time, "monotonic", lambda: now[0])
    page = Page()
    looking = PageObserver(page, BenchStatus())
    looking.event("died", 1.0, "'adm' was killed")
    for k in range(1000):
        looking.event("command", 2.0, f"pause {k}")
    looking.event("failed", 3.0, "the run failed")
    now[0] += 20.0
    looking.event("command", 4.0, "stop")
    texts = [text for _, text in page.shown]
    assert texts[0] == "'adm' was killed"
    assert texts[1:11] == [f"pause {k}" for k in range(10)]
    assert "too fast" in texts[11]
    assert texts[12:] == ["the run failed", "stop"]


def test_a_run_that_falls_behind_its_clock_is_an_alarm():
    page = Page()
    looking = PageObserver(page, BenchStatus())
    for kind in ("behind", "waiting", "restarted"):
        looking.event(kind, 1.0, kind)
    assert page.shown == [("alarm", "behind"), ("warning", "waiting"), ("info", "restarted")]


def test_a_frequent_kind_does_not_push_out_a_rare_one():
    events = ["a", *"w" * 500, "a", *"i" * 30, *"w" * 500]
    found = latest(events, str, 200)
    assert len(found) == 200
    assert [found.count(kind) for kind in "aiw"] == [2, 30, 168]
    assert found == ["a", "a", *"i" * 30, *"w" * 168]
    assert latest(events[:200], str, 200) == events[:200]
    assert latest(list(range(300)), lambda k: k % 2, 200) == list(range(100, 300))


def test_a_command_that_comes_again_and_again_is_shown_each_time(monkeypatch):
    """The page counts what is the same in one line, so it hides nothing."""
    monkeypatch.setattr(watching.time, "monotonic", lambda: 100.0)
    page = Page()
    looking = PageObserver(page, BenchStatus())
    for text in ("pause", *["clear"] * 50, "pause"):
        looking.event("command", 1.0, text)
    assert [text for _, text in page.shown] == ["pause", *["clear"] * 50, "pause"]


def test_spans_of_faults_are_told_though_they_are_short():
    """One of two steps, one that is cleared, one that is on; the latest hundred."""
    spans = FaultSpans()
    for k in range(100):
        on = [("star: lost", 1.0)] * (10 <= k < 12) + [("gyro: silent", 2.0)] * (20 <= k < 50)
        spans.observe(on + [("star: lost", 7.0)] * (k >= 70), 0.1 * k)
    assert spans.for_page == [
        {"label": "star: lost", "begin_s": 1.0, "end_s": 0.1 * 12},
        {"label": "gyro: silent", "begin_s": 2.0, "end_s": 5.0},
        {"label": "star: lost", "begin_s": 7.0, "end_s": None},
    ]
    for k in range(150):
        spans.observe([("again", float(k))], float(k))
    assert [one["begin_s"] for one in spans.for_page] == [float(k) for k in range(50, 150)]


def test_true_and_estimated_attitude_are_signals_of_the_page():
    found = signals(AttitudeLoop())
    check(found)
    attitudes = [s for s in found if s.role == "attitude"]
    assert [s.of for s in attitudes] == ["true"] * 4 + ["estimated"] * 4
    assert found[:8] == attitudes  # as `sample` has them first


# --------------------------------------------------------------------------------- the status file


@pytest.fixture
def place(tmp_path, monkeypatch):
    """The folder of the status files, which is not there yet."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    return tmp_path / f"robins-bench-{os.getuid()}"


def test_a_report_is_a_file_of_its_own_that_nobody_else_reads(place):
    with BenchStatus() as status:
        status.report({"state": "running"})
        (path,) = place.iterdir()
        assert (place.stat().st_mode & 0o777, path.stat().st_mode & 0o777) == (0o700, 0o600)
        (place / "2147483647.json").write_text("{}")  # of a bench that was killed
        (place / f"{os.getpid()}.01234567.new").write_text("half")  # is being written
        (place / "notes.txt").write_text("not ours")
        (one,) = running()
        assert (one["state"], one["pid"], status.refused) == ("running", os.getpid(), "")
        left = {f"{os.getpid()}.json", f"{os.getpid()}.01234567.new", "notes.txt"}
        assert {path.name for path in place.iterdir()} == left
    assert running() == []


def _linked(place, goal):
    goal.mkdir(mode=0o700)
    place.symlink_to(goal)


@pytest.mark.parametrize(
    ("spoil", "why"),
    [
        (_linked, "is a link, which is not followed"),
        (lambda place, goal: place.mkdir(mode=0o755), r"is open to others \(mode 755\); chmod 700"),
        (lambda place, goal: place.write_text(""), "cannot be used: "),
    ],
)
def test_a_folder_of_others_is_refused_and_the_run_goes_on_without(place, tmp_path, spoil, why):
    goal = tmp_path / "goal"
    spoil(place, goal)
    with BenchStatus() as status:
        status.report({"state": "running"})
        assert re.search(f"does not show this run: {place}: .* {why}", status.refused)
    with pytest.raises(RobinsError, match=why) as caught:
        running()
    assert not caught.value.bad_input
    assert not goal.exists() or list(goal.iterdir()) == []
    assert place.is_file() or list(place.iterdir()) == []


def test_a_folder_of_another_user_is_refused(place, monkeypatch):
    mine = os.getuid()
    place.with_name(f"robins-bench-{mine + 1}").mkdir(mode=0o700)
    monkeypatch.setattr(os, "getuid", lambda: mine + 1)
    with pytest.raises(RobinsError, match=f"belongs to the user with number {mine}"):
        running()


def test_links_among_the_reports_lead_nowhere(place, tmp_path):
    target = tmp_path / "precious"
    target.write_text("kept")
    place.mkdir(mode=0o700)
    (place / f"{os.getpid()}.json").symlink_to(target)
    (place / f"{os.getpid()}.new").symlink_to(target)
    with BenchStatus() as status:
        assert running() == []
        (place / f"{os.getpid()}.json").symlink_to(target)
        status.report({"state": "running"})
        assert target.read_text() == "kept"
        assert running()[0]["state"] == "running"
    assert target.read_text() == "kept"
