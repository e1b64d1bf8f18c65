"""Replay of records that are written by hand, with parts on threads and in processes."""

import contextlib
import shutil
import subprocess
import sys
import threading

import numpy as np
import pytest
from stations import GONE, receive

from robins.bench import wire
from robins.bench.ports.port import Address, open_port
from robins.bench.recording import Entry, Event, Recorder, open_record
from robins.bench.recording.replay import ReplayError, recorded, replay
from robins.bench.rigs.satellite.messages import WIRE
from robins.bench.wire import Header, Receiver
from robins.bench.wire.c_header import firmware

STEP_NS = 100_000_000
STEPS = 60
RUN = 11


def time_ns(step: int) -> int:
    return (step + 1) * STEP_NS


def encoded(name: str, sequence: int, at_ns: int, run: int = RUN, **values) -> bytes:
    return wire.encode_frame(
        Header(WIRE.numbers[name], run, sequence, at_ns), WIRE.encode(name, values)
    )


# --------------------------------------------------------------- a part, and what it ought to say


def estimate(total: np.ndarray, step: int) -> dict:
    """Output of the part: sums of all inputs, so that one wrong frame changes all after."""
    return {
        "q_ib": [1.0, *total],
        "gyro_bias": np.sqrt(np.abs(total)),
        "sigma": np.full(6, np.nan) if step % 7 == 0 else np.full(6, 0.1),
        "flags": step % 2,
    }


class Echo(threading.Thread):
    """The part 'adm' on a thread; says `estimate` of the sum of the gyro's samples."""

    def __init__(self, path: str, **odd):
        super().__init__(daemon=True)
        self.path, self.odd, self.code = path, odd, None
        self.heard = b""

    def poll(self):
        return self.code

    def run(self) -> None:
        with contextlib.suppress(*GONE), open_port(Address(self.path), 0.2) as port:
            self.talk(port)

    def talk(self, port) -> None:
        receiver, run, sequence, total, answer = Receiver(), 0, 0, np.zeros(3), (-1, b"")
        said = {"part": WIRE.parts.index(self.odd.get("part", "adm")), "schema": WIRE.number}
        said["schema"] ^= self.odd.get("schema", 0)
        port.write(encoded("hello", 0, 0, run=0, **said))
        inbox: dict[int, np.ndarray] = {}
        while True:
            data = receive(port)
            self.heard += data
            for frame in receiver.feed(data):
                name, head = WIRE.message(frame.header.type).name, frame.header
                if name == "begin" and head.run != run:
                    run, sequence, total = head.run, 0, np.zeros(3)
                if name == "stop":
                    return
                values = WIRE.decode(name, frame.payload)
                if name == "gyro" and head.run == run:
                    inbox.setdefault(head.time_ns, values["theta_b"])
                if name != "tick" or values["step"] < answer[0]:
                    continue
                k = values["step"]
                if k == self.odd.get("dies"):
                    self.code = -9
                    return
                if k == self.odd.get("hangs"):
                    continue
                if k == self.odd.get("starts anew"):
                    port.write(encoded("hello", 0, 0, run=0, **said))
                    continue
                if k > answer[0]:
                    total = total + inbox.get(head.time_ns, 0.0)
                    told = self.odd.get("change", lambda e, k: e)(estimate(total, k), k)
                    answer = (k, WIRE.encode("estimate", told))
                at = head.time_ns
                out = wire.encode_frame(
                    Header(WIRE.numbers["estimate"], run, sequence, at), answer[1]
                )
                took = int(np.random.default_rng().integers(10**6))
                port.write(out + encoded("done", sequence + 1, at, run, step=k, compute=took))
                sequence += 2


@contextlib.contextmanager
def echo(path: str, **odd):
    part = Echo(path, **odd)
    part.start()
    yield part
    part.join(3.0)
    assert not part.is_alive()


def starting(**odd):
    return lambda path: echo(path, **odd)


class Story:
    """A record, entry by entry; what the part says is computed here, not by the part."""

    def __init__(self, seed: int = 0):
        self.rng = np.random.default_rng(seed)
        self.entries: list[Entry] = []
        self.to_count = self.from_count = 0
        self.theta = self.rng.normal(size=(STEPS, 3))
        self.total = np.zeros(3)

    def to(self, data: bytes, link: str = "adm") -> None:
        self.entries.append(Entry(len(self.entries), link, "to", data))

    def back(self, data: bytes, link: str = "adm") -> None:
        self.entries.append(Entry(len(self.entries), link, "from", data))

    def hello(self) -> None:
        said = {"part": WIRE.parts.index("adm"), "schema": WIRE.number}
        self.back(encoded("hello", 0, 0, run=0, **said))

    def begin(self) -> None:
        self.to(encoded("begin", 0, 0, step=STEP_NS))
        self.to_count, self.from_count, self.total = 1, 0, np.zeros(3)

    def say(self, name: str, at: int, **values) -> None:
        self.to(encoded(name, self.to_count, time_ns(at), **values))
        self.to_count += 1

    def answer(self, step: int, took: int = 5) -> None:
        told = estimate(self.total, step)
        self.back(encoded("estimate", self.from_count, time_ns(step), **told))
        self.back(encoded("done", self.from_count + 1, time_ns(step), step=step, compute=took))
        self.from_count += 2

    def step(self, k: int) -> None:
        self.to(b"of another link", link="gyro")
        self.say("gyro", k, theta_b=self.theta[k])
        self.say("tick", k, step=k)
        self.total = self.total + self.theta[k]
        self.answer(k)


def plain_story() -> Story:
    story = Story()
    story.hello()
    story.begin()
    for k in range(STEPS):
        story.step(k)
    story.say("stop", STEPS)
    return story


def noisy_story() -> Story:
    """Wrong bytes, lost and repeated frames, ticks that come again, another run's leftovers."""
    story = Story(1)
    story.hello()
    story.hello()
    story.begin()
    story.begin()  # each hello is answered
    for k in range(STEPS):
        sample = encoded("gyro", story.to_count, time_ns(k), theta_b=story.theta[k])
        if k % 5 == 1:  # spoilt, so it does not count
            spoilt = bytearray(sample)
            spoilt[int(story.rng.integers(1, len(sample) - 1))] ^= 4
            story.to(bytes(spoilt))
        elif k % 5 == 2:  # cut, and there again
            story.to(sample[:20])
            story.to(sample)
            story.total = story.total + story.theta[k]
        elif k % 5 == 3:
            story.to(story.rng.bytes(50))
            story.to(encoded("gyro", 9, time_ns(k), run=RUN - 1, theta_b=[1, 1, 1]))
        story.to_count += 1
        story.say("tick", k, step=k)
        story.answer(k)
        if k % 4 == 0:  # the tick came again, and so does the answer
            story.say("tick", k, step=k)
            story.answer(k)
        if k % 4 == 2:  # one that is over is not answered
            story.say("tick", k, step=k - 1)
    story.say("stop", STEPS)
    return story


# ------------------------------------------------------------------------------------------ tests


@pytest.mark.parametrize("story", [plain_story, noisy_story])
def test_the_same_part_says_the_same(story, tmp_path):
    """Through a file, as a record is."""
    with Recorder(tmp_path / "run.mcap", WIRE, {}) as recorder:
        for entry in story().entries:
            recorder.write(entry)
        recorder.event(Event(0, "note", "nothing", {}))
    told, parts = [], []

    @contextlib.contextmanager
    def start(path):
        with echo(path) as part:
            parts.append(part)
            yield part

    record = open_record(tmp_path / "run.mcap")
    frames: list[wire.Frame] = []
    found = replay(
        record.entries, WIRE, "adm", start, 5.0, lambda k, n: told.append((k, n)), frames.append
    )
    assert found.first_difference is None
    assert found.same
    assert (found.part, found.starts, found.step_ns) == ("adm", 1, STEP_NS)
    assert frames == list(recorded(record.entries, "adm"))
    many = STEPS + (STEPS // 4 if story is noisy_story else 0)
    assert found.compared.frames == [many, many]
    assert len(frames) == many
    assert found.compared.found() == []
    assert told == [(k + 1, found.steps) for k in range(found.steps)]
    # byte for byte what it heard then, wrong ones included
    sent = b"".join(e.data for e in record.entries if (e.link, e.direction) == ("adm", "to"))
    assert parts[0].heard == sent


def test_a_part_that_has_changed_is_found_out():
    def change(said, k):
        if k >= 23:
            said["gyro_bias"][1] = np.nextafter(said["gyro_bias"][1], 9.0)
        return said

    found = replay(plain_story().entries, WIRE, "adm", starting(change=change), 5.0)
    assert not found.same
    then = list(recorded(plain_story().entries, "adm"))[23]
    then = float(WIRE.decode("estimate", then.payload)["gyro_bias"][1])
    words = f"was {then!r}, is {float(np.nextafter(then, 9.0))!r}"
    assert found.first_difference == f"step 23 (2.4 s): estimate.gyro_bias[1] {words}"
    (d,) = found.compared.found()
    assert (d.field, d.component, d.first_step, d.count) == ("gyro_bias", 1, 23, STEPS - 23)


def test_a_nan_of_other_bits_is_not_byte_for_byte():
    def change(said, k):
        if k == 7:
            said["sigma"] = -np.full(6, np.nan)
        return said

    found = replay(plain_story().entries, WIRE, "adm", starting(change=change), 5.0)
    assert not found.same
    words = "step 7 (0.8 s): 'estimate' of 0.8 s, number 14, has the same numbers in other bytes"
    assert words in found.first_difference


def test_frames_too_many_and_too_few_are_told():
    story = plain_story()
    lacking = [e for k, e in enumerate(story.entries) if k != 2 + 5 * 8 + 3]
    found = replay(lacking, WIRE, "adm", starting(), 5.0)
    words = "step 8 (0.9 s): 'estimate' of 0.9 s, number 16, is said now and was not recorded"
    assert found.first_difference == words
    last = [e for k, e in enumerate(story.entries) if k != 2 + 5 * (STEPS - 1) + 3]
    found = replay(last, WIRE, "adm", starting(), 5.0)
    assert f"number {2 * STEPS - 2}, is said now and was not recorded" in found.first_difference
    more = {"innovation": [0] * 3, "sigma": [0] * 3, "ratio": 0}
    story.back(encoded("innovation", 2 * STEPS, time_ns(60), **more))
    found = replay(story.entries, WIRE, "adm", starting(), 5.0)
    assert "number 120, was recorded and is not said now" in found.first_difference


def test_a_frame_that_the_bench_heard_twice_counts_once():
    story = plain_story()
    doubled = [e for e in story.entries for _ in range(1 + (e.direction == "from"))]
    assert replay(doubled, WIRE, "adm", starting(), 5.0).same


@pytest.mark.parametrize("lost", [1, 2, 3, 4, 5, 6])
def test_a_record_that_was_cut_is_replayed_so_far(lost):
    """Wherever an answer was cut, what is there is the same."""
    cut = plain_story().entries[:-lost]
    found = replay(cut, WIRE, "adm", starting(), 5.0)
    assert found.same
    assert found.steps == STEPS - (lost >= 4)


def test_a_part_that_was_started_anew_is_started_anew():
    story = Story()
    story.begin()
    for k in range(20):
        story.step(k)
    story.say("gyro", 20, theta_b=story.theta[20])
    story.say("tick", 20, step=20)  # it died over this, after its first frame
    told = estimate(story.total + story.theta[20], 20)
    story.back(encoded("estimate", story.from_count, time_ns(20), **told))
    story.hello()
    story.begin()
    for k in range(21, STEPS):
        story.step(k)
    found = replay(story.entries, WIRE, "adm", starting(), 5.0)
    assert found.first_difference is None
    assert (found.starts, found.steps) == (2, STEPS)


@pytest.mark.parametrize(
    ("odd", "words"),
    [
        ({"dies": 12}, r"part 'adm' died in step 12 \(exit code -9\)"),
        ({"dies": 0}, "died in step 0"),
        ({"hangs": 12}, "part 'adm' did not answer in step 12 for 0.5 s"),
        ({"starts anew": 12}, "part 'adm' started anew by itself in step 12"),
        ({"part": "acm"}, "'adm' is to be replayed, but who says hello is 'acm'"),
        ({"schema": 1}, "part 'adm' has the schema 0x.*: build it with the header"),
    ],
)
def test_a_part_that_does_not_go_through_with_it(odd, words):
    parts = []

    @contextlib.contextmanager
    def start(path):
        parts.append(Echo(path, **odd))
        parts[0].start()
        yield parts[0]

    with pytest.raises(ReplayError, match=words):
        replay(plain_story().entries, WIRE, "adm", start, 0.5)
    parts[0].join(3.0)  # it ends when its line does
    assert not parts[0].is_alive()


def test_a_part_that_says_nothing():
    with pytest.raises(ReplayError, match=r"'adm' did not answer before its hello for 0\.2 s"):
        replay(plain_story().entries, WIRE, "adm", lambda _: contextlib.nullcontext(), 0.2)


def test_a_record_without_the_part_lists_those_it_has():
    with pytest.raises(ReplayError, match="no begin to the part 'star'; links in it: adm, gyro"):
        replay(plain_story().entries, WIRE, "star", starting())
    with pytest.raises(ReplayError, match="links in it: adm, gyro"):
        list(recorded(plain_story().entries, "star"))
    with pytest.raises(ReplayError, match="links in it: none"):
        replay([], WIRE, "star", starting())


def test_a_process_that_dies_is_told_by_its_code():
    @contextlib.contextmanager
    def start(path):
        code = "import sys, time; time.sleep(0.2); sys.exit(3)"
        process = subprocess.Popen([sys.executable, "-c", code])
        yield process
        process.wait()

    with pytest.raises(ReplayError, match=r"died before its hello \(exit code 3\)"):
        replay(plain_story().entries, WIRE, "adm", start, 30.0)


@pytest.mark.skipif(shutil.which("gcc") is None, reason="needs a C compiler, gcc")
def test_a_board_in_c_says_the_same_to_a_record(tmp_path):
    """The turn between attitudes about one axis, by hand, to the bit where it is an exact one."""
    for name, text in firmware(WIRE).items():
        (tmp_path / name).write_text(text)
    command = ["gcc", "-std=c99", "-O1", "gyro_board.c", "platform_posix.c", "-lm", "-o", "board"]
    subprocess.run(command, cwd=tmp_path, check=True)

    @contextlib.contextmanager
    def start(path):
        process = subprocess.Popen([tmp_path / "board", path])
        yield process
        process.kill()
        process.wait()

    entries = []

    def entry(direction, data):
        entries.append(Entry(len(entries), "gyro", direction, data))

    entry("to", encoded("begin", 0, 0, step=STEP_NS))
    quarter = [np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)]
    for k in range(100):
        q = [[1.0, 0.0, 0.0, 0.0], quarter][k % 2]
        entry("to", encoded("mounted", 2 * k + 1, time_ns(k), q_ib=q))
        entry("to", encoded("tick", 2 * k + 2, time_ns(k), step=k))
        turn = [np.nan] * 3 if k == 0 else [0.0, 0.0, (1 if k % 2 else -1) * np.pi / 2]
        entry("from", encoded("gyro", 2 * k, time_ns(k), theta_b=turn))
        entry("from", encoded("done", 2 * k + 1, time_ns(k), step=k, compute=1))
    frames: list[wire.Frame] = []
    found = replay(entries, WIRE, "gyro", start, 5.0, says=frames.append)
    assert all(d.max_abs < 1e-15 for d in found.compared.found())
    again = replay([*now(entries, frames)], WIRE, "gyro", start, 5.0)
    assert again.same


def now(entries: list[Entry], frames) -> list[Entry]:
    """The record with what the part says now."""
    left = [wire.encode_frame(*f) for f in frames]
    out = []
    for e in entries:
        is_data = e.direction == "from" and len(e.data) > 45
        out.append(e._replace(data=left.pop(0)) if is_data else e)
    return out
