"""The satellite's filters against the bands and orders of the specification, section 5; 24 runs."""

import pytest
from satellite_runs import flown

RUNS = 24


@pytest.fixture(scope="module")
def s1():
    names = ("raw", "mekf", "mixed-riccati", "mixed-riccati-quarter", "hinf")
    return flown("s1", names, RUNS)


@pytest.fixture(scope="module")
def s2():
    return flown("s2", ("mekf", "mixed-riccati"), RUNS)


@pytest.fixture(scope="module")
def s4():
    names = ("mekf", "mixed-riccati", "mixed-riccati-quarter", "mixed-bias", "mekf-informed")
    return flown("s4", names, RUNS)


class TestNoiseAsBelieved:
    def test_errors_are_those_of_the_reference(self, s1):
        assert abs(s1["mekf"].attitude - 8.0) < 0.5
        assert abs(s1["raw"].attitude - 42.5) < 1.0
        assert abs(s1["mixed-riccati"].attitude - 8.9) < 0.5

    def test_the_order_is_that_of_the_price(self, s1):
        names = ("mekf", "mixed-riccati", "mixed-riccati-quarter", "hinf", "raw")
        figures = [s1[name].attitude for name in names]
        assert figures == sorted(figures)

    def test_what_is_stated_is_true(self, s1):
        """Also of constant gains, whose covariance is not that of a Kalman filter."""
        for name in ("mekf", "mixed-riccati", "hinf", "raw"):
            assert abs(s1[name].nees[:, s1[name].counted].mean() - 1.0) < 0.1, name

    def test_spread(self, s1):
        assert 0.3 < s1["mekf"].spread < 0.8


def test_gyro_errors_that_no_filter_knows_of(s2):
    assert abs(s2["mekf"].attitude - 12.4) < 2.5
    assert abs(s2["mixed-riccati"].attitude - 10.2) < 1.0
    assert s2["mixed-riccati"].spread < 0.6 * s2["mekf"].spread


class TestDriftFasterThanBelieved:
    def test_errors_are_those_of_the_reference(self, s4):
        assert abs(s4["mekf"].attitude - 20.0) < 2.0
        assert abs(s4["mixed-riccati"].attitude - 14.0) < 1.0

    def test_a_bounded_worst_case_pays(self, s4):
        assert s4["mixed-riccati-quarter"].attitude < 0.75 * s4["mekf"].attitude
        assert s4["mixed-riccati-quarter"].spread < 0.5 * s4["mekf"].spread

    def test_the_truth_pays_more(self, s4):
        assert s4["mekf-informed"].attitude < s4["mixed-riccati-quarter"].attitude
        assert s4["mekf-informed"].attitude < s4["mixed-riccati"].attitude

    def test_on_the_bias_it_points_better(self, s4):
        assert s4["mixed-bias"].points < 0.85 * s4["mixed-riccati-quarter"].points
