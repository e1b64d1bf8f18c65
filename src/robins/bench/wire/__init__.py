"""The wire: the messages between the parts of a vehicle over serial lines.

- `fields`: messages and their fields.
- `schema`: every message of a rig in one table; encoder, decoder, documentation and C header follow
  it.
- `records`: payloads, from values to bytes and back, and the check that each of them passes.
- `frames`: header, check and COBS around them.
- `receiver`: frames out of a stream of bytes of which some are wrong.
- `c_header`: the same for firmware; `firmware`: example of a board.
"""

from robins.bench.wire.fields import Field, Message
from robins.bench.wire.frames import (
    VERSION,
    Frame,
    FrameError,
    Header,
    decode_frame,
    encode_frame,
)
from robins.bench.wire.receiver import Counts, Receiver, Sequence
from robins.bench.wire.records import RecordError
from robins.bench.wire.schema import FIRST_DATA, PROTOCOL, Wire, WireError

__all__ = [
    "FIRST_DATA",
    "PROTOCOL",
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
    "Wire",
    "WireError",
    "decode_frame",
    "encode_frame",
]
