"""What a run says aloud, from the flags of its estimates: each thing when it begins and ends."""

from __future__ import annotations

from typing import Literal, NamedTuple

from robins.bench.wire.schema import FLAGS

Level = Literal["info", "warning", "alarm"]
_USED, _REFUSED, _HELD, _SAFE, _SILENT, _SHORT = (1 << k for k in range(len(FLAGS)))
_OF_FRAMES = _USED | _REFUSED | _SHORT  # said of a star frame, so nothing between two frames


class Said(NamedTuple):
    """Something to tell people."""

    level: Level
    text: str


class Alarms:
    """Listens to the flags of one estimate after another."""

    def __init__(self) -> None:
        self._stands = 0  # flags that were said to have begun and not to have ended
        self._frames = 0  # refused in a row

    def hear(self, flags: int) -> list[Said]:
        """What there is to say of the next estimate.

        A sensor whose frames are refused one after another is said so once, and how many there were
        when one is used again.
        """
        now, begun = flags, self._stands
        if not flags & _OF_FRAMES:  # no frame: what was said of the last one stands
            now |= begun & (_REFUSED | _SHORT)
        new, over = now & ~begun, begun & ~now
        if flags & _REFUSED:
            self._frames = 1 if new & _REFUSED else self._frames + 1
        self._stands = now & ~_USED
        said = []
        if new & _REFUSED:
            said.append(Said("alarm", "star refused"))
        if over & _REFUSED:
            frames = "one frame was" if self._frames == 1 else f"{self._frames} frames were"
            said.append(Said("info", f"star used again, {frames} refused"))
        for flag in (_HELD, _SILENT, _SHORT):
            if new & flag:
                said.append(Said("warning", FLAGS[flag.bit_length() - 1]))
        if new & _SAFE:
            said.append(Said("alarm", FLAGS[_SAFE.bit_length() - 1]))
        if over & _SAFE:
            said.append(Said("info", "the estimate can be steered by again"))
        return said
