"""The histogram of lateness."""

import numpy as np
import xarray as xr

from robins.report.lateness import lateness
from robins.results import array


def test_every_step_is_in_a_bar_with_the_edge_that_it_is_above():
    counts, edges = np.array([0, 3, 0, 40, 2, 0]), np.array([1.0, 20.0, 500.0, 2000.0, 1e6])
    picture = lateness(xr.Dataset(array("lateness_steps", counts) | array("lateness_edge", edges)))
    axes = picture.figure.axes[0]
    assert [bar.get_height() for bar in axes.patches] == [0, 3, 0, 40, 2]
    labels = [t.get_text() for t in axes.get_xticklabels()]
    assert labels == ["< 1 µs", "1 µs", "20 µs", "500 µs", "2 ms"]
    assert picture.caption.startswith("45 steps")
