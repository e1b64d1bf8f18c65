"""The retuned LMI against the tables and a direct search for the best gain."""

import inspect
from functools import cache

import numpy as np
import pytest
from design_plants import attitude_axis, two_states
from gain_search import best_by_search

from robins.filters.synthesis import Unreachable, certify, kalman_gain
from robins.filters.synthesis.lmi import observer, retuned


@cache
def found(plant, gamma, form="slack"):
    return retuned(PLANTS[plant](), gamma, form)


PLANTS = {"axis": attitude_axis, "two states": two_states}
TABLES = [  # gamma, retuned slack form, best gain by search
    ("axis", 4.9576, 2.8924, 2.8924),
    ("axis", 3.8559, 2.9706, 2.9706),
    ("axis", 2.7542, 3.1984, 3.1983),
    ("axis", 1.6525, 3.7716, 3.7716),
    ("axis", 1.1017, 4.3789, 4.3788),
    ("axis", 0.5508, 5.6129, 5.6128),
    ("two states", 1.0, 0.9066, 0.8746),
    ("two states", 0.8, 1.5006, 1.4393),
    ("two states", 0.7, 2.4225, 2.3286),
]


@pytest.mark.parametrize(("plant", "gamma", "slack", "best"), TABLES)
def test_retuned_designs_have_the_tabulated_price(plant, gamma, slack, best):
    design = found(plant, gamma)
    assert design.h2 == pytest.approx(slack, rel=1e-4)
    assert design.hinf == pytest.approx(gamma, rel=1e-5)
    assert design.hinf <= gamma * (1.0 + 1e-6)
    assert best * (1.0 - 1e-4) < design.h2 <= design.bound
    before = observer(PLANTS[plant](), gamma, "slack")
    assert design.h2 < before.h2 * 0.997  # it takes back what the proof cost
    assert "gamma' = " in design.status


@pytest.mark.parametrize(
    ("plant", "gamma", "best"), [(p, g, b) for p, g, _, b in TABLES if g in (2.7542, 0.8, 0.7)]
)
def test_a_search_over_gains_finds_what_the_table_calls_best(plant, gamma, best):
    given, design = PLANTS[plant](), found(plant, gamma)
    start = observer(given, gamma).gain  # inside: its worst gain is below gamma
    searched = best_by_search(given, gamma, start)
    assert searched == pytest.approx(best, rel=3e-4)
    assert searched <= design.h2 * (1.0 + 1e-5)


def test_attitude_gain():
    of_angle, of_bias = found("axis", 2.7542).gain[:, 0]
    assert of_angle == pytest.approx(0.15365, rel=2e-5)
    assert of_bias == pytest.approx(-0.000346, abs=5e-7)


def test_the_common_form_is_retuned_to_the_same_price_or_nearly():
    for plant, gamma in (("axis", 1.1017), ("two states", 0.7)):
        common = found(plant, gamma, "common")
        assert common.hinf == pytest.approx(gamma, rel=1e-5)
        assert common.h2 == pytest.approx(found(plant, gamma).h2, rel=5e-3)
        assert common.method == "retuned-common"


@pytest.mark.parametrize("gamma", [1.8, np.inf])
def test_a_gamma_that_the_kalman_filter_meets_asks_for_nothing_more(gamma):
    given = two_states()
    best = certify(given, kalman_gain(given), method="kalman")
    design = retuned(given, gamma)
    assert best.hinf < 1.8
    assert design.h2 == pytest.approx(best.h2, rel=1e-8)
    assert (design.gamma, design.status) == (gamma, "optimal at gamma' = inf")


def test_a_gamma_next_to_the_kalman_filters_ends_the_search():
    """The true norm hardly depends on gamma' any more, and the solver's digits decide."""
    given = two_states()
    best = certify(given, kalman_gain(given), method="kalman")
    design = retuned(given, best.hinf * (1.0 - 1e-7))
    assert design.h2 == pytest.approx(best.h2, rel=1e-4)


def test_out_of_reach_and_bad_arguments():
    with pytest.raises(Unreachable, match=r"gamma 0\.5 is below the least .* 0\.594542"):
        retuned(two_states(), 0.5)
    with pytest.raises(ValueError, match="gamma must be positive"):
        retuned(two_states(), 0.0)
    with pytest.raises(ValueError, match="form must be"):
        inspect.unwrap(retuned)(two_states(), 1.0, "full")
