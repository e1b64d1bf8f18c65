"""Serialisation of ROS 2 messages, header and fields, in CDR.

CDR is that of DDSI-RTPS 2.3 (OMG), chapter 10: four bytes that mean "little endian", then XCDR1:
each number is aligned to its own size, counted from there; a text is its length including the final
zero, and the bytes.

The coder is our own, because the layouts are fixed: one `struct` packs a message. An Imu takes
6 us; `rosbags` takes 26 us, and depends on an extension for SQLite and a reader of YAML (15 MB).
The tests compare every message with `rosbags`.
"""

from __future__ import annotations

import struct
from functools import cache
from typing import NamedTuple

from robins.errors import RobinsError
from robins.ros.messages import Imu, MagneticField, Message, NavSatFix, Odometry, name_of

_LITTLE = b"\x00\x01\x00\x00"
_ORDERS = {b"\x00\x00": ">", b"\x00\x01": "<"}
_HEADER = "i I s"  # seconds, nanoseconds, frame_id
_LAYOUTS: dict[type[Message], tuple[str, ...]] = {  # codes of `struct`, one per field; s: a text
    kind: (*_HEADER.split(), *rest.split())
    for kind, rest in {
        Imu: "4d 9d 3d 9d 3d 9d",
        MagneticField: "3d 9d",
        NavSatFix: "b H d d d 9d B",
        Odometry: "s 3d 4d 36d 3d 3d 36d",
    }.items()
}
NUMBERS: dict[str, tuple[str, ...]] = {
    **{name_of(kind): layout for kind, layout in _LAYOUTS.items()},
    "geometry_msgs/msg/TwistStamped": (*_HEADER.split(), "3d", "3d"),
    "geometry_msgs/msg/TwistWithCovarianceStamped": (*_HEADER.split(), "3d", "3d", "36d"),
}
"""Layouts of the types that `numbers` decodes, by name."""


class RosError(RobinsError, ValueError):
    """A value that a ROS message cannot hold."""


class Stamped(NamedTuple):
    """A message with its header."""

    time_ns: int
    frame_id: str
    message: Message


def encode(message: Message, time_ns: int, frame_id: str = "") -> bytes:
    """The bytes of a message.

    Args:
        message: its fields; NaN stays NaN.
        time_ns: of its header.
        frame_id: of its header.

    Raises:
        RosError: a field has another length or type, or the time is beyond the range of ROS (32 bit
            of seconds).
    """
    values: list[object] = [_LITTLE, *divmod(time_ns, 1_000_000_000)]
    lengths: list[int] = []
    for one in (frame_id, *message):
        if isinstance(one, str):
            text = one.encode() + b"\0"
            lengths.append(len(text))
            values += (len(text), text)
        elif isinstance(one, int | float):
            values.append(one)
        else:
            values += one
    kind = type(message)
    try:
        return _packer(_LAYOUTS[kind], tuple(lengths)).pack(*values)
    except struct.error as error:
        raise RosError(
            f"{name_of(kind)} at {time_ns} ns cannot be encoded ({error})",
            fix="give each field the numbers that its class names, and a time of 32 bit in seconds",
        ) from None


@cache
def _packer(layout: tuple[str, ...], lengths: tuple[int, ...]) -> struct.Struct:
    """Struct of a message with texts of these lengths, with the padding that aligns it."""
    out, at, texts = "<4s", 0, iter(lengths)
    for code in layout:
        if code == "s":
            code = f"I{next(texts)}s"
        out += "x" * (-at % _size(code)) + code
        at = struct.calcsize(out) - len(_LITTLE)
    return struct.Struct(out)


def decode(kind: type[Message], data: bytes) -> Stamped:
    """Decode a message; bytes after its last field are ignored.

    Raises:
        RosError: there are too few bytes, or they are not in XCDR1.
    """
    time_ns, frame_id, fields = _fields(name_of(kind), _LAYOUTS[kind], data, False)
    return Stamped(time_ns, frame_id, kind(*fields))


def numbers(name: str, data: bytes, ros1: bool = False) -> tuple[int, str, list[float]]:
    """Stamp [ns], frame and numbers of a message, its texts left out.

    Args:
        name: a type of `NUMBERS`.
        data: its bytes.
        ros1: serialised by ROS 1: packed, little endian, with a sequence number before the stamp.

    Raises:
        RosError: there are too few bytes, or (but for ROS 1) they are not in XCDR1.
    """
    time_ns, frame_id, fields = _fields(name, NUMBERS[name], data, ros1)
    flat: list[float] = []
    for one in fields:
        if not isinstance(one, str):
            flat += one if isinstance(one, tuple) else (float(one),)
    return time_ns, frame_id, flat


def _fields(name: str, layout: tuple[str, ...], data: bytes, ros1: bool) -> tuple[int, str, list]:
    """Stamp [ns], frame and the fields after the header."""
    order = "<" if ros1 else _ORDERS.get(bytes(data[:2]))
    if order is None:
        raise RosError(
            f"{name} is encoded in another way ({bytes(data[:4]).hex()})",
            fix="write it in CDR, as ROS 2 does",
        )
    # four bytes that name the encoding, or the sequence number
    body, at, values = memoryview(data)[4:], 0, []
    try:
        for code in layout:
            at += 0 if ros1 else -at % _size("I" if code == "s" else code)
            if code == "s":
                (length,) = struct.unpack_from(f"{order}I", body, at)
                code, at = f"{length}s", at + 4
            found = struct.unpack_from(order + code, body, at)
            at += struct.calcsize(order + code)
            if code.endswith("s"):
                values.append(found[0].rstrip(b"\0").decode())
            else:
                values.append(found if code[:-1] else found[0])
    except (struct.error, UnicodeDecodeError) as error:
        raise RosError(
            f"{name} of {len(data)} bytes cannot be decoded ({error})",
            fix="is it of another version of ROS?",
        ) from None
    sec, nanosec, frame_id, *fields = values
    return sec * 1_000_000_000 + nanosec, frame_id, fields


@cache
def _size(code: str) -> int:
    """Bytes of one number of a code."""
    return struct.calcsize(f"<{code.lstrip('0123456789')[0]}")
