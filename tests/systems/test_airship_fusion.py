"""Ways to fuse, the states of a product, and the loss of the radar: the reference figures.

Figures are means over 200 to 800 s of 20 runs, bands those of the specification.
"""

import jax
import numpy as np
import pytest
from airship_runs import RUNS, flights, found, parsed, without_radar

from robins.campaign.bound import bound_sigma
from robins.systems.airship.problem import airship_problem

FIRST_LOST, LAST_LOST = 399, 698  # numbers of the epochs that end at 400 s and 699 s


@pytest.fixture(scope="module")
def matched():
    return flights("matched")


@pytest.fixture(scope="module")
def central(matched):
    return found(matched, "centralised")


def test_the_centralised_filter_knows_how_wrong_it_is(central):
    assert 0.9 < central.nees_per_dim < 1.15


def test_information_shared_out_is_not_counted_twice(matched, central):
    """Once the 300 arcsec of the start are gone, in which sigma points still see a curve."""
    at = central.counted
    federated = found(matched, "federated")
    size = np.max(np.abs(central.error[:, at]), axis=(0, 1))
    off = np.max(np.abs(federated.error[:, at] - central.error[:, at]), axis=(0, 1))
    assert np.all(off < 1e-6 * size), off / size
    np.testing.assert_allclose(federated.nees[:, at], central.nees[:, at], rtol=1e-6)


def test_locals_with_the_same_prior_are_overconfident(matched):
    assert 1.08 < found(matched, "ukf").nees_per_dim < 1.30


def test_intersection_is_cautious(matched):
    assert found(matched, "intersection", quick=True).nees_per_dim < 0.85


def test_the_covariance_fed_back_is_counted_again_and_again(matched):
    with pytest.warns(UserWarning, match="counted again at the next fusion"):
        problem = airship_problem(parsed("matched"), ("distributed-full",), seed=0)
    assert found(matched._replace(problem=problem), "distributed-full").nees_per_dim > 100.0


# ------------------------------------------------------------------------- states for what is wrong


def test_states_for_the_wind_are_worth_it():
    wind = found(flights("s0"), "cukf-wind-states")
    assert 7.0 < wind.position_m < 8.6
    assert 0.32 < wind.velocity_m_s < 0.40


@pytest.mark.parametrize("name", ["s0", "s1"])
def test_the_product_is_as_good_as_its_sensors_allow(name):
    of = flights(name)
    product = found(of, "product", quick=True)
    least = bound_sigma(of.problem, "product", jax.tree.map(lambda x: x[0], of.batch))
    for block, at in (("velocity", slice(3, 6)), ("position", slice(6, 9))):
        rms = np.sqrt(np.mean(product.error[:, product.counted, at] ** 2))
        best = np.sqrt(np.mean(least[product.counted, at] ** 2))
        assert 0.9 * best < rms < 1.15 * best, block
    assert 0.9 < product.nees_per_dim < 1.1


# ----------------------------------------------------------------------- radar and barometer lost


@pytest.mark.parametrize(
    ("name", "low_m", "high_m"),
    [("ukf", 400.0, np.inf), ("cukf-wind-states", 0.0, 120.0), ("product", 0.0, 60.0)],
)
def test_the_wind_keeps_the_position_without_radar(name, low_m, high_m):
    """S1 without radar and barometer from 400 s to 700 s, which `airship/sar-loss` is."""
    gusts = flights("s1")
    batch = without_radar(gusts.batch, FIRST_LOST, LAST_LOST + 1)
    lost = found(gusts, name, batch, quick=name == "product")
    assert lost.error.shape[0] == RUNS
    assert low_m < lost.horizontal_rms_m(LAST_LOST) < high_m
    # until then nothing is lost, and all is soon well again
    assert lost.horizontal_rms_m(FIRST_LOST - 1) < 20.0
    assert lost.horizontal_rms_m(LAST_LOST + 51) < 40.0
    assert np.all(np.isfinite(lost.error))
