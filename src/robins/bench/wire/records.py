"""Payloads: values of a message to bytes and back, checked by the limits of its table."""

from __future__ import annotations

import math
import struct
from typing import Any, NamedTuple

import numpy as np

from robins.bench.wire.fields import SIZES, Field, Message, Values
from robins.errors import RobinsError

_CODES = {"u8": "B", "u16": "H", "u32": "I", "u64": "Q", "f64": "d"}


class RecordError(RobinsError, ValueError):
    """Values or bytes that do not fit the message."""


class PayloadFault(NamedTuple):
    """Reason why a payload contradicts the table of its message."""

    text: str
    sized: bool  # it has the length of its message, so one of its numbers is to blame


class MessageCodec:
    """The payloads of one message."""

    def __init__(self, of: Message):
        """Lay out the numbers of the message."""
        self.message, self.size, self._names = of, of.size, {f.name for f in of.fields}
        self._numbers = tuple(
            (f.name + f"[{k}]" * (f.length > 1), *(f.limits or (0.0, 256.0 ** SIZES[f.kind])), f)
            for f in of.fields
            for k in range(f.length)
        )  # name, least, most, field of each number
        self._all = struct.Struct("<" + "".join(f"{f.length}{_CODES[f.kind]}" for f in of.fields))

    def encode(self, values: Values) -> bytes:
        """Encode a payload.

        Args:
            values: by field; a number, or as many as the field has. Floats are copied bit for bit,
                NaN included.

        Raises:
            RecordError: a field is missing, unknown, of another length, or beyond its type.
        """
        of = self.message
        if values.keys() != self._names:
            raise RecordError(
                f"message '{of.name}' has the fields {sorted(self._names)}, got {sorted(values)}"
            )
        return b"".join([_field(of.name, f, values[f.name]) for f in of.fields])

    def decode(self, payload: bytes) -> Values:
        """Decode a payload: a number for a field of length one, else an array.

        Raises:
            RecordError: the payload is not as long as the message.
        """
        of = self.message
        if len(payload) != self.size:
            raise RecordError(f"message '{of.name}' has {self.size} bytes, got {len(payload)}")
        out: dict[str, Any] = {}
        at = 0
        for f in of.fields:
            if f.kind == "f64" and f.length > 1:
                out[f.name] = np.frombuffer(payload, "<f8", f.length, at).copy()
            else:
                some = struct.unpack_from(f"<{f.length}{_CODES[f.kind]}", payload, at)
                out[f.name] = some[0] if f.length == 1 else np.array(some)
            at += f.length * SIZES[f.kind]
        return out

    def unsound(self, payload: bytes) -> PayloadFault | None:
        """Check length and limits of a payload; None: it is valid.

        An infinity exceeds every limit; NaN passes only where the table has it for a missing
        number.
        """
        if len(payload) != self.size:
            why = f"it has {len(payload)} bytes, '{self.message.name}' has {self.size}"
            return PayloadFault(why, False)
        numbers = zip(self._all.unpack(payload), self._numbers, strict=True)
        for x, (name, least, most, field) in numbers:
            if not least <= x <= most and not (field.missing and math.isnan(x)):
                unit = "" if field.unit == "1" else f" {field.unit}"
                return PayloadFault(f"{name} is {x:g}{unit}, not {field.span}", True)
        return None


def _field(name: str, f: Field, value: Any) -> bytes:
    """The bytes of a field."""
    if f.kind == "f64":
        numbers = np.asarray(value, "<f8")
        if numbers.size != f.length:
            raise RecordError(f"{name}.{f.name} has {f.length} numbers, got {numbers.size}")
        return numbers.tobytes()
    whole = [value] if isinstance(value, int) else np.ravel(np.asarray(value)).tolist()
    if len(whole) != f.length:
        raise RecordError(f"{name}.{f.name} has {f.length} numbers, got {len(whole)}")
    try:
        return struct.pack(f"<{f.length}{_CODES[f.kind]}", *whole)
    except struct.error:
        raise RecordError(
            f"message '{name}': {name}.{f.name} is {f.kind}: whole numbers are wanted, as large as "
            f"{256 ** SIZES[f.kind] - 1} at most, got {value}"
        ) from None
