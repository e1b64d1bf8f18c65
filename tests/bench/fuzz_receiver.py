"""Coverage-guided fuzzing of the parser of the wire, beside a second parser that is written apart.

    python tests/bench/fuzz_receiver.py CORPUS -max_total_time=3600

Every input makes a stream of bytes. Its frames must be those of the second parser, whatever way it
is cut up; nothing may be raised, and no more held than the longest frame. Needs atheris.
"""

from __future__ import annotations

import os
import struct
import sys

import fastcrc
from cobs import cobs

HEADER = struct.Struct("<BBIIQ")
LONGEST_BODY = 22 + 4096
LONGEST = LONGEST_BODY + LONGEST_BODY // 254 + 1  # stuffed


def _table() -> list[int]:
    out = []
    for byte in range(256):
        for _ in range(8):
            byte = (byte >> 1) ^ (0x82F63B78 if byte & 1 else 0)
        out.append(byte)
    return out


CRC = _table()


def crc32c(data: bytes) -> int:
    crc = 0xFFFFFFFF
    for byte in data:
        crc = (crc >> 8) ^ CRC[(crc ^ byte) & 0xFF]
    return crc ^ 0xFFFFFFFF


def unstuffed(data: bytes) -> bytes | None:
    """Bytes before stuffing; None: they were not stuffed."""
    out, at = bytearray(), 0
    while at < len(data):
        code = data[at]
        block = data[at + 1 : at + code]
        if len(block) != code - 1:
            return None
        out += block
        at += code
        if code != 255 and at < len(data):
            out.append(0)
    return bytes(out)


def frames_of(stream: bytes) -> list[tuple]:
    """Headers and payloads, by going through what lies between zeros."""
    found = []
    for piece in stream.split(b"\0")[:-1]:
        body = unstuffed(piece)
        if body is None or not 22 <= len(body) <= LONGEST_BODY:
            continue
        if crc32c(body[:-4]) != int.from_bytes(body[-4:], "little") or body[0] != 1:
            continue
        version, *head = HEADER.unpack_from(body)
        found.append(((*head, version), body[18:-4]))
    return found


def framed(body: bytes) -> bytes:
    """A frame of any body, by the packages that are fast."""
    return b"\0" + cobs.encode(body + struct.pack("<I", fastcrc.crc32.iscsi(body))) + b"\0"


class Bytes:
    """Numbers and pieces out of an input, zeros when it is used up."""

    def __init__(self, data: bytes):
        self.data, self.at = data, 0

    def __bool__(self) -> bool:
        return self.at < len(self.data)

    def take(self, count: int) -> bytes:
        self.at += count
        return self.data[self.at - count : self.at]

    def number(self) -> int:
        return int.from_bytes(self.take(1) or b"\0")


def composed(given: Bytes) -> bytes:
    """A stream of pieces that mutation alone would hardly make, such as right checks."""
    out = bytearray()
    while given and len(out) < 8000:
        what, size = given.number(), given.number()
        data = given.take(size)
        way = what % 7
        if way == 0:
            out += data
        elif way == 1:  # a sound frame
            out += framed(b"\x01" + data[:17].ljust(17, b"\1") + data[17:])
        elif way == 2:  # a right check over anything: too short, another version
            out += framed(data)
        elif way == 3:  # stuffed rightly, check wrong
            out += b"\0" + cobs.encode(data) + b"\0"
        elif way == 4:  # cut off
            out += framed(b"\x01" + data.ljust(17, b"\2"))[: 1 + size % 40]
        elif way == 5:  # about as long as the longest, or longer
            out += framed(
                b"\x01" + bytes([what]) * 17 + (data or b"\3") * (4090 // max(len(data), 1))
            )
            out += bytes([size or 1]) * (what * 30)
        else:
            out += b"\0" * (size % 4)
    return bytes(out)


def stream_and_cuts(data: bytes) -> tuple[bytes, list[int]]:
    """The first bytes say how the rest is read and how it is cut."""
    given = Bytes(data)
    way, cuts = given.number(), [1 + given.number() for _ in range(3)]
    stream = composed(given) if way % 2 else given.data[4:]
    return stream, cuts


def seeds() -> list[bytes]:
    """Inputs to begin with: each message of the wire, as bytes and composed, and noise."""
    from robins.bench.rigs.satellite.messages import WIRE
    from robins.bench.wire import Header, encode_frame

    out = []
    for k, m in enumerate(WIRE.messages):
        payload = bytes((7 * i + k) % 256 for i in range(WIRE.size_of(m.name)))
        frame = encode_frame(Header(m.number, 7, k, k * 10**8), payload)
        out.append(bytes([0, 3, k, 30]) + frame + b"\x11\x22" * k + frame)
        out.append(bytes([1, 9, 1, k, 1, len(payload)]) + payload + bytes([0, 3]) + b"abc")
    out += [bytes([1, 200, 20, 30, way, 40]) + bytes(range(40)) for way in range(7)]
    out += [b"", bytes(50), bytes([0, 1, 1, 1]) + b"\xff" * 300 + b"\0"]
    return out


def check(data: bytes) -> None:
    """The properties that must hold for any input."""
    from robins.bench.wire import encode_frame, receiver

    stream, cuts = stream_and_cuts(data)
    expected = frames_of(stream)
    whole = receiver.Receiver()
    found = whole.feed(stream)
    assert [(tuple(f.header), f.payload) for f in found] == expected, "not the frames of the stream"
    assert whole.counts.frames == len(found), "wrong count"
    pieces, at, k, again = receiver.Receiver(), 0, 0, []
    while at < len(stream):
        again += pieces.feed(stream[at : at + cuts[k % 3]])
        at += cuts[k % 3]
        k += 1
        assert pieces.held <= LONGEST, "holds too much"
    assert (again, pieces.counts, pieces.held) == (found, whole.counts, whole.held), "cut matters"
    for frame in found:
        if len(frame.payload) < 200:  # a longer one may be stuffed in more than one way
            assert encode_frame(*frame)[1:-1] in stream, "not what was on the line"


def plant(bug: str) -> None:
    """Spoil the receiver, so that a test may see it found."""
    from robins.bench.wire import frames, receiver

    feed, decode = receiver.Receiver.feed, receiver.decode_frame

    def raises(self, data):
        if b"\xff\0" in data:
            raise IndexError("planted")
        return feed(self, data)

    def cut(self, data):
        return feed(self, data[:-1] if data[-1:] == b"\x05" else data)

    def unchecked(piece):
        try:
            return decode(piece)
        except frames.FrameError as error:
            if error.why != "crc":
                raise
            body = unstuffed(piece)
            version, *head = HEADER.unpack_from(body)
            return frames.Frame(frames.Header(*head, version), body[18:-4])

    if bug == "hoards":
        receiver.LONGEST = 10**9
    elif bug == "unchecked":
        receiver.decode_frame = unchecked
    else:
        receiver.Receiver.feed = {"raises": raises, "cut": cut}[bug]


def main() -> None:
    import atheris

    with atheris.instrument_imports(include=["robins.bench"]):
        import robins.bench.wire.receiver  # noqa: F401
    if bug := os.environ.get("ROBINS_PLANTED_BUG"):
        plant(bug)
    atheris.Setup(sys.argv, check)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
