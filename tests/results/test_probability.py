"""Shares of runs with their intervals, against the binomial distribution itself."""

import json

import numpy as np
import pytest
from scipy import stats

from robins.report import numbers
from robins.results import Probability
from robins.results.probability import interval
from robins.results.summary import dumps, plain

N = 40
HITS = np.arange(N + 1)


@pytest.mark.parametrize("level", [0.9, 0.95, 0.999])
def test_each_end_leaves_half_the_rest_to_what_was_counted(level):
    """Definition of the interval: at its ends, so many hits or worse have half of 1 - level."""
    low, high = interval(HITS, N, level)
    half = 0.5 * (1.0 - level)
    np.testing.assert_allclose(stats.binom.sf(HITS[1:] - 1, N, low[1:]), half, rtol=1e-9)
    np.testing.assert_allclose(stats.binom.cdf(HITS[:-1], N, high[:-1]), half, rtol=1e-9)
    assert low[0] == 0.0
    assert high[-1] == 1.0
    for k in (0, 1, 17, N):
        want = stats.binomtest(k, N).proportion_ci(level, method="exact")
        np.testing.assert_allclose((low[k], high[k]), (want.low, want.high), atol=1e-11)


@pytest.mark.parametrize("of", [1, 2, 50, 10**6])
def test_none_and_all_have_a_closed_form(of):
    """(1 - high)^of = half of 5 %."""
    none, all_ = Probability.among(np.zeros(of, bool)), Probability.among(np.ones(of, bool))
    assert none[:2] == (0.0, 0.0)
    np.testing.assert_allclose(none.high, -np.expm1(np.log(0.025) / of), rtol=1e-9)
    assert all_.share == all_.high == 1.0
    np.testing.assert_allclose(all_.low, 1.0 - none.high, rtol=1e-12)


@pytest.mark.parametrize("of", [5, 50, 300])
def test_the_interval_holds_the_truth_as_often_as_it_says(of):
    """Coverage over all outcomes and their probabilities, however rare the event."""
    low, high = interval(np.arange(of + 1), of)
    for p in (1e-4, 0.01, 0.03, 0.3, 0.5, 0.77, 0.995):
        covered = stats.binom.pmf(np.arange(of + 1), of, p)[(low <= p) & (p <= high)].sum()
        assert covered >= 0.95


def test_a_summary_holds_it_as_an_object_of_its_own():
    told = Probability.among(np.arange(50) < 47)
    written = json.loads(dumps(plain({"filters": {"kf": {"diverged_share": told}}})))
    value = written["filters"]["kf"]["diverged_share"]
    assert set(value) == {"share", "low", "high", "of", "level"}
    assert (value["share"], value["of"], value["level"]) == (0.94, 50, 0.95)
    assert Probability.read(value) == told == Probability.read(told)
    for other in (0.94, None, [1.0] * 5, {"share": 0.94}):
        assert Probability.read(other) is None
        assert Probability.share_of(other) is other


@pytest.mark.parametrize(
    ("hits", "of", "text"),
    [
        (47, 50, "0.94 (0.83 to 0.99)"),
        (0, 50, "0 (0 to 0.071)"),
        (50, 50, "1 (0.929 to 1)"),
        (970, 1000, "0.97 (0.957 to 0.98)"),
        (3, 10**6, "0.000003 (0.0000006 to 0.0000088)"),
    ],
)
def test_people_read_it_with_its_interval(hits, of, text):
    found = Probability.among(np.arange(of) < hits)
    assert numbers.show(found) == numbers.show(plain(found)) == text


def test_a_share_of_no_runs_is_refused():
    with pytest.raises(ValueError, match="a run at least"):
        Probability.among(np.zeros(0, bool))
