"""Idle time of a process, by the processor time that it uses.

A part that compiles may take any time; one that waits for input that never comes is hanging.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable
from pathlib import Path

_WORK_S = 0.5  # processor time that counts as work; waiting at a port uses less in two minutes


def idleness() -> Callable[[int | None], float]:
    """Make a function that returns the idle time [s] of a process, given by its process ID.

    Idle time counts from the first call for the process. It is infinite where there is no process,
    or where the system does not show its processor time in ``/proc``.
    """
    worked: dict[int, tuple[float, float]] = {}  # processor time used, when first seen [s]

    def idle_s(pid: int | None) -> float:
        if pid is None:
            return math.inf
        try:
            fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        except OSError:
            return math.inf
        used_s, now = sum(map(int, fields[11:15])) / os.sysconf("SC_CLK_TCK"), time.monotonic()
        if pid not in worked or used_s - worked[pid][0] > _WORK_S:
            worked[pid] = used_s, now
        return now - worked[pid][1]

    return idle_s
