"""The end of a gyro's range, found and bridged: against peaks that are known."""

import numpy as np
import pytest

from robins.systems.marg.saturation import beyond, bridged, levels

TIME = np.arange(3000) / 100.0
TIME_NS = np.arange(3000) * 10_000_000


def shakes(hertz=4.0, size=10.0, seed=0):
    """(N, 3) rad/s: shaking about x whose strength swells, small motion about the others."""
    rng = np.random.default_rng(seed)
    swell = 0.6 + 0.4 * np.sin(2.0 * np.pi * 0.13 * TIME)
    out = 0.2 * rng.standard_normal((len(TIME), 3))
    out[:, 0] = size * swell * np.sin(2.0 * np.pi * hertz * TIME)
    return out


def test_a_range_that_cuts_is_found_on_its_axis_and_no_other():
    cut = np.clip(shakes(), -7.37, 7.25)
    cut[:, 0] += 0.005 * np.random.default_rng(1).standard_normal(len(TIME))
    found = levels(cut, 0.01)
    np.testing.assert_allclose(found[0], [7.37, 7.25], rtol=0.01)
    assert np.all(np.isinf(found[1:]))


@pytest.mark.parametrize("hertz", [0.2, 1.0, 2.3, 5.0, 11.0])
def test_no_smooth_motion_has_a_range(hertz):
    """Sines of one height, whose peaks all fill the same level."""
    rate = np.stack([9.0 * np.sin(2.0 * np.pi * hertz * TIME + p) for p in (0.0, 0.3, 1.0)], axis=1)
    assert np.all(np.isinf(levels(rate, 0.01)))


def test_a_range_whose_edge_the_chip_filters_is_found():
    """No jump is left, but a plateau that slopes a little, as a unit with its own filter reads."""
    cut = np.clip(shakes(hertz=1.2), -7.3, np.inf)
    cut = np.stack([np.convolve(x, np.ones(4) / 4.0, "same") for x in cut.T], axis=1)
    low = cut[:, 0] <= -7.3
    cut[:, 0] += 0.02 * low * np.linspace(0.0, 1.0, len(cut))
    found = levels(cut, 0.01)
    assert found[0, 0] == pytest.approx(7.3, rel=0.015)
    assert np.isinf(found[0, 1])
    assert np.all(np.isinf(found[1:]))


@pytest.mark.parametrize("stays_s", [0.03, 0.6, 5.0])
def test_a_turn_at_one_rate_is_no_plateau(stays_s):
    """A turn of a machine that gets there in 0.3 s."""
    edges = np.cumsum([5.0, 0.3, stays_s, 0.3])
    rate = np.interp(TIME, edges, [0.0, 6.0, 6.0, 0.0])
    assert np.all(np.isinf(levels(np.stack([rate] * 3, axis=1), 0.01)))


def test_peaks_are_put_back_to_within_what_is_stated():
    true = shakes(hertz=3.0)
    cut = np.clip(true, -7.3, 7.3)
    full = beyond(cut, levels(cut, 0.01), np.inf)
    rate, doubt = bridged(TIME_NS, cut, full)
    assert full[:, 0].sum() > 100
    assert not full[:, 1:].any()
    there = np.isfinite(doubt[:, 0])
    assert there.sum() > 0.9 * full[:, 0].sum()
    lost, left = (np.abs(a - true)[there, 0].sum() for a in (cut, rate))
    assert left < 0.25 * lost
    # areas of peaks, which is what turns the unit, against the stated spread
    assert np.mean(np.abs(rate - true)[there, 0] < 3.0 * doubt[there, 0]) > 0.9
    np.testing.assert_array_equal(rate[~full], cut[~full])


def test_a_range_that_is_told_is_used_and_a_long_stay_is_not_bridged():
    cut = np.zeros((500, 3))
    cut[100:300, 2] = 34.9
    full = beyond(cut, levels(cut, 0.01), 34.9)
    rate, doubt = bridged(TIME_NS[:500], cut, full)
    assert full[:, 2].sum() == 200
    assert np.isnan(doubt).all()
    np.testing.assert_array_equal(rate, cut)
