"""The wire: the messages between the parts of a vehicle over serial lines.

- `schema`: every message, field by field; encoder, decoder, documentation and C header follow it.
- `records`: payloads, from values to bytes and back, and the gate that each of them passes.
- `frames`: header, check and COBS around them.
- `receiver`: frames out of a stream of bytes of which some are wrong.
- `c_header`: the same for firmware; `firmware`: a board to begin with.
"""

from robins.bench.wire.frames import Frame, FrameError, Header, decode_frame, encode_frame
from robins.bench.wire.receiver import Counts, Receiver, Sequence
from robins.bench.wire.records import RecordError, decode, encode, size_of, unsound
from robins.bench.wire.schema import (
    FIRST_DATA,
    FLAGS,
    MESSAGES,
    NAMES,
    NUMBERS,
    PARTS,
    VERSION,
    Field,
    Message,
    markdown,
    message,
)

__all__ = [
    "FIRST_DATA",
    "FLAGS",
    "MESSAGES",
    "NAMES",
    "NUMBERS",
    "PARTS",
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
    "unsound",
]
