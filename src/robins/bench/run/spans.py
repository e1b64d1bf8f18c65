"""Times at which faults were active, for the live page.

The page gets the state of the bench every half second, and some faults are shorter.
"""

from __future__ import annotations

from collections.abc import Iterable

from robins.bench.live.feed import JsonObject

MOST = 100  # latest spans kept


class FaultSpans:
    """Begin and end of each fault, observed step by step."""

    def __init__(self) -> None:
        self._ends: dict[tuple[str, float], float | None] = {}

    def observe(self, active: Iterable[tuple[str, float]], time_s: float) -> None:
        """Record the faults that are active after a step.

        Args:
            active: label and begin [s] of each fault.
            time_s: of the run.
        """
        now = set(active)
        for span, end in self._ends.items():
            if end is None and span not in now:
                self._ends[span] = time_s
        for span in sorted(now - self._ends.keys()):
            self._ends[span] = None
            if len(self._ends) > MOST:
                self._ends.pop(next(iter(self._ends)))

    @property
    def for_page(self) -> list[JsonObject]:
        """Spans for the page; one that is still active has no end."""
        return [
            {"label": label, "begin_s": begin, "end_s": end}
            for (label, begin), end in self._ends.items()
        ]
