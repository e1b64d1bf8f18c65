"""The satellite's filters against the bands and orders of the specification, section 5.

S1: noise as believed. S2: gyro errors that no filter knows of. S4: drift faster than believed.
`make test` makes 8 runs of the filter of the reference and of those with a bounded worst case: they
stay within the bands for 24. `make certify` makes 24 of every filter.
"""

import pytest
from satellite_runs import MANY, RUNS, flown

QUARTER = "mixed-riccati-quarter"

REFERENCE = [("s1", "mekf", 8.0, 0.5), ("s1", "mixed-riccati", 8.9, 0.5), ("s4", "mekf", 20.0, 2.0)]
OTHERS = [
    ("s1", "raw", 42.5, 1.0),
    ("s2", "mekf", 12.4, 2.5),
    ("s2", "mixed-riccati", 10.2, 1.0),
    ("s4", "mixed-riccati", 14.0, 1.0),
]


@pytest.mark.parametrize(
    ("runs", "name", "filter_", "arcsec", "off"),
    [(RUNS, *row) for row in REFERENCE] + [(MANY, *row) for row in REFERENCE + OTHERS],
)
def test_errors_are_those_of_the_reference(runs, name, filter_, arcsec, off):
    assert abs(flown(name, filter_, runs).attitude - arcsec) < off


@pytest.mark.parametrize(
    ("runs", "filter_"),
    [(runs, name) for runs in (RUNS, MANY) for name in ("mekf", "mixed-riccati")]
    + [(MANY, "hinf"), (MANY, "raw")],
)
def test_what_is_stated_is_true(runs, filter_):
    """Also of constant gains, whose covariance is not that of a Kalman filter."""
    one = flown("s1", filter_, runs)
    assert abs(one.nees[:, one.counted].mean() - 1.0) < 0.1


@pytest.mark.parametrize("runs", [RUNS, MANY])
def test_runs_differ_by_a_stated_spread(runs):
    assert 0.3 < flown("s1", "mekf", runs).spread < 0.8


BOUNDED = [
    ("s4", "attitude", QUARTER, 0.75, "mekf"),  # a bounded worst case pays
    ("s4", "spread", QUARTER, 0.5, "mekf"),
]
ORDERS = [
    ("s1", "attitude", "mekf", 1.0, "mixed-riccati"),  # the order of the price
    ("s1", "attitude", "mixed-riccati", 1.0, QUARTER),
    ("s1", "attitude", QUARTER, 1.0, "hinf"),
    ("s1", "attitude", "hinf", 1.0, "raw"),
    ("s2", "spread", "mixed-riccati", 0.6, "mekf"),
    ("s4", "attitude", "mekf-informed", 1.0, QUARTER),  # the truth pays more
    ("s4", "attitude", "mekf-informed", 1.0, "mixed-riccati"),
    ("s4", "points", "mixed-bias", 0.85, QUARTER),
]


@pytest.mark.parametrize(
    ("runs", "name", "figure", "better", "share", "worse"),
    [(runs, *row) for runs in (RUNS, MANY) for row in BOUNDED] + [(MANY, *row) for row in ORDERS],
)
def test_filters_are_better_where_the_specification_says(runs, name, figure, better, share, worse):
    ours, theirs = (getattr(flown(name, f, runs), figure) for f in (better, worse))
    assert ours <= share * theirs
