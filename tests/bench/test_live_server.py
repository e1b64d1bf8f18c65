"""The live page without a browser: what the bench says comes, what strangers say does not."""

import json
import os
import re
import signal
import socket
import struct
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from reused_page import ReusedPage
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from robins.bench import live as package
from robins.bench.live import LivePage, Signal
from robins.bench.live.feed import to_json
from robins.bench.live.hub import QUEUE, Client

STATIC = Path(package.__file__).parent / "static"
SIGNALS = [
    Signal("error x", "arcsec", "Error"),
    Signal("sigma x", "arcsec", "Error", "sigma", "error x"),
    Signal("ratio", "1", "Ratio"),
]
FAULTS = [
    {"label": "star stuck", "fault": {"kind": "stuck", "link": "star"}},
    {"label": "noise", "fault": {"kind": "bit errors", "bits": 2}},
]
RUN = 41


@pytest.fixture
def live():
    """A server for a test that is rough with it."""
    with ReusedPage(SIGNALS, "a bench", RUN, faults=FAULTS) as made:
        yield made


@pytest.fixture(scope="module")
def server():
    with ReusedPage(SIGNALS, "a bench", RUN, faults=FAULTS) as made:
        yield made


@pytest.fixture
def shared(server):
    """The server of all tests that leave it as it was, with nothing of the test before."""
    server.next_run()
    return server


def page_of(live: LivePage, **options):
    """A websocket to the server, as a page opens it; it takes in all that comes."""
    return connect(live.url.replace("http", "ws") + "live", max_queue=None, **options)


def texts(page, kind: str, within_s: float = 3.0):
    """The next text of a kind; others and samples are passed over."""
    until = time.monotonic() + within_s
    while time.monotonic() < until:
        got = page.recv(timeout=within_s)
        if isinstance(got, str) and json.loads(got)["kind"] == kind:
            return json.loads(got)
    raise AssertionError(f"no {kind} within {within_s} s")


def frames(page, many: int, within_s: float = 5.0) -> list[bytes]:
    """Samples that come; fewer if the rest stays away."""
    found: list[bytes] = []
    until = time.monotonic() + within_s
    while len(found) < many and time.monotonic() < until:
        try:
            got = page.recv(timeout=min(0.5, within_s))
        except TimeoutError:
            continue
        if isinstance(got, bytes) and not is_history(got):
            found.append(got)
    return found


def await_sample(page, number: int, within_s: float = 60.0) -> None:
    """Receive samples until one of a number comes."""
    until = time.monotonic() + within_s
    while number not in numbers(frames(page, 1)):
        assert time.monotonic() < until, f"sample {number} does not come within {within_s} s"


def is_history(frame: bytes) -> bool:
    return frame[4:8] == b"\xff\xff\xff\xff"


def numbers(samples: list[bytes]) -> np.ndarray:
    return np.array([struct.unpack_from("<I", s, 4)[0] for s in samples])


def gone(pid: int, within_s: float = 4.0) -> bool:
    """Test for the end of a process; one that nobody waited for yet has ended too."""
    until = time.monotonic() + within_s
    while time.monotonic() < until:
        try:
            state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
        except (FileNotFoundError, ProcessLookupError):
            return True
        if state == "Z":
            return True
        time.sleep(0.02)
    return False


# --------------------------------------------------------------------------- what the bench says


def test_a_sample_comes_bit_for_bit(shared):
    values = [1.0 / 3.0, -5e-324, float("nan")]
    with page_of(shared) as page:
        hello = texts(page, "hello")
        shared.push(0.1, values)
        (frame,) = frames(page, 1)
    assert frame == struct.pack("<IId3d", shared.run, 0, 0.1, *values)
    assert (hello["run"], hello["title"], hello["bench"]) == (shared.run, "a bench", True)
    assert hello["signals"] == [
        {"name": n, "unit": u, "plot": p, "role": r, "of": o} for n, u, p, r, o in SIGNALS
    ]
    assert hello["faults"] == FAULTS


def test_a_page_that_comes_late_sees_what_was(shared):
    for k in range(250):
        shared.event("info", float(k), f"event {k}")
    shared.status({"state": "running", "deadlines": {"missed": 2}})
    with page_of(shared) as first:  # the feed keeps the order: with the last sample all is there
        for k in range(500):
            shared.push(0.1 * k, [float(k), 1.0, 0.5])
            if k % 50 == 49:  # a server that does not keep up loses samples
                await_sample(first, k)
    with page_of(shared) as page:
        hello = texts(page, "hello")
        assert hello["history"] == 300
        before = page.recv(timeout=3.0)
        while isinstance(before, str):
            before = page.recv(timeout=3.0)
        assert np.array_equal(numbers(frames(page, 300)), np.arange(200, 500))
    # what was before the latest 300: one bucket a sample, since there are few; by the documented
    # layout: head, times, least and greatest of each signal
    assert struct.unpack_from("<6I", before) == (shared.run, 0xFFFFFFFF, 200, 3, 1, 200)
    rows = np.array(struct.unpack_from("<1600d", before, 24)).reshape(8, 200)
    k = np.arange(200.0)
    wanted = [0.1 * k, 0.1 * k, k, k**0, 0.5 * k**0, k, k**0, 0.5 * k**0]
    assert np.array_equal(rows, wanted)
    assert [e["text"] for e in hello["events"]] == [f"event {k}" for k in range(50, 250)]
    assert hello["status"] == {"state": "running", "deadlines": {"missed": 2}}


def test_the_latest_status_and_every_event_come(shared):
    with page_of(shared) as page:
        texts(page, "hello")
        shared.status({"deadlines": {"lateness_us": {"p50": np.float64(1.5), "max": np.nan}}})
        got = texts(page, "status")["status"]
        shared.event("alarm", 3.5, "star refused")
        event = texts(page, "event")
    assert got == {"deadlines": {"lateness_us": {"p50": 1.5, "max": None}}}
    said = {"id": event["id"], "level": "alarm", "time_s": 3.5, "text": "star refused"}
    assert event == {"kind": "event", **said}


def test_another_run_begins_on_the_same_page(shared):
    old = shared.run
    shared.push(0.1, [1.0, 1.0, 1.0])
    shared.event("info", 0.1, "old")
    with page_of(shared) as page:
        assert texts(page, "hello")["run"] == old
        shared.next_run()
        hello = texts(page, "hello")
        shared.push(0.1, [2.0, 1.0, 1.0])
        (frame,) = frames(page, 1)
    assert (hello["run"], hello["events"], hello["history"]) == (old + 1, [], 0)
    assert struct.unpack_from("<IId", frame) == (old + 1, 0, 0.1)


def test_an_event_that_comes_again_and_again_is_one_line_with_a_count(shared):
    with page_of(shared) as page:
        texts(page, "hello")
        for k in range(50):
            shared.event("warning", float(k), "command pause")
            got = texts(page, "event")
        shared.event("info", 51.0, "something else")
        shared.event("warning", 52.0, "command pause")
        assert texts(page, "event")["text"] == "something else"
        assert "count" not in texts(page, "event")
    with page_of(shared) as page:
        kept = texts(page, "hello")["events"]
    assert (got["count"], got["time_s"], got["until_s"]) == (50, 0.0, 49.0)
    assert [(e["text"], e.get("count", 1)) for e in kept] == [
        ("command pause", 50),
        ("something else", 1),
        ("command pause", 1),
    ]


def test_an_alarm_waits_until_one_page_acknowledges_it_for_all(shared):
    with page_of(shared) as page, page_of(shared) as other:
        texts(page, "hello")
        for time_s, level in ((1.0, "alarm"), (1.5, "warning"), (2.0, "alarm")):
            shared.event(level, time_s, f"{level} at {time_s}")
        first, _, second = (texts(page, "event")["id"] for _ in range(3))
        page.send(json.dumps({"do": "acknowledge", "alarms": [first]}))
        assert texts(other, "acknowledged")["alarms"] == [first]
        assert texts(page, "taken")["do"] == "acknowledge"
        page.send(json.dumps({"do": "acknowledge", "alarms": [first]}))
        assert "none of these alarms waits" in texts(page, "refused")["text"]
        other.send(json.dumps({"do": "acknowledge", "alarms": [first, second]}))
        assert texts(page, "acknowledged")["alarms"] == [second]
    label = "'alarm at 1.0' of 1.0 s"
    commands = shared.commands()
    assert commands[0] == {"do": "acknowledge", "alarms": [first], "label": label}
    assert commands[1]["alarms"] == [second]
    shared.restart()  # a server that comes anew knows it too, from the bench
    shared.event("alarm", 3.0, "alarm at 2.0")
    with page_of(shared) as page:
        while len(kept := texts(page, "hello")["events"]) < 4:
            pass
    assert [e.get("acknowledged") for e in kept] == [True, None, True, None]


def test_json_has_nothing_that_a_browser_does_not_read():
    text = to_json({"a": [np.nan, np.inf, 1.5], "b": np.arange(2), 3: (True, None, "x")})
    assert json.loads(text) == {"a": [None, None, 1.5], "b": [0, 1], "3": [True, None, "x"]}


# -------------------------------------------------------------------- slow pages, dead processes


def test_the_bench_never_waits_for_a_server_that_does_not_read(live):
    os.kill(live._process.pid, signal.SIGSTOP)
    try:
        longest = 0.0
        for k in range(6000):
            began = time.perf_counter()
            live.push(0.1 * k, [float(k), 1.0, 1.0])
            longest = max(longest, time.perf_counter() - began)
    finally:
        os.kill(live._process.pid, signal.SIGCONT)
    # microseconds, but on a machine that others use; waiting would be for ever
    assert longest < 1.0
    assert live.dropped > 1000
    with page_of(live) as page:
        texts(page, "hello")
        seen: list[bytes] = []
        until = time.monotonic() + 5.0
        while not seen or numbers(seen)[-1] < 5999:
            assert time.monotonic() < until
            live.poll()
            seen += frames(page, 50, 0.1)
        got = numbers(seen)
        # What was dropped is the oldest of what waited; what came last is there.
        assert np.array_equal(got[-300:], np.arange(5700, 6000))
        assert np.all(np.diff(got) > 0)
        heartbeat = texts(page, "beat")
    assert heartbeat["dropped_before"] == live.dropped
    assert heartbeat["dropped"] == 0


@contextmanager
def deaf_page(live: LivePage):
    """A page that asks for samples and does not read them, with the least buffer there is."""
    at = live._at.getsockname()
    with socket.socket() as raw:
        raw.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        raw.settimeout(5.0)
        raw.connect(at)
        raw.sendall(
            f"GET /live HTTP/1.1\r\nHost: {at[0]}:{at[1]}\r\nUpgrade: websocket\r\n"
            "Connection: Upgrade\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n"
            "Sec-WebSocket-Version: 13\r\n\r\n".encode()
        )
        yield raw


def test_a_slow_page_loses_its_oldest_samples_and_slows_nobody():
    many = [Signal(f"s{k}", "1", "Many") for k in range(400)]  # 3 kB each, so that buffers fill
    with LivePage(many, "a bench", RUN) as live, deaf_page(live) as deaf, page_of(live) as page:
        texts(page, "hello")
        seen: list[bytes] = []
        for k in range(2000):
            live.push(0.1 * k, np.full(400, float(k)))
            if k % 20 == 19:
                seen += frames(page, 20, 5.0)
        assert np.array_equal(numbers(seen), np.arange(2000))  # the quick one has all of them
        assert live.dropped == 0
        got = drain(deaf)
        late = numbers([body for kind, body in got if kind == 2])
        beats = [json.loads(b) for kind, b in got if kind == 1 and b'"beat"' in b]
    assert late[-1] == 1999
    missing = np.diff(late) - 1
    assert np.count_nonzero(missing) == 1  # the oldest that waited went, no other
    assert missing.sum() == beats[-1]["dropped"] > 1000
    assert np.count_nonzero(late > late[np.argmax(missing)]) >= QUEUE


def drain(raw: socket.socket) -> list[tuple[int, bytes]]:
    """Messages of a websocket, opcode and body, until a beat comes after the last sample."""
    stream, found, last = raw.makefile("rb"), [], False
    while stream.readline().strip():
        pass  # the answer to the handshake
    with stream:
        while not last or b'"beat"' not in found[-1][1]:
            kind, length = stream.read(2)
            if length == 126:
                (length,) = struct.unpack(">H", stream.read(2))
            found.append((kind & 15, stream.read(length)))
            last = last or (found[-1][0] == 2 and numbers([found[-1][1]]) == 1999)
    return found


def test_memory_of_the_server_stays_constant(shared):
    def resident_kb() -> int:
        status = Path(f"/proc/{shared._process.pid}/status").read_text()
        return int(re.findall(r"VmRSS:\s+(\d+)", status)[0])

    sizes = []
    with deaf_page(shared), page_of(shared) as page:
        texts(page, "hello")
        for block in range(4):
            for k in range(1500 * block, 1500 * (block + 1)):
                shared.push(0.1 * k, [float(k), 1.0, 1.0])
                shared.event("info", 0.1 * k, f"event {k} " * 200)  # 2 kB
                if k % 100 == 99:  # the server drops samples: not all of them come
                    frames(page, 100, within_s=0.2)
            sizes.append(resident_kb())
    assert sizes[-1] < 1.1 * sizes[0]


def test_a_queue_counts_what_it_drops():
    client = Client()
    for k in range(QUEUE + 7):
        client.sample(bytes([k % 256]))
    assert client.dropped == 7


def test_a_killed_server_comes_back_at_the_same_port_with_what_was(live):
    for k in range(10):
        live.push(0.1 * k, [float(k), 1.0, 1.0])
    live.event("alarm", 0.5, "before")
    live.status({"state": "running"})
    os.kill(live._process.pid, signal.SIGKILL)
    until = time.monotonic() + 2.0
    while live.alive:
        assert time.monotonic() < until
    for k in range(10, 20):
        live.push(0.1 * k, [float(k), 1.0, 1.0])  # nobody listens, nothing is raised
    assert live.commands() == []
    url, until = live.url, time.monotonic() + 5.0
    while not live.alive and time.monotonic() < until:
        live.poll()
        time.sleep(0.02)
    assert (live.restarts, live.url, live.dropped) == (1, url, 0)
    with page_of(live, open_timeout=10) as page:
        assert texts(page, "hello")["restarts"] == 1
        assert np.array_equal(numbers(frames(page, 20)), np.arange(20))
    with page_of(live) as page:
        hello = texts(page, "hello")
    assert [e["text"] for e in hello["events"]] == ["before"]
    assert hello["status"] == {"state": "running"}


def test_a_server_that_comes_back_has_the_whole_run(live):
    for k in range(1000):
        live.push(0.1 * k, [float(k), 1.0, 1.0])
        live.poll()
    live.restart()
    while live._samples or live._partial:
        live.poll()
    with page_of(live) as page:
        while not (isinstance(got := page.recv(timeout=3.0), bytes) and is_history(got)):
            pass
        samples = numbers(frames(page, 300))
    assert struct.unpack_from("<6I", got)[2:] == (700, 3, 1, 700)
    assert np.array_equal(np.frombuffer(got, "<f8", 700, 24), 0.1 * np.arange(700))
    assert np.array_equal(samples, np.arange(700, 1000))


def test_a_server_that_keeps_dying_is_not_started_more_than_once_a_second(live):
    started = set()
    until = time.monotonic() + 2.5
    while time.monotonic() < until:
        live.poll()
        if live.alive:
            started.add(live._process.pid)
            os.kill(live._process.pid, signal.SIGKILL)
            live._process.wait()
    assert 2 <= len(started) <= 4


BENCH = """
import sys, time
from robins.bench.live import Live, Signal
live = Live([Signal("a", "1", "A")], "a bench", 1)
print(live._process.pid, live.url, flush=True)
time.sleep(60)
"""


def test_no_server_outlives_a_bench_that_was_killed():
    with subprocess.Popen(
        [sys.executable, "-c", BENCH], stdout=subprocess.PIPE, text=True
    ) as bench:
        pid, url = bench.stdout.readline().split()
        with connect(url.replace("http", "ws") + "live") as page:
            assert texts(page, "hello")["bench"]
            bench.kill()
            assert texts(page, "ended")
            with pytest.raises(ConnectionClosed):
                texts(page, "hello")
        assert gone(int(pid))


def test_ctrl_c_at_the_terminal_does_not_reach_the_server(shared):
    assert os.getsid(shared._process.pid) == shared._process.pid != os.getsid(0)


def test_close_ends_the_server_though_a_page_does_not_read():
    many = [Signal(f"s{k}", "1", "Many") for k in range(400)]
    with LivePage(many, "a bench", RUN) as live, deaf_page(live):
        for k in range(200):
            live.push(0.1 * k, np.zeros(400))
        pid = live._process.pid
        began = time.monotonic()
        live.close()
        assert time.monotonic() - began < 4.5
        assert gone(pid, 0.1)
        live.close()
        live.poll()
        assert not live.alive
