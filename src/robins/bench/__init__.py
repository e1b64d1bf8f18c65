"""The test bench: so far its wire, the frames in which its parts talk over serial lines.

- `schema`: every message, field by field; encoder, decoder, documentation and C header follow it.
- `records`: payloads, from values to bytes and back.
- `frames`: header, CRC-32C and COBS around a payload.
- `receiver`: frames out of a stream of bytes of which some are wrong.
- `c_header`: the same for firmware.

Needs the extra "bench".
"""

from robins.bench.frames import Frame, FrameError, Header, decode_frame, encode_frame
from robins.bench.receiver import Counts, Receiver, Sequence
from robins.bench.records import RecordError, decode, encode, size_of
from robins.bench.schema import MESSAGES, VERSION, Field, Message, markdown, message

__all__ = [
    "MESSAGES",
    "VERSION",
    "Counts",
    "Field",
    "Frame",
    "FrameError",
    "Header",
    "Message",
    "Receiver",
    "RecordError",
    "Sequence",
    "decode",
    "decode_frame",
    "encode",
    "encode_frame",
    "markdown",
    "message",
    "size_of",
]
