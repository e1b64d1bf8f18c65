"""Who looks on sees what matters, however much else happens."""

from robins.bench.live.feed import check, latest
from robins.bench.rigs.satellite.view import signals
from robins.bench.run import watching
from robins.bench.run.spans import FaultSpans
from robins.bench.run.watching import Looking
from robins.bench.status import Status
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
    looking = Looking(page, Status())
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
    looking = Looking(page, Status())
    for text in ("pause", *["clear"] * 50, "pause"):
        looking.event("command", 1.0, text)
    assert [text for _, text in page.shown] == ["pause", *["clear"] * 50, "pause"]


def test_spans_of_faults_are_told_though_they_are_short():
    """One of two steps, one that is cleared, one that is on; the latest hundred."""
    spans = FaultSpans()
    for k in range(100):
        on = [("star: lost", 1.0)] * (10 <= k < 12) + [("gyro: silent", 2.0)] * (20 <= k < 50)
        spans.hear(on + [("star: lost", 7.0)] * (k >= 70), 0.1 * k)
    assert spans.told == [
        {"label": "star: lost", "begin_s": 1.0, "end_s": 0.1 * 12},
        {"label": "gyro: silent", "begin_s": 2.0, "end_s": 5.0},
        {"label": "star: lost", "begin_s": 7.0, "end_s": None},
    ]
    for k in range(150):
        spans.hear([("again", float(k))], float(k))
    assert [one["begin_s"] for one in spans.told] == [float(k) for k in range(50, 150)]


def test_true_and_estimated_attitude_are_signals_of_the_page():
    found = signals(AttitudeLoop())
    check(found)
    attitudes = [s for s in found if s.role == "attitude"]
    assert [s.of for s in attitudes] == ["true"] * 4 + ["estimated"] * 4
    assert found[:8] == attitudes  # as `sample` has them first
