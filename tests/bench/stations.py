"""The seven parts in one process, joined by bytes: the loop of the bench without ports."""

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np

from robins.bench.parts.satellite import BUILD, Kit
from robins.bench.parts.satellite.preparing import kit_for
from robins.bench.parts.station import Station, ready
from robins.bench.run.setup import read
from robins.bench.wire import Frame, Header, Receiver, decode, encode, encode_frame, message

RUN = 7
ORDER = ("acm", "actuators", "plant", "table", "gyro", "star", "adm")
Meddle = Callable[[int, str, str, bytes], list[tuple[int, bytes]]]


@cache
def kit(name: str = "satellite/s1", filter_: str = "mekf", *settings: str) -> Kit:
    flight = read(name, settings)
    return kit_for(flight.loop, filter_, seed=0)


class Loop:
    """Stations with the bench between them; ``meddle`` gives what becomes of a message on its way.

    meddle(step, message, taker, payload) -> [(time [ns], payload)], by default that one.
    """

    def __init__(self, of: Kit, meddle: Meddle | None = None):
        self.kit, self.meddle = of, meddle
        self.stations = {
            name: Station(ready(build(of), of.frames)) for name, build in BUILD.items()
        }
        self.sent = dict.fromkeys(BUILD, 0)
        self.receivers = {name: Receiver() for name in BUILD}
        self.heard: dict[str, list[dict[str, Any]]] = {}
        self.said: list[tuple[str, Frame]] = []
        self.step = 0
        for name in BUILD:
            self.to(name, "begin", encode("begin", {"step": of.step_ns}), 0)

    def to(self, part: str, name: str, payload: bytes, time_ns: int) -> bytes:
        header = Header(message(name).number, RUN, self.sent[part], time_ns)
        self.sent[part] += 1
        return self.stations[part].feed(encode_frame(header, payload))

    def run(self, steps: int) -> "Loop":
        for k in range(self.step, self.step + steps):
            now = (k + 1) * self.kit.step_ns
            for part in ORDER:
                answer = self.to(part, "tick", encode("tick", {"step": k}), now)
                for frame in self.receivers[part].feed(answer):
                    self.pass_on(k, part, frame)
        self.step += steps
        return self

    def pass_on(self, step: int, part: str, frame: Frame) -> None:
        name = message(frame.header.type).name
        self.said.append((part, frame))
        if name == "done":
            return
        self.heard.setdefault(name, []).append(decode(name, frame.payload))
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
