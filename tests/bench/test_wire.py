"""The wire: golden bytes, streams cut anywhere, what is wrong in them, and the same in C."""

import re
import shutil
import struct
import subprocess
from pathlib import Path

import numpy as np
import pytest
from fuzz_receiver import crc32c
from hypothesis import given
from hypothesis import strategies as st

from robins.bench import wire
from robins.bench.rigs.satellite.messages import WIRE
from robins.bench.wire import Frame, Header, Receiver, RecordError, Sequence
from robins.bench.wire.c_header import c_header, firmware
from robins.bench.wire.frames import LEAST, MOST_PAYLOAD, FrameError
from robins.bench.wire.receiver import LONGEST

# Written down once. If this test fails, the wire has changed: raise the version of the protocol.
GOLDEN_TICK = bytes.fromhex("00040102070101030201010104e1f50501010103080701052df23f5a00")
GYRO = {"theta_b": [1.5, -0.25, np.nan]}


def frame(payload: bytes, sequence: int = 0, kind: int = 18) -> bytes:
    return wire.encode_frame(Header(kind, 7, sequence, 10**9), payload)


def plain_cobs(data: bytes) -> bytes:
    """COBS by its definition: blocks of up to 254 bytes that end in a zero that is left out."""
    out, block = bytearray(), bytearray()
    for i, byte in enumerate(data):
        if byte:
            block.append(byte)
        if not byte or (len(block) == 254 and i + 1 < len(data)):
            out += bytes([len(block) + 1]) + block
            block.clear()
    return bytes(out + bytes([len(block) + 1]) + block)


# ---------------------------------------------------------------------------------------- frames


def test_golden_bytes():
    """Every byte of a frame by hand: header, payload, check, stuffing."""
    body = struct.pack("<BBIIQ", 1, 2, 7, 258, 100_000_000) + struct.pack("<I", 1800)
    body += struct.pack("<I", crc32c(body))
    by_hand = b"\x00" + plain_cobs(body) + b"\x00"
    made = wire.encode_frame(
        Header(WIRE.message("tick").number, 7, 258, 100_000_000),
        WIRE.encode("tick", {"step": 1800}),
    )
    assert made == by_hand
    assert made == GOLDEN_TICK


@given(st.binary(max_size=600), st.integers(0, 255), st.integers(0, 2**32 - 1))
def test_frames_come_back(payload, kind, sequence):
    header = Header(kind, 12345, sequence, 2**63 + 1)
    made = wire.encode_frame(header, payload)
    assert made[0] == made[-1] == 0
    assert 0 not in made[1:-1]
    assert wire.decode_frame(made[1:-1]) == Frame(header, payload)


def test_longest_frame_fits_the_buffer():
    made = frame(bytes([255]) * MOST_PAYLOAD)
    assert len(made) - 2 <= LONGEST
    assert len(Receiver().feed(made)) == 1
    with pytest.raises(FrameError, match="has 4096 bytes at most, got 4097"):
        frame(bytes(MOST_PAYLOAD + 1))


@pytest.mark.parametrize("wrong", [Header(256, 0, 0, 0), Header(1, -1, 0, 0), Header(1, 0, 0, -1)])
def test_headers_out_of_range(wrong):
    with pytest.raises(FrameError, match="header"):
        wire.encode_frame(wrong, b"")


def test_another_version_is_told():
    made = wire.encode_frame(Header(2, 0, 0, 0, version=2), b"")
    with pytest.raises(FrameError, match="version 2; this is version 1"):
        wire.decode_frame(made[1:-1])


# ---------------------------------------------------------------------------------------- streams


def stream(count: int, rng: np.random.Generator) -> tuple[list[bytes], list[bytes]]:
    payloads = [rng.bytes(int(rng.integers(0, 120))) for _ in range(count)]
    return payloads, [frame(p, k) for k, p in enumerate(payloads)]


@given(st.lists(st.integers(1, 40), min_size=1, max_size=60), st.integers(0, 5))
def test_how_a_stream_is_cut_does_not_matter(cuts, seed):
    rng = np.random.default_rng(seed)
    payloads, frames = stream(8, rng)
    data = rng.bytes(9) + b"".join(frames) + rng.bytes(3) + frame(b"end", 8)
    whole, cut = Receiver(), Receiver()
    at, found = 0, []
    for size in cuts:
        found += cut.feed(data[at : at + size])
        at += size
    found += cut.feed(data[at:])
    assert found == whole.feed(data)
    assert cut.counts == whole.counts
    assert [f.payload for f in found][-9:] == [*payloads, b"end"]


@given(st.binary(max_size=3000))
def test_any_bytes_do_no_harm(data):
    receiver = Receiver()
    for one in receiver.feed(data):
        assert len(one.payload) <= MOST_PAYLOAD
    assert receiver.held <= LONGEST
    good = frame(b"good")
    # what came before may have eaten the first zero, not the frame after it
    assert receiver.feed(good + good)[-1].payload == b"good"


def test_a_frame_that_never_ends_is_not_kept():
    receiver = Receiver()
    for _ in range(100):
        assert receiver.feed(b"\x01" * 1000) == []
        assert receiver.held <= LONGEST
    assert len(receiver.feed(frame(b"next"))) == 1
    assert receiver.counts.long == 1
    assert receiver.counts.wrong == 1


def test_what_is_wrong_is_counted_by_its_kind():
    receiver = Receiver()
    made = bytearray(frame(b"payload"))
    made[-3] ^= 1
    receiver.feed(bytes(made))
    receiver.feed(b"\x00\x05ab\x00")  # says four bytes, has two
    receiver.feed(b"\x00\x03ab\x00")
    receiver.feed(wire.encode_frame(Header(2, 0, 0, 0, version=9), b""))
    counts = receiver.counts
    assert (counts.crc, counts.cobs, counts.short, counts.version) == (1, 1, 1, 1)
    assert (counts.wrong, counts.frames) == (4, 0)


def test_sequences_tell_lost_repeated_and_late():
    seen = Sequence()
    assert [seen.take(k) for k in (5, 6, 9, 9, 8, 10)] == [True, True, True, False, False, True]
    assert (seen.lost, seen.repeated, seen.late) == (1, 1, 1)  # 7; 9 again; 8
    around = Sequence()
    assert [around.take(k) for k in (2**32 - 1, 0, 2)] == [True] * 3
    assert around.lost == 1
    far = Sequence()
    far.take(0)
    far.take(10**6)
    assert far.lost == 10**6 - 1


def test_a_sender_that_counts_anew_is_not_locked_out():
    for jump in (2**31, 2**32 - 500, 3):
        seen = Sequence()
        for step in range(700):
            assert seen.take(2 * step, step)
            assert seen.take(2 * step + 1, step)
        assert not seen.take(1399, 699)  # came in this step
        assert not seen.take(7, None)  # an old frame, of an old time
        at = (1400 + jump) % 2**32
        assert [seen.take(at + k, 700 + k // 2) for k in range(9)] == [True] * 9
        assert seen.jumps == (jump >= 2**31)
        assert seen.repeated == 2


# ---------------------------------------------------------------------------------------- records


@pytest.mark.parametrize("m", WIRE.messages, ids=lambda m: m.name)
def test_values_come_back_bit_for_bit(m):
    rng = np.random.default_rng(m.number)
    values = {
        f.name: rng.normal(size=f.length) * 10.0 ** rng.integers(-300, 300, f.length)
        if f.kind == "f64"
        else rng.integers(0, 200, f.length)
        for f in m.fields
    }
    payload = WIRE.encode(m.name, values)
    assert len(payload) == WIRE.size_of(m.name)
    back = WIRE.decode(m.name, payload)
    for name, value in values.items():
        np.testing.assert_array_equal(np.ravel(back[name]), value)
    assert WIRE.encode(m.name, back) == payload


def test_nan_is_a_number_of_the_wire():
    back = WIRE.decode("gyro", WIRE.encode("gyro", GYRO))
    np.testing.assert_array_equal(back["theta_b"], GYRO["theta_b"])


@pytest.mark.parametrize(
    ("name", "values", "words"),
    [
        ("tick", {}, r"has the fields \['step'\], got \[\]"),
        ("tick", {"step": 1, "more": 2}, "has the fields"),
        ("tick", {"step": -1}, "message 'tick'"),
        ("tick", {"step": 2**32}, "message 'tick'"),
        ("tick", {"step": 1.5}, "tick.step is u32: whole numbers are wanted"),
        ("gyro", {"theta_b": [1.0, 2.0]}, "gyro.theta_b has 3 numbers, got 2"),
    ],
)
def test_values_that_are_not_the_message(name, values, words):
    with pytest.raises(RecordError, match=words):
        WIRE.encode(name, values)


def test_payloads_that_are_not_the_message():
    with pytest.raises(RecordError, match="message 'tick' has 4 bytes, got 3"):
        WIRE.decode("tick", b"abc")
    with pytest.raises(KeyError, match="no message 'tock' in version 1; there are hello, tick"):
        WIRE.encode("tock", {})


@pytest.mark.parametrize(
    ("name", "values", "words"),
    [
        ("gyro", {"theta_b": [0, 1e308, 0]}, r"theta_b\[1\] is 1e\+308 rad, not -10 to 10 or NaN"),
        ("gyro", {"theta_b": [np.inf, 0, 0]}, r"theta_b\[0\] is inf rad"),
        ("motion", {"q_ib": [1, 0, np.nan, 0], "omega_b": [0] * 3}, r"q_ib\[2\] is nan, not -2"),
        ("wheels", {"momentum": [np.nan] * 4}, r"momentum\[0\] is nan N m s"),
        (
            "estimate",
            {"q_ib": [1, 0, 0, 0], "gyro_bias": [0] * 3, "sigma": [np.nan] * 6, "flags": 128},
            "flags is 128, not 0 to 127",
        ),
    ],
)
def test_what_cannot_be_is_refused(name, values, words):
    why = WIRE.unsound(name, WIRE.encode(name, values))
    assert why.sized
    assert re.match(words, why.text)


def test_the_gate_knows_lengths_and_what_may_be_missing():
    for m in WIRE.messages:
        whole = bytes(WIRE.size_of(m.name))
        assert WIRE.unsound(m.name, whole) is None
        for other in (whole + b"\1", whole[:-1]) if whole else (b"\1",):
            why = WIRE.unsound(m.name, other)
            assert not why.sized
            assert str(len(other)) in why.text
    gone = WIRE.encode("star", {"q_ib": [np.nan] * 4, "factor": [np.nan] * 9, "stars": 0})
    assert WIRE.unsound("star", gone) is None
    assert WIRE.unsound("gyro", WIRE.encode("gyro", GYRO)) is None


def test_the_table_is_sound():
    numbers = [m.number for m in WIRE.messages]
    assert numbers == sorted(set(numbers))
    assert all(0 < n < 256 for n in numbers)
    for m in WIRE.messages:
        assert len({f.name for f in m.fields}) == len(m.fields)
        assert WIRE.size_of(m.name) <= MOST_PAYLOAD
        assert WIRE.message(m.number) is WIRE.message(m.name)


def test_the_page_has_the_table():
    page = Path(__file__).resolve().parents[2] / "docs" / "wire.md"
    assert WIRE.markdown() in page.read_text("utf-8")


# ---------------------------------------------------------------------------------------------- C

PROGRAM = """
#include "robins_wire.h"
#include <stdio.h>
#include <stdlib.h>

/* reads "size, bytes" until the end; for each payload a frame, decoded again */
int main(void) {
  uint32_t size, number = 0;
  static uint8_t payload[ROBINS_MOST_PAYLOAD], out[ROBINS_MOST_FRAME], body[ROBINS_MOST_BODY];
  while (fread(&size, 4, 1, stdin) == 1) {
    if (size && fread(payload, 1, size, stdin) != size) return 1;
    size_t made = robins_encode(ROBINS_GYRO, 7, number++, 1000000000u, payload, size, out);
    if (!made) return 2;
    long back = robins_decode(out + 1, made - 2, body);
    if (back != (long)size || memcmp(body + ROBINS_HEADER, payload, size)) return 3;
    out[made / 2] ^= 4;
    if (out[made / 2] && robins_decode(out + 1, made - 2, body) >= 0) return 4;
    out[made / 2] ^= 4;
    uint32_t length = (uint32_t)made;
    fwrite(&length, 4, 1, stdout);
    fwrite(out, 1, made, stdout);
  }
  return ROBINS_SCHEMA == strtoul(SCHEMA, 0, 0) ? 0 : 5;
}
"""


@pytest.mark.skipif(shutil.which("gcc") is None, reason="needs a C compiler")
def test_firmware_makes_the_same_bytes(tmp_path):
    (tmp_path / "robins_wire.h").write_text(c_header(WIRE))
    (tmp_path / "echo.c").write_text(PROGRAM)
    flags = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-O1"]
    schema = f'-DSCHEMA="{WIRE.number:#x}"'
    command = ["gcc", *flags, schema, "echo.c", "-o", "echo"]
    built = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stderr

    rng = np.random.default_rng(0)
    # lengths about those where COBS begins another block, and bytes with and without zeros
    sizes = [0, 1, *range(225, 240), *range(480, 496), 1000, MOST_PAYLOAD]
    payloads = [rng.integers(1, 256, n, dtype=np.uint8).tobytes() for n in sizes]
    payloads += [bytes(n) for n in (1, 254, 300)]
    payloads += [rng.integers(0, 3, n, dtype=np.uint8).tobytes() for n in (50, 300)]
    given_bytes = b"".join(struct.pack("<I", len(p)) + p for p in payloads)
    result = subprocess.run(
        [tmp_path / "echo"], input=given_bytes, capture_output=True, check=False
    )
    assert result.returncode == 0
    expected = b"".join(
        struct.pack("<I", len(made)) + made
        for made in (frame(p, k) for k, p in enumerate(payloads))
    )
    assert result.stdout == expected


@pytest.mark.skipif(shutil.which("g++") is None, reason="needs a C++ compiler")
def test_the_example_compiles_as_c_plus_plus_too(tmp_path):
    files = firmware(WIRE)
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    flags = ["-std=c++11", "-Wall", "-Wextra", "-Werror", "-pedantic", "-fsyntax-only", "-x", "c++"]
    # The board of an exported filter needs that filter; `test_adm_board.py` compiles it.
    sources = [name for name in files if name.endswith(".c") and name != "adm_board.c"]
    command = ["g++", *flags, *sources]
    built = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stderr
    # A compiler that takes NaN for impossible would pass or refuse any number that is missing.
    command.insert(1, "-ffast-math")
    refused = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert refused.returncode != 0
    assert "NaN means missing here: compile without -ffast-math" in refused.stderr


def test_a_frame_without_payload_is_the_least():
    assert len(frame(b"")) == LEAST + 3
