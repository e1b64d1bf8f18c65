"""Plants: the error system against a simulation, the current form, and what is refused."""

import numpy as np
import pytest
from design_plants import kinematics, two_states

from robins.filters.synthesis import Plant, current_form, error_system, plant

RNG = np.random.default_rng(0)
A = np.array([[0.9, 0.3, 0.0], [0.0, 1.0, 0.2], [0.1, 0.0, 0.5]])
BW, BN = RNG.normal(size=(3, 2)), RNG.normal(size=(3, 1))
C = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 1.0]])
DW, DN = RNG.normal(size=(2, 2)), RNG.normal(size=(2, 1))
DV = np.diag([0.5, 2.0])
L = np.array([[1.0, 1.0, 0.0]])
K = RNG.normal(size=(3, 2))


def errors(system, inputs):
    """z - z^ after each input, from e = 0."""
    e, found = np.zeros(len(system.A)), []
    for w, n in inputs:
        e = system.A @ e + system.Bw @ w + system.Bn @ n
        found.append(system.L @ e)
    return np.array(found)


def test_the_error_of_a_predictor_simulated():
    p = plant(A, BW, BN, C, DW, DN, L)
    inputs = [(RNG.normal(size=2), RNG.normal(size=1)) for _ in range(20)]
    x, estimate, wanted = np.zeros(3), np.zeros(3), []
    for w, n in inputs:
        y = C @ x + DW @ w + DN @ n
        estimate = A @ estimate + K @ (y - C @ estimate)
        x = A @ x + BW @ w + BN @ n
        wanted.append(L @ (x - estimate))
    np.testing.assert_allclose(errors(error_system(p, K), inputs), wanted, atol=1e-9)


def test_the_error_of_a_navigation_filter_simulated():
    p = current_form(A, BW, BN, C, DV, L, DN)
    inputs = [(RNG.normal(size=4), RNG.normal(size=1)) for _ in range(20)]
    x, estimate, wanted = np.zeros(3), np.zeros(3), []
    for noise, n in inputs:
        w, v = noise[:2], noise[2:]
        x = A @ x + BW @ w + BN @ n
        y = C @ x + DV @ v + DN @ n
        predicted = A @ estimate
        estimate = predicted + K @ (y - C @ predicted)
        wanted.append(L @ (x - estimate))
    np.testing.assert_allclose(errors(error_system(p, K), inputs), wanted, atol=1e-9)


def test_what_is_left_away_is_nothing_and_the_whole_state():
    p = plant(A, BW, BN, C)
    assert np.array_equal(p.Dw, np.zeros((2, 2)))
    assert np.array_equal(p.Dn, np.zeros((2, 1)))
    assert np.array_equal(p.L, np.eye(3))
    assert all(block.dtype == float for block in plant([[0]], [[1]], [[2]], [[3]]))
    # a copy: what the caller does to the array later does not change the plant
    given = A.copy()
    p = plant(given, BW, BN, C)
    given[:] = np.nan
    assert np.array_equal(p.A, A)
    assert plant(A, BW, np.zeros((3, 0)), C).Dn.shape == (2, 0)


def call(**blocks):
    return plant(**({"A": A, "Bw": BW, "Bn": BN, "C": C} | blocks))


@pytest.mark.parametrize(
    ("blocks", "why"),
    [
        ({"A": A[:2]}, r"A is \(2, 3\): the transition of a state must be square"),
        ({"A": [[1.0, 2.0], [3.0]]}, "A is no matrix: its rows differ in length"),
        ({"Bw": BW[:2]}, r"Bw is \(2, 2\), must be \(3, 2\): A says that x has 3 components"),
        ({"Bn": BN[:1]}, r"Bn is \(1, 1\), must be \(3, 1\): A says that x has 3 components"),
        ({"Bn": BN[:, 0]}, r"Bn has shape \(3,\), a matrix"),
        ({"C": C[:, :2]}, r"C is \(2, 2\), must be \(2, 3\): A says that x has 3 components"),
        ({"C": np.zeros((0, 3))}, r"C is \(0, 3\): nothing is measured"),
        (
            {"Dw": DW[:, :1]},
            r"Dw is \(2, 1\), must be \(2, 2\): C says that y has 2 components and",
        ),
        ({"Dw": np.ones((1, 2))}, r"Dw is \(1, 2\), must be \(2, 2\)"),
        ({"Dn": np.eye(2)}, r"Dn is \(2, 2\), must be \(2, 1\): .* Bn that n has 1"),
        ({"L": np.eye(2)}, r"L is \(2, 2\), must have one row .* and 3 columns"),
        ({"L": np.zeros((0, 3))}, r"L is \(0, 3\), must have one row"),
        ({"Bw": np.where(BW > 0, np.nan, BW)}, r"Bw\[\d, \d\] is nan, not a finite number"),
        ({"L": [[1.0, np.inf, 0.0]]}, r"L\[0, 1\] is inf, not a finite number"),
    ],
)
def test_a_block_that_does_not_fit_is_named(blocks, why):
    with pytest.raises(ValueError, match=why):
        call(**blocks)


def test_numbers_must_be_real():
    with pytest.raises(TypeError, match="C holds complex128"):
        call(C=C * 1j)
    with pytest.raises(TypeError, match="Bw holds <U"):
        call(Bw=[["1 deg"]])


def test_the_shapes_of_the_document_are_refused_with_the_mend():
    # A measurement of four components in which a modelling error of three enters by D = I4.
    eye = np.eye(4)
    Bn = 0.5 * kinematics([1.0, 0.0, 0.0, 0.0])
    with pytest.raises(ValueError, match="own in y") as caught:
        plant(eye, eye, Bn, eye, None, eye)
    assert str(caught.value) == (
        "Dn is (4, 4), must be (4, 3): C says that y has 4 components and Bn that n has 3. If n "
        "has parts of its own in y, give them columns: Bn = [Bn, 0] and Dn = [0, Dn]"
    )
    split = plant(eye, eye, np.hstack([Bn, 0 * eye]), eye, None, np.hstack([0 * Bn, eye]))
    assert split.Dn.shape == (4, 7)


@pytest.mark.parametrize(
    ("mode", "seen", "told"),
    [
        (1.0, False, "at 1 does"),
        (1.02, False, "at 1.02 does"),
        (0.999, False, None),
        (1.02, True, None),
    ],
)
def test_a_mode_that_is_not_seen_and_does_not_decay_is_named(mode, seen, told):
    A = np.diag([0.5, 0.9, mode])
    A[0, 1] = 0.3
    C = np.array([[1.0, 0.0, float(seen)]])
    turn = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    for T in (np.eye(3), np.diag([1.0, 1e8, 1e-8]), turn):
        blocks = T @ A @ np.linalg.inv(T), T, T, C @ np.linalg.inv(T)
        if told is None:
            assert isinstance(plant(*blocks), Plant)
            continue
        with pytest.raises(ValueError, match=rf"\(A, C\) is not detectable: the mode .* {told}"):
            plant(*blocks)


def test_modes_of_a_chain_and_of_a_rotation():
    # Angle and bias: seen through a chain, however short the step and small the unit.
    for step in (1.0, 1e-6):
        chain = np.array([[1.0, -step], [0.0, 1.0]])
        assert isinstance(plant(chain, np.eye(2), np.eye(2), [[1e-9, 0.0]]), Plant)
        with pytest.raises(ValueError, match=r"at 1 .* along state 0"):
            plant(chain, np.eye(2), np.eye(2), [[0.0, 1.0]])
    turn = np.array([[np.cos(0.3), -np.sin(0.3)], [np.sin(0.3), np.cos(0.3)]])
    assert isinstance(plant(turn, np.eye(2), np.eye(2), [[1.0, 0.0]]), Plant)
    blind = np.block([[turn, np.zeros((2, 1))], [np.zeros((1, 2)), 0.5 * np.eye(1)]])
    with pytest.raises(ValueError, match=r"at 0.955336 [+-]0.29552i does"):
        plant(blind, np.eye(3), np.eye(3), [[0.0, 0.0, 1.0]])


def test_a_defective_mode_that_rounding_scatters_is_found():
    # Three times the same eigenvalue: computed ones lie 1e-5 about it, inside the circle and out.
    block = np.eye(3) + np.diag([1.0, 1.0], 1)
    T = np.random.default_rng(2).normal(size=(3, 3))
    turned = T @ block @ np.linalg.inv(T)
    seen, blind = (row @ np.linalg.inv(T) for row in ([[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]]))
    assert isinstance(plant(turned, np.eye(3), np.eye(3), seen), Plant)
    with pytest.raises(ValueError, match="not detectable"):
        plant(turned, np.eye(3), np.eye(3), blind)


def test_current_form_names_blocks_as_they_were_given():
    with pytest.raises(ValueError, match=r"Dv is \(1, 1\), must be \(2, 1\)"):
        current_form(A, BW, BN, C, [[1.0]])
    with pytest.raises(ValueError, match=r"Dn is \(2, 2\), must be \(2, 1\)"):
        current_form(A, BW, BN, C, DV, Dn=np.eye(2))
    with pytest.raises(ValueError, match=r"C is \(2, 2\), must be \(2, 3\)"):
        current_form(A, BW, BN, C[:, :2], DV)


@pytest.mark.parametrize(
    ("gain", "why"),
    [
        (np.ones((1, 2)), r"K is \(1, 2\), must be \(2, 1\): x has 2 components and y has 1"),
        ([[np.nan], [0.0]], r"K\[0, 0\] is nan"),
    ],
)
def test_a_gain_that_does_not_fit(gain, why):
    with pytest.raises(ValueError, match=why):
        error_system(two_states(), gain)
