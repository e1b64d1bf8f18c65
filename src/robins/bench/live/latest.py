"""The latest events, of which a frequent kind does not push out a rare one."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Hashable, Sequence
from typing import Any


def latest(events: Sequence[Any], kind: Callable[[Any], Hashable], most: int) -> list[Any]:
    """As many of the latest events as there is room for, in their order.

    Each kind has the same room, and what one does not need is for the others; so a thousand
    warnings leave the alarm that came before them.

    Args:
        events: the oldest first.
        kind: of an event.
        most: how many there is room for.
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
