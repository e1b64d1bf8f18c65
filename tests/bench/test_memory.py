"""A part that was started in the place of another goes on from what that one remembered."""

import math
import os
import socket
import threading
import time
from functools import partial

import pytest
from stations import RUN, Loop, config

from robins.bench.broker import BenchError, Injector, Link
from robins.bench.broker.restart import SentFrames, beginning, catch_up
from robins.bench.parts import station as memory
from robins.bench.parts.idle import idleness
from robins.bench.parts.station import Station
from robins.bench.rigs.satellite import RIG
from robins.bench.rigs.satellite.messages import WIRE
from robins.bench.wire import Header, Receiver, encode_frame

LAST = 68  # step whose memory is gone on from
SHORT = "duration=60 s", "counted_from=10 s"


class Told(Loop):
    """Remembers what each part was told since its memory, as the bench does."""

    def __init__(self, *given):
        self.histories = {name: SentFrames(LAST.__ge__) for name in RIG.parts}
        super().__init__(*given)

    def to(self, part, name, payload, time_ns):
        header = Header(WIRE.message(name).number, RUN, self.sent[part], time_ns)
        step = WIRE.decode("tick", payload)["step"] if name == "tick" else None
        self.histories[part].add(step, encode_frame(header, payload))
        answer = super().to(part, name, payload, time_ns)
        if step is not None:
            self.histories[part].answered(step)
        return answer


def test_every_part_goes_on_from_its_memory_to_the_last_bit(monkeypatch, tmp_path):
    monkeypatch.setattr(memory, "EVERY", 23)
    loop = Told(config("satellite/s1", "mekf", *SHORT))
    for name, station in loop.stations.items():
        station._put_aside = lambda k, m, name=name: memory.save_memory(tmp_path, name, k, m)
    loop.run(99)
    # the two latest of each part are kept
    kept = sorted(f"{name}.{k}.memory" for name in loop.stations for k in (LAST, LAST + 23))
    assert sorted(path.name for path in tmp_path.iterdir()) == kept
    for name, history in loop.histories.items():
        saved = memory.path_of(tmp_path, name, LAST).read_bytes()
        new, receiver = Station(loop.stations[name].part, WIRE, saved), Receiver()
        assert not new.begun
        assert new.feed(beginning(RUN, loop.config.step_ns)) == b""
        assert new.begun
        assert history.since == LAST
        again = [f for _, raw in history.sent_frames for f in receiver.feed(new.feed(raw))]
        end_ns = (LAST + 1) * loop.config.step_ns
        said = [f for who, f in loop.said if who == name and f.header.time_ns > end_ns]
        assert [f.header for f in again] == [f.header for f in said]
        done = WIRE.message("done").number  # tells how long computing took
        payloads = [[f.payload for f in x if f.header.type != done] for x in (again, said)]
        assert payloads[0] == payloads[1]
        assert len(payloads[0]) >= 30 // 5


@pytest.mark.parametrize("idle_s", [0.0, math.inf])
def test_a_part_that_computes_is_waited_for(idle_s):
    """Its hello, and each answer, may take as long as it computes."""
    ours, theirs = socket.socketpair()
    link = Link("adm", ours.fileno(), WIRE, Injector(RIG.table), lambda *_: None)
    hello = Header(WIRE.numbers["hello"], 0, 0, 0), WIRE.encode("hello", {"part": 5, "schema": 0})
    done = Header(WIRE.numbers["done"], RUN, 0, 0), WIRE.encode("done", {"step": 3, "compute": 0})
    with ours, theirs:
        late = [
            threading.Timer(0.3 * (k + 1), theirs.send, (encode_frame(*frame),))
            for k, frame in enumerate((hello, done))
        ]
        for timer in late:
            timer.start()
        wait = partial(catch_up, link, [(3, b"tick")], b"", 3, 0.1, lambda: None)
        if idle_s:
            with pytest.raises(BenchError, match=r"there is no hello from it in 0.1 s"):
                wait(lambda: idle_s)
        else:
            wait(lambda: idle_s)
        for timer in late:
            timer.join()


def test_a_process_that_computes_is_known_from_one_that_waits():
    idle_s, pid = idleness(), os.getpid()
    assert idle_s(pid) == 0.0
    time.sleep(0.2)
    assert idle_s(pid) >= 0.2
    until = time.process_time() + 0.6
    while time.process_time() < until:
        pass
    assert idle_s(pid) == 0.0
    assert idle_s(None) == idle_s(2**22 + 1) == math.inf


def test_what_is_kept_for_a_part_is_bounded():
    there = {255, 767}
    history, most = SentFrames(there.__contains__), 0
    for step in range(1000):
        for raw in (b"data", b"more"):
            history.add(None, raw)
        history.add(step, b"tick")
        if step == 255:
            history.add(None, b"late")
            history.add(step, b"tick again")
        history.answered(step)
        most = max(most, len(history.sent_frames))
        if step == 255:
            assert (history.since, [raw for _, raw in history.sent_frames]) == (
                255,
                [b"late", b"tick again"],
            )
        if step == 511:  # its memory could not be written
            assert history.since == 255
    assert history.since == 767
    assert most <= 3 * 2 * memory.EVERY + 2
    assert [at for at, _ in history.sent_frames if at is not None] == list(range(768, 1000))
