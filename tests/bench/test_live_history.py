"""The history of a whole run in bounded memory, against plain groups of samples."""

import struct
import time
import tracemalloc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robins.bench.live import history as module
from robins.bench.live.feed import pack_sample
from robins.bench.live.history import SampleHistory

RUN = 77


def unpack(packed: bytes) -> tuple[tuple[int, ...], np.ndarray]:
    """Head, and rows: first, last time, least of each signal, greatest of each; by the layout."""
    head = struct.unpack_from("<6I", packed)
    rows = np.array(struct.unpack(f"<{(len(packed) - 24) // 8}d", packed[24:]))
    return head, rows.reshape(-1, head[2])


def grouped(time_s: np.ndarray, values: np.ndarray, buckets: int) -> tuple[int, np.ndarray]:
    """The same by loops: the least power of two with which the groups are few enough."""
    per = 1
    while len(time_s) > buckets * per:
        per *= 2
    rows = []
    for begin in range(0, len(time_s), per):
        some, part = time_s[begin : begin + per], values[begin : begin + per]
        columns = [[x for x in column if np.isfinite(x)] for column in part.T]
        least = [min(column, default=np.nan) for column in columns]
        most = [max(column, default=np.nan) for column in columns]
        rows.append([some[0], some[-1], *least, *most])
    return per, np.array(rows).T


@pytest.mark.parametrize("many", [1, 63, 64, 65, 256, 257, 512, 513, 1000, 4097])
def test_buckets_have_the_least_and_the_greatest_of_their_samples(many, monkeypatch):
    monkeypatch.setattr(module, "BUCKETS", 256)
    draw = np.random.default_rng(many)
    time_s, values = np.cumsum(draw.uniform(0.01, 0.1, many)), draw.normal(size=(many, 3))
    values[draw.uniform(size=values.shape) < 0.3] = np.nan
    values[0, 0] = np.inf  # as good as missing: nothing can draw it
    values[:, 2] = np.nan
    kept = SampleHistory(3)
    for k in range(many):
        kept.add(pack_sample(RUN, k, time_s[k], values[k]))
        if k == many // 2:
            kept.pack(RUN)  # a page that comes meanwhile changes nothing
    head, rows = unpack(kept.pack(RUN))
    per, wanted = grouped(time_s, values, 256)
    assert head == (RUN, 0xFFFFFFFF, wanted.shape[1], 3, per, many)
    assert np.array_equal(rows, wanted, equal_nan=True)


@given(st.integers(0, 300), st.integers(1, 200))
def test_a_server_that_comes_anew_goes_on_where_the_one_before_it_was(before, after):
    def add(kept, begin, many):
        for k in range(begin, begin + many):
            kept.add(pack_sample(RUN, k, 0.1 * k, [np.sin(k), np.nan if k % 3 else float(k)]))

    whole, first = SampleHistory(2), SampleHistory(2)
    add(whole, 0, before + after)
    add(first, 0, before)
    second = SampleHistory.unpack(first.pack(RUN)) if before else SampleHistory(2)
    add(second, before, after)
    assert second.pack(RUN) == whole.pack(RUN)


def test_nothing_is_sent_of_nothing():
    assert SampleHistory(3).pack(RUN) == b""


def test_a_day_is_flat_in_memory_and_a_spike_of_one_sample_stays():
    """24 h of 20 samples a second of 40 signals, a minute at a time."""
    minute, spike = 1200, 1_000_003
    kind = np.dtype([("run", "<u4"), ("sequence", "<u4"), ("time_s", "<f8"), ("x", "<f8", 40)])
    rows = np.zeros(minute, kind)
    kept = SampleHistory(40)
    tracemalloc.start()  # NumPy's arrays are counted; other threads' memory is not the history's
    for begin in range(0, 24 * 60 * minute, minute):
        number = begin + np.arange(minute)
        rows["sequence"], rows["time_s"] = number, 0.05 * number
        rows["x"][:, 0] = np.where(number == spike, 7.5, 0.0)
        kept.add(rows.tobytes())
        if begin == 10 * minute:
            size, _ = tracemalloc.get_traced_memory()
            tracemalloc.reset_peak()
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most < size + 4e6  # the day itself has 580 MB
    head, rows = unpack(kept.pack(RUN))
    assert head[2:] == (3375, 40, 512, 1440 * minute)
    hit = np.flatnonzero(rows[42] == 7.5)  # the greatest of the first signal
    assert list(hit) == [spike // 512]
    assert rows[0, hit] <= 0.05 * spike <= rows[1, hit]
    assert np.count_nonzero(rows[2:]) == 1


def test_a_sample_costs_some_microseconds():
    sample, kept = bytes(336), SampleHistory(40)
    began = time.process_time()
    for _ in range(10_000):  # with one halving
        kept.add(sample)
    assert (time.process_time() - began) / 10_000 < 100e-6  # 3 us, and the checks of the test run
