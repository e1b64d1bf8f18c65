"""Blocks of increments: nothing lost, nothing twice, splits at the right place."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from robins.ins.blocks import cut, epochs_between
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
    blocks = cut(increments, time, 0.0, epochs)
    in_order = blocks.parent[blocks.parent >= 0]
    np.testing.assert_array_equal(in_order, np.arange(400), "increments out of order")
    assert np.sum(blocks.increments.dt) == pytest.approx(time[-1], abs=1e-12)
    np.testing.assert_array_equal(blocks.increments.theta[0, :50], increments.theta[:50])
    np.testing.assert_array_equal(blocks.increments.dv[2, :151], increments.dv[100:251])
    assert np.all(blocks.increments.dt[blocks.parent < 0] == 0.0)
    np.testing.assert_allclose(blocks.duration_s, np.diff([0.0, *epochs]), rtol=0, atol=1e-12)


def test_a_split_increment_composes_to_the_whole(stream):
    increments, time = stream
    epoch = time[10] + 0.3 * increments.dt[11]
    blocks = cut(increments, time, 0.0, np.array([epoch, time[-1]]))
    first = blocks.increments.theta[0, 11], blocks.increments.dv[0, 11]
    second = blocks.increments.theta[1, 0], blocks.increments.dv[1, 0]
    assert blocks.increments.dt[0, 11] == pytest.approx(0.3 * increments.dt[11], abs=1e-12)
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
