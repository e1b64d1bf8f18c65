"""The protocol of a part: hello, begin, data, tick, done, stop, and all that may go wrong."""

import numpy as np
import pytest

from robins.bench.parts.station import Part, Station, ready
from robins.bench.rigs.satellite.messages import WIRE
from robins.bench.wire import Header, Receiver, encode_frame

STEP = 100


def part(**more) -> Part:
    """A gyro that adds up what it was shown, and says how often it was asked."""

    def act(state, step, inputs):
        shown = inputs["mounted"]
        total, asked = state
        total += 0.0 if shown is None else float(shown["q_ib"][0])
        return (total, asked + 1), [("gyro", {"theta_b": [total, asked + 1, step]})]

    return Part("gyro", {"mounted": 0}, lambda: (0.0, 0), act, **more)


def test_a_part_without_an_example_is_made_ready_if_it_can_do_without_its_inputs():
    seen = []

    def act(state, step, inputs):
        seen.append(inputs["mounted"])
        return state, [("gyro", {"theta_b": inputs["mounted"]["q_ib"][:3]})]

    shown = {"q_ib": np.ones(4)}
    plain = Part("gyro", {"mounted": 0}, lambda: None, act)
    ready(plain, (0, 1))  # it cannot, and is compiled by its first step
    ready(plain._replace(example={"mounted": shown}), (0,))
    assert seen == [None, shown]
    with pytest.raises(KeyError, match="q_ib"):  # what is wrong is not hidden
        ready(plain._replace(example={"mounted": {}}), (0,))
    source = Part("gyro", {}, lambda: None, lambda state, step, inputs: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        ready(source, (0,))


class Bench:
    """The far end, by hand."""

    def __init__(self, run: int = 5):
        self.station, self.receiver = Station(part(), WIRE), Receiver()
        self.run, self.number = run, 0
        self.begin()

    def begin(self):
        return self.send("begin", {"step": STEP}, 0)

    def send(self, name, values, time_ns, number=None, run=None):
        if number is None:
            number, self.number = self.number, self.number + 1
        header = Header(WIRE.message(name).number, run or self.run, number, time_ns)
        return self.feed(encode_frame(header, WIRE.encode(name, values)))

    def feed(self, data):
        found = self.receiver.feed(self.station.feed(data))
        return [
            (
                WIRE.message(f.header.type).name,
                f.header,
                WIRE.decode(WIRE.message(f.header.type).name, f.payload),
            )
            for f in found
        ]

    def show(self, value, step, **more):
        return self.send("mounted", {"q_ib": [value, 0, 0, 0]}, (step + 1) * STEP, **more)

    def tick(self, step, **more):
        return self.send("tick", {"step": step}, (step + 1) * STEP, **more)


def theta(answer):
    (said,) = [values["theta_b"] for name, _, values in answer if name == "gyro"]
    return list(said)


def test_it_says_who_it_is_until_it_is_answered():
    station = Station(part(), WIRE)
    assert not station.begun
    (hello,) = Receiver().feed(station.hello())
    assert hello.header.run == 0
    said = WIRE.decode("hello", hello.payload)
    assert WIRE.parts[said["part"]] == "gyro"
    assert said["schema"] == WIRE.number
    assert Bench().station.begun


def test_a_tick_is_answered_by_outputs_and_done():
    bench = Bench()
    assert bench.show(2.0, 0) == []  # data are kept until the tick
    answer = bench.tick(0)
    assert [name for name, _, _ in answer] == ["gyro", "done"]
    assert [header.sequence for _, header, _ in answer] == [0, 1]
    assert all(header.time_ns == STEP and header.run == 5 for _, header, _ in answer)
    assert theta(answer) == [2.0, 1.0, 0.0]
    assert answer[-1][2]["step"] == 0


def test_a_tick_that_is_repeated_is_answered_and_not_computed_again():
    bench = Bench()
    bench.show(2.0, 0)
    first, again = bench.tick(0), bench.tick(0)
    assert theta(first) == theta(again) == [2.0, 1.0, 0.0]
    assert [header.sequence for _, header, _ in again] == [2, 3]
    bench.tick(1)
    assert bench.tick(0) == []  # over and done with
    assert bench.station.counts["late"] == 1


def test_data_of_another_time_are_never_used():
    bench = Bench()
    bench.show(1.0, 0)
    bench.tick(0)
    bench.show(10.0, 0)  # came after its step
    assert theta(bench.tick(1)) == [1.0, 2.0, 1.0]
    assert bench.station.counts["late"] == 1
    bench.show(100.0, 3)  # is early, and waits for its step
    assert theta(bench.tick(2))[0] == 1.0
    assert theta(bench.tick(3))[0] == 101.0


def test_data_that_come_twice_or_out_of_order_count_once():
    bench = Bench()
    bench.show(1.0, 0, number=1)
    bench.show(5.0, 0, number=1)
    assert bench.station.counts["repeated"] == 1
    assert theta(bench.tick(0, number=2)) == [1.0, 1.0, 0.0]
    bench.show(8.0, 1, number=5)
    bench.show(9.0, 1, number=4)  # overtaken by number 5
    assert theta(bench.tick(1, number=6))[0] == 9.0
    assert bench.station.counts["repeated"] == 2


def test_frames_of_another_run_or_an_unknown_message_are_strange():
    bench = Bench()
    assert bench.tick(0, run=99) == []
    bench.feed(encode_frame(Header(77, 5, 1, STEP), b"new in version 9"))
    bench.send("star", {"q_ib": [1, 0, 0, 0], "factor": [0] * 9, "stars": 0}, STEP)
    assert bench.station.counts["strange"] == 3
    assert theta(bench.tick(0)) == [0.0, 1.0, 0.0]


def test_a_payload_of_another_length_is_as_if_it_had_not_come():
    bench = Bench()
    bench.feed(encode_frame(Header(WIRE.message("mounted").number, 5, 1, STEP), b"short"))
    assert theta(bench.tick(0)) == [0.0, 1.0, 0.0]
    assert bench.station.counts["size"] == 1


def test_another_run_begins_anew_and_the_same_does_not():
    bench = Bench()
    bench.show(2.0, 0)
    bench.tick(0)
    bench.begin()  # the bench answers each hello
    assert theta(bench.tick(1)) == [2.0, 2.0, 1.0]
    bench.run, bench.number = 6, 0
    bench.begin()
    answer = bench.tick(0)
    assert theta(answer) == [0.0, 1.0, 0.0]
    assert answer[0][1].sequence == 0


def test_stop_ends_it():
    bench = Bench()
    assert not bench.station.over
    bench.send("stop", {}, 0)
    assert bench.station.over


def test_how_bytes_are_cut_makes_no_difference():
    whole, bytewise = Bench(), Bench()
    shown = WIRE.encode("mounted", {"q_ib": [3.0, 0, 0, 0]})
    frames = encode_frame(Header(WIRE.message("mounted").number, 5, 1, STEP), shown)
    frames += encode_frame(
        Header(WIRE.message("tick").number, 5, 2, STEP), WIRE.encode("tick", {"step": 0})
    )
    expected = theta(whole.feed(b"\x07noise" + frames))
    pieces = [bytewise.feed(bytes([b])) for b in b"\x07noise" + frames]
    assert theta([x for answer in pieces for x in answer]) == expected == [3.0, 1.0, 0.0]


def test_warming_up_leaves_no_trace():
    warm = part(example={"mounted": {"q_ib": np.ones(4)}})
    station = Station(ready(warm, (0, 1)), WIRE)
    bench = Bench()
    bench.station = station
    bench.number = 0
    bench.begin()
    assert theta(bench.tick(0)) == [0.0, 1.0, 0.0]


def test_a_message_that_was_forgotten_is_an_error_of_ours():
    broken = Part("gyro", {}, lambda: None, lambda state, step, inputs: (state, [("gyro", {})]))
    bench = Bench()
    bench.station = Station(broken, WIRE)
    bench.begin()
    with pytest.raises(ValueError, match="has the fields"):
        bench.tick(0)
