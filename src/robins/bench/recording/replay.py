"""Replay of one part of a recorded run on its recorded input, with a comparison of its answers.

The part receives every recorded byte in the recorded order, corrupt ones included, and as in
lock-step the next tick waits until the part is done with the last. So a part whose output depends
on its input alone sends the same bits again, however the run was paced; for one that has been
changed, `robins.bench.recording.differences` finds the differences.
"""

from __future__ import annotations

import os
import select
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from itertools import groupby
from typing import Any, NamedTuple

from robins.bench.parts.idle import idleness
from robins.bench.ports.port import Pair, open_pair
from robins.bench.recording.differences import Differences, differences, name_of
from robins.bench.recording.layout import Entry
from robins.bench.wire.frames import Frame, Header, encode_frame
from robins.bench.wire.receiver import Receiver
from robins.bench.wire.records import RecordError
from robins.bench.wire.schema import BARE, FIRST_DATA, NUMBERS, Wire
from robins.errors import RobinsError

TIMEOUT_S = 60.0  # time-out of a part that neither answers nor computes
_LOOK_S = 0.1  # period of checks that the part is alive
_HELLO, _TICK, _DONE, _STOP, _BEGIN = (
    NUMBERS[name] for name in ("hello", "tick", "done", "stop", "begin")
)
_DONE_SIZE = BARE.size_of("done")

Start = Callable[[str], AbstractContextManager[Any]]
"""Function from the path of a port to a context within which the part runs there. The value of the
context may have ``poll()``, as `subprocess.Popen` has, to distinguish a dead part from a slow
one."""


class ReplayError(RobinsError, RuntimeError):
    """A replay that cannot be done, or that a part did not complete."""

    bad_input = False


class Replayed(NamedTuple):
    """Answers of a part to a record, compared with those in the record."""

    part: str
    compared: Differences  # data frames of the part, recorded and replayed
    first_difference: str | None  # of any byte except computing times; in words
    steps: int  # replayed
    step_ns: int
    starts: int  # of the part; more than one where it was restarted in the record

    @property
    def same(self) -> bool:
        """True if every byte of every frame is equal, apart from computing times."""
        return self.first_difference is None


class _LinkRow(NamedTuple):
    """Bytes on the line of a part."""

    life: int  # number of the part's start, from 0
    begin: Frame  # of it
    to: bool  # the part, or from it
    data: bytes
    found: list[Frame]  # that end in it

    def ticks(self) -> list[Frame]:
        """Ticks of this run."""
        run = self.begin.header.run
        return [f for f in self.found if f.header.type == _TICK and f.header.run == run]


def replay(
    entries: Iterable[Entry],
    wire: Wire,
    part: str,
    start: Start,
    timeout_s: float = TIMEOUT_S,
    progress: Callable[[int, int], None] | None = None,
    says: Callable[[Frame], None] = lambda frame: None,
) -> Replayed:
    """Run a part again on a record, and compare its answers.

    The part is restarted where it was restarted in the record. Memory holds only frames that are
    still to be compared.

    Args:
        entries: of a run, in the order in which they were written; iterated more than once. A
            truncated record is replayed up to its end.
        wire: its messages.
        part: whose link it is.
        start: runs the part at a port.
        timeout_s: time-out for the part's hello, and for each step.
        progress: called with the steps done, and their total.
        says: called with each data frame that the part sends in the replay.

    Raises:
        ReplayError: the record has nothing of the part, or the part has another schema, died, did
            not answer in time, or restarted by itself; names the step.
    """
    total = sum(len(row.ticks()) for row in _rows(entries, part) if row.to)
    first: str | None = None
    done, starts, step_ns, compared = 0, 0, 0, None

    def count() -> None:
        nonlocal done
        done += 1
        if progress is not None:
            progress(done, total)

    for (_, begin), rows in groupby(_rows(entries, part), _life_of):
        step_ns = int(BARE.decode("begin", begin.payload)["step"])
        compared = compared or Differences(wire, step_ns)
        life = _PartLifetime(wire, begin, step_ns, compared, says)
        with open_pair() as pair, start(pair.path) as process:
            _Replay(wire, part, pair, process, timeout_s, life).run(rows, count)
        first = first or life.first_difference()
        starts += 1
    assert compared is not None  # else there was no begin
    return Replayed(part, compared, first, total, step_ns, starts)


# ------------------------------------------------------------------------------------- the record


def recorded(entries: Iterable[Entry], part: str) -> Iterator[Frame]:
    """Data frames that a part sent in a record, each once, in order.

    Raises:
        ReplayError: the record has nothing of the part; raised at its end.
    """
    for _, rows in groupby(_rows(entries, part), _life_of):
        newest = -1
        for row in rows:
            for frame in () if row.to else row.found:
                if _is_recorded(frame, row.begin) and frame.header.sequence > newest:
                    newest = frame.header.sequence
                    yield frame


def _life_of(row: _LinkRow) -> tuple[int, Frame]:
    return row.life, row.begin


def _is_recorded(frame: Frame, begin: Frame) -> bool:
    return frame.header.type >= FIRST_DATA and frame.header.run == begin.header.run


def _rows(entries: Iterable[Entry], part: str) -> Iterator[_LinkRow]:
    """Record of a part from its first begin on.

    A begin before the first tick answers a repeated hello; a later one starts another lifetime of
    the part.

    Raises:
        ReplayError: there is no begin; raised at the end.
    """
    begin, life, record_tick = None, -1, False
    links: set[str] = set()
    to, back = Receiver(), Receiver()
    for entry in entries:
        links.add(entry.link)
        if entry.link != part:
            continue
        if entry.direction == "to":
            found = to.feed(entry.data)
            new = next((f for f in found if f.header.type == _BEGIN), None)
            if new is not None and (begin is None or record_tick):
                begin, life, record_tick, back = new, life + 1, False, Receiver()
        elif begin is None:
            continue
        else:
            found = back.feed(entry.data)
        if begin is not None:
            row = _LinkRow(life, begin, entry.direction == "to", entry.data, found)
            record_tick = record_tick or (row.to and bool(row.ticks()))
            yield row
    if begin is None:
        there = ", ".join(sorted(links)) or "none"
        raise ReplayError(f"the record has no begin to the part '{part}'; links in it: {there}")


# --------------------------------------------------------------------------------------- the part


@dataclass
class _Replay:
    """Replay of one lifetime of a part, from start to exit."""

    _wire: Wire
    _part: str
    _pair: Pair
    _process: Any
    _timeout_s: float
    _life: _PartLifetime
    _idle_s: Callable[[int | None], float] = field(default_factory=idleness)
    _receiver: Receiver = field(default_factory=Receiver)
    _waiting: list[Frame] = field(default_factory=list)
    _where: str = "before its hello"

    def run(self, rows: Iterable[_LinkRow], count: Callable[[], None]) -> None:
        """Send the part its recorded input; pass recorded and new answers to the comparison."""
        self._greet()
        latest, last = -1, self._life.begin.header
        for row in rows:
            if not row.to:
                self._life.add_recorded(row)
                continue
            self._write(row.data)
            last = row.found[-1].header if row.found else last
            for tick in row.ticks():
                step = int(BARE.decode("tick", tick.payload)["step"])
                self._life.record_tick(step)
                if step >= latest:  # a part does not keep its answers to older ones
                    self._where = f"in step {step}"
                    for frame in self._until_done(step, latest):
                        self._life.add_new(frame)
                    latest = step
                count()
        if last.type != _STOP:  # the record ends before the run did
            head = Header(_STOP, self._life.run, (last.sequence + 1) % 2**32, last.time_ns)
            self._write(encode_frame(head, b""))

    def _greet(self) -> None:
        hello = self._next()
        while hello.header.type != _HELLO:
            hello = self._next()
        number = self._value("hello", hello, "part")
        parts, known = self._wire.parts, self._wire.number
        name = parts[number] if number < len(parts) else f"number {number}"
        if name != self._part:
            raise ReplayError(f"'{self._part}' is to be replayed, but who says hello is '{name}'")
        if (schema := self._value("hello", hello, "schema")) != known:
            raise ReplayError(
                f"part '{self._part}' has the schema {schema:#010x}, this is "
                f"{known:#010x}: build it with the header of this version"
            )

    def _until_done(self, step: int, latest: int) -> list[Frame]:
        """Frames that the part sends in a step; `latest` is the last step that it completed."""
        said: list[Frame] = []
        while True:
            frame = self._next()
            kind = frame.header.type
            if kind == _HELLO and latest >= 0:
                raise ReplayError(f"part '{self._part}' started anew by itself {self._where}")
            if frame.header.run != self._life.run:
                continue
            if kind == _DONE and self._value("done", frame, "step") == step:
                return said
            if kind >= FIRST_DATA:
                said.append(frame)

    def _value(self, name: str, frame: Frame, number: str) -> int:
        try:
            return BARE.decode(name, frame.payload)[number]
        except RecordError as error:
            raise ReplayError(f"part '{self._part}', {self._where}: {error}") from None

    def _next(self) -> Frame:
        """The next frame that the part sends."""
        began = time.monotonic()
        while not self._waiting:
            if not self._read(_LOOK_S):
                self._check(began)
        return self._waiting.pop(0)

    def _write(self, data: bytes) -> None:
        """Write bytes to the line; read meanwhile, so that the two ends cannot deadlock."""
        began = time.monotonic()
        master = self._pair.master
        while data:
            readable, writable, _ = select.select([master], [master], [], _LOOK_S)
            if readable:
                self._read(0.0)
            if writable:
                try:
                    data = data[os.write(master, data) :]
                except BlockingIOError:
                    continue
            else:
                self._check(began)

    def _read(self, wait_s: float) -> bool:
        master = self._pair.master
        if not select.select([master], [], [], wait_s)[0]:
            return False
        self._waiting += self._receiver.feed(os.read(master, 65536))
        return True

    def _check(self, began: float) -> None:
        """Check that the part is alive, and that it computes or has time left."""
        poll = getattr(self._process, "poll", None)
        if poll is not None and (code := poll()) is not None and not self._read(0.0):
            raise ReplayError(f"part '{self._part}' died {self._where} (exit code {code})")
        idle_s = self._idle_s(getattr(self._process, "pid", None))
        if min(time.monotonic() - began, idle_s) > self._timeout_s:
            raise ReplayError(
                f"part '{self._part}' did not answer {self._where} for {self._timeout_s:g} s"
            )


# ---------------------------------------------------------------------------------------- compare


class _PartLifetime:
    """Comparison of a part's recorded and new answers, from one begin to the next.

    Attributes:
        begin: its first frame.
        step_ns: length of a step.
    """

    def __init__(
        self,
        wire: Wire,
        begin: Frame,
        step_ns: int,
        compared: Differences,
        says: Callable[[Frame], None],
    ):
        self._wire, self.begin, self.step_ns = wire, begin, step_ns
        self._compared, self._says = compared, says
        self._then: dict[int, Frame] = {}  # recorded, by sequence number, not compared yet
        self._now: dict[int, Frame] = {}
        self._newest = self._tick = self._answered = -1  # of the record
        self._first: tuple[int, str] | None = None

    @property
    def run(self) -> int:
        return self.begin.header.run

    def record_tick(self, step: int) -> None:
        """Record a tick that was sent to the part."""
        self._tick = step

    def add_recorded(self, row: _LinkRow) -> None:
        """Add a recorded answer."""
        for frame in row.found:
            head = frame.header
            # the bench may have received a frame twice: a fault doubled it, or the part died after
            # it and its replacement sent it again
            if _is_recorded(frame, self.begin) and head.sequence > self._newest:
                self._newest = head.sequence
                self._compared.take(0, frame)
                self._then[head.sequence] = frame
                self._compare(head.sequence)
            elif (head.type, head.run) == (_DONE, self.run) and len(frame.payload) == _DONE_SIZE:
                step = int(BARE.decode("done", frame.payload)["step"])
                self._answered = max(self._answered, step)

    def add_new(self, frame: Frame) -> None:
        """Add a new answer."""
        self._says(frame)
        self._compared.take(1, frame)
        self._now[frame.header.sequence] = frame
        self._compare(frame.header.sequence)

    def _compare(self, number: int) -> None:
        if number in self._then and number in self._now:
            then, now = self._then.pop(number), self._now.pop(number)
            if then != now:
                self._differs(number, _in_words(self._wire, self, then, now))

    def _differs(self, number: int, words: str) -> None:
        if self._first is None or number < self._first[0]:
            self._first = number, words

    def first_difference(self) -> str | None:
        """First frame that differs, in words; call it at the end."""
        for number, frame in self._then.items():
            self._differs(number, f"{self._text(frame)} was recorded and is not said now")
        # a truncated record, or a part that died, ends in the middle of an answer
        complete = self._tick <= self._answered
        for number, frame in self._now.items():
            if complete or number < self._newest:
                self._differs(number, f"{self._text(frame)} is said now and was not recorded")
        return None if self._first is None else self._first[1]

    def _text(self, frame: Frame) -> str:
        return f"{_place(self, frame)}: {_frame_text(self._wire, frame)}"


def _in_words(wire: Wire, life: _PartLifetime, then: Frame, now: Frame) -> str:
    where = _place(life, then)
    if then.header != now.header:
        return (
            f"{where}: {_frame_text(wire, then)} was recorded, {_frame_text(wire, now)} is said now"
        )
    found = differences(wire, [then], [now], life.step_ns)
    if not found:  # a NaN has many bit patterns
        return f"{where}: {_frame_text(wire, then)} has the same numbers in other bytes"
    d = found[0]
    if not d.field:
        return f"{where}: {_frame_text(wire, then)} has other bytes"
    return f"{where}: {name_of(d)} was {d.a!r}, is {d.b!r}"


def _place(life: _PartLifetime, frame: Frame) -> str:
    time_ns = frame.header.time_ns
    return f"step {time_ns // life.step_ns - 1} ({time_ns * 1e-9:g} s)"


def _frame_text(wire: Wire, frame: Frame) -> str:
    head = frame.header
    name = wire.names.get(head.type, f"message {head.type}")
    return f"'{name}' of {head.time_ns * 1e-9:g} s, number {head.sequence},"
