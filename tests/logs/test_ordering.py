import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robins.logs.ordering import increasing, reasons


def chosen(*times):
    times = np.array(times)
    keep = increasing(times)
    return times[keep].tolist(), reasons(times, keep)


def longest_by_trial(times):
    """Length of the longest strictly increasing choice, by trying all."""
    n = len(times)
    return max(
        len(c)
        for r in range(n + 1)
        for c in itertools.combinations(range(n), r)
        if all(times[a] < times[b] for a, b in itertools.pairwise(c))
    )


@given(st.lists(st.integers(0, 6), max_size=9))
def test_as_few_as_possible_are_refused(times):
    keep = increasing(np.array(times, np.int64))
    kept = np.array(times)[keep]
    assert np.all(np.diff(kept) > 0)
    assert len(kept) == longest_by_trial(times)
    assert sum(reasons(np.array(times, np.int64), keep).values()) == len(times) - len(kept)


@given(st.lists(st.integers(0, 1000), min_size=2, max_size=40, unique=True), st.data())
def test_one_row_that_does_not_advance_time_is_the_one_refused(times, data):
    times = sorted(times)
    at = data.draw(st.integers(1, len(times)))
    late = times[at - 1] - data.draw(st.integers(0, 2000))
    keep = increasing(np.array([*times[:at], late, *times[at:]]))
    assert np.flatnonzero(~keep).tolist() == [at]


@pytest.mark.parametrize(
    ("times", "kept", "why"),
    [
        ([1, 2, 3], [1, 2, 3], {}),
        ([], [], {}),
        ([5], [5], {}),
        ([1, 2, 2, 3], [1, 2, 3], {"duplicate": 1}),
        ([4, 4, 4], [4], {"duplicate": 2}),
        ([10, 20, 30, 25, 40], [10, 20, 30, 40], {"backward": 1}),
        ([1, 2, 3600, 3, 4], [1, 2, 3, 4], {"ahead": 1}),
        ([3600, 1, 2, 3], [1, 2, 3], {"ahead": 1}),
        ([1, 2, 3, 4, 5, 3, 4, 5, 6, 7], [1, 2, 3, 4, 5, 6, 7], {"backward": 2, "duplicate": 1}),
        ([1, 2, 3, 4, 1, 2, 3], [1, 2, 3, 4], {"backward": 3}),
        ([7, 8, 1, 2, 3, 4, 5], [1, 2, 3, 4, 5], {"ahead": 2}),
        ([3, 2, 1], [3], {"backward": 2}),
    ],
)
def test_slips_steps_and_restarts(times, kept, why):
    assert chosen(*times) == (kept, {"duplicate": 0, "backward": 0, "ahead": 0} | why)


def test_a_long_log_with_its_clock_set_back_is_quick():
    times = np.arange(1_000_000)
    times[600_000:] -= 150_000
    keep = increasing(times)
    assert np.flatnonzero(~keep).tolist() == list(range(600_000, 750_000))
