"""Designs anew at every sample: the same gains as one by one, checked, with their warning."""

import numpy as np
import pytest
from design_plants import attitude_axis, quaternion, two_states

from robins.filters.synthesis import (
    Unreachable,
    error_system,
    lmi,
    programs,
    spectral_radius,
)
from robins.filters.synthesis.lmi import EveryStep, FrozenTimeWarning, observer


def designer(*args):
    with pytest.warns(FrozenTimeWarning, match="guarantee nothing for a plant that varies"):
        return EveryStep(*args)


def noisier(plant, factor):
    return plant._replace(Dw=plant.Dw * factor)


def turning(rates):
    return [quaternion(rate_rad_s=rate) for rate in rates]


@pytest.mark.parametrize(
    ("plants", "gamma", "form"),
    [
        (turning((0.0, 0.05, 0.1225, 0.4)), 1.0, "common"),
        (turning((0.02, 0.3)), 0.7, "slack"),
        ([noisier(attitude_axis(), factor) for factor in (1.0, 2.0, 5.0)], 2.7542, "common"),
    ],
    ids=["quaternion", "quaternion, slack", "axis"],
)
def test_each_gain_is_that_of_a_design_for_the_plant_of_its_step(plants, gamma, form):
    each = designer(gamma, form)
    gains = [each(plant) for plant in plants]
    built = programs.build.cache_info().misses
    for plant, gain in zip(plants, gains, strict=True):
        alone = observer(plant, gamma, form)
        np.testing.assert_allclose(gain, alone.gain, rtol=0, atol=2e-4 * np.abs(gain).max())
    assert programs.build.cache_info().misses == built
    assert np.abs(gains[-1] - gains[0]).max() > 1e-3


def test_it_warns_when_made_and_not_again(recwarn):
    each = EveryStep(1.0)
    for rate in (0.1, 0.2):
        each(quaternion(rate_rad_s=rate))
    assert [w.category for w in recwarn.list] == [FrozenTimeWarning]


def test_without_gamma_it_is_the_kalman_filter_of_the_step():
    np.testing.assert_allclose(
        designer(np.inf)(two_states()), observer(two_states(), np.inf).gain, rtol=0, atol=1e-6
    )


def test_another_shape_gets_units_of_its_own():
    each = designer(2.7542)
    each(two_states())
    gain = each(attitude_axis(axes=3, rate_rad_s=(0.02, 0.0, 0.0)))
    assert gain.shape == (6, 3)


def spoilt(key, factor):
    def solve(*asked):
        answer = programs.solve(*asked)
        return answer._replace(unknowns=answer.unknowns | {key: factor * answer.unknowns[key]})

    return solve


def cheap(*asked):
    answer = programs.solve(*asked)
    return answer._replace(value=0.5 * answer.value)


@pytest.mark.parametrize(
    "solve",
    [
        spoilt("Y", 9.0),  # errors grow
        spoilt("Y", 0.9),  # gamma is exceeded
        cheap,  # the bound is
        lambda *_: programs.SolverAnswer("solver_error", np.nan, {}),
    ],
    ids=["grows", "gamma", "bound", "none"],
)
def test_a_gain_whose_norms_are_not_right_is_never_given_out(solve, monkeypatch):
    gamma = 0.52
    plants = turning((0.1, 0.2))
    each = designer(gamma)
    each(plants[0])
    wanted = observer(plants[1], gamma).gain
    once = iter([solve])
    monkeypatch.setattr(lmi, "solve", lambda *asked: next(once, programs.solve)(*asked))
    np.testing.assert_allclose(each(plants[1]), wanted, rtol=0, atol=1e-12)


def test_a_gamma_out_of_reach_at_some_step_is_told():
    each = designer(0.52)
    each(quaternion(b=0.5))
    with pytest.raises(Unreachable, match=r"below the least .* have, 0\.6 "):
        each(quaternion(b=0.6))


def test_bad_arguments():
    with pytest.raises(ValueError, match="gamma must be positive"):
        EveryStep(-1.0)


def test_frozen_designs_need_not_make_a_filter_whose_errors_decay():
    """Reason for the warning: two plants in turns, each with a gain certified for it."""
    each, errors = designer(500.0), []
    for A in ([[0.5, 2.0], [0.0, 0.5]], [[0.5, 0.0], [2.0, 0.5]]):
        noisy = noisier(two_states(), 100.0)._replace(A=np.array(A))
        errors.append(error_system(noisy, each(noisy)).A)
        assert spectral_radius(errors[-1]) < 0.6
    assert spectral_radius(errors[1] @ errors[0]) > 4.0
