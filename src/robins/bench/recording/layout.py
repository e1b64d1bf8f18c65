"""The layout of a record: its entries, and how an MCAP file holds them.

MCAP (mcap.dev) is a container of time-stamped messages that other tools open too. Ours has a topic
for each link and direction, ``/gyro/from`` or ``/adm/to``, whose messages are the bytes on the
line, and ``/events`` in JSON. A metadata record with the header of the run comes first; messages
are in uncompressed chunks, each with a checksum.
"""

from __future__ import annotations

import json
import struct
from typing import Any, Literal, NamedTuple

import fastcrc
from mcap.records import Schema

from robins.bench.wire.frames import VERSION
from robins.bench.wire.schema import Wire
from robins.errors import RobinsError

MAGIC = b"\x89MCAP0\r\n"
PROFILE = "robins-bench"
METADATA = "robins"  # name of the record with the header
ENCODING = "robins-wire-"  # of messages; the version of the wire follows
EVENTS = "/events"

RECORD = struct.Struct("<BQ")  # opcode, length of what follows
MESSAGE = struct.Struct("<BQHIQQ")  # of a record; channel, number, log time, publish time
CHUNK = struct.Struct("<BQQQQIIQ")  # of a record; first, last, size, check, 0: plain, size

FRAMES_SCHEMA, EVENTS_SCHEMA = 1, 2
_EVENT = {
    "type": "object",
    "properties": {
        "kind": {"type": "string"},
        "text": {"type": "string"},
        "fields": {"type": "object"},
    },
}


class RecordingError(RobinsError, ValueError):
    """A record that cannot be created or read; names the cause, the place and the fix."""


class Entry(NamedTuple):
    """Bytes of a link."""

    received_ns: int
    link: str  # part whose link it is
    direction: Literal["to", "from"]  # the part
    data: bytes  # a complete frame with its zeros, or bytes that form no frame


class Event(NamedTuple):
    """Event of a run."""

    received_ns: int
    kind: str
    text: str
    fields: dict[str, Any]


def schemas(wire: Wire) -> tuple[Schema, Schema]:
    """MCAP schemas of frames and of events."""
    table, event = wire.markdown().encode(), json.dumps(_EVENT, sort_keys=True).encode()
    return (
        Schema(FRAMES_SCHEMA, table, "text/markdown", f"{ENCODING}{VERSION}"),
        Schema(EVENTS_SCHEMA, event, "jsonschema", "robins-event"),
    )


def json_text(what: str, value: Any) -> str:
    """Canonical JSON text of a value.

    Raises:
        RecordingError: JSON cannot hold it; ``what`` names it.
    """
    try:
        return json.dumps(value, sort_keys=True, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise RecordingError(f"{what}: JSON cannot hold it: {error}") from None


def check_of(text: str) -> str:
    """CRC-32C of a text, hexadecimal: MCAP has none of its own for metadata."""
    return f"{fastcrc.crc32.iscsi(text.encode()):08x}"
