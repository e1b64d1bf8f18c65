"""The server's data on the bench, and the pages that show them.

Each page has its own bounded queues: a slow page loses its oldest samples, which are counted, and
does not slow the others.
"""

from __future__ import annotations

import asyncio
import json
from collections import deque
from collections.abc import Awaitable, Callable

from robins.bench.live.events import Events
from robins.bench.live.feed import EVENTS, MARK, RECENT, FrameKind, JsonObject, sequence_of, to_json
from robins.bench.live.history import SampleHistory

QUEUE = 2 * RECENT  # samples that wait for a page


class Client:
    """Queues of one page.

    Attributes:
        dropped: samples lost because the page was too slow.
    """

    def __init__(self) -> None:
        self.dropped = 0
        self._lines: deque[str] = deque(maxlen=EVENTS)
        self._latest: dict[str, str] = {}  # newest text by key
        self._history = b""
        self._samples: deque[bytes] = deque()
        self._some = asyncio.Event()

    def greet(self, hello: str, history: bytes, recent: deque[bytes]) -> None:
        """Queue the full greeting, and drop all that is queued."""
        self._lines.clear()
        self._latest.clear()
        self._history = history
        self._samples = deque(recent)
        self._lines.append(hello)
        self._some.set()

    def line(self, text: str) -> None:
        """Queue a line."""
        self._lines.append(text)
        self._some.set()

    def latest(self, key: str, text: str) -> None:
        """Set the latest text of a key, in place of the one before."""
        self._latest[key] = text
        self._some.set()

    def sample(self, sample: bytes) -> None:
        """Queue a sample; if the queue is full, drop the oldest."""
        if len(self._samples) == QUEUE:
            self._samples.popleft()
            self.dropped += 1
        self._samples.append(sample)
        self._some.set()

    async def pump(
        self,
        send_text: Callable[[str], Awaitable[None]],
        send_bytes: Callable[[bytes], Awaitable[None]],
    ) -> None:
        """Send the queues for ever, as fast as the page takes them."""
        while True:
            if self._lines:
                await send_text(self._lines.popleft())
            elif self._latest:
                await send_text(self._latest.pop(next(iter(self._latest))))
            elif self._history:
                history, self._history = self._history, b""
                await send_bytes(history)
            elif self._samples:
                await send_bytes(self._samples.popleft())
            else:
                self._some.clear()
                await self._some.wait()


class Hub:
    """Receiver of the bench's data: passes it on, and keeps what a page that joins late needs.

    Attributes:
        clients: pages.
        faults: that a page may inject.
        says: labels of the operator messages that a page may send.
        events: of the run.
    """

    def __init__(self) -> None:
        self.clients: set[Client] = set()
        self.faults: list[JsonObject] = []
        self.says: list[str] = []
        self._hello: JsonObject | None = None
        self.events = Events()
        self._history = SampleHistory(0)
        self._recent: deque[bytes] = deque()
        self._status: JsonObject | None = None
        self._expected: int | None = None  # number of the next sample
        self._dropped = 0  # samples lost between bench and server

    def take(self, kind: int, body: bytes) -> None:
        """Process a frame from the bench."""
        if kind == FrameKind.SAMPLE:
            return self._take_sample(body)
        if kind == FrameKind.HISTORY:
            self._history = SampleHistory.unpack(body)
            return self._greet_all()
        greeting = json.loads(body)
        if kind == FrameKind.HELLO:
            self._take_hello(greeting)
        elif kind == FrameKind.STATUS:
            self._status = greeting
            self._send_latest("status", {"kind": "status", "status": greeting})
        elif kind == FrameKind.EVENT:
            self.events.keep(greeting)
            self._send_all({"kind": "event", **greeting})
        return None

    def join(self, client: Client) -> None:
        """Add a page."""
        client.greet(*self._greeting())
        self.clients.add(client)
        self.heartbeat()

    def leave(self, client: Client) -> None:
        """Remove a page."""
        self.clients.discard(client)

    def acknowledge(self, alarms: list[int]) -> None:
        """Send each page the alarms that were acknowledged."""
        self.events.acknowledge(alarms)
        self._send_all({"kind": "acknowledged", "alarms": alarms})

    def heartbeat(self) -> None:
        """Send each page a heartbeat with the counts of dropped samples."""
        for client in self.clients:
            heartbeat = {
                "kind": "beat",
                "dropped": client.dropped,
                "dropped_before": self._dropped,
                "pages": len(self.clients),
            }
            client.latest("beat", to_json(heartbeat))

    def end(self) -> None:
        """Notify each page that the bench has disconnected."""
        self._send_all({"kind": "ended"})

    def _take_hello(self, greeting: JsonObject) -> None:
        self._hello = greeting
        self.faults, self.says = greeting["faults"], greeting["says"]
        self._dropped = greeting["dropped"]
        self._expected = None
        self._status = None
        self.events = Events()
        self._history = SampleHistory(len(greeting["signals"]))
        self._recent.clear()
        self._greet_all()

    def _take_sample(self, sample: bytes) -> None:
        number = sequence_of(sample)
        if self._expected is not None:
            self._dropped += (number - self._expected) % MARK
        self._expected = number + 1
        if len(self._recent) == RECENT:
            self._history.add(self._recent.popleft())
        self._recent.append(sample)
        for client in self.clients:
            client.sample(sample)

    def _greet_all(self) -> None:
        for client in self.clients:
            client.greet(*self._greeting())

    def _greeting(self) -> tuple[str, bytes, deque[bytes]]:
        """Hello, history and the latest samples."""
        hello = self._hello or {"run": 0, "title": "", "signals": [], "faults": [], "says": []}
        text = to_json(
            {
                "kind": "hello",
                "bench": self._hello is not None,
                **hello,
                "events": self.events.kept,
                "status": self._status,
                "history": len(self._recent),
            }
        )
        return text, self._history.pack(hello["run"]), self._recent

    def _send_all(self, message: JsonObject) -> None:
        text = to_json(message)
        for client in self.clients:
            client.line(text)

    def _send_latest(self, key: str, message: JsonObject) -> None:
        text = to_json(message)
        for client in self.clients:
            client.latest(key, text)
