"""Lateness and durations of the parts and of whole cycles, over days in little memory.

A histogram keeps each number to one part in 256 (the leading eight bits, as HdrHistogram by G. Tene
does), so a run of any length needs a few thousand counters and constant time per number. The
largest number is kept exactly.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import deque
from typing import Any

_BITS = 8  # leading bits kept of a number
RECENT = 100  # cycles, for the live page
EDGES_US = (1, 2, 5, 10, 20, 50, 100, 200, 500, *(k * 10**d for d in (3, 4, 5) for k in (1, 2, 5)))
EDGES_US += (1_000_000,)
"""Bin edges of the lateness histogram [us]; numbers outside are counted in two open bins."""
_KINDS = ("lateness", "compute", "round_trip")


class Histogram:
    """Histogram of durations [ns]; a negative one counts as 0.

    Attributes:
        count: number of durations.
        most: the largest [ns].
    """

    def __init__(self) -> None:
        self.count = self.most = 0
        self._cells: dict[int, int] = {}

    def add(self, ns: int) -> None:
        """Add a duration [ns]."""
        ns = max(ns, 0)
        shift = max(ns.bit_length() - _BITS, 0)
        cell = (shift << _BITS) + (ns >> shift)
        self._cells[cell] = self._cells.get(cell, 0) + 1
        self.count += 1
        self.most = max(self.most, ns)

    def quantile(self, share: float) -> float | None:
        """Quantile of the numbers [ns], to 0.4 %; None: the histogram is empty.

        Args:
            share: of the numbers that do not exceed it, from 0 to 1.
        """
        wanted, passed = share * self.count, 0
        for cell in sorted(self._cells):
            passed += self._cells[cell]
            if passed >= wanted:
                shift = cell >> _BITS
                low = (cell & (2**_BITS - 1)) << shift
                return min(low + 0.5 * (2**shift - 1), float(self.most))
        return None


class _Times:
    """Lateness, compute and round-trip times of a part or of a cycle: all, and the latest."""

    def __init__(self) -> None:
        self._all = {kind: Histogram() for kind in _KINDS}
        self._latest = {kind: deque[int](maxlen=RECENT) for kind in _KINDS}

    def add(self, kind: str, ns: int) -> None:
        self._all[kind].add(ns)
        self._latest[kind].append(max(ns, 0))

    def summary(self) -> dict[str, dict[str, float | int | None]]:
        return {f"{kind}_us": _quantiles(histogram) for kind, histogram in self._all.items()}

    def recent(self) -> dict[str, dict[str, float | int | None]]:
        out = {}
        for kind, latest in self._latest.items():
            histogram = Histogram()
            for ns in latest:
                histogram.add(ns)
            out[f"{kind}_us"] = _quantiles(histogram)
        return out


class Latencies:
    """Lateness, compute and round-trip times of a run, by part and by cycle.

    *Lateness* is the delay of a tick, or of the start of a cycle, after its deadline: the wake-up
    latency in real time; lock-step has no deadlines and no lateness. *Compute* is the computing
    time that a part reports, for a cycle the sum over its parts. *Round trip* is from a tick to its
    done, for a cycle from its start to its end.
    """

    def __init__(self) -> None:
        self._parts: dict[str, _Times] = {}
        self._cycle = _Times()
        self._asked: dict[str, tuple[int, int]] = {}  # by part: step, time sent [ns]
        self._answered: dict[str, int] = {}  # by part: step
        self._computed = 0  # ns in the current cycle
        self._cycles = self._missed = 0
        self._latest_missed = deque[bool](maxlen=RECENT)
        self._late = [0] * (len(EDGES_US) + 1)

    def tick(self, part: str, step: int, deadline_ns: int | None, sent_ns: int) -> None:
        """Record the tick of a part for a step; of a repeated tick the first counts."""
        if self._asked.get(part, (None, 0))[0] == step:
            return
        self._asked[part] = step, sent_ns
        if deadline_ns is not None:
            self._of(part).add("lateness", sent_ns - deadline_ns)

    def done(self, part: str, step: int, received_ns: int, compute_ns: int) -> None:
        """Record the end of a step of a part; an unrequested or repeated answer does not count."""
        asked, sent_ns = self._asked.get(part, (None, 0))
        if asked != step or self._answered.get(part) == step:
            return
        self._answered[part] = step
        times = self._of(part)
        times.add("compute", compute_ns)
        times.add("round_trip", received_ns - sent_ns)
        self._computed += compute_ns

    def cycle(
        self, step: int, deadline_ns: int | None, began_ns: int, ended_ns: int, missed: bool
    ) -> None:
        """Record the end of a step: all parts are done, or its time is up.

        Args:
            step: its number.
            deadline_ns: planned start; None in lock-step.
            began_ns: actual start.
            ended_ns: time at which the last part was done.
            missed: whether the deadline of the next step was missed.
        """
        if deadline_ns is not None:
            late_ns = max(began_ns - deadline_ns, 0)
            self._cycle.add("lateness", late_ns)
            self._late[bisect_right(EDGES_US, late_ns / 1000)] += 1
        self._cycle.add("round_trip", ended_ns - began_ns)
        self._cycle.add("compute", self._computed)
        self._computed = 0
        self._cycles += 1
        self._missed += missed
        self._latest_missed.append(missed)

    def summary(self) -> dict[str, Any]:
        """Summary of the run for JSON: microseconds, None where there is no number.

        ``histogram`` is that of the lateness of cycles: ``counts`` has one number more than
        ``edges_us``; the first counts lateness below the first edge. A value on an edge belongs to
        the bin above.
        """
        return {
            "cycles": self._cycles,
            "missed": self._missed,
            "cycle": self._cycle.summary(),
            "parts": {part: times.summary() for part, times in self._parts.items()},
            "histogram": {"edges_us": list(EDGES_US), "counts": list(self._late)},
        }

    def recent(self) -> dict[str, Any]:
        """Summary of the last hundred cycles, as `summary` without the histogram."""
        return {
            "cycles": len(self._latest_missed),
            "missed": sum(self._latest_missed),
            "cycle": self._cycle.recent(),
            "parts": {part: times.recent() for part, times in self._parts.items()},
        }

    def table(self) -> str:
        """Summary as a text table."""
        names = [*self._parts, "cycle"]
        wide = max(len(name) for name in names)
        heads = (f"{kind.replace('_', ' ')} [us]" for kind in _KINDS)
        lines = [
            " " * wide + "".join(f"  {head:^29}" for head in heads).rstrip(),
            " " * wide + f"  {'p50':>9} {'p99':>9} {'max':>9}" * len(_KINDS),
        ]
        for name, times in (*self._parts.items(), ("cycle", self._cycle)):
            cells = [_shown(c[q]) for c in times.summary().values() for q in ("p50", "p99", "max")]
            groups = (" ".join(f"{c:>9}" for c in cells[k : k + 3]) for k in range(0, 9, 3))
            lines.append(f"{name:<{wide}}  " + "  ".join(groups))
        lines.append(f"{self._cycles} cycles, {self._missed} missed")
        return "\n".join(lines) + "\n"

    def _of(self, part: str) -> _Times:
        if part not in self._parts:
            self._parts[part] = _Times()
        return self._parts[part]


def _quantiles(histogram: Histogram) -> dict[str, float | int | None]:
    """Quantiles of a histogram in microseconds, None where it is empty."""
    p50, p99 = (_microseconds(histogram.quantile(share)) for share in (0.5, 0.99))
    most = _microseconds(histogram.most) if histogram.count else None
    return {"p50": p50, "p99": p99, "max": most, "count": histogram.count}


def _microseconds(ns: float | int | None) -> float | None:
    return None if ns is None else ns / 1000


def _shown(us: float | int | None) -> str:
    return "-" if us is None else f"{us:.1f}"
