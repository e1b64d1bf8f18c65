"""The seven parts in one process: joined by bytes, or on threads in the place of processes."""

import os
import select
import signal
import termios
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import cache, partial
from hashlib import sha256
from multiprocessing import Pipe
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, ClassVar

import numpy as np

from robins.bench.parts.config_files import put, take
from robins.bench.parts.station import HELLO_EACH_S, Part, Station, path_of, ready, save_memory
from robins.bench.ports.port import address, open_port
from robins.bench.recording.replay import Start
from robins.bench.rig import Rig
from robins.bench.rigs.satellite import RIG
from robins.bench.rigs.satellite.config import SatelliteConfig, satellite_config
from robins.bench.rigs.satellite.judging import inside
from robins.bench.rigs.satellite.messages import WIRE
from robins.bench.run.processes import PartProcesses
from robins.bench.run.setup import LoadedRun, config_of, read
from robins.bench.wire import Frame, Header, Receiver, encode_frame

RUN = 7
ORDER = ("acm", "actuators", "plant", "table", "gyro", "star", "adm")
Meddle = Callable[[int, str, str, bytes], list[tuple[int, bytes]]]


def alive(pid: int) -> bool:
    """Test for a process of this number."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


@cache
def config(name: str = "satellite/s1", filter_: str = "mekf", *settings: str) -> SatelliteConfig:
    flight = read(name, settings)
    return satellite_config(flight.given, filter_, seed=0)


@cache
def one_program(name: str, filter_: str, *settings: str) -> dict[str, np.ndarray]:
    """The run of a config without any wire."""
    return inside(config(name, filter_, *settings))


_KITS: dict[int, tuple[Any, Any, str]] = {}
_READY: dict[tuple[str, str], dict[str, Part]] = {}
MOST_KITS = 4  # whose parts are kept: each has some hundred MB of programs


class Parts(dict[str, Part]):
    """Parts by name, each compiled when it is first needed."""

    def __init__(self, rig: Rig, of: Any):
        super().__init__()
        self.rig, self.config = rig, of

    def __missing__(self, name: str) -> Part:
        return self.setdefault(name, ready(self.rig.part(name, self.config), self.config.frames))


def parts(of: Any, rig: Rig = RIG) -> Mapping[str, Part]:
    """Parts of a config as a process would take it; compiled once for all kits with the same bytes.

    What they remember is with their stations.
    """
    if id(of) not in _KITS:  # the config is kept, so that no other has its identity
        with TemporaryDirectory() as folder:
            put(of, path := Path(folder) / "kit")
            _KITS[id(of)] = of, take(path), sha256(path.read_bytes()).hexdigest()
    _, taken, digest = _KITS[id(of)]
    key = rig.name, digest
    _READY[key] = _READY.pop(key, None) or Parts(rig, taken)  # the latest is the last
    while len(_READY) > MOST_KITS:
        del _READY[next(iter(_READY))]
    return _READY[key]


class Node(threading.Thread):
    """Stand-in for the process of a part: a thread at the end of a pseudo-terminal."""

    pid = None

    def __init__(self, station: Station, port: str):
        super().__init__(daemon=True)
        self.station, self.port, self.code = station, port, None
        self.killed, self.killer = Pipe(duplex=False)
        self.start()

    def run(self) -> None:
        code = 1
        try:
            with suppress(OSError), open_port(address(self.port), timeout_s=None) as line:
                self.serve(line)
            code = 0
        finally:
            self.code = code if self.code is None else self.code

    def serve(self, line: Any) -> None:
        """Do as `robins.bench.parts.station.serve` does, until it is killed."""
        station = self.station
        while not station.over:
            if not station.begun:
                line.write(station.hello())
            wait_s = None if station.begun else HELLO_EACH_S
            found = select.select([line, self.killed], [], [], wait_s)[0]
            if self.killed in found:
                return
            if not found:
                continue
            if not (data := os.read(line.fileno(), 65536)):
                return  # the far end is gone
            if answer := station.feed(data):
                line.write(answer)

    def poll(self) -> int | None:
        return self.code

    def kill(self) -> None:
        self.code = -signal.SIGKILL
        self.killer.send_bytes(b"!")
        self.wait()

    def wait(self) -> None:
        self.join(5.0)


class Threads(PartProcesses):
    """Stand-in for `PartProcesses`: parts of a rig on threads, but for programs and a few.

    Attributes:
        stations: of parts that are odd.
        processes: parts that stay processes.
    """

    stations: ClassVar[Mapping[str, Callable[..., Station]]] = {}
    processes: ClassVar[Sequence[str]] = ()

    def start(self, part: str, port: str, since: int = -1) -> None:
        if part in {*self._programs, *self.processes}:
            return super().start(part, port, since)
        (self._folder / f"{part}.txt").touch()
        given = [parts(self._config, self._rig)[part], self._rig.wire]
        if self._restarts:
            memory = None if since < 0 else path_of(self._folder, part, since).read_bytes()
            given += [memory, partial(save_memory, self._folder, part)]
        self._running[part] = Node(self.stations.get(part, Station)(*given), port)


@contextmanager
def starting(flight: LoadedRun, part: str, program: Path | None) -> Iterator[Start]:
    """Stand-in for the function that starts a process for a replay."""
    programs = {} if program is None else {part: program}
    with Threads(flight.rig, config_of(flight), programs=programs) as part_processes:

        @contextmanager
        def start(port: str) -> Iterator[Any]:
            part_processes.start(part, port)
            running = part_processes._running[part]
            yield running
            running.kill()
            running.wait()

        yield start


def on_threads(
    monkeypatch: Any,
    part_processes: type[Threads] = Threads,
    processes: Sequence[str] = (),
    **stations: Any,
) -> None:
    """Let sessions and replays start threads, but for some parts; some with other stations."""
    monkeypatch.setattr(part_processes, "stations", stations)
    monkeypatch.setattr(part_processes, "processes", processes)
    monkeypatch.setattr("robins.bench.run.session.PartProcesses", part_processes)
    monkeypatch.setattr("robins.workbench.bench._starter", starting)


class Loop:
    """Stations with the bench between them; ``meddle`` gives what becomes of a message on its way.

    meddle(step, message, taker, payload) -> [(time [ns], payload)], by default that one.
    """

    def __init__(self, of: SatelliteConfig, meddle: Meddle | None = None):
        self.config, self.meddle = of, meddle
        self.stations = {name: Station(parts(of)[name], WIRE) for name in RIG.parts}
        self.sent = dict.fromkeys(RIG.parts, 0)
        self.receivers = {name: Receiver() for name in RIG.parts}
        self.heard: dict[str, list[dict[str, Any]]] = {}
        self.said: list[tuple[str, Frame]] = []
        self.step = 0
        for name in RIG.parts:
            self.to(name, "begin", WIRE.encode("begin", {"step": of.step_ns}), 0)

    def to(self, part: str, name: str, payload: bytes, time_ns: int) -> bytes:
        header = Header(WIRE.message(name).number, RUN, self.sent[part], time_ns)
        self.sent[part] += 1
        return self.stations[part].feed(encode_frame(header, payload))

    def run(self, steps: int) -> "Loop":
        for k in range(self.step, self.step + steps):
            now = (k + 1) * self.config.step_ns
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
