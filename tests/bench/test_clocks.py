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
    assert clock.over(3) is False
    assert clock.patience_ns is None
    clock.rested(10**9)


def test_deadlines_are_of_the_grid_however_long_steps_take(wall):
    clock = RealTime(100.0)
    found = []
    for k in range(50):
        found.append(clock.wait(k, wall.serve))
        wall.ns += 3_000_000 if k % 7 else 9_000_000
        assert not clock.over(k)
    assert [b - a for a, b in itertools.pairwise(found)] == [10_000_000] * 49
    assert clock.patience_ns == 10_000_000


def test_a_long_step_is_caught_up_with_or_skipped(wall):
    clocks = {policy: RealTime(100.0, policy) for policy in ("continue", "skip")}
    late = {}
    for policy, clock in clocks.items():
        first = clock.wait(0, wall.serve)
        wall.ns = first + 35_000_000
        assert clock.over(0)
        late[policy] = clock.wait(1, wall.serve) - first
    assert late == {"continue": 10_000_000, "skip": 40_000_000}
    assert clocks["skip"].skipped == 3


def test_abort_says_how_late_it_was(wall):
    clock = RealTime(100.0, "abort")
    first = clock.wait(0, wall.serve)
    wall.ns = first + 9_000_000
    assert not clock.over(0)
    wall.ns = first + 22_000_000
    with pytest.raises(BenchError, match=r"step 0 ended 12.0 ms after the next one's deadline"):
        clock.over(0)


def test_a_pause_moves_all_deadlines(wall):
    clock = RealTime(100.0)
    first = clock.wait(0, wall.serve)
    clock.rested(2_000_000_000)
    wall.ns += 2_000_000_000
    assert clock.wait(1, wall.serve) - first == 2_010_000_000
