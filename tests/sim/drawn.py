"""For all tests of simulated sensors: the spread of what was drawn, and attitudes as SciPy's."""

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import chi2


def assert_variance(x, wanted):
    """Mean square of independent draws of mean zero, within 1e-4 of each side of chi-square."""
    x = np.asarray(x)
    low, high = chi2.ppf([1e-4, 1.0 - 1e-4], len(x)) / len(x)
    ratio = np.mean(np.square(x), axis=0) / wanted
    assert np.all((ratio > low) & (ratio < high)), (ratio, low, high)


def rotation(q):
    return Rotation.from_quat(np.asarray(q), scalar_first=True)
