"""The end of a link at a part of the vehicle: takes bytes, computes at a tick, answers.

A part is a function from the messages received to those sent; lost, damaged, repeated and reordered
frames are handled here. Firmware does the same, see `bench/wire/firmware`.

Every `EVERY` steps a part saves its memory for a process that may replace it. The replacement goes
on from the latest memory that is older than the input sent again, so a death costs the time of some
hundred steps, however long the run. A memory is a file in the folder of the bench's processes; the
part writes it before it answers the tick of that step.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import select
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from robins.bench.wire.fields import Values
from robins.bench.wire.frames import Frame, Header, encode_frame
from robins.bench.wire.receiver import Receiver, Sequence
from robins.bench.wire.records import RecordError
from robins.bench.wire.schema import FIRST_DATA, Wire

EVERY = 256  # steps


def is_due(step: int) -> bool:
    """True if a part saves its memory after a step."""
    return (step + 1) % EVERY == 0


def path_of(folder: Path, part: str, step: int) -> Path:
    """Path of the memory of a part after a step."""
    return folder / f"{part}.{step}.memory"


def save_memory(folder: Path, part: str, step: int, memory: bytes) -> None:
    """Write a memory atomically; keep the one before it and delete older ones.

    If it cannot be written, the existing ones stay, and the run goes on.
    """
    path = path_of(folder, part, step)
    with contextlib.suppress(OSError):
        path.with_suffix(".new").write_bytes(memory)
        os.replace(path.with_suffix(".new"), path)
        path_of(folder, part, step - 2 * EVERY).unlink(missing_ok=True)


HELLO_EACH_S = 0.5
_MOST = 65536  # bytes read at once

_MEMORY = ("_run", "_step_ns", "_sequence", "_sent", "_state", "_inbox", "_done")

Inputs = Mapping[str, Any]  # values by field, for each message; None: it did not come
Sent = Iterable[tuple[str, Values]]  # messages with their values


class Part(NamedTuple):
    """Behaviour of a part.

    Attributes:
        name: one of the parts of its rig.
        takes: messages it takes, with their lag in steps: 0 or 1.
        begin: () -> state before the first step.
        act: (state, step, inputs) -> (state, sent), at a tick.
        example: inputs of the types to come, to compile all before the first tick; a message left
            out is None, as if it had not come.
        rare: runs code that no example reaches, to compile that too.
    """

    name: str
    takes: Mapping[str, int]
    begin: Callable[[], Any]
    act: Callable[[Any, int, Inputs], tuple[Any, Sent]]
    example: Inputs = MappingProxyType({})
    rare: Callable[[], Any] = lambda: None


class Station:
    """The protocol of a part, without a port: bytes in, bytes out.

    Attributes:
        counts: frames that were not used, by reason: "strange" (another run or an unknown message),
            "repeated", "late" (of a step that is over), "size".
        over: true once the bench has ended the run.
        begun: true once the bench has answered.
    """

    def __init__(
        self,
        part: Part,
        wire: Wire,
        memory: bytes | None = None,
        save_memory: Callable[[int, bytes], None] | None = None,
    ):
        """Set up the station of a part.

        Args:
            part: the part.
            wire: the messages of its rig.
            memory: saved by the process that it replaces; None: it starts without one.
            save_memory: called with step and memory every `EVERY` steps; None: none is saved.
        """
        self.part, self._wire, self._put_aside = part, wire, save_memory
        self.counts: Counter[str] = Counter()
        self.over = False
        self._receiver = Receiver()
        self._run: int | None = None
        self._step_ns = self._hellos = 0
        self._reset()
        if memory is not None:
            self.__dict__.update(pickle.loads(memory))
        self.begun = False

    def hello(self) -> bytes:
        """Hello frame, sent until the bench answers; numbered, so that a restarted part can be
        distinguished from one whose hello was on its way when the bench answered.
        """
        wire = self._wire
        said = {"part": wire.parts.index(self.part.name), "schema": wire.number}
        header = Header(wire.numbers["hello"], 0, self._hellos, 0)
        self._hellos += 1
        return encode_frame(header, wire.encode("hello", said))

    def feed(self, data: bytes) -> bytes:
        """Process received bytes and return the bytes to answer with."""
        answer = b""
        for frame in self._receiver.feed(data):
            answer += self._take(frame)
        return answer

    def _reset(self) -> None:
        self._sequence, self._sent = Sequence(), 0
        self._state = self.part.begin()
        self._inbox: dict[tuple[str, int], bytes] = {}
        self._done: tuple[int, int, list[tuple[str, bytes]]] | None = None  # step, time, answer

    def _take(self, frame: Frame) -> bytes:
        head = frame.header
        name = self._wire.names.get(head.type)
        if (
            name is not None
            and head.type < FIRST_DATA
            and len(frame.payload) != self._wire.size_of(name)
        ):
            self.counts["size"] += 1
            return b""
        if name == "begin":
            if head.run != self._run:
                self._reset()
                self._run, self.over = head.run, False
            self.begun = True
            self._step_ns = self._wire.decode("begin", frame.payload)["step"]
            return b""
        if head.run != self._run or name is None:
            self.counts["strange"] += 1
            return b""
        fresh = self._sequence.take(head.sequence)
        if name == "tick":
            return self._tick(self._wire.decode("tick", frame.payload)["step"], head.time_ns)
        if name == "stop":
            self.over = True
        elif name not in self.part.takes:
            self.counts["strange"] += 1
        elif not fresh:
            self.counts["repeated"] += 1
        elif self._done and head.time_ns + self.part.takes[name] * self._step_ns <= self._done[1]:
            self.counts["late"] += 1  # the step was computed without it
        else:
            self._inbox[name, head.time_ns] = frame.payload
        return b""

    def _tick(self, step: int, time_ns: int) -> bytes:
        if self._done and step < self._done[0]:
            self.counts["late"] += 1
            return b""
        fresh = not self._done or step > self._done[0]
        if fresh:
            self._compute(step, time_ns)
        assert self._done is not None
        out = b"".join(self._frame(name, payload, time_ns) for name, payload in self._done[2])
        if fresh and self._put_aside is not None and is_due(step):
            self._put_aside(step, pickle.dumps({name: self.__dict__[name] for name in _MEMORY}))
        return out

    def _compute(self, step: int, time_ns: int) -> None:
        began = time.perf_counter_ns()
        inputs = {name: self._input(name, time_ns) for name in self.part.takes}
        oldest = time_ns - self._step_ns
        self._inbox = {k: v for k, v in self._inbox.items() if k[1] > oldest}
        self._state, sent = self.part.act(self._state, step, inputs)
        answer = [(name, self._wire.encode(name, values)) for name, values in sent]
        elapsed_ns = min(time.perf_counter_ns() - began, 2**32 - 1)
        answer.append(("done", self._wire.encode("done", {"step": step, "compute": elapsed_ns})))
        self._done = step, time_ns, answer

    def _input(self, name: str, time_ns: int) -> Values | None:
        payload = self._inbox.get((name, time_ns - self.part.takes[name] * self._step_ns))
        if payload is None:
            return None
        try:
            return self._wire.decode(name, payload)
        except RecordError:
            self.counts["size"] += 1
            return None

    def _frame(self, name: str, payload: bytes, time_ns: int) -> bytes:
        assert self._run is not None
        header = Header(self._wire.numbers[name], self._run, self._sent, time_ns)
        self._sent = (self._sent + 1) % 2**32
        return encode_frame(header, payload)


def ready(part: Part, steps: Iterable[int]) -> Part:
    """Compile all that a part will run, before the clock of a run starts, and return the part.

    Args:
        part: the part.
        steps: one of each kind that takes different code.

    Raises:
        Exception: any error of the part, if it has an example of each message that it takes. A part
            that fails for lack of one is compiled by its first steps.
    """
    given = {name: part.example.get(name) for name in part.takes}
    reraised = contextlib.nullcontext() if given.keys() <= part.example.keys() else None
    with reraised or contextlib.suppress(Exception):
        for step in steps:
            part.act(part.begin(), step, given)
    part.rare()
    return part


def serve(port: Any, station: Station) -> Counter[str]:
    """Run a part at a port until the bench sends stop.

    Args:
        port: an open `serial.Serial`.
        station: of the part.

    Returns:
        Counts of the frames that were not used, see `Station.counts`.

    Raises:
        OSError: the far end of the port is gone.
    """
    fd = port.fileno()
    said = 0.0
    while not station.over:
        if not station.begun and time.monotonic() - said >= HELLO_EACH_S:
            port.write(station.hello())
            said = time.monotonic()
        # All available bytes in one system call: `port.read` needs three.
        if select.select([fd], [], [], None if station.begun else HELLO_EACH_S)[0]:
            data = os.read(fd, _MOST)
            if not data:
                raise ConnectionError(f"port '{port.port}': the far end is gone")
            if answer := station.feed(data):
                port.write(answer)
    return station.counts
