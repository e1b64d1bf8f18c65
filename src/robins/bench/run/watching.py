"""Views of a running bench: its live page, and the file that `robins bench status` reads."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Sequence
from typing import Protocol, runtime_checkable

from robins.bench.live import LivePage, Signal
from robins.bench.live.feed import JsonObject
from robins.bench.live.handle import Level
from robins.bench.rig import LoadedRun, Rig
from robins.bench.run.session import Session
from robins.bench.run.setup import steps_of
from robins.bench.run.spans import FaultSpans
from robins.bench.status import STARTING, BenchStatus
from robins.scenario import Parameters

_EACH_S = 0.05  # least period of samples for the page
_STATUS_S = 0.5
_COMMANDS, _COMMANDS_S = 10, 10.0  # at most so many commands are shown in so many seconds
STEP = Signal("time of a step", "ms", "time of a step")
_PREPARING = {
    "state": "preparing",
    "doing": "The filter is compiled, then each part starts as a process and says hello.",
}
ALARMS = ("died", "failed", "killed", "behind")
WARNINGS = ("missed", "refused", "command", "power", "waiting")


@runtime_checkable
class Page(Protocol):
    """Interface of a live page; see `robins.bench.live.LivePage`."""

    url: str

    def push(self, time_s: float, values: Sequence[float]) -> None:
        """Show a sample."""

    def status(self, status: JsonObject) -> None:
        """Show the state of the bench."""

    def event(self, level: Level, time_s: float, text: str) -> None:
        """Show an event."""

    def commands(self) -> list[JsonObject]:
        """Commands of the user."""
        ...

    def poll(self) -> None:
        """Keep its server alive."""


class PageObserver:
    """Observer of a run, for page and status file; a `robins.bench.run.session.RunObserver`."""

    def __init__(self, page: Page | None, status: BenchStatus):
        """Set up the observer, with the page if there is one."""
        self._page, self._status = page, status
        self._told = 0.0
        self._due = 0.0  # time of the next sample for the page
        self._alarms, self._listens = None, False  # those of the rig, set at the first step
        self._since = 0  # first step after the last sample
        self._commanded: deque[float] = deque(maxlen=_COMMANDS)
        self._flooded = False
        self._command = ""  # last command shown
        self._spans = FaultSpans()

    def over(self, session: Session, failed: bool) -> None:
        """Handle the end of the run."""
        if self._page is not None:
            last = self._state(session, session.done)
            self._page.status(last | {"state": "failed" if failed else "stopped"})
            self._page.poll()

    def event(self, kind: str, time_s: float, text: str) -> None:
        """Handle an event."""
        if self._page is not None and (kind != "command" or (text := self._shown(text))):
            level = "alarm" if kind in ALARMS else "warning" if kind in WARNINGS else "info"
            self._page.event(level, time_s, text)

    def _shown(self, text: str) -> str:
        """Text to show for a command; beyond a rate, commands are only recorded, not shown.

        A repeated command is always shown, since the page counts it in one line.
        """
        if text == self._command:
            return text
        self._command = text
        now, flooded = time.monotonic(), self._flooded
        full = len(self._commanded) == _COMMANDS and now - self._commanded[0] < _COMMANDS_S
        self._flooded = full
        if not full:
            self._commanded.append(now)
            return text
        return "" if flooded else "commands come too fast to show each; the record has them all"

    def commands(self, session: Session) -> list[JsonObject]:
        """Commands from the page."""
        if self._page is None:
            return []
        self._page.poll()
        if session.paused:
            self._report_state(session, session.done)
        return self._page.commands()

    def step(self, session: Session, step: int) -> None:
        """Handle the end of a step."""
        if self._page is not None:
            active = ((label, fault.begin) for label, fault in session.active_faults())
            self._spans.observe(active, session.time_s)
            view, series = session.rig.shown, session.telemetry.series
            if not self._listens:
                self._alarms, self._listens = view.alarms(), True
            for level, text in self._alarms.observe(series, step) if self._alarms else ():
                self._page.event(level, session.time_s, text)
            now = time.monotonic()
            if now >= self._due:  # a late sample does not delay the next one
                self._due = max(self._due + _EACH_S, now - _EACH_S)
                values = view.sample(series, session.config, self._since, step)
                self._page.push(session.time_s, [*values, session.step_ms])
                self._since = step + 1
        self._report_state(session, step + 1)

    def _state(self, session: Session, done: int) -> JsonObject:
        return state(session, done) | {"fault_spans": self._spans.for_page}

    def _report_state(self, session: Session, done: int) -> None:
        now = time.monotonic()
        if self._page is not None and now - self._told >= _STATUS_S:
            self._told = now
            self._page.status(self._state(session, done))
        if self._status.due:
            self._status.report(report(session, done, "" if self._page is None else self._page.url))


def state(session: Session, done: int) -> JsonObject:
    """State of the bench for the page."""
    recent = session.latencies.recent()
    late = recent["cycle"]["lateness_us"]
    now_ns, links, health = session.broker.time_ns, session.broker.links, _health(session)
    return {
        "state": "paused" if session.paused else "running",
        "clock": _clock(session),
        "deadlines": {
            "missed": session.latencies.summary()["missed"],
            "lateness_us": {k: late[k] for k in ("p50", "p99", "max")},
            "cycles_per_s": session.pace,
            "histogram": session.latencies.summary()["histogram"],
        },
        "links": {
            name: health[name] | {"silent_s": max(now_ns - link.health.heard_ns, 0) * 1e-9}
            for name, link in links.items()
        },
        "nodes": {name: session.state_of(name) for name in links},
        "faults": [
            {"label": label, "until_s": fault.end} for label, fault in session.active_faults()
        ],
        "counts": {
            **session.rig.shown.counts(session.telemetry.series, done),
            "wrong_frames": sum(counted["wrong"] for counted in health.values()),
            "lost_frames": sum(counted["lost"] for counted in health.values()),
            "processes_died": session.deaths,
        },
    }


def _clock(session: Session) -> str:
    setup = session.flight.setup
    if setup.clock == "lockstep":
        return "lock-step"
    return f"real time, {setup.rate or 1.0 / session.flight.timing.step_s:g} Hz"


def starting_state(flight: LoadedRun) -> JsonObject:
    """State of the bench for the page before any part has started.

    Raises:
        ScenarioError: the length of the run does not fit the scenario.
    """
    return {
        "name": flight.name,
        "filter": flight.setup.filter,
        "clock": flight.setup.clock,
        "state": STARTING,
        "time_s": 0.0,
        "step": 0,
        "steps": steps_of(flight),
        "cycles_per_s": 0.0,
        "url": "",
        "parts": {},
    }


def report(session: Session, done: int, url: str) -> JsonObject:
    """State of the bench for the status file."""
    return starting_state(session.flight) | {
        "state": "paused" if session.paused else "running",
        "time_s": session.time_s,
        "step": done,
        "cycles_per_s": session.pace,
        "url": url,
        "parts": {
            name: {
                "process": session.part_processes.process(name),
                "port": session.flight.setup.ports.get(name, ""),
                **counted,
            }
            for name, counted in _health(session).items()
        },
    }


def _health(session: Session) -> dict[str, dict[str, int]]:
    names, links = ("frames", "wrong", "lost", "late"), session.broker.links.items()
    return {link: {k: getattr(one.health, k) for k in names} for link, one in links}


def page_for(rig: Rig, given: Parameters, title: str, run: int, host: str, port: int) -> LivePage:
    """Start a live page for a run.

    Raises:
        ImportError, OSError, RuntimeError: as of `LivePage`.
    """
    shown, signals = rig.shown, [*rig.shown.signals(given), STEP]
    page = LivePage(signals, title, run, host, port, shown.offered, tuple(shown.console_messages))
    page.status(_PREPARING)
    return page
