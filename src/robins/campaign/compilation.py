"""Switch of a campaign from the interpreter to compiled lanes, which have the same bits.
Interpreting begins at once and takes about twice as long as compiled lanes. The compiler runs in a
thread of its own, along with the campaign, as soon as it would save more time on the remaining runs
than it takes; each loop switches when its lanes are compiled.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Sequence

from robins.errors import RobinsError
from robins.program.stages import AxisLoop, StagedFunction

LOOP_S = 0.6  # compile time of any loop
NODE_S = 3e-4  # and for a node of its program (`benchmarks/campaigns.py --compile`)
SAVED = 0.5  # of the interpreter's time, by compiled lanes (`benchmarks/program.py`)


class CompilationTrigger:
    """Trigger that compiles the loops of a campaign once that is faster than interpreting."""

    def __init__(self, stages: Sequence[StagedFunction]):
        self._loops: list[AxisLoop] = [
            loop for staged in stages for loop in staged.loops if loop.is_worth
        ]
        self._each_s: float | None = None  # for a run, on one core
        self._compiler_s: float | None = None  # about, for all loops
        self._lock = threading.Lock()
        self.compiling: threading.Thread | None = None

    def record_time(self, runs: int, seconds: float, left: int) -> None:
        """Record the time of some runs, and compile the loops if that pays for the rest.

        The first call only starts the record, as it may have traced the loops.

        Args:
            runs: how many were computed, by one thread.
            seconds: how long they took.
            left: how many runs are still to be computed.
        """
        with self._lock:
            first, each_s = self._each_s is None, seconds / runs
            self._each_s = each_s if self._each_s is None else min(self._each_s, each_s)
            if first or self.compiling is not None:
                return
            if self._compiler_s is None:
                self._compiler_s = sum(LOOP_S + NODE_S * loop.nodes for loop in self._loops)
            if SAVED * self._each_s * left > self._compiler_s:
                self.compiling = threading.Thread(target=self._compile, daemon=True)
                self.compiling.start()

    def _compile(self) -> None:
        with contextlib.suppress(RobinsError):  # without a compiler the interpreter goes on
            for loop in self._loops:
                loop.hand_over()
