"""Blocks of increments: nothing lost, nothing twice, splits at the right place."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from robins.ins.blocks import cut, epochs_between, gained_between, mean_rate
from robins.ins.increments import Increments


@pytest.fixture
def stream():
    rng = np.random.default_rng(4)
    dt = rng.uniform(0.006, 0.009, 400)
    theta, dv = rng.normal(0, 0.02, (400, 3)), rng.normal(0, 0.1, (400, 3))
    return Increments(dt, theta, dv), np.cumsum(dt)


def test_every_increment_is_used_once_in_its_block(stream):
    increments, time = stream
    epochs = time[[49, 99, 250, 399]]
    blocks, parent = cut(increments, time, 0.0, epochs)
    in_order = parent[parent >= 0]
    np.testing.assert_array_equal(in_order, np.arange(400), "increments out of order")
    assert np.sum(blocks.dt) == pytest.approx(time[-1], abs=1e-12)
    np.testing.assert_array_equal(blocks.theta[0, :50], increments.theta[:50])
    np.testing.assert_array_equal(blocks.dv[2, :151], increments.dv[100:251])
    assert np.all(blocks.dt[parent < 0] == 0.0)
    np.testing.assert_allclose(blocks.dt.sum(1), np.diff([0.0, *epochs]), rtol=0, atol=1e-12)


def test_a_split_increment_composes_to_the_whole(stream):
    increments, time = stream
    epoch = time[10] + 0.3 * increments.dt[11]
    blocks, _ = cut(increments, time, 0.0, np.array([epoch, time[-1]]))
    first = blocks.theta[0, 11], blocks.dv[0, 11]
    second = blocks.theta[1, 0], blocks.dv[1, 0]
    assert blocks.dt[0, 11] == pytest.approx(0.3 * increments.dt[11], abs=1e-12)
    turned = Rotation.from_rotvec(first[0]) * Rotation.from_rotvec(second[0])
    np.testing.assert_allclose(turned.as_rotvec(), increments.theta[11], atol=1e-14)
    # velocity: the second part is given in the body axes after the first part's turn
    dv = first[1] + Rotation.from_rotvec(first[0]).apply(second[1])
    np.testing.assert_allclose(dv, increments.dv[11], atol=1e-14)


def test_epochs_hold_all_wanted_times_and_no_long_block():
    wanted = np.array([0.4, 1.0, 1.0, 7.3, 99.0, -1.0])
    epochs = epochs_between(0.0, 10.0, wanted, 1.0)
    assert {0.4, 1.0, 7.3, 10.0} <= set(epochs)
    assert epochs[-1] == 10.0
    assert np.all(np.diff(np.concatenate([[0.0], epochs])) <= 1.0 + 1e-9)
    assert np.all(np.diff(epochs) > 0.0)


def test_refuses_what_the_imu_does_not_cover(stream):
    increments, time = stream
    with pytest.raises(ValueError, match="does not cover"):
        cut(increments, time, 0.0, np.array([time[-1] + 1.0]))
    with pytest.raises(ValueError, match="does not cover"):
        cut(increments, time, -1.0, np.array([1.0]))


def test_mean_rate_and_gain_over_windows_are_those_of_the_increments_in_them(stream):
    """Sums by SciPy, forwards, with parts of increments at both ends; alone and in any array."""
    increments, time = stream
    begin, end = np.array([0.1004, 0.5, 1.0]), np.array([0.1021, 0.8113, 1.0])
    turn, gained = gained_between(increments, time, begin, end)
    rate = mean_rate(increments, time, begin[:2], end[:2])
    for k in range(2):
        whole, push, angle = Rotation.identity(), np.zeros(3), np.zeros(3)
        for dt, theta, dv, t in zip(*increments[:3], time, strict=True):
            share = max(0.0, min(t, end[k]) - max(t - dt, begin[k])) / dt
            push += whole.apply(share * dv)  # in the axes at the start of the window
            whole, angle = whole * Rotation.from_rotvec(share * theta), angle + share * theta
        np.testing.assert_allclose(turn[k], whole.as_rotvec(), atol=1e-13)
        np.testing.assert_allclose(gained[k], whole.inv().apply(push), atol=1e-13)
        np.testing.assert_allclose(rate[k], angle / (end[k] - begin[k]), atol=1e-12)
        alone = gained_between(increments, time, begin[k : k + 1], end[k : k + 1])
        np.testing.assert_array_equal(np.stack([turn[k], gained[k]]), np.concatenate(alone))
    assert not np.any(turn[2])
    assert not np.any(gained[2])
