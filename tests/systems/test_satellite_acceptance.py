"""The satellite's filters against the bands and orders of the specification, section 5; 24 runs.

S1: noise as believed. S2: gyro errors that no filter knows of. S4: drift faster than believed.
`make test` runs the filter of the reference and those with a bounded worst case; `make certify` the
others.
"""

from functools import partial

import pytest
from satellite_runs import flown

found = partial(flown, runs=24)
QUARTER = "mixed-riccati-quarter"


@pytest.mark.parametrize(
    ("name", "filter_", "arcsec", "off"),
    [
        ("s1", "mekf", 8.0, 0.5),
        ("s1", "mixed-riccati", 8.9, 0.5),
        ("s4", "mekf", 20.0, 2.0),
        # by `make certify`
        ("s1", "raw", 42.5, 1.0),
        ("s2", "mekf", 12.4, 2.5),
        ("s2", "mixed-riccati", 10.2, 1.0),
        ("s4", "mixed-riccati", 14.0, 1.0),
    ],
)
def test_errors_are_those_of_the_reference(name, filter_, arcsec, off):
    assert abs(found(name, filter_).attitude - arcsec) < off


@pytest.mark.parametrize("filter_", ["mekf", "mixed-riccati", "hinf", "raw"])
def test_what_is_stated_is_true(filter_):
    """Also of constant gains, whose covariance is not that of a Kalman filter."""
    one = found("s1", filter_)
    assert abs(one.nees[:, one.counted].mean() - 1.0) < 0.1


def test_runs_differ_by_a_stated_spread():
    assert 0.3 < found("s1", "mekf").spread < 0.8


@pytest.mark.parametrize(
    ("name", "figure", "better", "share", "worse"),
    [
        ("s4", "attitude", QUARTER, 0.75, "mekf"),  # a bounded worst case pays
        ("s4", "spread", QUARTER, 0.5, "mekf"),
        # by `make certify`
        ("s1", "attitude", "mekf", 1.0, "mixed-riccati"),  # the order of the price
        ("s1", "attitude", "mixed-riccati", 1.0, QUARTER),
        ("s1", "attitude", QUARTER, 1.0, "hinf"),
        ("s1", "attitude", "hinf", 1.0, "raw"),
        ("s2", "spread", "mixed-riccati", 0.6, "mekf"),
        ("s4", "attitude", "mekf-informed", 1.0, QUARTER),  # the truth pays more
        ("s4", "attitude", "mekf-informed", 1.0, "mixed-riccati"),
        ("s4", "points", "mixed-bias", 0.85, QUARTER),
    ],
)
def test_filters_are_better_where_the_specification_says(name, figure, better, share, worse):
    assert getattr(found(name, better), figure) <= share * getattr(found(name, worse), figure)
