"""Messages between the bench and the server of its page, over a pair of sockets.

To the server: `length u32 | kind u8 | body`, little endian; a body is a sample or a history as the
browser gets it, or JSON. Back: JSON, one object a line.

    sample:  run u32 | sequence u32 | time_s f64 | values f64 ...
    history: run u32 | MARK u32 | ...  what came before the latest samples; see `live.history`

The page draws signals, gathered in plots.
"""

from __future__ import annotations

import json
import math
import struct
from collections import Counter
from collections.abc import Callable, Hashable, Mapping, Sequence
from enum import IntEnum
from itertools import groupby
from typing import Any, Literal, NamedTuple, TypeVar, get_args

import numpy as np

JsonObject = dict[str, Any]
EventT = TypeVar("EventT")
Role = Literal["value", "sigma", "limit", "attitude"]


class Signal(NamedTuple):
    """A number of each sample, and how it is drawn.

    Signals of one plot share `plot`, its title, and their unit. Values of a plot get the colours
    of x, y, z and a fourth in the order in which they come.

    An attitude is four signals that follow one another, w, x, y, z of the quaternion from body to
    reference, scalar first, with the same `of`. A plot of attitudes is drawn in three dimensions:
    the first is solid, others are shown transparent.
    """

    name: str
    unit: str
    plot: str
    role: Role = "value"  # "sigma": a band of +-3 about zero; "limit": a dashed line
    of: str = ""  # "sigma": name of the value it belongs to; "attitude": its label, such as "true"


def check(signals: Sequence[Signal]) -> None:
    """Raise if signals cannot be drawn.

    Raises:
        ValueError: there are none, two of one name, a plot of two units, an unknown role, a sigma
            of something that is not a value of the same plot, an attitude that is not four signals
            of a plot of attitudes, or an `of` where there is neither.
    """
    if not signals:
        raise ValueError("a live page needs at least one signal")
    by_name: dict[str, Signal] = {}
    units: dict[str, str] = {}
    for s in signals:
        if s.name in by_name:
            raise ValueError(f"two signals are named '{s.name}'; names distinguish them")
        if s.role not in get_args(Role):
            roles = ", ".join(get_args(Role))
            raise ValueError(f"signal '{s.name}': role '{s.role}' is none of {roles}")
        if units.setdefault(s.plot, s.unit) != s.unit:
            raise ValueError(
                f"signal '{s.name}' is in {s.unit}, but plot '{s.plot}' is in {units[s.plot]}; "
                "give it a plot of its own or another unit"
            )
        by_name[s.name] = s
    _check_attitudes(signals)
    for s in signals:
        if s.role != "sigma":
            if s.of and s.role != "attitude":
                raise ValueError(f"signal '{s.name}' is a {s.role}; only a sigma is `of` another")
            continue
        of = by_name.get(s.of)
        if of is None or of.role != "value" or of.plot != s.plot:
            raise ValueError(f"sigma '{s.name}' is of '{s.of}', which is no value of its plot")


def _check_attitudes(signals: Sequence[Signal]) -> None:
    plots = {s.plot for s in signals if s.role == "attitude"}
    for s in signals:
        if s.plot in plots and (s.role != "attitude" or s.unit != "1" or not s.of):
            raise ValueError(
                f"signal '{s.name}': plot '{s.plot}' is one of attitudes; each of its signals has "
                "the role 'attitude', the unit '1', and says `of` what it is"
            )
    groups = [(key, len(list(four))) for key, four in groupby(signals, lambda s: (s.plot, s.of))]
    attitudes = [(key, many) for key, many in groups if key[0] in plots]
    for (plot, of), many in attitudes:
        if many != 4 or attitudes.count(((plot, of), many)) > 1:
            raise ValueError(
                f"attitude '{of}' of plot '{plot}' must be four signals in a row: w, x, y, z"
            )


def as_json(signals: Sequence[Signal]) -> list[JsonObject]:
    """Signals as the page gets them."""
    return [s._asdict() for s in signals]


HEAD = struct.Struct("<IB")
SAMPLE_HEAD = struct.Struct("<IId")
MARK = 0xFFFFFFFF  # in place of the number of a sample: it is a history
RECENT = 300  # latest samples sent one by one to a page that joins late; older ones as a history
EVENTS = 200  # latest events sent to it


class FrameKind(IntEnum):
    """Type of the body of a frame."""

    HELLO = 0
    SAMPLE = 1
    STATUS = 2
    EVENT = 3
    HISTORY = 4


def pack(kind: FrameKind, body: bytes) -> bytes:
    """Frame of a body: its header and the body."""
    return HEAD.pack(len(body), kind) + body


def pack_sample(
    run: int, sequence: int, time_s: float, values: Sequence[float] | np.ndarray
) -> bytes:
    """The body of a sample."""
    head = SAMPLE_HEAD.pack(run & 0xFFFFFFFF, sequence % MARK, time_s)
    return head + np.asarray(values, dtype="<f8").tobytes()


def sequence_of(sample: bytes) -> int:
    """The number of a sample."""
    return SAMPLE_HEAD.unpack_from(sample)[1]


def to_json(value: Any) -> str:
    """JSON that every browser reads: numbers that are not finite become null.

    Raises:
        TypeError: something in it is not a number, text, list or mapping.
    """
    return json.dumps(_plain(value), allow_nan=False, separators=(",", ":"))


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def latest(events: Sequence[EventT], kind: Callable[[EventT], Hashable], most: int) -> list[EventT]:
    """Latest events up to a number, in their order.

    Each kind has an equal share of the room, and the others use what it leaves; so a thousand
    warnings do not push out an earlier alarm.

    Args:
        events: the oldest first.
        kind: function that returns the kind of an event.
        most: number of events to keep.
    """
    if len(events) <= most:
        return list(events)
    left = Counter(kind(one) for one in events)
    room, kinds = most, len(left)
    each: dict[Hashable, int] = {}
    for name, count in sorted(left.items(), key=lambda item: item[1]):
        each[name] = min(count, room // kinds)
        room, kinds = room - each[name], kinds - 1
    kept = []
    for one in reversed(events):
        if each[kind(one)]:
            each[kind(one)] -= 1
            kept.append(one)
    return kept[::-1]
