"""The wire of the test bench: messages to frames and back, frames out of a stream, the record.

The stream's peer is the same parser in Python alone, with a table for the check; the record's is
the writer of the mcap package, given the same frames.
"""

import io
import struct

import numpy as np
from mcap.writer import CompressionType, Writer
from timing import best_of, show

from robins.bench.broker.injector import Injector, LinkFault
from robins.bench.recording import Entry, Recorder
from robins.bench.rigs.satellite.messages import WIRE
from robins.bench.wire import Header, Receiver, decode_frame, encode_frame

FRAMES = 2000
CYCLE = (16, 16, 16, 17, 17, 18, 18, 18, 19, 19, 20, 20, 21, 21, 22, 22, 23, 23, 24)
CYCLE += (2, 3) * 7  # what goes over the seven links in a step
HEADER = struct.Struct("<BBIIQ")
READ = 4096  # bytes of the stream at once


def table():
    out = []
    for byte in range(256):
        for _ in range(8):
            byte = (byte >> 1) ^ (0x82F63B78 if byte & 1 else 0)
        out.append(byte)
    return out


CRC = table()


def plain_frames(stream):
    """Frames of a stream, in Python alone."""
    found, held = [], b""
    for at in range(0, len(stream), READ):
        *ended, held = (held + stream[at : at + READ]).split(b"\0")
        for piece in ended:
            body, k = bytearray(), 0
            while k < len(piece):
                code = piece[k]
                body += piece[k + 1 : k + code]
                k += code
                if code != 255 and k < len(piece):
                    body.append(0)
            if len(body) < 22:
                continue
            crc = 0xFFFFFFFF
            for byte in body[:-4]:
                crc = (crc >> 8) ^ CRC[(crc ^ byte) & 0xFF]
            if crc ^ 0xFFFFFFFF == int.from_bytes(body[-4:], "little"):
                version, *head = HEADER.unpack_from(body)
                found.append((Header(*head, version), bytes(body[18:-4])))
    return found


def frames(stream):
    receiver = Receiver()
    return [f for at in range(0, len(stream), READ) for f in receiver.feed(stream[at : at + READ])]


def values_of(m, rng):
    return {
        f.name: rng.normal(size=f.length) if f.kind == "f64" else rng.integers(0, 200, f.length)
        for f in m.fields
    }


def there(m, values):
    return [
        encode_frame(Header(m.number, 7, k, k), WIRE.encode(m.name, values)) for k in range(FRAMES)
    ]


def back(m, made):
    return [WIRE.decode(m.name, decode_frame(one).payload) for one in made]


def record(some, known):
    """Write frames down; `known`: their times are."""
    with Recorder("/dev/null", {"run": 1}, overwrite=True) as recorder:
        for k, one in enumerate(some):
            recorder.write(Entry(k * 80_000, "gyro", "from", one), k if known else None)


def record_by_mcap(some):
    writer = Writer(io.BytesIO(), chunk_size=65536, compression=CompressionType.NONE)
    writer.start()
    schema = writer.register_schema("frame", "", b"")
    channel = writer.register_channel("/gyro/from", "robins-wire-1", schema)
    for k, one in enumerate(some):
        writer.add_message(channel, k * 80_000, one, k, k)
    writer.finish()


def inject(injector, some):
    for one, raw in some:
        injector.pass_on("gyro", "from", one, raw, 10**9)


def main():
    rng = np.random.default_rng(0)
    values = {m.number: values_of(m, rng) for m in WIRE.messages}
    for m in WIRE.messages:
        made = [one[1:-1] for one in there(m, values[m.number])]
        tasks = {
            "encode": lambda m=m: there(m, values[m.number]),
            "decode": lambda m=m, made=made: back(m, made),
        }
        for name, seconds in best_of(tasks).items():
            show(f"{name} {m.name}, {len(made[0]) + 2} bytes", seconds, FRAMES, "frame")

    by_number = {m.number: m for m in WIRE.messages}
    some = [
        encode_frame(Header(n, 7, k, k), WIRE.encode(by_number[n].name, values[n]))
        for k, n in enumerate(CYCLE * (FRAMES // len(CYCLE)))
    ]
    stream = b"".join(some)
    best = best_of({"ours": lambda: frames(stream), "plain": lambda: plain_frames(stream)})
    assert [tuple(f) for f in frames(stream)] == plain_frames(stream)
    show("receive, Python alone", best["plain"], len(some), "frame")
    show("receive", best["ours"], len(some), "frame", best["plain"])
    print(f"{'receive':<46}{len(stream) / best['ours'] / 1e6:10.3f} MB/s")

    tasks = {
        "record": lambda: record(some, True),
        "record, time looked up": lambda: record(some, False),
        "mcap": lambda: record_by_mcap(some),
    }
    best = best_of(tasks)
    peer = best.pop("mcap")
    show("record, mcap's writer", peer, len(some), "frame")
    for name, seconds in best.items():
        show(name, seconds, len(some), "frame", peer)

    received = list(zip(frames(stream), some, strict=True))
    noise = LinkFault(kind="bit errors", begin=0.0, link="gyro", share=0.01)
    elsewhere = LinkFault(kind="bit errors", begin=0.0, link="star", share=0.01)
    tasks = {
        "pass by faults, none there": lambda: inject(Injector([elsewhere]), received),
        "pass by faults, bit errors of 1 %": lambda: inject(Injector([noise]), received),
    }
    for name, seconds in best_of(tasks).items():
        show(name, seconds, len(some), "frame")


if __name__ == "__main__":
    main()
