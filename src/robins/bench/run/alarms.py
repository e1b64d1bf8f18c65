"""What a run says aloud, from the flags of its estimates: each thing when it begins and ends."""

from __future__ import annotations

from typing import Literal, NamedTuple

from robins.bench.wire.schema import FLAGS, HELD, REFUSED, SAFE, SHORT, SILENT, USED

Level = Literal["info", "warning", "alarm"]
_OF_FRAMES = USED | REFUSED | SHORT  # said of a star frame, so nothing between two frames


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
            now |= begun & (REFUSED | SHORT)
        new, over = now & ~begun, begun & ~now
        if flags & REFUSED:
            self._frames = 1 if new & REFUSED else self._frames + 1
        self._stands = now & ~USED
        said = []
        if new & REFUSED:
            said.append(Said("alarm", "star refused"))
        if over & REFUSED:
            frames = "one frame was" if self._frames == 1 else f"{self._frames} frames were"
            said.append(Said("info", f"star used again, {frames} refused"))
        for flag in (HELD, SILENT, SHORT):
            if new & flag:
                said.append(Said("warning", FLAGS[flag.bit_length() - 1]))
        if new & SAFE:
            said.append(Said("alarm", FLAGS[SAFE.bit_length() - 1]))
        if over & SAFE:
            said.append(Said("info", "the estimate can be steered by again"))
        return said
