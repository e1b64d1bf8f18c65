"""The angles of a star sensor against SciPy's rotations."""

import jax
import numpy as np
import pytest
from drawn import assert_variance
from scipy import stats
from scipy.spatial.transform import Rotation

from robins.sim.random import Component, stream
from robins.sim.star_sensor import observe_euler

COUNT = 4000
KEY = stream(9, 1, Component.STAR_SENSOR)
SIGMA = np.array([1e-4, 1e-4, 1e-3])  # boresight along the third axis
TRUE = Rotation.random(COUNT, rng=np.random.default_rng(8))
Q_NB = TRUE.as_quat(scalar_first=True)
PRESENT = np.arange(COUNT) % 5 != 0
euler = jax.jit(observe_euler)


def assert_normal(error, sigma):
    assert_variance(error, sigma**2)
    assert np.abs(np.corrcoef(error.T)[~np.eye(3, dtype=bool)]).max() < 4.0 / len(error) ** 0.5
    for axis in range(3):
        assert stats.kstest(error[:, axis] / sigma[axis], "norm").pvalue > 1e-3


def test_angles_have_white_noise_each():
    sigma = np.array([1e-4, 2e-4, 3e-4])
    got = np.asarray(euler(KEY, Q_NB, sigma, PRESENT))
    assert np.all(np.isnan(got[~PRESENT]))
    heading, pitch, roll = TRUE.as_euler("ZYX").T
    error = (got - np.stack([pitch, roll, heading], 1))[PRESENT]
    assert_normal(np.mod(error + np.pi, 2.0 * np.pi) - np.pi, sigma)


def test_heading_is_wrapped_where_north_passes_through_south():
    q = Rotation.from_euler("ZYX", np.tile([np.pi - 1e-6, 0.1, -0.2], (200, 1)))
    there = np.ones(200, bool)
    got = np.asarray(observe_euler(KEY, q.as_quat(scalar_first=True), 1e-3, there))
    assert np.all((got[:, 2] >= -np.pi) & (got[:, 2] < np.pi))
    assert 50 < np.sum(got[:, 2] < 0.0) < 150
    off = np.mod(got[:, 2] - (np.pi - 1e-6) + np.pi, 2.0 * np.pi) - np.pi
    assert np.abs(off).max() < 5e-3


def test_numbers_do_not_depend_on_sigma_or_presence():
    there = np.ones(COUNT, bool)
    some, every = (np.asarray(euler(KEY, Q_NB, SIGMA, seen)) for seen in (PRESENT, there))
    np.testing.assert_array_equal(some[PRESENT], every[PRESENT])
    heading, pitch, roll = TRUE.as_euler("ZYX").T
    angles = np.asarray(euler(KEY, Q_NB, 0.0, there))
    np.testing.assert_allclose(angles, np.stack([pitch, roll, heading], 1), atol=1e-12)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((Q_NB, -1.0, PRESENT), "sigma_rad must be a finite number from 0, got -1.0"),
        ((Q_NB, [1.0, 2.0], PRESENT), r"sigma_rad must be a number or of shape \(3,\)"),
        ((Q_NB[:, :3], 1.0, PRESENT), r"q_nb must have shape \(4000, 4\)"),
        ((Q_NB, 1.0, PRESENT[:7]), r"q_nb must have shape \(7, 4\)"),
    ],
)
def test_what_cannot_be_is_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        observe_euler(KEY, *arguments)
