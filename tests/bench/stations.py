"""The seven parts in one process: joined by bytes, or on threads in the place of processes."""

import os
import termios
import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import cache
from typing import Any, ClassVar

import numpy as np

from robins.bench.parts.station import Part, Station, ready, serve
from robins.bench.ports.port import address, open_port
from robins.bench.rig import Rig
from robins.bench.rigs.satellite import BUILD, RIG, Kit
from robins.bench.rigs.satellite.errors import inside
from robins.bench.rigs.satellite.messages import WIRE
from robins.bench.rigs.satellite.preparing import kit_for
from robins.bench.run.setup import read
from robins.bench.wire import Frame, Header, Receiver, Wire, encode_frame

RUN = 7
ORDER = ("acm", "actuators", "plant", "table", "gyro", "star", "adm")
Meddle = Callable[[int, str, str, bytes], list[tuple[int, bytes]]]


def alive(pid: int) -> bool:
    """Whether there is a process of this number."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


@cache
def kit(name: str = "satellite/s1", filter_: str = "mekf", *settings: str) -> Kit:
    flight = read(name, settings)
    return kit_for(flight.given, filter_, seed=0)


@cache
def one_program(name: str, filter_: str, *settings: str) -> dict[str, np.ndarray]:
    """The run of a kit without any wire."""
    return inside(kit(name, filter_, *settings))


_READY: dict[int, tuple[Any, dict[str, Part]]] = {}


def parts(of: Any, rig: Rig = RIG) -> dict[str, Part]:
    """The parts of a kit, compiled once; what they remember is with their stations."""
    if id(of) not in _READY:  # the kit is kept, so that no other has its identity
        made = {name: ready(build(of), of.frames) for name, build in rig.build.items()}
        _READY[id(of)] = of, made
    return _READY[id(of)][1]


class Threads:
    """In the place of `Crew`: parts on threads, over pseudo-terminals; starts no process."""

    stations: ClassVar[Mapping[str, Callable[[Part, Wire], Station]]] = {}  # of parts that are odd

    def __init__(self, rig: Rig, kit: Any, *_: object):
        self.parts, self.wire = parts(kit, rig), rig.wire
        self.threads = list[threading.Thread]()

    def __enter__(self) -> "Threads":
        return self

    def __exit__(self, *_: object) -> None:
        for thread in self.threads:
            thread.join(5.0)

    def start(self, name: str, port: str, since: int = -1) -> None:
        def be():
            with suppress(OSError), open_port(address(port), timeout_s=None) as line:
                serve(line, self.stations.get(name, Station)(self.parts[name], self.wire))

        self.threads.append(threading.Thread(target=be, daemon=True))
        self.threads[-1].start()

    def process(self, name: str) -> None:
        return None

    def deaths(self, among: str | None = None) -> list[Any]:
        return []

    def remembers(self, name: str, step: int) -> bool:
        return False


def on_threads(monkeypatch: Any, crew: type[Threads] = Threads, **stations: Any) -> None:
    """Let sessions start threads, some of them with other stations."""
    monkeypatch.setattr(crew, "stations", stations)
    monkeypatch.setattr("robins.bench.run.session.Crew", crew)


class Loop:
    """Stations with the bench between them; ``meddle`` gives what becomes of a message on its way.

    meddle(step, message, taker, payload) -> [(time [ns], payload)], by default that one.
    """

    def __init__(self, of: Kit, meddle: Meddle | None = None):
        self.kit, self.meddle = of, meddle
        self.stations = {name: Station(part, WIRE) for name, part in parts(of).items()}
        self.sent = dict.fromkeys(BUILD, 0)
        self.receivers = {name: Receiver() for name in BUILD}
        self.heard: dict[str, list[dict[str, Any]]] = {}
        self.said: list[tuple[str, Frame]] = []
        self.step = 0
        for name in BUILD:
            self.to(name, "begin", WIRE.encode("begin", {"step": of.step_ns}), 0)

    def to(self, part: str, name: str, payload: bytes, time_ns: int) -> bytes:
        header = Header(WIRE.message(name).number, RUN, self.sent[part], time_ns)
        self.sent[part] += 1
        return self.stations[part].feed(encode_frame(header, payload))

    def run(self, steps: int) -> "Loop":
        for k in range(self.step, self.step + steps):
            now = (k + 1) * self.kit.step_ns
            for part in ORDER:
                answer = self.to(part, "tick", WIRE.encode("tick", {"step": k}), now)
                for frame in self.receivers[part].feed(answer):
                    self.pass_on(k, part, frame)
        self.step += steps
        return self

    def pass_on(self, step: int, part: str, frame: Frame) -> None:
        name = WIRE.message(frame.header.type).name
        self.said.append((part, frame))
        if name == "done":
            return
        self.heard.setdefault(name, []).append(WIRE.decode(name, frame.payload))
        for taker, station in self.stations.items():
            if name in station.part.takes:
                pieces = [(frame.header.time_ns, frame.payload)]
                if self.meddle is not None:
                    pieces = self.meddle(step, name, taker, frame.payload)
                for time_ns, payload in pieces:
                    self.to(taker, name, payload, time_ns)

    def all(self, name: str, field: str) -> np.ndarray:
        """A field of all messages of a name, in their order."""
        return np.array([said[field] for said in self.heard[name]])

    def flags(self) -> np.ndarray:
        return self.all("estimate", "flags").astype(int)


GONE = (OSError, termios.error)
"""What a port raises whose far end is gone."""


def receive(port) -> bytes:
    """All that has come in; waits for a first byte as long as the port's timeout says."""
    return port.read(max(1, port.in_waiting))
