"""Payloads: the values of a message to bytes and back, as the schema says."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np

from robins.bench.schema import SIZES, Message, message

_CODES = {"u8": "B", "u16": "H", "u32": "I", "u64": "Q", "f64": "d"}


class RecordError(ValueError):
    """Values or bytes that are not those of the message."""


@cache
def _packer(name: str) -> struct.Struct:
    return struct.Struct("<" + "".join(f"{f.length}{_CODES[f.kind]}" for f in message(name).fields))


def size_of(name: str) -> int:
    """Bytes of a payload.

    Raises:
        KeyError: there is no such message.
    """
    return sum(f.length * SIZES[f.kind] for f in message(name).fields)


def encode(name: str, values: Mapping[str, Any]) -> bytes:
    """The payload of a message.

    Args:
        name: of the message.
        values: by field; a number, or as many as the field has. Floats go as they are, bit for
            bit, NaN included.

    Raises:
        KeyError: there is no such message.
        RecordError: a field is missing, unknown, of another length, or beyond its type.
    """
    of = message(name)
    fields = {f.name for f in of.fields}
    if fields != set(values):
        raise RecordError(f"message '{name}' has the fields {sorted(fields)}, got {sorted(values)}")
    flat: list[Any] = []
    for f in of.fields:
        numbers = np.ravel(np.asarray(values[f.name]))
        if len(numbers) != f.length:
            raise RecordError(f"{name}.{f.name} has {f.length} numbers, got {len(numbers)}")
        if f.kind != "f64":
            if numbers.dtype.kind not in "iub":
                raise RecordError(f"{name}.{f.name} is {f.kind}: whole numbers are wanted")
            flat += [int(x) for x in numbers]
        else:
            flat += [float(x) for x in numbers]
    try:
        return _packer(name).pack(*flat)
    except struct.error as error:
        raise RecordError(f"message '{name}': {error}") from None


def decode(name: str, payload: bytes) -> dict[str, Any]:
    """The values of a payload: a number for a field of one, else an array.

    Raises:
        KeyError: there is no such message.
        RecordError: the payload is not as long as the message.
    """
    of = message(name)
    if len(payload) != size_of(name):
        raise RecordError(f"message '{name}' has {size_of(name)} bytes, got {len(payload)}")
    return _named(of, _packer(name).unpack(payload))


def _named(of: Message, flat: tuple[Any, ...]) -> dict[str, Any]:
    out: dict[str, Any] = {}
    at = 0
    for f in of.fields:
        some = flat[at : at + f.length]
        out[f.name] = some[0] if f.length == 1 else np.array(some)
        at += f.length
    return out
