"""Finding arrays in a solution, and thinning them without changing what is seen."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from robins.report import series


def test_values_come_in_the_unit_of_figures(drive):
    found = series.get(drive, "error", "attitude")
    assert found.unit == "deg"
    assert found.axes == ["roll", "pitch", "heading"]
    np.testing.assert_allclose(found.values, np.rad2deg(drive["error_attitude"].values), rtol=1e-14)
    np.testing.assert_array_equal(found.x, drive["time"].values)
    bias = series.get(drive, "sigma", "gyro_bias")
    deg_per_h = np.rad2deg(drive["sigma_gyro_bias"].values) * 3600.0
    np.testing.assert_allclose(bias.values, deg_per_h, rtol=1e-14)
    assert series.get(drive, "error", "nothing") is None


def test_the_clock_keeps_numbers_short():
    for seconds, unit, per in ((600.0, "s", 1.0), (3600.0, "min", 60.0), (86400.0, "h", 3600.0)):
        clock = series.clock(np.array([0.0, seconds]))
        assert clock == (per, f"time since start [{unit}]")
    assert series.clock(np.array([])).seconds == 1.0
    assert series.clock(np.array([np.nan])).seconds == 1.0


numbers = st.one_of(st.floats(-1e6, 1e6), st.just(np.nan))


@given(arrays(float, st.integers(3, 400), elements=numbers), st.integers(10, 60))
def test_thinning_keeps_ends_extremes_and_gaps(y, points):
    x = np.arange(len(y)) * 0.5
    other = np.cos(x)
    thin_x, thin_y, thin_other = series.thin(x, y, other, points=points)
    assert thin_x[0] == x[0]
    assert thin_x[-1] == x[-1]
    assert np.all(np.diff(thin_x) > 0.0)
    index = np.rint(thin_x / 0.5).astype(int)
    np.testing.assert_array_equal(thin_y, y[index])
    np.testing.assert_array_equal(thin_other, other[index])
    if np.isfinite(y).any():
        assert np.nanmax(thin_y) == np.nanmax(y)
        assert np.nanmin(thin_y) == np.nanmin(y)
    assert np.isnan(thin_y).any() == np.isnan(y).any()
    # Per line and bin two extremes, one gap; and the two ends.
    assert len(thin_x) <= max(points, 2) * 1.5 + 8 or len(thin_x) == len(x)


def test_thinning_keeps_the_envelope_everywhere():
    """No bin of the picture looks different: its lowest and highest stay."""
    rng = np.random.default_rng(1)
    y = np.cumsum(rng.normal(size=100_000))
    x = np.arange(len(y)) * 0.01
    thin_x, thin_y = series.thin(x, y, points=1000)
    assert len(thin_x) < 1600
    size = len(y) // 500
    for begin in range(0, len(y), size):
        inside = (thin_x >= x[begin]) & (thin_x <= x[min(begin + size, len(y)) - 1])
        assert thin_y[inside].max() == y[begin : begin + size].max()
        assert thin_y[inside].min() == y[begin : begin + size].min()


def test_a_short_line_is_left_alone():
    y = np.arange(5.0)
    assert series.thin(y, y)[1] is y


def test_a_sampled_cloud_keeps_its_outliers_and_its_density():
    rng = np.random.default_rng(2)
    y = rng.normal(size=50_000)
    y[12_345], y[500:600] = 40.0, np.nan
    x = np.arange(len(y)) * 1.0
    some_x, some_y = series.sample(x, y, points=4000)
    assert 40.0 in some_y
    assert 3500 < len(some_x) < 5000
    middle, some_middle = (np.mean(np.abs(v[np.isfinite(v)]) < 1.0) for v in (y, some_y))
    assert some_middle == pytest.approx(middle, abs=0.1)


def test_outages_are_none_where_there_are_none(drive):
    assert series.outage(drive.drop_vars("outage")) is None
    assert series.outage(drive.assign(outage=drive["outage"] & False)) is None
    found = series.outage(drive)
    assert found[0][found[1]].min() == pytest.approx(300.2)
