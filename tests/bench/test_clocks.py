"""The clocks: deadlines that do not drift, and what becomes of those that are missed."""

import itertools
import time

import pytest

from robins.bench.broker import BenchError
from robins.bench.run import LockStep, RealTime


class Wall:
    """A monotonic clock that goes only where it is told to."""

    def __init__(self):
        self.ns = 5_000_000_000

    def monotonic_ns(self):
        return self.ns

    def serve(self, seconds):
        self.ns += round(seconds * 1e9) + 1


@pytest.fixture
def wall(monkeypatch):
    clock = Wall()

    def ticking():
        clock.ns += 1000  # so that what spins comes to an end
        return clock.ns

    monkeypatch.setattr(time, "monotonic_ns", ticking)
    return clock


def test_lock_step_waits_for_nobody():
    clock = LockStep()
    assert clock.wait(3, lambda seconds: pytest.fail("it waited")) is None
    assert clock.missed_deadline(3) is False
    assert clock.timeout_ns is None
    clock.shift_deadlines(10**9)


def test_deadlines_are_of_the_grid_however_long_steps_take(wall):
    clock = RealTime(100.0)
    found = []
    for k in range(50):
        found.append(clock.wait(k, wall.serve))
        wall.ns += 3_000_000 if k % 7 else 9_000_000
        assert not clock.missed_deadline(k)
    assert [b - a for a, b in itertools.pairwise(found)] == [10_000_000] * 49
    assert clock.timeout_ns == 10_000_000


def test_a_long_step_is_caught_up_with_or_skipped(wall):
    clocks = {policy: RealTime(100.0, policy) for policy in ("continue", "skip")}
    late = {}
    for policy, clock in clocks.items():
        first = clock.wait(0, wall.serve)
        wall.ns = first + 35_000_000
        assert clock.missed_deadline(0)
        late[policy] = clock.wait(1, wall.serve) - first
    assert late == {"continue": 10_000_000, "skip": 40_000_000}
    assert clocks["skip"].skipped == 3


def test_abort_says_how_late_it_was(wall):
    clock = RealTime(100.0, "abort")
    first = clock.wait(0, wall.serve)
    wall.ns = first + 9_000_000
    assert not clock.missed_deadline(0)
    wall.ns = first + 22_000_000
    with pytest.raises(BenchError, match=r"step 0 ended 12.0 ms after the next one's deadline"):
        clock.missed_deadline(0)


@pytest.mark.parametrize("policy", ["continue", "skip"])
def test_a_run_that_falls_behind_says_so_again_when_that_has_doubled(wall, policy):
    clock, told, period_ns = RealTime(100.0, policy), [], 10_000_000
    first = clock.wait(0, wall.serve)
    for k in range(90):  # each step takes eight periods, then none
        wall.ns += 8 * period_ns if k < 60 else 0
        clock.missed_deadline(k)
        told += [(k, words)] if (words := clock.lag_notice(k)) else []
    late_s = [0.07 * (k + 1) for k, _ in told]
    assert late_s[0] == pytest.approx(1.0, abs=0.08)  # within a step
    assert late_s[1] == pytest.approx(2.0 * late_s[0], abs=0.08)
    assert [words for _, words in told] == [
        f"the run is {late:.1f} s behind its clock: 100 Hz is too fast" for late in late_s
    ]
    wall.ns = first + 2 * 10**9  # it has caught up, and falls behind again
    assert clock.lag_notice(199) == ""
    wall.ns += 11 * 10**8
    assert clock.lag_notice(199).startswith("the run is 1.1 s behind")
    assert LockStep().lag_notice(3) == ""


def test_a_slow_clock_is_behind_by_periods(wall):
    clock = RealTime(0.5)
    wall.ns = clock.wait(0, wall.serve) + 21 * 10**9
    assert clock.lag_notice(0) == ""
    wall.ns += 2 * 10**9
    assert clock.lag_notice(0).startswith("the run is 21.0 s behind")


def test_a_pause_moves_all_deadlines(wall):
    clock = RealTime(100.0)
    first = clock.wait(0, wall.serve)
    clock.shift_deadlines(2_000_000_000)
    wall.ns += 2_000_000_000
    assert clock.wait(1, wall.serve) - first == 2_010_000_000
