"""The least gamma against closed forms, a search over gains, the game by inverses and an LMI."""

import numpy as np
import pytest
import scipy.linalg
import scipy.optimize
from design_plants import attitude_axis, quaternion, stable_system, two_states
from gain_search import worst

from robins.filters.synthesis import (
    Unreachable,
    error_system,
    hinf_norm,
    least_gamma,
    observer,
    plant,
    riccati,
    trade_off,
)


def faintly_seen():
    """n drives x0 and is seen in y1 at 1e-5 of its size: K = [., 1e5] keeps it out whole."""
    return plant(
        A=[[0.9, 0.0], [0.3, 0.5]],
        Bw=[[1.0, 0.0, 0.0], [0.0, 0.0, 0.0]],
        Bn=[[1.0], [0.0]],
        C=np.eye(2),
        Dw=[[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
        Dn=[[0.0], [1e-5]],
    )


def test_a_gamma_that_a_gain_meets_is_not_refused():
    """A solver that stops at 1e-8 takes 1e-5, squared, for nothing, and says 1."""
    p = faintly_seen()
    exact = error_system(p, [[0.9, 1e5], [0.3, 0.0]])
    assert not exact.Bn.any()
    assert np.abs(np.linalg.eigvals(exact.A)).max() < 1.0
    found = trade_off(p, [0.5], ["riccati"])
    (made,) = found.attempts
    assert made.design.hinf == pytest.approx(0.5, rel=1e-6)
    assert (found.least.proved, found.least.reached, found.least.step) == (0.0, 0.0, 0)
    assert riccati(p, 1e-3).hinf <= 1e-3
    # and what is a gain's is told: the other methods raise the promise, not the proof
    assert found.least.improved_by(made.design) is found.least


def by_inverses(p, gamma):
    """Test for the end of the game, with P and its inverse; n in x and in y must be apart."""
    Q, R = p.Bn @ p.Bn.T, p.Dn @ p.Dn.T
    P = Q
    for _ in range(400):
        if np.linalg.eigvalsh(p.L @ P @ p.L.T)[-1] >= gamma**2:
            return True
        news = p.C.T @ np.linalg.inv(R) @ p.C - p.L.T @ p.L / gamma**2
        P = p.A @ P @ np.linalg.inv(np.eye(len(P)) + news @ P) @ p.A.T + Q
    return False


def test_the_proof_is_the_game_s_and_the_gain_reaches_it():
    rng = np.random.default_rng(3)
    for n, m in ((2, 1), (3, 2), (5, 2)):
        A, B, C = stable_system(rng, n, 2, m, 0.97)
        zero = np.zeros
        p = plant(
            A, np.hstack([B, zero((n, m))]), np.hstack([B, zero((n, m))]), C,
            np.hstack([zero((m, 2)), np.eye(m)]), np.hstack([zero((m, 2)), 0.3 * np.eye(m)]),
            rng.normal(size=(2, n)),
        )  # fmt: skip
        least = least_gamma(p)
        assert least.exact
        assert least.proved <= least.reached == least.design.hinf
        assert by_inverses(p, 0.9999 * least.proved)
        assert not by_inverses(p, 1.0002 * least.proved)
        e = error_system(p, least.design.gain)
        assert least.reached == hinf_norm(e.A, e.Bn, e.L)


def test_no_gain_beats_it_in_a_search_and_an_lmi_stands_on_either_side():
    p, least = two_states(), least_gamma(two_states())
    assert least.proved == pytest.approx(0.594542, rel=1e-6)
    assert least.reached == pytest.approx(least.proved, rel=1e-5)
    searched = scipy.optimize.minimize(
        lambda k: worst(p, k.reshape(2, 1)), least.design.gain.ravel() + 0.05,
        method="Nelder-Mead", options={"xatol": 1e-5, "fatol": 1e-8, "maxfev": 300},
    )  # fmt: skip
    assert least.proved * (1.0 - 1e-6) < searched.fun < least.reached * (1.0 + 1e-3)
    assert observer(p, 1.001 * least.proved).hinf < 1.001 * least.proved
    with pytest.raises(Unreachable, match=rf"recursion of the game ends at step {least.step}\)"):
        observer(p, 0.999 * least.proved)


def test_what_is_not_seen_has_the_norm_of_the_plant_itself():
    rng = np.random.default_rng(5)
    A, B, L = stable_system(rng, 3, 2, 2, 0.9)
    p = plant(
        scipy.linalg.block_diag(A, 0.5), np.eye(4, 5), np.vstack([B, np.zeros((1, 2))]),
        [[0.0, 0.0, 0.0, 1.0]], [[0.0, 0.0, 0.0, 0.0, 1.0]], None, np.hstack([L, np.zeros((2, 1))]),
    )  # fmt: skip
    least = least_gamma(p)
    assert 0.999 * hinf_norm(A, B, L) < least.proved <= hinf_norm(A, B, L)
    assert least.reached == pytest.approx(hinf_norm(A, B, L), rel=1e-9)


@pytest.mark.parametrize("columns", [0, 1])
def test_a_plant_without_a_modelling_error_meets_any_gamma(columns):
    p = two_states()._replace(Bn=np.zeros((2, columns)), Dn=np.zeros((1, columns)))
    assert least_gamma(p).reached == 0.0
    assert observer(p, 1e-3).hinf == 0.0
    assert observer(p, 1e-3).h2 == pytest.approx(0.6571125579, rel=1e-8)


def test_closed_forms():
    # The rate error moves what the star sensor measures: K = (1, 0) takes it out whole.
    assert least_gamma(attitude_axis()).reached == 0.0
    # An error of the rate is seen a step too late: b.
    assert least_gamma(quaternion()).proved == pytest.approx(0.5, rel=1e-7)
    # A growing state, n in the measurement alone: k / (1 - |2 - k|), least at k = 2. Not proved.
    grows = plant([[2.0]], [[1.0, 0.0]], [[0.0]], [[1.0]], [[0.0, 1.0]], [[1.0]])
    least = least_gamma(grows)
    assert (least.proved, least.exact) == (0.0, False)
    assert least.reached == pytest.approx(2.0, rel=1e-3)


def test_it_follows_the_units():
    p = two_states()
    small = p._replace(L=1e-5 * p.L, Bn=1e-3 * p.Bn)
    assert least_gamma(small).proved == pytest.approx(1e-8 * 0.594542, rel=1e-6)
