"""Damaged frames of each kind among as many sound ones, and every error of one or two bits."""

from itertools import combinations

import numpy as np
import pytest
from cobs import cobs

from robins.bench import wire
from robins.bench.rigs.satellite.messages import WIRE
from robins.bench.wire import Frame, Header, Receiver, Sequence, receiver
from robins.bench.wire.receiver import LONGEST

EACH = 4000
KINDS = ("one bit", "two bits", "burst", "truncated", "dropped byte", "noise")
DATA = [m for m in WIRE.messages if m.number >= 16]
Pieces = list[tuple[bytes, Frame, bool]]  # on the line, what it was, whether damaged


def sound(k: int, rng: np.random.Generator) -> Frame:
    """A frame of any kind of data, of any values."""
    m = DATA[k % len(DATA)]
    return Frame(Header(m.number, 7, k, k * 10**8), rng.bytes(WIRE.size_of(m.name)))


def damaged(kind: str, made: bytes, rng: np.random.Generator) -> bytes:
    data = bytearray(made)
    if kind in ("one bit", "two bits"):
        for bit in rng.choice(8 * len(data), 1 + (kind == "two bits"), replace=False):
            data[bit // 8] ^= 1 << int(bit % 8)
    elif kind == "burst":
        size = int(rng.integers(2, 24))
        at = int(rng.integers(0, len(data) - 1))
        data[at : at + size] = rng.bytes(len(data[at : at + size]))
    elif kind == "truncated":
        del data[int(rng.integers(0, len(data))) :]
    elif kind == "dropped byte":
        del data[int(rng.integers(0, len(data)))]
    else:  # between frames; in every other one there are zeros
        noise = rng.integers(int(rng.integers(2)), 256, int(rng.integers(1, 200)), dtype="u1")
        data = noise.tobytes() + data
    return bytes(data)


def stream(kind: str, seed: int = 8, edges: slice = slice(None)) -> Pieces:
    """Sound and damaged frames in turn."""
    rng, out = np.random.default_rng(seed), []
    for k in range(2 * EACH):
        frame = sound(k, rng)
        made = wire.encode_frame(*frame)[edges]
        out.append((damaged(kind, made, rng) if k % 2 else made, frame, k % 2 == 1))
    return out


def received(pieces: Pieces, seed: int = 9) -> tuple[list[Frame], Receiver]:
    """Frames received from the bytes, cut up at random."""
    rng, taker = np.random.default_rng(seed), Receiver()
    line = b"".join(data for data, _, _ in pieces) + b"\0"
    found, at = [], 0
    while at < len(line):
        size = int(rng.integers(1, 400))
        found += taker.feed(line[at : at + size])
        assert taker.held <= LONGEST
        at += size
    return found, taker


def expected(pieces: Pieces) -> list[Frame]:
    """The sound ones, and the damaged ones of which nothing but an edge was lost."""
    return [
        frame
        for data, frame, hurt in pieces
        if not hurt or data.strip(b"\0") == wire.encode_frame(*frame).strip(b"\0")
    ]


@pytest.mark.parametrize("kind", KINDS)
def test_no_wrong_frame_and_no_good_one_lost(kind):
    pieces = stream(kind)
    found, taker = received(pieces)
    if kind == "noise":  # it costs nothing, before a frame or after it
        assert found == [frame for _, frame, _ in pieces]
        assert taker.counts.wrong >= EACH / 2
        return
    assert found == expected(pieces)
    gone = 2 * EACH - len(found)
    if kind == "dropped byte":  # one of the two edges, now and then, which a frame can be without
        edges = sum(2 / len(wire.encode_frame(*frame)) for _, frame, hurt in pieces if hurt)
        assert abs(EACH - gone - edges) < 5.0 * edges**0.5
    else:
        assert gone > 0.97 * EACH
    assert taker.counts.frames == len(found)
    # what was cut off before its first byte leaves nothing to count
    left = sum(bool(data.strip(b"\0")) for data, _, hurt in pieces if hurt)
    assert taker.counts.wrong >= left - (len(found) - EACH)
    # and who counts sequence numbers knows of each of them
    numbers = Sequence()
    for frame in found:
        assert numbers.take(frame.header.sequence)
    last_gone = 2 * EACH - 1 - found[-1].header.sequence
    assert numbers.lost == gone - last_gone
    assert (numbers.repeated, numbers.late) == (0, 0)


def test_every_error_of_one_or_two_bits():
    """A Castagnoli check finds them all; here with the stuffing, where a bit may make a zero."""
    made = wire.encode_frame(Header(2, 7, 1, 10**8), WIRE.encode("tick", {"step": 77}))
    as_number = int.from_bytes(made, "big")
    flips = [1 << k for k in range(8 * len(made))]
    taker, count = Receiver(), 0
    for flip in [*flips, *(a ^ b for a, b in combinations(flips, 2))]:
        assert taker.feed((as_number ^ flip).to_bytes(len(made), "big") + b"\0") == []
        count += 1
    assert count == len(flips) * (len(flips) + 1) // 2 > 20_000
    assert taker.counts.frames == 0
    assert len(taker.feed(made)) == 1


def test_these_tests_find_a_receiver_without_a_check(monkeypatch):
    """They would be worth nothing if they could not fail."""

    def unchecked(stuffed: bytes) -> Frame:
        try:
            body = cobs.decode(stuffed)
        except cobs.DecodeError:
            body = b""
        if len(body) < 22:
            raise wire.FrameError("cobs", "none")
        numbers = (
            int.from_bytes(body[a:b], "little") for a, b in ((1, 2), (2, 6), (6, 10), (10, 18))
        )
        return Frame(Header(*numbers, body[0]), body[18:-4])

    monkeypatch.setattr(receiver, "decode_frame", unchecked)
    for kind in ("one bit", "burst"):
        pieces = stream(kind)
        assert received(pieces)[0] != expected(pieces)


def test_one_edge_a_frame_would_not_do():
    """Each frame needs both zeros: with one behind it only, noise takes the next frame along."""
    pieces = stream("noise", edges=slice(1, None))
    lost = {frame for _, frame, _ in pieces} - set(received(pieces)[0])
    assert len(lost) > EACH / 2
