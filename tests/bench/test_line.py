"""A line that takes its time: byte for byte against fractions, and what does not fit."""

from fractions import Fraction
from math import ceil

import pytest
from hypothesis import given
from hypothesis import strategies as st

from robins.bench.ports.line import SerialLine, load

BAUDS = st.sampled_from([300, 9600, 115_200, 460_800, 921_600, 999_983])


class Exact:
    """The same line in fractions of a nanosecond, each byte for itself."""

    def __init__(self, baud, bits):
        self.byte = Fraction(bits * 10**9, baud)
        self.last = Fraction(0)
        self.waiting = []

    def send(self, data, now):
        for byte in data:
            self.last = max(self.last, Fraction(now)) + self.byte
            self.waiting.append((self.last, byte))

    def take(self, now):
        out = bytes(byte for at, byte in self.waiting if at <= now)
        self.waiting = self.waiting[len(out) :]
        return out


@given(
    BAUDS,
    st.sampled_from([10, 11]),
    st.lists(st.tuples(st.integers(0, 3_000_000), st.binary(max_size=12), st.booleans())),
)
def test_bytes_get_through_at_their_instant(baud, bits, steps):
    line, exact, now = SerialLine(baud, bits), Exact(baud, bits), 0
    for pause_ns, data, takes in steps:
        now += pause_ns
        line.send(data, now)
        exact.send(data, now)
        if takes:
            assert line.take(now) == exact.take(now)
        assert line.backlog == len(exact.waiting)
        assert line.next_ns == (ceil(exact.waiting[0][0]) if exact.waiting else None)
    # one by one, at the very instants that the line names
    while (at := line.next_ns) is not None:
        assert line.take(at - 1) == b""
        assert line.take(at) == exact.take(at) != b""
    assert exact.waiting == []


def test_a_second_of_bytes_takes_a_second():
    line = SerialLine(115_200)
    data = bytes(k % 251 for k in range(11_520))
    line.send(data, 5)
    assert line.take(10**9 + 4) == data[:-1]
    assert line.take(10**9 + 5) == data[-1:]
    assert line.next_ns is None


def test_nothing_adds_up():
    """A byte takes 21701.388... ns: bursts on end for an hour end where one division says."""
    line, burst, bursts = SerialLine(460_800, most=10**6), bytes(10**6), 170
    for _ in range(bursts):
        line.send(burst, 0)
        assert len(line.take(10**13)) == len(burst)
    line.send(b"x", 0)
    assert line.next_ns == ceil(Fraction((bursts * len(burst) + 1) * 10**10, 460_800))


def test_what_does_not_fit_is_dropped_and_counted():
    line = SerialLine(9600, most=10)
    line.send(b"01234567", 0)
    line.send(b"89abc", 0)
    assert (line.backlog, line.dropped) == (10, 3)
    line.send(b"d", 0)
    assert line.dropped == 4
    assert line.take(10**10) == b"0123456789"
    line.send(b"next", 10**10)
    assert line.take(2 * 10**10) == b"next"
    assert (line.backlog, line.dropped) == (0, 4)


@pytest.mark.parametrize("wrong", [{"baud": 0}, {"baud": 1, "bits_per_byte": 0}, {"most": -1}])
def test_lines_that_cannot_be(wrong):
    with pytest.raises(ValueError, match="must be at least 1, got"):
        SerialLine(**({"baud": 9600} | wrong))


def test_load():
    """A frame of the gyro at 100 Hz, as the page of the wire says."""
    assert load(49 * 100, 1.0, 49_000) == pytest.approx(1.0, rel=1e-15)
    assert load(1152, 0.1, 115_200, 11) == pytest.approx(1.1, rel=1e-15)
    with pytest.raises(ValueError, match="seconds and baud must be above 0, got 0"):
        load(1, 0, 9600)
