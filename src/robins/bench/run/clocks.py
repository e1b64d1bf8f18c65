"""Clocks that start each step: as soon as possible, or at its time.

Soft real time: an ordinary kernel wakes us late at times, and Python collects garbage. Lateness is
counted, not excluded.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Literal

from robins.bench.broker.link import BenchError
from robins.bench.rig import LoadedRun

Overrun = Literal["continue", "skip", "abort"]
_BEHIND_S, _BEHIND_PERIODS = 1.0, 10.0  # lag of a run that is behind: the longer
_SPIN_NS = 200_000  # before a deadline: busy wait instead of sleep


class LockStep:
    """The next step begins when the last one is over."""

    timeout_ns: int | None = None

    def wait(self, step: int, serve: Callable[[float], None]) -> int | None:
        """Return at once; there is no deadline."""
        return None

    def missed_deadline(self, step: int) -> bool:
        """False: in lock-step there is no deadline to miss."""
        return False

    def lag_notice(self, step: int) -> str:
        """Empty: in lock-step there is no clock to be behind."""
        return ""

    def shift_deadlines(self, ns: int) -> None:
        """Ignore a pause of the run: there are no deadlines."""


class RealTime:
    """Clock by which step k begins at t0 + k/rate (monotonic), whenever step k - 1 ended.

    Attributes:
        timeout_ns: time-out of a part in a step.
        skipped: number of deadlines skipped.
    """

    def __init__(self, rate_hz: float, overrun: Overrun = "continue", timeout_periods: float = 1.0):
        """Set the clock.

        Args:
            rate_hz: steps per second.
            overrun: what to do when a step is not over at the next one's deadline.
            timeout_periods: periods for which a part is waited for.
        """
        self._rate_hz, self._overrun = rate_hz, overrun
        self.timeout_ns: int | None = round(timeout_periods * 1e9 / rate_hz)
        self.skipped = 0
        self._alarm_s = self._least_s = max(_BEHIND_S, _BEHIND_PERIODS / rate_hz)
        self._began_ns: int | None = None

    def deadline_ns(self, step: int) -> int:
        """Time at which a step is to begin [ns of the wall clock]."""
        assert self._began_ns is not None
        return self._began_ns + round((step + self.skipped) * 1e9 / self._rate_hz)

    def wait(self, step: int, serve: Callable[[float], None]) -> int | None:
        """Wait for the deadline of a step, and meanwhile serve what comes.

        Args:
            step: its number.
            serve: takes what comes within a time [s].

        Returns:
            The deadline [ns of the monotonic clock].
        """
        if self._began_ns is None:
            self._began_ns = time.monotonic_ns() + 10_000_000
        deadline = self.deadline_ns(step)
        while (left := deadline - time.monotonic_ns()) > 0:
            if left > _SPIN_NS:
                serve((left - _SPIN_NS) * 1e-9)
        return deadline

    def shift_deadlines(self, ns: int) -> None:
        """Move all deadlines by the duration of a pause [ns]."""
        if self._began_ns is not None:
            self._began_ns += ns

    def lag_notice(self, step: int) -> str:
        """Notice that the run is far behind its clock after a step: once, and again whenever the
        lag has doubled; else empty. Skipped deadlines count too.
        """
        assert self._began_ns is not None
        due_ns = self._began_ns + round((step + 1) * 1e9 / self._rate_hz)
        late_s = (time.monotonic_ns() - due_ns) * 1e-9
        if late_s < self._alarm_s:
            self._alarm_s = self._alarm_s if late_s > 0.5 * self._least_s else self._least_s
            return ""
        self._alarm_s = 2.0 * late_s
        return f"the run is {late_s:.1f} s behind its clock: {self._rate_hz:g} Hz is too fast"

    def missed_deadline(self, step: int) -> bool:
        """True if the step just completed has missed the deadline of the next one.

        Raises:
            BenchError: it has, and the policy is to abort.
        """
        late_ns = time.monotonic_ns() - self.deadline_ns(step + 1)
        if late_ns <= 0:
            return False
        if self._overrun == "abort":
            raise BenchError(
                f"step {step} ended {late_ns * 1e-6:.1f} ms after the next one's deadline, and "
                'overrun = "abort"'
            )
        if self._overrun == "skip":
            self.skipped += 1 + int(late_ns * 1e-9 * self._rate_hz)
        return True


def clock_of(flight: LoadedRun) -> LockStep | RealTime:
    """The clock of a run."""
    setup = flight.setup
    if setup.clock == "lockstep":
        return LockStep()
    return RealTime(setup.rate or 1.0 / flight.timing.step_s, setup.overrun, setup.patience)
