"""Mean, covariance and percentiles of the errors over the runs, against all errors at once."""

import numpy as np
import pytest
from test_norms import a_record

from robins.campaign import Statistics, histogram
from robins.campaign.histogram import EDGES, WORST
from robins.campaign.statistics import PERCENTS, THIN, thinned
from robins.systems.study import StateBlock

RUNS, EPOCHS = 230, 150
LEVEL = StateBlock("level", slice(1, 4), "m", "m", "NED", ("a", "b", "c"))
ALONE = StateBlock("alone", slice(0, 1), "m", "m", "NED", ("a",))
BLOCKS = (ALONE, LEVEL)
RNG = np.random.default_rng(0)
MIX = RNG.normal(size=(4, 4))
# of every size from 1e-9 to 1e3, with a mean of its own
ERROR = RNG.normal(size=(RUNS, EPOCHS, 4)) @ MIX + 0.3
ERROR *= np.geomspace(1e-9, 1e3, EPOCHS)[:, None]


def added(chunks, blocks=BLOCKS):
    out = Statistics(blocks)
    for chunk in chunks:
        part = out.blank()
        part.add(a_record(chunk))
        out.merge(part)
    return out


CHUNKS = np.split(ERROR, [64, 128, 192])


@pytest.fixture(scope="module")
def statistics():
    return added(CHUNKS)


def test_mean_and_covariance_are_those_of_all_errors(statistics):
    np.testing.assert_allclose(statistics.mean, np.mean(ERROR, axis=0), rtol=1e-11)
    at = statistics.thinned
    for block in BLOCKS:
        got = statistics.covariance(block)
        size = len(block.axes)
        assert got.shape == (THIN, size, size)
        for k, epoch in enumerate(at):
            want = np.cov(ERROR[:, epoch, block.where].T).reshape(size, size)
            np.testing.assert_allclose(got[k], want, rtol=1e-11, atol=1e-11 * np.trace(want))


def test_percentiles_are_those_of_all_errors_to_the_width_of_a_bin(statistics):
    for block in BLOCKS:
        lengths = np.linalg.norm(ERROR[:, statistics.thinned, block.where], axis=2)
        want = np.percentile(lengths, PERCENTS, axis=0, method="inverted_cdf").T
        got = statistics.percentiles(block)
        assert np.max(np.abs(got / want - 1.0)) <= WORST
        assert np.max(np.abs(got / want - 1.0)) > 0.9 * WORST  # and it is that wide
    assert pytest.approx(0.0366, rel=1e-2) == WORST


def test_counts_do_not_depend_on_the_order_of_the_chunks(statistics):
    other = added([CHUNKS[3][::-1], CHUNKS[1], CHUNKS[0], CHUNKS[2]])
    at_once = added([ERROR])
    for block in BLOCKS:
        for one in (other, at_once):
            np.testing.assert_array_equal(one.bins[block.name], statistics.bins[block.name])
        assert statistics.bins[block.name][1].sum() == RUNS * THIN


def test_a_run_that_diverged_is_beyond_all(statistics):
    broken = ERROR.copy()
    broken[:3, 100:, 2] = np.nan  # three of 230 runs are more than one percent
    got = added([broken])
    assert np.all(np.isinf(got.mean))
    assert np.all(np.isinf(got.covariance(LEVEL)))
    lengths = np.linalg.norm(ERROR[3:, got.thinned, LEVEL.where], axis=2)
    lengths = np.concatenate([lengths, np.full((3, THIN), np.inf)])
    want = np.sort(lengths, axis=0)[[11, 114, 218]].T  # of 230, the 12th, the 115th, the 219th
    np.testing.assert_allclose(got.percentiles(LEVEL)[:, :3], want, rtol=WORST)
    assert np.all(np.isinf(got.percentiles(LEVEL)[:, 3]))


def test_what_is_beyond_the_bins_is_told_as_such():
    values = np.array([[0.0, 1e-19, EDGES[0], EDGES[7], 1.0, EDGES[-1], np.inf]])
    got = histogram.percentiles(histogram.histogram_of(values), values.shape[1], (1, 100))
    np.testing.assert_array_equal(got[:, 0], got[:, 1])
    np.testing.assert_array_equal(got[[0, 1, 5, 6], 0], [0.0, 0.0, np.inf, np.inf])
    np.testing.assert_allclose(got[2:5, 0], values[0, 2:5], rtol=WORST * (1.0 + 1e-12))


def test_memory_grows_neither_with_runs_nor_with_epochs():
    one = histogram.histogram_of(np.exp(RNG.normal(size=(500, THIN))))
    many = histogram.histogram_of(np.exp(RNG.normal(size=(20_000, THIN))))
    assert many.shape[1] < 2 * one.shape[1]
    for epochs in (1, 2, THIN, THIN + 1, 10**6):
        at = thinned(epochs)
        assert (at[0], at[-1]) == (0, epochs - 1)
        assert len(at) == min(epochs, THIN)
        assert len(set(np.diff(at))) <= 2  # even, but for rounding


def test_of_one_run_there_is_no_covariance():
    assert np.all(np.isnan(added([ERROR[:1]]).covariance(LEVEL)))
