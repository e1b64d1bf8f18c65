"""The bytes of a message of ROS 2: its header and fields in CDR.

CDR is that of DDSI-RTPS 2.3 (OMG), chapter 10: four bytes that say "little endian", then XCDR1:
each number is aligned to its own size, counted from there; a text is its length with the closing
zero, and the bytes.

The encoder is our own, because the layouts are fixed: one `struct` packs a message. A message Imu
takes 6 us, with `rosbags` 26 us, which also brings an extension for SQLite and a reader of YAML (15
MB). The tests compare every message with `rosbags`.
"""

from __future__ import annotations

import struct
from functools import cache

from robins.errors import RobinsError
from robins.ros.messages import Imu, MagneticField, Message, NavSatFix, Odometry, name_of

_LITTLE = b"\x00\x01\x00\x00"
_HEADER = "i I s"  # seconds, nanoseconds, frame_id
_LAYOUTS: dict[type[Message], tuple[str, ...]] = {  # codes of `struct`; s: a text
    kind: (*_HEADER.split(), *rest.split())
    for kind, rest in {
        Imu: "37d",
        MagneticField: "12d",
        NavSatFix: "b H 12d B",
        Odometry: "s 85d",
    }.items()
}


class RosError(RobinsError, ValueError):
    """What cannot be a message of ROS."""


def encode(message: Message, time_ns: int, frame_id: str = "") -> bytes:
    """The bytes of a message.

    Args:
        message: its fields; NaN stays NaN.
        time_ns: of its header.
        frame_id: of its header.

    Raises:
        RosError: a field has another length or type, or the time is beyond what ROS can say (32 bit
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
    """All of a message whose texts have these lengths, with the bytes that align it."""
    out, at, texts = "<4s", 0, iter(lengths)
    for code in layout:
        if code == "s":
            code = f"I{next(texts)}s"
        size = struct.calcsize(f"<{code.lstrip('0123456789')[0]}")
        out += "x" * (-at % size) + code
        at = struct.calcsize(out) - len(_LITTLE)
    return struct.Struct(out)
