"""The bench's handle of its live page: feeds the server process without ever blocking on it."""

from __future__ import annotations

import importlib.util
import ipaddress
import json
import select
import socket
import subprocess
import sys
import time
import warnings
from collections import deque
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np

from robins.bench.closing import Closing
from robins.bench.live import feed
from robins.bench.live.events import Events
from robins.bench.live.feed import FrameKind, JsonObject, Signal, as_json, check
from robins.bench.live.history import SampleHistory

START_S = 20.0  # time-out for a server to listen
END_S = 3.0  # time for it to end before it is killed
PAUSE_S = 1.0  # between two attempts to restart it
SEND_BUFFER = 1 << 16  # bytes in the kernel for a browser that does not read

Level = Literal["info", "warning", "alarm"]


class LivePage(Closing):
    """A page that shows a running bench, served by another process.

    The server has its own session, so Ctrl-C leaves it to the bench to end it, and it ends by
    itself when the bench is gone, even if killed. `push`, `status`, `event`, `commands` and `poll`
    do not block: data that the server does not take in time is kept up to a bound, beyond which the
    oldest samples are dropped and counted. For one thread; call `poll` regularly.

    Attributes:
        url: of the page.
        run: number of the run.
        dropped: samples lost because the server was too slow or down.
        restarts: times that the server was restarted.
    """

    def __init__(
        self,
        signals: Sequence[Signal],
        title: str,
        run: int,
        host: str = "127.0.0.1",
        port: int = 0,
        faults: Sequence[JsonObject] = (),
        says: Sequence[str] = (),
    ) -> None:
        """Start the server and wait until it listens.

        Args:
            signals: values of each sample, in this order.
            title: of the page.
            run: number of the run; a page clears its plots when it changes.
            host: address to listen at; any program that reaches it can stop the bench, so one
                beyond this machine gives a warning.
            port: to listen at; 0: any that is free.
            faults: offered for injection, each `{"label": str, "fault": {...}}`.
            says: labels of the operator messages that the page offers.

        Raises:
            ValueError: signals that cannot be plotted, or faults without distinct labels.
            ImportError: the extra "live" is not installed.
            OSError: the host or port is not available.
            RuntimeError: the server does not start.
        """
        check(signals)
        _check_faults(faults)
        for module in ("starlette", "uvicorn", "websockets"):
            if importlib.util.find_spec(module) is None:
                raise ImportError(f"the live page needs {module}: pip install 'robins[live]'")
        self.run = run
        self.dropped = 0
        self.restarts = 0
        self._signals, self._title, self._faults = tuple(signals), title, tuple(faults)
        self._says = tuple(says)
        self._sequence = 0
        self._recent: deque[bytes] = deque()
        self._history = SampleHistory(len(signals))  # of all samples so far
        self._events = Events()
        self._last_status: bytes | None = None
        self._commands: deque[dict[str, Any]] = deque(maxlen=100)
        self._process: subprocess.Popen[bytes] | None = None
        self._pipe: socket.socket | None = None
        self._started_at = -PAUSE_S
        self._closed = False
        self._at = _listen(host, port)
        self.url = _url(self._at)
        try:
            self._start()
            self._wait_until_it_listens()
        except BaseException:
            self.close()
            raise

    # ---------------------------------------------------------------------- from bench to page

    def push(self, time_s: float, values: Sequence[float] | np.ndarray) -> None:
        """Show a sample.

        Args:
            time_s: since the start of the run.
            values: of the signals, in their order; NaN: missing.

        Raises:
            ValueError: there are not as many values as signals.
        """
        if len(values) != len(self._signals):
            raise ValueError(f"{len(self._signals)} signals are shown, got {len(values)} values")
        sample = feed.pack_sample(self.run, self._sequence, time_s, values)
        self._sequence += 1
        if len(self._recent) == feed.RECENT:
            self._history.add(self._recent.popleft())
        self._recent.append(sample)
        if len(self._samples) == feed.RECENT:
            self._samples.popleft()
            self.dropped += 1
        self._samples.append(sample)
        self._pump()

    def status(self, status: JsonObject) -> None:
        """Show the state of the bench, in place of the one before; docs/live.md lists the keys.

        Raises:
            TypeError: something in it is not a number, text, list or mapping.
        """
        self._last_status = self._status = feed.to_json(status).encode()
        self._pump()

    def event(self, level: Level, time_s: float, text: str) -> None:
        """Add an event, or count it with the last one if the text is the same.

        An "alarm" goes to the alarm line too, until it is acknowledged.

        Args:
            level: how much it matters.
            time_s: since the start of the run.
            text: one sentence.
        """
        self._lines.append(feed.to_json(self._events.add(level, time_s, text)).encode())
        self._pump()

    # ---------------------------------------------------------------------- from page to bench

    def commands(self) -> list[JsonObject]:
        """Commands of the page since the last call, oldest first.

        Each has "do": "start", "pause", "stop", "inject", "clear", "say" or "acknowledge". "inject"
        has the "label" and the "fault" as they were given, and "duration_s", a number, or None for
        "until cleared"; "clear" has the "label" of one fault, or None for all; "say" has the
        "label" of an offered message; "acknowledge" has "alarms", the numbers of events, and a
        "label" that describes them.
        """
        self._receive()
        taken = list(self._commands)
        self._commands.clear()
        return taken

    # ---------------------------------------------------------------------------------- its server

    @property
    def alive(self) -> bool:
        """True if the server runs."""
        return self._pipe is not None and self._process is not None and self._process.poll() is None

    def poll(self) -> None:
        """Send what waits; start the server again if it died, once a second at most."""
        if self._closed:
            return
        self._receive()
        self._pump()
        if not self.alive and time.monotonic() - self._started_at >= PAUSE_S:
            self._end(kill=True)
            self.restarts += 1
            self._start()
            self._pump()

    def close(self) -> None:
        """End the server after it has shown the last samples and events. May be repeated."""
        if not self._closed:
            self._closed = True
            self._end(kill=False)
            self._at.close()

    # --------------------------------------------------------------------------------------- inside

    def _start(self) -> None:
        self._started_at = time.monotonic()
        ours, theirs = socket.socketpair()
        ours.setblocking(False)
        self._pipe, self._unread, self._listens = ours, b"", False
        # A restarted server shows the same page as the one before.
        self._hello: bytes | None = self._make_hello()
        self._before = self._history.pack(self.run)
        lines = (feed.to_json(event).encode() for event in self._events.kept)
        self._lines = deque(lines, maxlen=feed.EVENTS)
        self._samples = deque(self._recent)
        self._status, self._partial = self._last_status, b""
        fds = (theirs.fileno(), self._at.fileno())
        # -P: files in the working folder must not be imported as modules.
        command = [sys.executable, "-P", "-m", "robins.bench.live"]
        with theirs:
            self._process = subprocess.Popen(
                [*command, "--feed", str(fds[0]), "--listen", str(fds[1])],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                pass_fds=fds,
                start_new_session=True,
            )

    def _make_hello(self) -> bytes:
        hello = {
            "run": self.run,
            "title": self._title,
            "signals": as_json(self._signals),
            "faults": [dict(f) for f in self._faults],
            "says": list(self._says),
            "restarts": self.restarts,
            "dropped": self.dropped,
        }
        return feed.to_json(hello).encode()

    def _wait_until_it_listens(self) -> None:
        until = time.monotonic() + START_S
        while not self._listens:
            left = until - time.monotonic()
            if left <= 0.0 or not self.alive:
                code = self._process.poll() if self._process else None
                raise RuntimeError(
                    "the server of the live page does not start: "
                    + ("no word of it in time" if code is None else f"it ended with {code}")
                )
            self._pump()
            if self._pipe:
                select.select([self._pipe], [], [], min(left, 0.1))
            self._receive()

    def _next(self) -> bytes:
        """Next bytes to send, in the order in which a page needs them; empty: none."""
        if self._hello is not None:
            kind, body, self._hello = FrameKind.HELLO, self._hello, None
        elif self._before:
            kind, body, self._before = FrameKind.HISTORY, self._before, b""
        elif self._lines:
            kind, body = FrameKind.EVENT, self._lines.popleft()
        elif self._status is not None:
            kind, body, self._status = FrameKind.STATUS, self._status, None
        elif self._samples:
            kind, body = FrameKind.SAMPLE, self._samples.popleft()
        else:
            return b""
        return feed.pack(kind, body)

    def _pump(self) -> None:
        """Send as much as the server takes now."""
        while self._pipe is not None:
            self._partial = self._partial or self._next()
            if not self._partial:
                return
            try:
                self._partial = self._partial[self._pipe.send(self._partial) :]
            except BlockingIOError:
                return
            except OSError:
                self._lose()

    def _receive(self) -> None:
        """Receive the lines that the server sent."""
        while self._pipe is not None:
            try:
                data = self._pipe.recv(4096)
            except BlockingIOError:
                return
            except OSError:
                data = b""
            if not data:
                self._lose()
                return
            *lines, self._unread = (self._unread + data).split(b"\n")
            for line in map(json.loads, lines):
                if "do" in line:
                    self._commands.append(line)
                    if line["do"] == "acknowledge":
                        self._events.acknowledge(line["alarms"])
                else:
                    self._listens = True

    def _lose(self) -> None:
        if self._pipe is not None:
            self._pipe.close()
            self._pipe = None

    def _end(self, kill: bool) -> None:
        process, self._process = self._process, None
        if process is None:
            return self._lose()
        if kill:
            process.kill()
        until = time.monotonic() + END_S / 3.0
        while self._pipe is not None and not kill and time.monotonic() < until:
            self._pump()
            if not self._partial:
                break
            select.select([], [self._pipe] if self._pipe else [], [], 0.05)
        self._lose()
        try:
            process.wait(END_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        return None


def _check_faults(faults: Sequence[JsonObject]) -> None:
    labels = set()
    for f in faults:
        if set(f) != {"label", "fault"} or not isinstance(f["label"], str):
            raise ValueError(f'a fault is {{"label": text, "fault": {{...}}}}, got {dict(f)}')
        if f["label"] in labels:
            raise ValueError(f"two faults are labelled '{f['label']}'")
        labels.add(f["label"])


def _listen(host: str, port: int) -> socket.socket:
    """Open a listening socket. The bench holds it, so that its port outlives a server."""
    where = f"{host}:{port}"
    try:
        family, kind, proto, _, address = socket.getaddrinfo(
            host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
    except OSError as error:
        raise OSError(f"the live page cannot listen at {where}: {error}") from None
    at = socket.socket(family, kind, proto)
    try:
        at.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        at.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
        at.bind(address)
        at.listen()
    except OSError as error:
        at.close()
        raise OSError(
            error.errno, f"the live page cannot listen at {where}: {error.strerror}; choose another"
        ) from None
    if not ipaddress.ip_address(at.getsockname()[0]).is_loopback:
        warnings.warn(
            f"the live page listens at {where}: everybody who reaches it can stop this bench and "
            "inject faults; an ssh tunnel to 127.0.0.1 is safer",
            stacklevel=3,
        )
    return at


def _url(at: socket.socket) -> str:
    host, port = at.getsockname()[:2]
    address = ipaddress.ip_address(host)
    if address.is_unspecified:
        return f"http://{socket.gethostname()}:{port}/"
    return f"http://{f'[{host}]' if address.version == 6 else host}:{port}/"
