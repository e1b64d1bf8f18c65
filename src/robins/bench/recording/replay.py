"""Runs a part of a recorded run again alone, on its recorded input, and compares its answers.

The part gets every byte that it got, in that order, wrong ones included, and as in lock-step the
next tick waits until it is done with the one before. So a part whose output depends on its input
alone says the same bits again, however the run was paced; one that has been changed does not, and
`robins.bench.recording.differences` tells where.
"""

from __future__ import annotations

import os
import select
import time
from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager
from typing import Any, NamedTuple

from robins.bench.ports.port import Pair, open_pair
from robins.bench.recording.differences import differences, name_of
from robins.bench.recording.layout import Entry
from robins.bench.recording.reader import Record
from robins.bench.wire.frames import Frame, Header, encode_frame
from robins.bench.wire.receiver import Receiver
from robins.bench.wire.records import RecordError
from robins.bench.wire.schema import BARE, FIRST_DATA, NUMBERS, Wire
from robins.errors import RobinsError

PATIENCE_S = 60.0  # a part may compile its filter before it answers
_LOOK_S = 0.1  # at whether the part still lives
_HELLO, _TICK, _DONE, _STOP, _BEGIN = (
    NUMBERS[name] for name in ("hello", "tick", "done", "stop", "begin")
)

Start = Callable[[str], AbstractContextManager[Any]]
"""From the path of a port to a context within which the part runs there. What the context gives may
have ``poll()``, as `subprocess.Popen` has, which tells a part that has died from a slow one."""


class ReplayError(RobinsError, RuntimeError):
    """A replay that cannot be done, or a part that did not go through with it."""

    bad_input = False


class Replayed(NamedTuple):
    """What a part said when it heard a record again."""

    part: str
    frames: list[Frame]  # with data, as it said them now
    recorded: list[Frame]  # and then
    same: bool  # every byte of every frame; but how long computing took
    first_difference: str | None  # in words
    steps: int  # that were replayed
    step_ns: int
    starts: int  # of the part; more than one where it was started anew in the record


class _Life(NamedTuple):
    """What went to and from a part from one begin to the next."""

    begin: Frame
    to: list[tuple[bytes, list[Frame]]]  # bytes, with the frames that end in them
    said: dict[int, Frame]  # with data, by sequence number
    answered: set[int]  # steps that the part was done with

    @property
    def run(self) -> int:
        return self.begin.header.run

    @property
    def step_ns(self) -> int:
        return int(BARE.decode("begin", self.begin.payload)["step"])

    @property
    def ticks(self) -> list[int]:
        """Steps, in the order of their ticks."""
        return [
            int(BARE.decode("tick", f.payload)["step"])
            for _, found in self.to
            for f in found
            if f.header.type == _TICK and f.header.run == self.run
        ]


def replay(
    record: Record,
    wire: Wire,
    part: str,
    start: Start,
    patience_s: float = PATIENCE_S,
    progress: Callable[[int, int], None] | None = None,
) -> Replayed:
    """Let a part hear a record again, and compare what it says.

    Where the part was started anew in the record, it is started anew here.

    Args:
        record: of a run; one that was cut is replayed so far.
        wire: its messages.
        part: whose link it is.
        start: runs the part at a port.
        patience_s: for the part's hello, and for each step.
        progress: told the steps done, and all there are.

    Raises:
        ReplayError: the record has nothing of the part, or the part has another schema, died, did
            not answer in time, or started anew by itself; says in which step.
    """
    lives = _lives(record.entries, part)
    total = sum(len(life.ticks) for life in lives)
    frames: list[Frame] = []
    first: str | None = None
    done = 0

    def count() -> None:
        nonlocal done
        done += 1
        if progress is not None:
            progress(done, total)

    for life in lives:
        with open_pair() as pair, start(pair.path) as process:
            said = _Replay(wire, part, pair, process, patience_s, life).run(count)
        first = first or _first_difference(wire, life, said)
        frames += said
    return Replayed(
        part, frames, _said(lives), first is None, first, total, lives[0].step_ns, len(lives)
    )


# ------------------------------------------------------------------------------------- the record


def recorded(record: Record, part: str) -> list[Frame]:
    """What a part said in a record, data only, each frame once.

    Raises:
        ReplayError: the record has nothing of the part.
    """
    return _said(_lives(record.entries, part))


def _said(lives: Iterable[_Life]) -> list[Frame]:
    return [frame for life in lives for _, frame in sorted(life.said.items())]


def _lives(entries: Iterable[Entry], part: str) -> list[_Life]:
    """The record of a part, from begin to begin.

    A begin that comes before the first tick answers a hello that was repeated.

    Raises:
        ReplayError: there is none.
    """
    lives: list[_Life] = []
    links: set[str] = set()
    to, back = Receiver(), Receiver()
    for entry in entries:
        links.add(entry.link)
        if entry.link != part:
            continue
        if entry.direction == "to":
            found = to.feed(entry.data)
            begin = next((f for f in found if f.header.type == _BEGIN), None)
            if begin is not None and not (lives and not lives[-1].ticks):
                lives.append(_Life(begin, [], {}, set()))
                back = Receiver()
            if lives:
                lives[-1].to.append((entry.data, found))
        elif lives:
            for frame in back.feed(entry.data):
                _hear(lives[-1], frame)
    if not lives:
        there = ", ".join(sorted(links)) or "none"
        raise ReplayError(f"the record has no begin to the part '{part}'; links in it: {there}")
    return lives


def _hear(life: _Life, frame: Frame) -> None:
    """Note what the part said then."""
    head = frame.header
    if head.run != life.run:
        return
    if head.type >= FIRST_DATA:
        # the bench may have heard a frame twice: a fault doubled it, or the part died after it and
        # the one that took its place said it again
        life.said.setdefault(head.sequence, frame)
    elif head.type == _DONE and len(frame.payload) == BARE.size_of("done"):
        life.answered.add(int(BARE.decode("done", frame.payload)["step"]))


# --------------------------------------------------------------------------------------- the part


class _Replay:
    """One life of a part, lived again."""

    def __init__(
        self, wire: Wire, part: str, pair: Pair, process: Any, patience_s: float, life: _Life
    ):
        self._wire, self._part, self._pair, self._process = wire, part, pair, process
        self._patience_s, self._life = patience_s, life
        self._receiver = Receiver()
        self._waiting: list[Frame] = []
        self._where = "before its hello"

    def run(self, count: Callable[[], None]) -> list[Frame]:
        """What the part says, data only."""
        self._greet()
        run = self._life.run
        said: list[Frame] = []
        latest, last = -1, self._life.begin.header
        for data, found in self._life.to:
            self._write(data)
            for frame in found:
                last = frame.header
                if last.type != _TICK or last.run != run:
                    continue
                step = int(BARE.decode("tick", frame.payload)["step"])
                if step >= latest:  # a part has forgotten what it said to older ones
                    self._where = f"in step {step}"
                    said += self._until_done(step, latest)
                    latest = step
                count()
        if last.type != _STOP:  # the record ends before the run did
            head = Header(_STOP, run, (last.sequence + 1) % 2**32, last.time_ns)
            self._write(encode_frame(head, b""))
        return said

    def _greet(self) -> None:
        hello = self._next()
        while hello.header.type != _HELLO:
            hello = self._next()
        number = int(self._value("hello", hello, "part"))
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
        """What the part says in a step; `latest` is the one that it was done with last."""
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

    def _value(self, name: str, frame: Frame, field: str) -> Any:
        try:
            return BARE.decode(name, frame.payload)[field]
        except RecordError as error:
            raise ReplayError(f"part '{self._part}', {self._where}: {error}") from None

    def _next(self) -> Frame:
        """The next frame that the part sends."""
        end = time.monotonic() + self._patience_s
        while not self._waiting:
            if not self._read(_LOOK_S):
                self._check(end)
        return self._waiting.pop(0)

    def _write(self, data: bytes) -> None:
        """Put bytes on the line; reads, too, so that neither end waits for the other."""
        end = time.monotonic() + self._patience_s
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
                self._check(end)

    def _read(self, wait_s: float) -> bool:
        master = self._pair.master
        if not select.select([master], [], [], wait_s)[0]:
            return False
        self._waiting += self._receiver.feed(os.read(master, 65536))
        return True

    def _check(self, end: float) -> None:
        """That the part lives and there is time left."""
        poll = getattr(self._process, "poll", None)
        if poll is not None and (code := poll()) is not None and not self._read(0.0):
            raise ReplayError(f"part '{self._part}' died {self._where} (exit code {code})")
        if time.monotonic() > end:
            raise ReplayError(
                f"part '{self._part}' did not answer {self._where} for {self._patience_s:g} s"
            )


# ---------------------------------------------------------------------------------------- compare


def _first_difference(wire: Wire, life: _Life, said: list[Frame]) -> str | None:
    """The first frame that is not the same, in words."""
    now = {frame.header.sequence: frame for frame in said}
    # a record that was cut, or a part that died, ends in the middle of an answer
    whole = not life.ticks or life.ticks[-1] in life.answered
    end = max(life.said, default=-1)
    for number in sorted(life.said.keys() | now.keys()):
        a, b = life.said.get(number), now.get(number)
        if a == b:
            continue
        if a is not None and b is not None:
            return _in_words(wire, life, a, b)
        if a is not None:
            return f"{_place(life, a)}: {_told(wire, a)} was recorded and is not said now"
        if b is not None and (whole or number < end):
            return f"{_place(life, b)}: {_told(wire, b)} is said now and was not recorded"
    return None


def _in_words(wire: Wire, life: _Life, then: Frame, now: Frame) -> str:
    where = _place(life, then)
    if then.header != now.header:
        return f"{where}: {_told(wire, then)} was recorded, {_told(wire, now)} is said now"
    found = differences(wire, [then], [now], life.step_ns)
    if not found:  # a NaN has many bit patterns
        return f"{where}: {_told(wire, then)} has the same numbers in other bytes"
    d = found[0]
    if not d.field:
        return f"{where}: {_told(wire, then)} has other bytes"
    return f"{where}: {name_of(d)} was {d.a!r}, is {d.b!r}"


def _place(life: _Life, frame: Frame) -> str:
    time_ns = frame.header.time_ns
    return f"step {time_ns // life.step_ns - 1} ({time_ns * 1e-9:g} s)"


def _told(wire: Wire, frame: Frame) -> str:
    head = frame.header
    name = wire.names.get(head.type, f"message {head.type}")
    return f"'{name}' of {head.time_ns * 1e-9:g} s, number {head.sequence},"
