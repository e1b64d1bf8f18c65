"""All methods over all gammas: against single designs, and what is told where there is none."""

import sys

import numpy as np
import pytest
from design_plants import attitude_axis, quaternion, two_states

from robins.filters.synthesis import (
    METHODS,
    Unreachable,
    kalman_design,
    least_riccati_gamma,
    lmi,
    plant,
    retuned,
    riccati,
    trade_off,
)


@pytest.fixture(scope="module")
def found():
    return trade_off(two_states(), [0.7, 1.0])


def test_every_method_is_its_own_design(found):
    p = two_states()
    assert found.gammas == (1.0, 0.7)
    assert found.kalman.h2 == kalman_design(p).h2
    assert found.least.reached == pytest.approx(0.594542, abs=1e-6)
    by_name = {(o.method, o.gamma): o for o in found.attempts}
    assert list(found.left_out) == ["closed-form"]
    assert len(by_name) == 2 * (len(METHODS) - 1)
    alone = {
        "riccati": riccati(p, 1.0),
        "lmi-common": lmi.observer(p, 1.0, "common"),
        "lmi-slack": lmi.observer(p, 1.0, "slack"),
        "retuned-common": retuned(p, 1.0, "common"),
        "retuned-slack": retuned(p, 1.0, "slack"),
        "full-order": lmi.full(p, 1.0),
    }
    for name, design in alone.items():
        made = by_name[name, 1.0].design
        assert (made.method, made.h2) == (design.method, pytest.approx(design.h2, rel=1e-9))


def test_the_table_of_the_specification(found):
    h2 = {(o.method, o.gamma): o.design.h2 for o in found.attempts if o.design is not None}
    printed = {
        ("lmi-common", 1.0): 0.9838,
        ("lmi-slack", 1.0): 0.9539,
        ("retuned-slack", 1.0): 0.9066,
        ("riccati", 1.0): 0.9420,
        ("lmi-common", 0.7): 2.5916,
        ("lmi-slack", 0.7): 2.5272,
        ("retuned-slack", 0.7): 2.4225,
    }
    assert {key: h2[key] for key in printed} == pytest.approx(printed, rel=1e-3)
    assert found.best(1.0).method == "retuned-slack"


def test_what_cannot_be_had_says_why(found):
    (refused,) = [o for o in found.attempts if o.design is None]
    assert (refused.method, refused.gamma) == ("riccati", 0.7)
    assert refused.least == least_riccati_gamma(two_states())
    assert "cannot reach gamma 0.7" in refused.why


def test_of_equals_the_simplest_is_the_best():
    # The Riccati design, the closed form and both retuned LMIs all find the same gain.
    found = trade_off(quaternion(), [1.0], ["retuned-slack", "closed-form", "riccati"])
    assert [o.method for o in found.attempts] == ["riccati", "closed-form", "retuned-slack"]
    assert max(o.design.h2 for o in found.attempts) < 4.1634
    assert found.best(1.0).method == "riccati"
    assert found.best(0.9) is None


@pytest.mark.parametrize("p", [two_states(), attitude_axis()], ids=["two states", "axis"])
def test_the_automatic_range_is_within_reach(p):
    said = []
    found = trade_off(p, methods=["riccati"], progress=lambda *word: said.append(word))
    assert len(found.gammas) == 6
    assert list(found.gammas) == sorted(found.gammas, reverse=True)
    assert found.gammas[0] == pytest.approx(0.9 * found.kalman.hinf, rel=1e-3)
    least = max(1.02 * found.least.reached, 0.1 * found.kalman.hinf)
    assert found.gammas[-1] == pytest.approx(least, rel=1e-3)
    assert found.gammas[-1] > found.least.reached
    assert [done for done, _, _ in said[1:]] == [0, 1, 2, 3, 4, 5]
    assert all(total == 6 for _, total, _ in said[1:])


def test_nothing_to_gain():
    # n is seen at once and kept out by the Kalman filter itself, as far as any gain can.
    p = plant([[0.5]], [[1.0, 0.0]], [[0.0]], [[1.0]], [[0.0, 1.0]])
    found = trade_off(p)
    assert (found.gammas, found.attempts) == ((), [])
    # and a filter whose gain is the safest there is: hardly any room between it and the least
    p = plant([[0.9]], [[1.0, 0.0]], [[1.0]], [[1.0]], [[0.0, 0.1]])
    found = trade_off(p, methods=["riccati"])
    assert found.least.reached < found.gammas[0] < found.kalman.hinf
    assert len(found.gammas) == 1


def test_every_gamma_below_the_least_is_refused_with_the_least():
    with pytest.raises(Unreachable, match=r"gamma 0\.5 is below the least .* have, 0\.594542") as e:
        trade_off(two_states(), [0.5, 0.3])
    assert e.value.least == pytest.approx(0.594542, abs=1e-6)


def test_without_the_packages_of_the_lmi_the_others_are_made(monkeypatch):
    monkeypatch.setitem(sys.modules, "cvxpy", None)
    found = trade_off(two_states(), [1.0, 0.7])
    assert [(o.method, o.gamma) for o in found.attempts] == [("riccati", 1.0), ("riccati", 0.7)]
    assert found.least.proved == pytest.approx(0.594542, abs=1e-6)  # which asks for no solver
    left_out = {name for name, why in found.left_out.items() if "robins[design]" in why}
    assert left_out == {name for name in METHODS if "lmi" in name or "retuned" in name} | {
        "full-order"
    }


def test_a_plant_that_is_not_stable_has_no_filter_of_full_order():
    found = trade_off(attitude_axis(), [2.0], ["full-order", "riccati"])
    assert "A has spectral radius 1" in found.left_out["full-order"]
    assert [o.method for o in found.attempts] == ["riccati"]


@pytest.mark.parametrize(
    ("gammas", "methods", "why"),
    [
        ([0.0], METHODS, "gamma must be positive"),
        ([np.inf], METHODS, "gamma must be finite here"),
        ([np.nan], METHODS, "gamma must be positive"),
        ([1.0], ["ricatti"], "no method 'ricatti'; there are riccati, "),
    ],
)
def test_bad_input(gammas, methods, why):
    with pytest.raises(ValueError, match=why):
        trade_off(two_states(), gammas, methods)
