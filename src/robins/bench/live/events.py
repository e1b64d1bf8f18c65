"""Latest events of a run, in bounded number, and the acknowledgement of alarms.

An event is a mapping: `id`, `level`, `time_s`, `text`; `count` and `until_s` if it repeated in a
row; `acknowledged` for an alarm.
"""

from __future__ import annotations

from collections.abc import Collection

from robins.bench.live.feed import EVENTS, JsonObject, latest


class Events:
    """The latest events; a frequent level does not push out a rare one."""

    def __init__(self) -> None:
        self.kept: list[JsonObject] = []
        self._next = 0

    def add(self, level: str, time_s: float, text: str) -> JsonObject:
        """Add an event; one equal to the last, unless that is acknowledged, raises its count."""
        last = self.kept[-1] if self.kept else {}
        if (last.get("level"), last.get("text")) == (level, text) and "acknowledged" not in last:
            again = {**last, "count": last.get("count", 1) + 1, "until_s": time_s}
        else:
            again = {"id": self._next, "level": level, "time_s": time_s, "text": text}
            self._next += 1
        self.keep(again)
        return again

    def keep(self, event: JsonObject) -> None:
        """Store an event, in place of its former state if it is the last."""
        if self.kept and self.kept[-1]["id"] == event["id"]:
            self.kept[-1] = event
        else:
            self.kept = latest([*self.kept, event], lambda one: one["level"], EVENTS)

    def waiting(self) -> list[JsonObject]:
        """Alarms that are not acknowledged."""
        alarms = (one for one in self.kept if one["level"] == "alarm")
        return [one for one in alarms if "acknowledged" not in one]

    def acknowledge(self, ids: Collection[int]) -> None:
        """Mark alarms as acknowledged."""
        for one in self.waiting():
            if one["id"] in ids:
                one["acknowledged"] = True
