"""A run on the bench, from a setup to arrays and counts: processes, links, broker, clock."""

from __future__ import annotations

import contextlib
import os
import time
from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from robins import __version__
from robins.bench.accounting import Latencies
from robins.bench.broker.broker import Broker
from robins.bench.broker.faults import LinkFault
from robins.bench.broker.injector import Injector
from robins.bench.broker.link import BenchError, Direction, Link
from robins.bench.broker.restart import SentFrames
from robins.bench.evaluation import RunResult
from robins.bench.live.feed import JsonObject
from robins.bench.parts.node import fewer_collections, realtime
from robins.bench.ports.port import BAUD, Pair, open_pair, open_port, replacements
from robins.bench.recording import Entry, Event, Recorder
from robins.bench.recording.topics import completed
from robins.bench.rig import LoadedRun, RunConfig
from robins.bench.run.clocks import clock_of
from robins.bench.run.orders import Orders, in_words
from robins.bench.run.processes import PartProcesses, ProcessExit
from robins.bench.run.setup import config_of, counted_from, steps_of
from robins.bench.run.switching import switch
from robins.bench.run.telemetry import Telemetry, require_truth
from robins.bench.wire.frames import VERSION
from robins.bench.wire.records import PayloadFault

FIRST_HELLO_S = 120.0  # time-out for the first hello of a part that does not compute
RESTART_S = 60.0  # time-out for the hello and each answer of a part that is restarted
_RESTART_HINT = '; on_death = "restart" would restart it'
_LONG_S = 9.0  # wait for a hello that is reported as an event
_TELL_S = 0.2  # period of progress reports
_MOST_DEATHS, _MINUTE_S = 3, 60.0  # deaths of a part without a fault in that time that fail the run
_POLL_NS = 50_000_000  # period of checks on the processes


@runtime_checkable
class RunObserver(Protocol):
    """Observer of a run, such as the live page; its calls must return at once."""

    def event(self, kind: str, time_s: float, text: str) -> None:
        """Handle an event."""

    def step(self, session: Session, step: int) -> None:
        """Handle the end of a step."""

    def over(self, session: Session, failed: bool) -> None:
        """Handle the end of the run."""

    def commands(self, session: Session) -> list[JsonObject]:
        """Commands of the observer; see `robins.bench.live.LivePage.commands`."""
        ...


class Session:
    """A run; `run` executes it.

    Attributes:
        flight: its setup.
        latencies: so far.
        telemetry: so far.
        injector: its faults; more may be added while it runs.
        config: input of its parts.
        part_processes: the processes.
        clock: decides when a step begins.
        done: steps so far.
        step_ms: duration of the last step.
        pace: recent rate [steps/s].
        deaths: number of processes that have died so far.
    """

    def __init__(
        self,
        flight: LoadedRun,
        record: Path | None = None,
        watch: RunObserver | None = None,
        progress: Callable[[float, str], None] | None = None,
        paused: bool = False,
        config: RunConfig | None = None,
    ):
        """Prepare a run.

        Args:
            flight: the run.
            record: path of the record to write; None: none.
            watch: the observer.
            progress: called with the share done, and the present activity.
            paused: whether to wait for a "start" of the observer.
            config: of the same run, if it has already been made.

        Raises:
            ScenarioError: the length of the run does not fit the scenario.
            PortError, ResultError: a port cannot be opened; there is no space for the telemetry.
            BenchError: the rig cannot prepare the run.
        """
        self.flight, self.rig, self._watch = flight, flight.rig, watch
        self._report_progress = progress or (lambda share, what: None)
        self.steps = steps_of(flight)
        setup = flight.setup
        self.ports, programs = replacements(setup.ports)
        if config is None:
            self._report_progress(0.0, "preparing")
            config = config_of(flight)
        self.config = config
        self.telemetry = Telemetry(self.rig, self.steps, config.step_ns, record)
        self.part_processes = PartProcesses(
            self.rig, config, setup.fifo, setup.on_death == "restart", programs
        )
        self.injector = Injector(self.rig.table, setup.faults, setup.seed)
        self._orders = Orders(flight, self.injector, config.step_ns)
        self.clock = clock_of(flight)
        self._broker: Broker | None = None  # until the links are open
        self._record_path = record
        self._recorder: Recorder | None = None
        self.latencies = Latencies()
        self.events: list[Event] = []
        self.deaths = 0
        self.run_number = int.from_bytes(os.urandom(4), "little") or 1
        self.done = 0
        self.step_ms = self.pace = 0.0
        self._histories: dict[str, SentFrames] = {}  # of parts that are restarted if they die
        self._died: dict[str, list[float]] = {}  # recent times of deaths without a fault, by part
        self._barred: set[tuple[str, str]] = set()  # links and messages already reported
        self._paused, self._stop = paused, False
        self._speaks: dict[str, str] = {}  # by part: the port that its process opens
        self._passed: deque[tuple[Entry, int]] = deque()  # to be recorded
        self._heard: deque[tuple[str, int, bytes]] = deque()  # to be added to the telemetry
        self._glanced_ns = 0
        self._began_ns = time.monotonic_ns()

    # --------------------------------------------------------------------------------- going

    def run(self) -> RunResult:
        """Execute the run; a failure is in `RunResult.failure`, with all results until then.

        Raises:
            KeyboardInterrupt: after all processes have ended and the record is whole.
        """
        failure, done, seconds = "", 0, 0.0
        with contextlib.ExitStack() as stack:
            self._recorder = self._open_record(stack)
            stack.enter_context(self.part_processes)
            self._broker = self._connect_parts(stack)
            began = time.monotonic()
            try:
                self.broker.gather(self.run_number, FIRST_HELLO_S)
                began = time.monotonic()
                done = self._go()
                counted = slice(counted_from(self.flight, done), done)
                require_truth(self.rig, self.telemetry.series, counted, self.time_s)
            except BenchError as error:
                failure = str(error)
                done = done or max(self.broker.time_ns // self.config.step_ns - 1, 0)
                self.event("failed", failure)
            finally:
                seconds = time.monotonic() - began
                self.broker.stop()
                with contextlib.suppress(BenchError):  # its failure has been reported, or is next
                    self._catch_up()
                if self._watch is not None:
                    self._watch.over(self, bool(failure))
        return RunResult(
            series=self.telemetry.series.until(done),
            config=self.config,
            steps=done,
            seconds=seconds,
            latencies=self.latencies,
            health={name: link.health for name, link in self.broker.links.items()},
            injected=dict(self.injector.counts),
            silent=dict(self.broker.silent),
            events=self.events,
            deaths=self.deaths,
            failure=failure,
            stopped=self._stop and done < self.steps,
            operator_events=tuple(self._orders.operator_events),
        )

    def _go(self) -> int:
        """Execute all steps and return the number completed."""
        told, counted, since = 0.0, 0, time.monotonic()
        with fewer_collections(), realtime(self.flight.setup.fifo) as refused:
            if refused:
                self.event("scheduler", refused)
            for k in range(self.steps):
                self._execute_commands(k)
                if self._stop:
                    self._catch_up()
                    return k
                deadline = self.clock.wait(k, self.broker.poll)
                began = time.monotonic_ns()
                self.broker.step(k, self.clock.timeout_ns)
                missed = self.clock.missed_deadline(k)
                ended = time.monotonic_ns()
                self.latencies.cycle(k, deadline, began, ended, missed)
                self.done, self.step_ms = k + 1, (ended - began) * 1e-6
                if missed:
                    text = f"step {k} was not over at the deadline of the next"
                    self.event("missed", text, False)
                if behind := self.clock.lag_notice(k):
                    self.event("behind", behind)
                if self._watch is not None:
                    self._catch_up()
                    self._watch.step(self, k)
                counted += 1
                if (now := time.monotonic()) - told > _TELL_S:
                    self.pace, counted, since = counted / max(now - since, 1e-9), 0, now
                    told = now
                    self._report_progress((k + 1) / self.steps, f"{self.time_s:.0f} s of the run")
        self._catch_up()
        return self.steps

    def _execute_commands(self, step: int) -> None:
        """Execute the commands of the observer; wait while it is paused."""
        time_ns = (step + 1) * self.config.step_ns
        switch(
            self.injector,
            self.part_processes,
            self.broker,
            time_ns,
            self._speaks,
            self._reap,
            self.event,
        )
        if self._watch is not None:
            began = time.monotonic_ns()
            while True:
                for command in self._watch.commands(self):
                    self._carry_out(command)
                if not self._paused or self._stop:
                    break
                self.broker.poll(0.05)
            self.clock.shift_deadlines(time.monotonic_ns() - began)
        if not self._stop:
            self._say(step)

    def _carry_out(self, command: JsonObject) -> None:
        what, label = command.get("do"), command.get("label")
        if what == "stop":
            self._stop = True
        elif what in ("pause", "start"):
            self._paused = what == "pause"
        elif what == "clear":
            self._orders.clear(label)
        elif what == "inject":
            begin = self.time_s + self.config.step_ns * 1e-9  # of the next step
            self._orders.inject(str(label), command["fault"], begin, command.get("duration_s"))
        elif what == "say":
            self._catch_up()
            of = self.rig.shown.console_messages[str(label)]
            self._orders.say(*of(self.telemetry.series, self.config, self.done - 1))
        self.event("command", f"{what} {label or ''}".strip())

    def say(self, message: str, **values: Any) -> None:
        """Send the parts a message before the next step; a field left out is missing or 0.

        Raises:
            OperatorMessageError: the bench does not send it, it has no such field, or a value is
                beyond its limits.
        """
        self._orders.say(message, values)

    def _say(self, step: int) -> None:
        """Send the operator's messages that are due before a step."""
        for message, payload, planned in self._orders.due(step):
            self.broker.say(message, payload)
            values = self.rig.wire.decode(message, payload)
            self.event("said", in_words(message, values), planned)

    def active_faults(self) -> list[tuple[str, LinkFault]]:
        """Faults that are active now, with their labels."""
        return self._orders.active(self.broker.time_ns)

    def state_of(self, part: str) -> str:
        """State of a part: "up", "board" or "dead"."""
        if part in self.ports:
            return "board"
        off = self.part_processes.process(part) is None or part in self.broker.off
        return "dead" if off else "up"

    # ------------------------------------------------------------------------------- making ready

    def _open_record(self, stack: contextlib.ExitStack) -> Recorder | None:
        if self._record_path is None:
            return None
        setup, given = self.flight.setup, self.flight.given
        header = {
            "robins": __version__,
            **{"wire": VERSION, "rig": self.rig.address or self.rig.name},
            "name": self.flight.name,
            "run": self.run_number,
            "setup": setup.model_dump(mode="json", exclude_unset=True),
            "loop": given.model_dump(mode="json", exclude_unset=True),
            "step_ns": self.config.step_ns,
            "steps": self.steps,
        }
        wire = self.rig.wire
        rows = completed(self.rig.topics(self.config), wire, self.rig.sends)
        recorder = Recorder(self._record_path, wire, header, topics=rows, overwrite=True)
        return stack.enter_context(recorder)

    def _connect_parts(self, stack: contextlib.ExitStack) -> Broker:
        """Open the ports and start the processes."""
        setup = self.flight.setup
        links: dict[str, Link] = {}
        for part in self.rig.parts:
            if (real := self.ports.get(part)) is not None:
                fd = stack.enter_context(open_port(real)).fileno()
                links[part] = self._link(part, fd, None)
                continue
            pair = stack.enter_context(open_pair())
            links[part] = self._link(part, pair.master, setup.baud)
            self._start(part, pair)
        if setup.on_death == "restart":
            own = set(links) - set(self.ports)
            self._histories = {
                p: SentFrames(partial(self.part_processes.has_saved_memory, p)) for p in own
            }
        return Broker(
            links,
            self.rig,
            {part: self.rig.part(part, self.config).takes for part in self.rig.parts},
            self.config.step_ns,
            self.injector,
            self._observe,
            self._poll,
            self._answered,
            self._catch_up,
            self._histories,
            self.part_processes.idle_s,
            self._report_waiting,
        )

    def _report_waiting(self, parts: Sequence[str], since_s: float) -> None:
        """Report the parts whose hello is missing."""
        processes = [part for part in parts if part not in self.ports]
        silent = [part for part in parts if part in self.ports]
        words = [f"{', '.join(processes)}: starting, compiling"] * bool(processes)
        words += [f"{', '.join(silent)}: no hello from the port yet"] * bool(silent)
        self._report_progress(self.done / self.steps, "; ".join(words))
        if since_s > _LONG_S:
            self.event("waiting", f"after {since_s:.0f} s: {'; '.join(words)}")

    def _link(self, part: str, fd: int, baud: int | None) -> Link:
        return Link(part, fd, self.rig.wire, self.injector, self._watch_wire, baud, self._refused)

    def _start(self, part: str, pair: Pair) -> None:
        self._speaks[part] = f"{pair.path},{self.flight.setup.baud or BAUD}"
        self.part_processes.start(part, self._speaks[part])

    # -------------------------------------------------------------------------------- looking on

    @property
    def broker(self) -> Broker:
        """Broker, once the links are open."""
        assert self._broker is not None
        return self._broker

    @property
    def time_s(self) -> float:
        """Time of the run [s]."""
        return 0.0 if self._broker is None else self._broker.time_ns * 1e-9

    @property
    def paused(self) -> bool:
        """True while the run waits for a start."""
        return self._paused

    def event(self, kind: str, text: str, shown: bool = True) -> None:
        """Record an event."""
        self._catch_up()  # earlier traffic comes first in the record
        one = Event(self._wall_ns(), kind, text, {"time_s": round(self.time_s, 9)})
        self.events.append(one)
        if self._recorder is not None:
            self._recorder.event(one)
        if shown and self._watch is not None:
            self._watch.event(kind, self.time_s, text)

    def _wall_ns(self) -> int:
        return time.monotonic_ns() - self._began_ns

    def _watch_wire(self, link: str, direction: Direction, data: bytes, time_ns: int) -> None:
        if self._recorder is not None:
            self._passed.append((Entry(self._wall_ns(), link, direction, data), time_ns))

    def _refused(self, link: str, message: str, why: PayloadFault) -> None:
        """Report a refused frame; later ones of the same link and message are only counted.

        Raises:
            BenchError: it is the truth, without which the run cannot be evaluated.
        """
        if message == self.rig.truth and why.sized and message in self.rig.sends[link]:
            raise BenchError(
                f"at {self.time_s:.1f} s '{link}' says a true {message} that cannot be: "
                f"{why.text}; look in the record at what acted on it before"
            )
        if (link, message) not in self._barred:
            self._barred.add((link, message))
            self.event("refused", f"'{link}': a frame '{message}' is refused: {why.text}")

    def _observe(self, message: str, time_ns: int, payload: bytes) -> None:
        self._heard.append((message, time_ns, payload))

    def _catch_up(self) -> None:
        """Record the traffic since the last call, while the parts compute."""
        while self._heard:
            self.telemetry.observe(*self._heard.popleft())
        recorder, failure = self._recorder, None
        while recorder is not None and self._passed:
            try:
                recorder.write(*self._passed.popleft())
            except OSError as error:  # the recorder counts what it loses from here on
                failure = error
        if failure is not None:
            raise BenchError(f"the record cannot be written: {failure}")

    def _answered(self, part: str, step: int, at_ns: int, now_ns: int, compute_ns: int) -> None:
        self.latencies.tick(part, step, None, at_ns)
        self.latencies.done(part, step, now_ns, compute_ns)

    def _poll(self) -> None:
        now = time.monotonic_ns()
        if now - self._glanced_ns > _POLL_NS:
            self._glanced_ns = now
            if self._recorder is not None and self._paused:
                self._recorder.flush()  # no traffic comes that would do so
            self._reap()

    def _reap(self, until: str | None = None) -> None:
        """Handle processes that have ended, by the policy of the setup.

        Raises:
            BenchError: a process has ended, and the policy is to fail.
        """
        deaths = self.part_processes.deaths()
        while until is not None and until not in [d.part for d in deaths]:
            time.sleep(0.001)
            deaths += self.part_processes.deaths()
        for death in deaths:
            self._handle_exit(death, by_itself=death.part != until)

    def _handle_exit(self, death: ProcessExit, by_itself: bool) -> None:
        part, setup = death.part, self.flight.setup
        while True:
            self.deaths += 1
            self.event("died", str(death))
            fatal = f"{death}, at {self.time_s:.1f} s of the run"
            if by_itself:  # kills by a fault are not limited
                died, now = self._died.setdefault(part, []), time.monotonic()
                died[:] = [*(at for at in died if now - at < _MINUTE_S), now]
            if setup.on_death == "fail" or self.broker.time_ns == 0:
                raise BenchError(fatal + ("" if self.rig.once(setup, part) else _RESTART_HINT))
            if self.deaths > setup.restarts:
                raise BenchError(f"{fatal}; that is one more than restarts = {setup.restarts}")
            if len(self._died.get(part, ())) >= _MOST_DEATHS:
                raise BenchError(f"{fatal}; that is its third death in a minute")
            since = self._histories[part].since
            self.part_processes.start(part, self._speaks[part], since)
            try:
                self.broker.revive(part, RESTART_S, partial(self._require_alive, part))
            except ProcessExit as again:
                death, by_itself = again, True
                continue
            told = "all" if since < 0 else f"all since step {since}"
            return self.event("restarted", f"'{part}' was restarted and told {told} again")

    def _require_alive(self, part: str) -> None:
        """Check that a restarted part has not died at once; deaths of others are handled later.

        Raises:
            ProcessExit: it has died.
        """
        if died := self.part_processes.deaths(part):
            raise died[0]
