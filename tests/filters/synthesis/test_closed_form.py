"""The design in closed form against general norms, searches and the table of the specification."""

import numpy as np
import pytest
import scipy.optimize
from design_plants import attitude_axis, kinematics, quaternion

from robins.filters.synthesis import (
    Unreachable,
    closed_form,
    error_system,
    h2_norm,
    hinf_norm,
    isotropic,
    kalman_gain,
    plant,
    riccati,
)


@pytest.mark.parametrize(
    ("gamma", "k", "h2", "hinf"),
    [
        (5.0, 0.28238, 3.7637, 1.7707),
        (1.5, 0.33333, 3.7947, 1.5),
        (1.0, 0.50000, 4.1633, 1.0),
        (0.7, 0.71429, 4.9351, 0.7),
        (0.52, 0.96154, 6.1106, 0.52),
    ],
)
def test_the_quaternion_of_the_specification(gamma, k, h2, hinf):
    design = closed_form(quaternion(), gamma)
    assert isotropic(quaternion()).gain(gamma) == pytest.approx(k, abs=5e-6)
    assert (design.h2, design.hinf) == pytest.approx((h2, hinf), abs=6e-5)
    assert np.linalg.norm(design.gain, 2) == pytest.approx(k, abs=5e-6)


@pytest.mark.parametrize("euler", [False, True], ids=["rotation", "grown"])
@pytest.mark.parametrize("k", [0.2, 0.5, 0.9])
def test_the_formulas_are_the_norms(k, euler):
    # The general computations know nothing of rotations; Bn is that of a true angular rate.
    p = quaternion(rate_rad_s=0.3, Bn=0.5 * kinematics([0.5, 0.5, -0.5, 0.5]), euler=euler)
    found = isotropic(p)
    assert found.rho == pytest.approx(np.hypot(1.0, 0.15) if euler else 1.0, rel=1e-12)
    e = error_system(p, k * found.U)
    assert found.h2(k) == pytest.approx(h2_norm(e.A, e.Bw, e.L), rel=1e-12)
    assert found.hinf(k) == pytest.approx(hinf_norm(e.A, e.Bn, e.L), rel=1e-9)


@pytest.mark.parametrize("rho", [0.7, 1.0, 1.3])
@pytest.mark.parametrize(("sw", "ss"), [(1.0, 3.0), (1e-9, 2e-9), (5.0, 0.1), (0.5, 0.0)])
def test_its_kalman_filter_is_the_kalman_filter(rho, sw, ss):
    angle = 0.4
    U = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    eye, zero = np.eye(2), np.zeros((2, 2))
    p = plant(rho * U, np.hstack([sw * eye, zero]), eye, eye, np.hstack([zero, ss * eye]))
    np.testing.assert_allclose(closed_form(p, np.inf).gain, kalman_gain(p), rtol=1e-9, atol=1e-12)


def test_no_other_multiple_of_the_rotation_is_better():
    found = isotropic(quaternion())
    for gamma in (5.0, 1.0, 0.6):
        best = found.gain(gamma)
        # by search: least H2 of all k that meet gamma
        ks = np.linspace(best * 0.5, found.rho, 2001)
        allowed = ks[[found.hinf(k) <= gamma * (1.0 + 1e-12) for k in ks]]
        assert found.h2(best) <= min(map(found.h2, allowed)) * (1.0 + 1e-12)
        assert found.hinf(best) <= gamma * (1.0 + 1e-12)
    minimum = scipy.optimize.minimize_scalar(found.h2, bounds=(0.01, 0.99), method="bounded")
    assert found.kalman() == pytest.approx(minimum.x, abs=1e-5)


def test_the_rotation_alone_turns_the_gain():
    slow, fast = (closed_form(quaternion(rate_rad_s=rate), 0.7) for rate in (0.0, 0.7))
    assert (fast.h2, fast.hinf) == pytest.approx((slow.h2, slow.hinf), rel=1e-9)
    A = quaternion(rate_rad_s=0.7).A
    np.testing.assert_allclose(fast.gain, slow.gain @ A, atol=1e-12)


def test_less_than_the_least_gamma_is_refused():
    p = quaternion()
    assert closed_form(p, 0.5).hinf == pytest.approx(0.5, rel=1e-9)
    with pytest.raises(
        Unreachable, match=r"gamma 0\.49: the least gamma of this form is 0\.5, at"
    ) as e:
        closed_form(p, 0.49)
    assert e.value.least == 0.5
    with pytest.raises(Unreachable):
        riccati(p, 0.49)
    with pytest.raises(ValueError, match="gamma must be positive"):
        closed_form(p, -1.0)


def test_an_error_in_some_directions_only_can_be_met_better():
    # Bn of the angular rate has three columns of four: lambda Bn Bn' leaves a direction alone.
    p = quaternion(Bn=0.5 * kinematics([0.5, 0.1, -0.7, 0.5]))
    for gamma in (1.5, 0.7):
        assert riccati(p, gamma).h2 < 0.999 * closed_form(p, gamma).h2


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (lambda p: p._replace(A=np.diag([1.0, 1.0, 1.0, 0.9])), "A is no multiple of an orthog"),
        (lambda p: p._replace(A=0.0 * p.A), "A is zero"),
        (lambda p: p._replace(C=2.0 * p.C), "C is not the identity"),
        (lambda p: p._replace(Bw=p.Bw * np.arange(1.0, 9.0)), "Bw Bw' is no multiple"),
        (lambda p: p._replace(Dw=p.Dw * np.arange(1.0, 9.0)), "Dw Dw' is no multiple"),
        (lambda p: p._replace(Dw=p.Dw + p.Bw), "w is in both x and y"),
        (lambda p: p._replace(Dn=np.eye(4)), "n enters the measurement"),
        (lambda p: p._replace(L=np.eye(4)[:2]), "L'L is no multiple"),
        (lambda p: attitude_axis(), "A is no multiple of an orthogonal matrix"),
    ],
)
def test_other_plants_are_refused(change, why):
    with pytest.raises(ValueError, match=f"no closed form: {why}"):
        closed_form(change(quaternion()), 1.0)
