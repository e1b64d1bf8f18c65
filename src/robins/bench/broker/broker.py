"""Broker of messages between the parts, step by step, over the links to all of them.

In each step it ticks a part as soon as all parts whose data of this step it needs are done; the
step is over when all parts are done. Nothing here depends on computing times: only the clock
decides when a step begins and how long to wait for a part.
"""

from __future__ import annotations

import contextlib
import math
import select
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial

from robins.bench.broker.console import OperatorMessageError
from robins.bench.broker.injector import Injector
from robins.bench.broker.link import BenchError, Link, LinkLost
from robins.bench.broker.restart import SentFrames, beginning, catch_up
from robins.bench.rig import Rig
from robins.bench.wire.frames import Frame
from robins.bench.wire.schema import BARE

Takes = Mapping[str, Mapping[str, int]]  # messages that it takes, each with its lag in steps
_REMEMBERED = 64  # steps for which repeated messages are recognised
_REPORT_S = 10.0  # period of reports on the parts that are waited for
_POLL_S = 0.05  # period of polling everything but the lines while nothing comes
ANSWER_NS = 30_000_000_000  # time-out for the answer to a tick, where there is no other
REPEAT_TICK_NS = 1_000_000_000  # time after which an unanswered tick is sent again
_CLOCK_NS = time.monotonic_ns


class Broker:
    """Hub of all links.

    Attributes:
        links: by part.
        time_ns: time of the run: the end of the current step.
        silent: steps in which a part did not answer in time, by part.
        off: parts without power: nothing is sent to them, and none is waited for.
    """

    def __init__(
        self,
        links: Mapping[str, Link],
        rig: Rig,
        takes: Takes,
        step_ns: int,
        injector: Injector,
        observe: Callable[[str, int, bytes], None],
        poll_processes: Callable[[], None],
        done: Callable[[str, int, int, int, int], None],
        meanwhile: Callable[[], None] = lambda: None,
        keep: Mapping[str, SentFrames] | None = None,
        idle_s: Callable[[str], float] = lambda part: math.inf,
        waiting: Callable[[Sequence[str], float], None] = lambda parts, since_s: None,
    ):
        """Set up the hub for the links of a run.

        Args:
            links: by part.
            rig: with its messages and their senders.
            takes: messages that each part takes.
            step_ns: length of a step.
            injector: the faults that the links have.
            observe: called with each message that passes: name, time [ns], payload.
            poll_processes: called now and then while nothing comes, and once per step.
            done: called with each answer: part, step, times of tick and answer [ns of the wall
                clock], computing time [ns].
            meanwhile: called when all parts due are computing, for work that need not precede it.
            keep: the histories of the parts that can be restarted.
            idle_s: idle time of the process of a part [s]; a process that computes has no time-out.
                Infinite: the part has no process.
            waiting: called with the parts whose hello is missing, and the waiting time [s]: when
                the parts change, and now and then.
        """
        self.links, self.step_ns = dict(links), step_ns
        self._wire, self._takes, self._console = rig.wire, takes, rig.console
        self.time_ns = 0
        self.silent = dict.fromkeys(links, 0)
        self.off: set[str] = set()
        self._run = 0
        self._injector, self._observe = injector, observe
        self._poll, self._answered_by, self._meanwhile = poll_processes, done, meanwhile
        self._idle_s, self._waiting = idle_s, waiting
        self._sends = {p: frozenset(rig.sends[p]) for p in links}
        now = {p: {name for name, lag in takes[p].items() if lag == 0} for p in links}
        # parts that must be done before each may compute
        self._sources = {p: {q for q in links if now[p] & self._sends[q]} for p in links}
        every = [name for sent in (*rig.sends.values(), rig.console) for name in sent]
        self._takers = {name: [p for p in links if name in takes[p]] for name in every}
        lags = {name: [taken.get(name, 0) for taken in takes.values()] for name in every}
        self._lags = {name: max(each, default=0) for name, each in lags.items()}  # the greatest
        self._kept = dict(keep or {})
        self._routed: dict[int, set[str]] = {}  # messages passed, by time, of the last steps
        self._ticked: dict[str, tuple[int, int]] = {}  # first and last sent [ns of wall clock]
        self._done: set[str] = set()
        self._by_fd = {link.fd: link for link in links.values()}
        self._fds = list(self._by_fd)
        self._slow = [link for link in links.values() if link.is_slow]
        self._step = -1
        self._glanced = 0.0

    # ------------------------------------------------------------------------------- beginning

    def gather(self, run: int, timeout_s: float) -> None:
        """Wait until every part has sent its hello, and start the run.

        Args:
            run: its number.
            timeout_s: time-out for a part without a process, or whose process is idle.

        Raises:
            BenchError: a part sends nothing, or uses another version of the wire.
        """
        self._run = run
        for link in self.links.values():
            link.restart(run)
            link.greeted = False
        self._await(self.links, timeout_s)

    def _await(self, parts: Iterable[str], timeout_s: float) -> None:
        began, shown, shown_s = time.monotonic(), list[str](), 0.0
        while waited := [name for name in parts if not self.links[name].greeted]:
            since_s = time.monotonic() - began
            if waited != shown or since_s - shown_s > _REPORT_S:
                shown, shown_s = waited, since_s
                self._waiting(waited, since_s)
            idle = [name for name in waited if self._idle_s(name) > timeout_s]
            if since_s > timeout_s and idle:
                raise BenchError(
                    f"no hello from {', '.join(idle)} in {timeout_s:g} s: is it connected, "
                    "at this speed, and does it run? (`robins bench ports` lists the ports)"
                )
            self.poll(_POLL_S)

    def _greet(self, name: str, frame: Frame) -> None:
        link, said, wire = self.links[name], BARE.decode("hello", frame.payload), self._wire
        if said["schema"] != wire.number:
            raise BenchError(
                f"'{name}' speaks another version of the wire (schema {said['schema']:#010x}, "
                f"here {wire.number:#010x}): build it with the header of this version"
            )
        if (number := said["part"]) != wire.parts.index(name):
            known = wire.parts[number] if number < len(wire.parts) else f"part {number}"
            raise BenchError(f"at the port of '{name}' there is {known}: exchange the ports")
        if link.greeted and self._step >= 0 and frame.header.sequence == 0:
            link.restart(self._run)  # the part has been restarted
        link.greeted = True
        self._put(link, "begin", BARE.encode("begin", {"step": self.step_ns}), 0)
        link.flush(_CLOCK_NS())

    # ----------------------------------------------------------------------------------- a step

    def step(
        self,
        number: int,
        timeout_ns: int | None = None,
        again_ns: int = REPEAT_TICK_NS,
        most_ns: int = ANSWER_NS,
    ) -> None:
        """Execute one step of all parts.

        Args:
            number: of the step, from 0.
            timeout_ns: time-out after which the step goes on without a part; None: ``most_ns``
                applies.
            again_ns: time after which an unanswered tick is sent again.
            most_ns: time after which a part that does not answer fails the run, unless its
                process computes.

        Raises:
            BenchError: a part does not answer.
            LinkLost: the far end of a port has closed.
        """
        self._step, self.time_ns = number, (number + 1) * self.step_ns
        self._done, self._ticked = set(self.off), {}
        self._routed[self.time_ns] = set()
        if len(self._routed) > _REMEMBERED:
            del self._routed[next(iter(self._routed))]
        self._poll()
        for name, link in self.links.items():
            if name in self.off:
                continue
            self._keep(link, None, link.release(self.time_ns))
            self._take(name, link.held(self.time_ns))
        self._advance()
        while len(self._done) < len(self.links):
            self.poll(_POLL_S if timeout_ns is None else min(_POLL_S, timeout_ns * 1e-9))
            self._wait(timeout_ns, again_ns, most_ns)

    def _wait(self, timeout_ns: int | None, again_ns: int, most_ns: int) -> None:
        """Repeat the tick to parts that have not answered, or give up on them."""
        now = _CLOCK_NS()
        for name, (at_ns, last_ns) in list(self._ticked.items()):
            if name in self._done:
                continue
            waited = now - at_ns
            if timeout_ns is not None and waited > timeout_ns:
                self.silent[name] += 1
                self._end(name)
            elif waited > again_ns and min(waited, 1e9 * self._idle_s(name)) > most_ns:
                raise BenchError(
                    f"'{name}' does not answer the tick of step {self._step} "
                    f"(for {most_ns * 1e-9:g} s)"
                )
            elif now - last_ns > again_ns:
                self._ticked[name] = at_ns, now
                self._tick(name)

    def _advance(self) -> None:
        """Tick every part whose sources are done."""
        for name, sources in self._sources.items():
            if name not in self._ticked and name not in self.off and sources <= self._done:
                now = _CLOCK_NS()
                self._ticked[name] = now, now
                self._tick(name)

    def _tick(self, name: str) -> None:
        link = self.links[name]
        self._put(link, "tick", self._step.to_bytes(4, "little"), self.time_ns)
        self._flush(link)

    def _end(self, name: str) -> None:
        self._done.add(name)
        self._advance()

    def say(self, message: str, payload: bytes) -> None:
        """Pass on an operator message between two steps; its time is the end of the last one.

        It goes out with the ticks of the next step, to parts that take it with a lag of one.

        Raises:
            OperatorMessageError: the bench does not send this message, or a number is beyond its
                limits.
        """
        if message not in self._console:
            raise OperatorMessageError(f"message: the bench does not say '{message}'")
        if why := self._wire.unsound(message, payload):
            raise OperatorMessageError(f"message '{message}': {why.text}")
        self._observe(message, self.time_ns, payload)
        for taker in self._takers[message]:
            if taker not in self.off:
                self._put(self.links[taker], message, payload, self.time_ns)

    def revive(self, name: str, timeout_s: float, poll_processes: Callable[[], None]) -> None:
        """Bring a restarted part to the state of the old one; the run waits.

        Args:
            name: of the part.
            timeout_s: for its hello, and for each answer.
            poll_processes: called now and then.

        Raises:
            BenchError: it does not answer.
            LinkLost: the far end of its port is gone.
        """
        answered = self._step if name in self._done else self._step - 1
        begin, idle_s = beginning(self._run, self.step_ns), partial(self._idle_s, name)
        sent_frames = self._kept[name].sent_frames
        try:
            catch_up(
                self.links[name], sent_frames, begin, answered, timeout_s, poll_processes, idle_s
            )
        except OSError as error:
            raise LinkLost(name, error) from None

    def switch_off(self, name: str) -> None:
        """Go on without a part whose process has ended, until `switch_on`."""
        link = self.links[name]
        with contextlib.suppress(OSError):
            link.read(_CLOCK_NS(), self.time_ns)  # its last output is of no use
        link.restart(self._run)
        link.greeted = False
        self.off.add(name)
        if name in self._kept:
            self._kept[name].forget()

    def switch_on(self, name: str, timeout_s: float) -> None:
        """Include a restarted part again; the run waits for its hello.

        Raises:
            BenchError: no hello comes.
            LinkLost: the far end of a port is gone.
        """
        self._await([name], timeout_s)
        self.off.remove(name)

    # ----------------------------------------------------------------------------------- the wire

    def poll(self, timeout_s: float) -> None:
        """Receive for up to a given time, pass messages on, write pending bytes; return as soon as
        some arrive.

        Raises:
            LinkLost: the far end of a port is gone.
        """
        by_fd, slow = self._by_fd, []
        if self._slow:  # virtual lines with a baud rate
            due = [t for link in self._slow if (t := link.next_ns()) is not None]
            slow = [link.fd for link in self._slow]
            if due:
                timeout_s = min(timeout_s, (min(due) - _CLOCK_NS()) * 1e-9)
        waiting = [link.fd for link in by_fd.values() if link.pending]
        ready, writable, _ = select.select(self._fds, waiting, [], 0.0)
        if not (ready or writable):
            self._meanwhile()
            ready, writable, _ = select.select(self._fds, waiting, [], max(0.0, timeout_s))
        for fd in dict.fromkeys([*ready, *slow]) if slow else ready:
            link = by_fd[fd]
            try:
                found = link.read(_CLOCK_NS(), self.time_ns)
            except OSError as error:
                raise LinkLost(link.name, error) from None
            self._take(link.name, found)
        for fd in dict.fromkeys([*writable, *slow]):
            self._flush(by_fd[fd])
        if time.monotonic() - self._glanced > _POLL_S:
            self._poll()
            self._glanced = time.monotonic()

    def _take(self, name: str, found: list[tuple[str, Frame]]) -> None:
        for message, frame in found:
            if message == "hello":
                self._greet(name, frame)
            elif message == "done":
                self._finished(name, frame)
            elif message not in self._sends[name]:
                self.links[name].count("strange")
            elif (age := self._age(name, message, frame.header.time_ns)) is not None:
                self._route(message, frame, age)

    def _age(self, name: str, message: str, at_ns: int) -> int | None:
        """Age of a frame in steps; None: not usable. A frame that is early or late is counted.

        The past does not change: a frame of a step that is over is passed on only to parts that
        take its message with such a lag, and only the first of its message for a step is.
        """
        link, (age, beside) = self.links[name], divmod(self.time_ns - at_ns, self.step_ns)
        if age < 0:
            link.count("early")
            return None
        if message in self._routed.get(at_ns, ()):
            link.count("repeated")
            return None
        if age or beside or name in self._done or self._step < 0:
            link.count("late")  # parts that take it without a lag have already computed
        usable = not beside and age <= min(self._lags[message], self._step)
        return age if usable else None

    def _finished(self, name: str, frame: Frame) -> None:
        said = BARE.decode("done", frame.payload)
        if name in self._kept:
            self._kept[name].answered(said["step"])
        if said["step"] != self._step or name not in self._ticked or name in self._done:
            return
        at = self._ticked[name][0]
        self._answered_by(name, self._step, at, _CLOCK_NS(), said["compute"])
        self._end(name)

    def _route(self, message: str, frame: Frame, age: int) -> None:
        at, payload = frame.header.time_ns, frame.payload
        self._routed.setdefault(at, set()).add(message)
        self._observe(message, at, payload)
        for taker in self._takers[message]:
            if taker in self.off or age > self._takes[taker][message]:
                continue
            link = self.links[taker]
            self._put(link, message, payload, at)
            if taker in self._ticked:
                self._flush(link)  # else it goes out with the tick

    def _put(self, link: Link, name: str, payload: bytes, time_ns: int) -> None:
        raw = link.send(name, payload, time_ns, self.time_ns)
        if name != "begin":
            self._keep(link, self._step if name == "tick" else None, raw)

    def _keep(self, link: Link, step: int | None, raw: bytes) -> None:
        if raw and link.name in self._kept:
            self._kept[link.name].add(step, raw)

    def _flush(self, link: Link) -> None:
        try:
            link.flush(_CLOCK_NS())
        except OSError as error:
            raise LinkLost(link.name, error) from None

    # ------------------------------------------------------------------------------------- the end

    def stop(self) -> None:
        """Notify every part of the end of the run."""
        for link in self.links.values():
            try:
                self._put(link, "stop", b"", self.time_ns)
                link.flush(_CLOCK_NS())
            except OSError:
                continue  # its far end has closed already
