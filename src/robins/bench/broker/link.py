"""The bench's end of a link: frames to bytes and back, with counts of all errors.

An outgoing message gets its header, then the injected faults, then the delay of the line; an
incoming one takes the reverse path. So a receiver that counts frames at the other end sees an
injected fault exactly as a real one. A watcher sees the bytes as the part sent them and as the part
received them: so its record can be replayed.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from robins.bench.broker.injector import Injector, LineOutput
from robins.bench.ports.line import SerialLine
from robins.bench.wire.frames import Frame, Header, encode_frame
from robins.bench.wire.receiver import Receiver, Sequence
from robins.bench.wire.records import PayloadFault
from robins.bench.wire.schema import FIRST_DATA, Wire
from robins.errors import RobinsError


class BenchError(RobinsError, RuntimeError):
    """A run on the bench that cannot go on; names the part, the time and the cause."""

    bad_input = False


class LinkLost(BenchError):
    """A port whose far end has closed."""

    def __init__(self, part: str, why: OSError):
        super().__init__(f"the port of '{part}' is gone: {why}")
        self.part = part


Direction = Literal["to", "from"]
_MOST = 65536  # bytes read at once

Watcher = Callable[[str, Direction, bytes, int], None]
"""Observer of the bytes on a link: link, direction, bytes of a complete frame or bytes that form
none, time [ns]."""
Refuser = Callable[[str, str, PayloadFault], None]
"""Callback for each refused frame: link, message, reason."""


@dataclass
class Health:
    """Counts of frames from a link to the bench; `Link.count` alone writes it."""

    frames: int = 0  # data frames, valid and new
    wrong: int = 0  # runs of bytes that form no frame
    lost: int = 0  # sequence numbers that never came
    jumps: int = 0  # of sequence numbers, further than frames can have been lost
    repeated: int = 0  # same sequence number, or a second one of its message for a step
    late: int = 0  # out of order, or of a step that was over
    early: int = 0  # of a future step
    strange: int = 0  # of another run, or a message that this part must not send
    refused: int = 0  # intact frames whose length or numbers contradict the table of their message
    bytes_in: int = 0
    bytes_out: int = 0
    heard_ns: int = 0  # time of the run when data came last


class Link:
    """The bench's end of the line of a part.

    Attributes:
        name: of the part.
        health: see `Health`.
        greeted: whether the part has sent its hello, in this run.
    """

    def __init__(
        self,
        name: str,
        fd: int,
        wire: Wire,
        injector: Injector,
        watch: Watcher,
        baud: int | None = None,
        refuse: Refuser = lambda link, message, why: None,
    ):
        """Take over an open port.

        Args:
            name: of the part.
            fd: non-blocking file descriptor, of a pseudo-terminal or a real port.
            wire: its messages.
            injector: of the faults on this link.
            watch: called with everything on the line.
            baud: of the virtual line; None: bytes pass without delay, or the line is real.
            refuse: called with each frame that contradicts the table of its message; the frame is
                counted and dropped.
        """
        self.name, self.fd = name, fd
        self._wire, self._refuse = wire, refuse
        self.health = Health()
        self.greeted = False
        self._injector, self._watch = injector, watch
        self._lines = None if baud is None else (SerialLine(baud), SerialLine(baud))
        self._run = 0
        self._out, self._ready = bytearray(), bytearray()  # for the line; through it
        self.restart(0)

    def restart(self, run: int) -> None:
        """Restart both directions, for a new run or for a restarted part."""
        self._run, self._sent = run, 0
        self._sequence = Sequence()
        self._receiver, self._spoilt = Receiver(), Receiver()
        self._counted: dict[str, int] = {}  # by those three, and in the health
        self._most_lost = 0  # frames that the part can have sent since the last one that came

    # ------------------------------------------------------------------------------------- to

    def send(self, name: str, payload: bytes, time_ns: int, now_ns: int) -> bytes:
        """Put a message on the line after its faults; `flush` writes it.

        Args:
            name: of the message.
            payload: its bytes.
            time_ns: of its header.
            now_ns: time of the run.

        Returns:
            The bytes that go out.
        """
        if name == "begin":  # sent to each hello, always as number 0
            number, self._sent = 0, max(self._sent, 1)
        else:
            number, self._sent = self._sent, (self._sent + 1) % 2**32
        if name == "tick":
            self._most_lost += len(self._wire.data) + 1
        header = Header(self._wire.numbers[name], self._run, number, time_ns)
        frame = Frame(header, payload)
        raw = encode_frame(header, payload)
        if header.type < FIRST_DATA:
            return self._put(raw, time_ns)
        return self._pass(self._injector.pass_on(self.name, "to", frame, raw, now_ns), time_ns)

    def release(self, now_ns: int) -> bytes:
        """Put frames on the line that a fault delayed until now."""
        return self._pass(self._injector.release(self.name, "to", now_ns), now_ns)

    def _pass(self, pieces: list[LineOutput], time_ns: int) -> bytes:
        out = b""
        for piece in pieces:
            raw = encode_frame(*piece.frame) if piece.frame is not None else piece.raw
            out += self._put(raw or b"", time_ns)
        return out

    def _put(self, raw: bytes, time_ns: int) -> bytes:
        self._watch(self.name, "to", raw, time_ns)
        self._out += raw
        return raw

    def flush(self, wall_ns: int) -> None:
        """Write as many bytes as the port takes now.

        Raises:
            OSError: the far end has closed.
        """
        if self._lines is None:
            self._ready += self._out
        else:
            self._lines[0].send(bytes(self._out), wall_ns)
            self._ready += self._lines[0].take(wall_ns)
        self._out.clear()
        while self._ready:
            try:
                written = os.write(self.fd, self._ready)
            except BlockingIOError:
                return  # the port is full; the rest goes first next time
            self.count("bytes_out", written)
            del self._ready[:written]

    @property
    def pending(self) -> bool:
        """True if bytes wait for the port."""
        return bool(self._out or self._ready)

    @property
    def is_slow(self) -> bool:
        """True if it has a virtual line with a baud rate."""
        return self._lines is not None

    def next_ns(self) -> int | None:
        """Time [ns] at which the line will have carried the next byte, on the clock of `flush`."""
        if self._lines is None:
            return None
        times = [t for line in self._lines if (t := line.next_ns) is not None]
        return min(times, default=None)

    # ----------------------------------------------------------------------------------- from

    def read(self, wall_ns: int, now_ns: int) -> list[tuple[str, Frame]]:
        """Frames received, with the names of their messages; of data only usable frames.

        Raises:
            OSError: the far end has closed.
        """
        try:
            data = os.read(self.fd, _MOST)
            if not data:
                raise OSError(f"the port of '{self.name}' was closed")
        except BlockingIOError:
            data = b""
        if self._lines is not None:
            self._lines[1].send(data, wall_ns)
            data = self._lines[1].take(wall_ns)
        self.count("bytes_in", len(data))
        found: list[tuple[str, Frame]] = []
        for frame in self._receiver.feed(data):
            name = self._wire.names.get(frame.header.type)
            if frame.header.type < FIRST_DATA:
                self._control(name, frame, found, now_ns)
            elif frame.header.run != self._run:
                self.count("strange")
            else:
                raw = encode_frame(*frame)
                self._watch(self.name, "from", raw, frame.header.time_ns)
                if name is not None and self._is_invalid(name, frame, now_ns):
                    continue
                pieces = self._injector.pass_on(self.name, "from", frame, raw, now_ns)
                self._arrive(pieces, found, now_ns)
        self._count()
        return found

    def held(self, now_ns: int) -> list[tuple[str, Frame]]:
        """Frames from the part that a fault delayed until now."""
        found: list[tuple[str, Frame]] = []
        self._arrive(self._injector.release(self.name, "from", now_ns), found, now_ns)
        self._count()
        return found

    def count(self, what: str, more: int = 1) -> None:
        """Add to a count of the health."""
        setattr(self.health, what, getattr(self.health, what) + more)

    def _control(
        self, name: str | None, frame: Frame, found: list[tuple[str, Frame]], now_ns: int
    ) -> None:
        if name != "hello" and (name != "done" or frame.header.run != self._run):
            self.count("strange")
            if frame.header.run == self._run:
                self._check_sequence(frame, now_ns)  # it has come, and is not lost
        elif not self._is_invalid(name, frame, now_ns):
            self._watch(self.name, "from", encode_frame(*frame), frame.header.time_ns)
            if name == "done":
                self._check_sequence(frame, now_ns)
            found.append((name, frame))

    def _is_invalid(self, name: str, frame: Frame, now_ns: int) -> bool:
        """Refuse a frame that contradicts the table of its message."""
        if (why := self._wire.unsound(name, frame.payload)) is None:
            return False
        if name != "hello":  # whose number is not of this run
            self._check_sequence(frame, now_ns)
        self.count("refused")
        self._refuse(self.name, name, why)
        return True

    def _check_sequence(self, frame: Frame, now_ns: int) -> bool:
        """Count the sequence number of a frame; true if the frame is new and in order."""
        here = now_ns if frame.header.time_ns == now_ns else None
        most = self._sequence.REMEMBERED + self._most_lost
        self._most_lost = 0
        return self._sequence.take(frame.header.sequence, here, most)

    def _arrive(
        self, pieces: list[LineOutput], found: list[tuple[str, Frame]], now_ns: int
    ) -> None:
        for piece in pieces:
            frames = self._spoilt.feed(piece.raw or b"") if piece.frame is None else [piece.frame]
            for frame in frames:
                self._use(frame, found, now_ns)

    def _use(self, frame: Frame, found: list[tuple[str, Frame]], now_ns: int) -> None:
        name = self._wire.names.get(frame.header.type)
        new = self._check_sequence(frame, now_ns)
        if name is None:
            self.count("strange")
        elif new:
            self.count("frames")
            self.health.heard_ns = now_ns
            found.append((name, frame))

    def _count(self) -> None:
        sequence = self._sequence
        counted = {name: getattr(sequence, name) for name in ("lost", "jumps", "repeated", "late")}
        counted["wrong"] = self._receiver.counts.wrong + self._spoilt.counts.wrong
        for what, so_far in counted.items():
            self.count(what, so_far - self._counted.get(what, 0))
        self._counted = counted
