"""All messages on the lines of a rig, in one table: encoded, checked, documented, put into C.

The messages of the protocol are those of every rig; a rig adds its parts and its data. Numbers are
part of the protocol: add at the end, never renumber, never reuse. Any change of this table, its
wording included, changes its number, `Wire.number`: boards must be rebuilt, and records made before
cannot be replayed, only read. `VERSION` is that of the framing.
"""

from __future__ import annotations

from functools import cached_property

import fastcrc

from robins.bench.wire.fields import Field, Message, Values, message
from robins.bench.wire.frames import VERSION
from robins.bench.wire.records import MessageCodec, PayloadFault
from robins.errors import RobinsError

FIRST_DATA = 16
"""Messages of a lower number are of the protocol, the others carry data."""
BENCH = "bench"
"""Name of the hub; its number as a part is 0."""

# fmt: off
PROTOCOL: tuple[Message, ...] = (
    message(1, "hello", "A part is there; its first message.",
        Field("part", "u8", 1, "1", "number of the part"),
        Field("schema", "u32", 1, "1", "CRC-32C of this table, so that both mean the same"),
    ),
    message(2, "tick", "The clock lets a step begin. The time in the header is that of its end.",
        Field("step", "u32", 1, "1", "number of the step, from 0"),
    ),
    message(3, "done", "A part has sent all that it sends in a step.",
        Field("step", "u32", 1, "1", "number of the step"),
        Field("compute", "u32", 1, "ns", "time it took to compute"),
    ),
    message(4, "stop", "The run is over."),
    message(5, "begin",
        "The bench answers a hello. All that follow have the number of the run in this header.",
        Field("step", "u64", 1, "ns", "length of a step"),
    ),
)
# fmt: on
NUMBERS = {m.name: m.number for m in PROTOCOL}


class WireError(RobinsError, ValueError):
    """Invalid table of messages."""


class Wire:
    """The parts of a rig and their messages.

    Attributes:
        parts: names, the bench first; the index of a part is its number.
        messages: all of them by number, those of the protocol first.
        names: of the messages, by number.
        numbers: of the messages, by name.
    """

    def __init__(self, parts: tuple[str, ...], messages: tuple[Message, ...]):
        """Check a table.

        Args:
            parts: of the rig, without the bench.
            messages: with its data; numbers from 16 to 255.

        Raises:
            WireError: a name or a number is used twice, or a number is reserved for the protocol.
        """
        self.parts = (BENCH, *parts)
        self.messages = (*PROTOCOL, *messages)
        self.names = {m.number: m.name for m in self.messages}
        self.numbers = {m.name: m.number for m in self.messages}
        if min(len(self.names), len(self.numbers)) < len(self.messages):
            raise WireError(f"a name or a number is there twice: {sorted(self.numbers.items())}")
        if wrong := [m.name for m in messages if not FIRST_DATA <= m.number < 256]:
            raise WireError(f"message '{wrong[0]}': its number must be from {FIRST_DATA} to 255")
        if len(set(self.parts)) < len(self.parts) or len(self.parts) > 256:
            raise WireError(f"parts must be 255 at most and have names of their own: {self.parts}")
        self._records = {m.name: MessageCodec(m) for m in self.messages}

    @property
    def data(self) -> tuple[Message, ...]:
        """The messages that are not of the protocol."""
        return self.messages[len(PROTOCOL) :]

    def message(self, which: str | int) -> Message:
        """A message by its name or number.

        Raises:
            KeyError: there is none; the message of the error lists those there are.
        """
        return self._record(which).message

    def size_of(self, name: str) -> int:
        """Bytes of a payload.

        Raises:
            KeyError: there is no such message.
        """
        return self._record(name).size

    def encode(self, name: str, values: Values) -> bytes:
        """The payload of a message; see `MessageCodec.encode`.

        Raises:
            KeyError: there is no such message.
            RecordError: the values do not fit the message.
        """
        return self._record(name).encode(values)

    def decode(self, name: str, payload: bytes) -> Values:
        """The values of a payload; see `MessageCodec.decode`.

        Raises:
            KeyError: there is no such message.
            RecordError: the payload is not as long as the message.
        """
        return self._record(name).decode(payload)

    def unsound(self, name: str, payload: bytes) -> PayloadFault | None:
        """Reason why a payload contradicts the table of its message; None: it is valid.

        Raises:
            KeyError: there is no such message.
        """
        return self._record(name).unsound(payload)

    def _record(self, which: str | int) -> MessageCodec:
        name = self.names.get(which) if isinstance(which, int) else which
        if name not in self._records:
            there = ", ".join(self.numbers)
            raise KeyError(f"no message {which!r} in version {VERSION}; there are {there}")
        return self._records[name]

    @cached_property
    def number(self) -> int:
        """Version number of the table: CRC-32C of its documentation."""
        return fastcrc.crc32.iscsi(self.markdown().encode())

    def markdown(self) -> str:
        """The table as documentation."""
        lines = ["| number | message | field | type | unit | limits | meaning |"]
        lines.append("|---|---|---|---|---|---|---|")
        for m in self.messages:
            lines.append(f"| {m.number} | `{m.name}` | | | | | {m.text} |")
            for f in m.fields:
                kind = f.kind if f.length == 1 else f"{f.kind} x {f.length}"
                lines.append(f"| | | `{f.name}` | {kind} | {f.unit} | {f.span} | {f.text} |")
        return "\n".join(lines) + "\n"


BARE = Wire((), ())
"""Table with the messages of the protocol alone."""
