"""Lengths of the error by run, over the epochs that count, against plain loops in NumPy."""

import numpy as np
import pytest

from robins.campaign.statistics import Statistics
from robins.systems.study import Norm, StateBlock

RUNS, EPOCHS, FIRST, LAST = 7, 40, 11, 33
BLOCKS = (StateBlock("all", slice(0, 4), "m", "m", "NED", ("a", "b", "c", "d")),)
NORMS = (Norm("level", (2, 3)), Norm("first", (0,)))
ERROR = np.random.default_rng(0).normal(size=(RUNS, EPOCHS, 4)) * [1.0, 2.0, 3.0, 4.0]
BAD = 4  # a run that is not finite from the middle on


def a_record(error):
    """Record of a campaign of runs without a sensor."""
    square = np.sum(error**2, axis=2)
    return {
        "error": error,
        "sigma": np.ones_like(error),
        "nees": square,
        "dim": np.full(len(error), 4),
        "block_nees": {"all": square},
        "updates": {},
    }


def added(chunks, last: int | None = LAST):
    out = Statistics(BLOCKS, FIRST, (), last, NORMS)
    for chunk in chunks:
        out.add(a_record(chunk))
    return out


@pytest.fixture(scope="module")
def statistics():
    """Statistics of chunks of three, three and one."""
    return added([ERROR[:3], ERROR[3:6], ERROR[6:]])


def plain(components, last: int | None = LAST):
    rows = []
    for run in range(RUNS):
        epochs = range(FIRST, EPOCHS if last is None else last)
        lengths = [sum(ERROR[run, k, i] ** 2 for i in components) ** 0.5 for k in epochs]
        mean = sum(lengths) / len(lengths)
        rows.append([mean, (sum((x - mean) ** 2 for x in lengths) / len(lengths)) ** 0.5])
    return np.array(rows)


@pytest.mark.parametrize("norm", NORMS, ids=lambda n: n.name)
def test_mean_and_spread_are_of_each_run_over_what_counts(statistics, norm):
    np.testing.assert_allclose(statistics.norm(norm.name), plain(norm.components), rtol=1e-12)


def test_without_a_last_epoch_all_the_rest_counts():
    got = added([ERROR], last=None)
    np.testing.assert_allclose(got.norm("level"), plain((2, 3), None), rtol=1e-12)
    assert got.counted == slice(FIRST, None)


def test_the_last_epoch_bounds_every_pooled_figure(statistics):
    counted = ERROR[:, FIRST:LAST]
    np.testing.assert_allclose(statistics.run_rms, np.sqrt(np.mean(counted**2, 1)), rtol=1e-12)
    # sigma is one, so the ratio of error to sigma is the RMS error
    pooled = np.sqrt(np.mean(counted**2, axis=(0, 1)))
    np.testing.assert_allclose(statistics.overall_ratio(), pooled, rtol=1e-12)
    # what is no pooled figure is there for all epochs
    np.testing.assert_allclose(statistics.rms, np.sqrt(np.mean(ERROR**2, 0)), rtol=1e-12)


def test_what_lies_outside_does_not_matter(statistics):
    wild = ERROR.copy()
    wild[:, :FIRST] = 1e9
    wild[:, LAST:] = -1e9
    other = added([wild])
    np.testing.assert_array_equal(other.norm("level"), statistics.norm("level"))
    np.testing.assert_array_equal(other.run_rms, statistics.run_rms)


@pytest.mark.parametrize("when", [FIRST - 5, FIRST + 5, LAST + 1])
def test_a_diverged_run_is_infinitely_wrong_and_the_others_are_not(statistics, when):
    """Also where it broke down outside of what counts: nothing of it can be believed."""
    broken = ERROR.copy()
    broken[BAD, when:, 1] = np.nan
    got = added([broken[:3], broken[3:]])
    assert got.diverged == 1
    norm, good = got.norm("level"), np.arange(RUNS) != BAD
    assert norm[BAD, 0] == np.inf
    assert not np.isfinite(norm[BAD, 1])
    np.testing.assert_array_equal(norm[good], statistics.norm("level")[good])
    assert np.mean(norm, axis=0)[0] == np.inf  # no average hides it
