"""Frames: a header, a payload and a check, between zeros, with no zero inside.

    0x00 COBS(version u8 | type u8 | run u32 | sequence u32 | time u64 | payload | CRC-32C u32) 0x00

Little endian; the check goes over all before it (Castagnoli's polynomial, as in iSCSI). COBS
(Cheshire & Baker 1999) takes every zero out for one byte in 254, so a zero is always the edge of a
frame. There is one at *both* ends: after noise the opening zero ends the noise, and a frame that
lost its closing zero ends at the next one's opening, so damage to one frame never costs another.
The same in C: `firmware/robins_wire.h.in`.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

import fastcrc
from cobs import cobs

from robins.errors import RobinsError

VERSION = 1
EDGE = b"\x00"
_HEADER = struct.Struct("<BBIIQ")
_CRC = struct.Struct("<I")
LEAST = _HEADER.size + _CRC.size  # bytes of an empty frame before COBS
MOST_PAYLOAD = 4096


class FrameError(RobinsError, ValueError):
    """Bytes that do not form a frame; `why` is a field of `robins.bench.wire.receiver.Counts`."""

    def __init__(self, why: str, text: str):
        super().__init__(text)
        self.why = why


class Header(NamedTuple):
    """Header of a frame."""

    type: int  # number of the message, see `robins.bench.wire.schema`
    run: int  # number of the run; identifies frames of an earlier run left in a buffer
    sequence: int  # of the link and direction, from 0, modulo 2^32
    time_ns: int  # of the payload's content, since the start of the run
    version: int = VERSION


class Frame(NamedTuple):
    """A frame that passed its check."""

    header: Header
    payload: bytes


def encode_frame(header: Header, payload: bytes) -> bytes:
    """The bytes of a frame, zeros at both ends included.

    Raises:
        FrameError: a number beyond its field, or a payload over 4096 bytes.
    """
    if len(payload) > MOST_PAYLOAD:
        raise FrameError("long", f"a payload has {MOST_PAYLOAD} bytes at most, got {len(payload)}")
    try:
        head = _HEADER.pack(
            header.version, header.type, header.run, header.sequence, header.time_ns
        )
    except struct.error as error:
        raise FrameError("header", f"header {header}: {error}") from None
    body = head + payload
    return EDGE + cobs.encode(body + _CRC.pack(fastcrc.crc32.iscsi(body))) + EDGE


def decode_frame(stuffed: bytes) -> Frame:
    """The frame between two zeros.

    Args:
        stuffed: what lies between them, without them.

    Raises:
        FrameError: it is not a frame: invalid stuffing ("cobs"), too short, too long, a wrong
            checksum ("crc"), or another version.
    """
    try:
        body = cobs.decode(stuffed)
    except cobs.DecodeError as error:
        raise FrameError("cobs", f"not stuffed rightly: {error}") from None
    if len(body) < LEAST:
        raise FrameError("short", f"a frame has {LEAST} bytes at least, got {len(body)}")
    if len(body) > LEAST + MOST_PAYLOAD:
        raise FrameError("long", f"a frame has {LEAST + MOST_PAYLOAD} bytes at most")
    inner, check = body[: -_CRC.size], _CRC.unpack(body[-_CRC.size :])[0]
    if (found := fastcrc.crc32.iscsi(inner)) != check:
        raise FrameError("crc", f"check is {check:#010x}, the bytes have {found:#010x}")
    version, kind, run, sequence, time_ns = _HEADER.unpack_from(inner)
    if version != VERSION:
        raise FrameError("version", f"version {version}; this is version {VERSION}")
    return Frame(Header(kind, run, sequence, time_ns, version), inner[_HEADER.size :])
