"""Norms against other computations: sums, grids, convolution matrices, closed forms."""

import numpy as np
import pytest
import scipy.linalg
from design_plants import attitude_axis, stable_system, two_states

from robins.filters.synthesis import (
    error_system,
    h2_norm,
    hinf_norm,
    kalman_gain,
    peak_gain,
    spectral_radius,
)
from robins.filters.synthesis.norms import gramian

RADII = (0.3, 0.9, 0.99)


def systems(count, seed):
    rng = np.random.default_rng(seed)
    for k in range(count):
        n, q, r = rng.integers(1, 6), rng.integers(1, 4), rng.integers(1, 4)
        A, B, C = stable_system(rng, n, q, r, RADII[k % len(RADII)])
        yield A, B, C, rng.normal(size=(r, q)) * (k % 2)


def impulse_response(A, B, C, count):
    """(count, r, q): C B, C A B, ..."""
    found = []
    for _ in range(count):
        found.append(C @ B)
        B = A @ B
    return np.array(found)


def on_circle(A, B, C, D, angle):
    z = np.exp(1j * angle)[:, None, None]
    return C @ np.linalg.inv(z * np.eye(len(A)) - A) @ B + D


def time_domain_gain(A, B, C, count):
    """Greatest energy gain over `count` steps: the norm of a block Toeplitz matrix."""
    h = impulse_response(A, B, C, count)
    r, q = h.shape[1:]
    T = np.zeros((count, r, count, q))
    for lag in range(count):
        k = np.arange(count - lag)
        T[k + lag, :, k, :] = h[lag]
    return np.linalg.norm(T.reshape(count * r, count * q), 2)


def test_h2_is_the_energy_of_the_impulse_responses():
    for A, B, C, D in systems(12, 0):
        energy = np.sum(impulse_response(A, B, C, 4000) ** 2) + np.sum(D**2)
        assert h2_norm(A, B, C, D) == pytest.approx(np.sqrt(energy), rel=1e-11)
        # and the same seen from the other side
        assert h2_norm(A.T, C.T, B.T, D.T) == pytest.approx(np.sqrt(energy), rel=1e-11)


def test_the_gramian_solves_its_equation():
    for A, B, _, _ in systems(12, 1):
        n = len(A)
        linear = np.eye(n * n) - np.kron(A, A)
        P = np.linalg.solve(linear, (B @ B.T).ravel()).reshape(n, n)
        np.testing.assert_allclose(gramian(A, B), P, rtol=1e-9, atol=1e-11 * np.max(P))


def test_hinf_is_the_top_of_a_dense_grid():
    angle = np.linspace(0.0, np.pi, 20001)
    for A, B, C, D in systems(12, 2):
        top = np.max(np.linalg.norm(on_circle(A, B, C, D, angle), 2, axis=(1, 2)))
        found = hinf_norm(A, B, C, D)
        assert found >= top * (1.0 - 1e-10)
        assert found == pytest.approx(top, rel=2e-5)  # what the grid can miss
        assert peak_gain(A, B, C, D) == pytest.approx(found, rel=1e-9)


def test_responses_that_are_nearly_flat():
    # A level may then lie below the response at every frequency, or be hardly above that at one.
    rng = np.random.default_rng(8)
    angle = np.linspace(0.0, np.pi, 2001)
    for k in range(40):
        radius = (0.01, 0.1, 0.4)[k % 3]
        A, B, C = stable_system(rng, *(rng.integers(1, 4, size=3)), radius)
        found, none = hinf_norm(A, B, C), np.zeros((len(C), B.shape[1]))
        top = np.max(np.linalg.norm(on_circle(A, B, C, none, angle), 2, axis=(1, 2)))
        assert top * (1.0 - 1e-10) <= found <= top * (1.0 + 1e-6)
        assert peak_gain(A, B, C) == pytest.approx(found, rel=1e-9)


def test_a_plant_whose_whole_response_lies_above_the_hankel_bound():
    A = np.array([[-0.35371781, -0.41815606], [-0.08547516, 0.05408667]])
    B = np.array([[-0.51823667, -1.60684668, -0.50546894], [-0.94631628, 0.62882333, -1.75424311]])
    C = np.array([[0.89488548, -0.34386331], [-1.15209894, 1.23556843], [-0.72794022, -1.12009219]])
    response = on_circle(A, B, C, np.zeros((3, 3)), np.linspace(0.0, np.pi, 4001))
    gain = np.linalg.norm(response, 2, axis=(1, 2))
    hankel = np.linalg.eigvals(gramian(A, B) @ gramian(A.T, C.T)).real
    assert np.sqrt(hankel.max()) < gain.min()
    assert hinf_norm(A, B, C) == pytest.approx(gain.max(), rel=1e-9)


def test_hinf_is_the_gain_of_long_signals():
    # Over N steps the gain is less than the norm by something that falls as 1 / N^2.
    rng = np.random.default_rng(3)
    for radius in (0.5, 0.8):
        A, B, C = stable_system(rng, 3, 1, 2, radius)
        norm = hinf_norm(A, B, C)
        short, long = (time_domain_gain(A, B, C, count) for count in (150, 300))
        assert short < long < norm * (1.0 + 1e-9)
        assert long + (long - short) / 3.0 == pytest.approx(norm, rel=2e-4)


def test_the_kalman_filter_of_the_specification():
    p = two_states()
    A, Bw, Bn, L = error_system(p, kalman_gain(p))
    assert h2_norm(A, Bw, L) == pytest.approx(0.6571125579, abs=1e-10)
    energy = np.sum(impulse_response(A, Bw, L, 300) ** 2)
    assert h2_norm(A, Bw, L) == pytest.approx(np.sqrt(energy), rel=1e-10)
    assert hinf_norm(A, Bn, L) == pytest.approx(1.70093599, abs=5e-9)
    assert peak_gain(A, Bn, L) == pytest.approx(hinf_norm(A, Bn, L), rel=1e-8)


@pytest.mark.parametrize("a", [0.0, 0.5, -0.5, 0.999999, -0.999999])
def test_one_state(a):
    A, B, C = np.array([[a]]), np.array([[2.0]]), np.array([[3.0]])
    assert h2_norm(A, B, C) == pytest.approx(6.0 / np.sqrt(1.0 - a**2), rel=1e-10)
    for found in (hinf_norm(A, B, C), peak_gain(A, B, C)):
        assert found == pytest.approx(6.0 / (1.0 - abs(a)), rel=1e-9)


@pytest.mark.parametrize("angle", [0.0, 1.234567, np.pi / 2.0, 3.0, np.pi])
@pytest.mark.parametrize("width", [0.5, 1e-3, 1e-7])
def test_a_narrow_resonance(angle, width):
    r = 1.0 - width
    A = r * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    eye = np.eye(2)
    for found in (hinf_norm(A, eye, eye), peak_gain(A, eye, eye)):
        assert found == pytest.approx(1.0 / width, rel=1e-8)
    assert h2_norm(A, eye, eye) == pytest.approx(np.sqrt(2.0 / (1.0 - r**2)), rel=1e-8)


def test_poles_all_about_the_circle():
    # Whatever point of the circle is mapped to infinity, some pole is near it.
    angle = np.arange(8) * np.pi / 4.0
    blocks = [
        0.999 * np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]]) for a in angle[1:4]
    ]
    A = scipy.linalg.block_diag(0.999, -0.999, *blocks)
    B = C = np.eye(8)
    assert hinf_norm(A, B, C) == pytest.approx(1000.0, rel=1e-9)
    B = np.ones((8, 1))
    assert hinf_norm(A, B, C) == pytest.approx(peak_gain(A, B, C), rel=1e-9)


def test_errors_that_vanish_after_a_few_steps():
    # Nilpotent: pure delays have gain one at all frequencies.
    chain = np.diag(np.ones(4), 1)
    first, last = np.eye(5)[:1], np.eye(5)[:, 4:]
    assert h2_norm(chain, last, first) == 1.0
    assert hinf_norm(chain, last, first) == pytest.approx(1.0, rel=1e-9)
    assert peak_gain(chain, last, first) == pytest.approx(1.0, rel=1e-12)
    # a delay seen late, with noise that is amplified only on its way
    stretched = chain * np.array([1.0, 1e3, 1e3, 1e3, 1e3])
    assert h2_norm(stretched, last, first) == pytest.approx(1e12, rel=1e-12)
    assert hinf_norm(stretched, last, first) == pytest.approx(1e12, rel=1e-9)
    B = np.array([[3.0, 0.0], [4.0, 1.0]])
    assert hinf_norm(np.zeros((2, 2)), B, np.eye(2)) == pytest.approx(np.linalg.norm(B, 2))


def test_nothing_comes_through():
    A, one, none = np.array([[0.5]]), np.array([[1.0]]), np.array([[0.0]])
    for B, C in ((none, one), (one, none), (np.zeros((1, 0)), one), (one, np.zeros((0, 1)))):
        assert (h2_norm(A, B, C), hinf_norm(A, B, C), peak_gain(A, B, C)) == (0.0, 0.0, 0.0)
    D = np.array([[-7.0]])
    assert (h2_norm(A, none, one, D), peak_gain(A, none, one, D)) == (7.0, 7.0)
    assert hinf_norm(A, none, one, D) == pytest.approx(7.0, rel=1e-10)
    # a state that is driven but not seen, and one that is seen but not driven
    A, B, C = np.diag([0.9, 0.5, 0.8]), np.array([[1.0], [1.0], [0.0]]), np.array([[0.0, 1.0, 1.0]])
    assert hinf_norm(A, B, C) == pytest.approx(2.0, rel=1e-10)
    assert h2_norm(A, B, C) == pytest.approx(np.sqrt(4.0 / 3.0), rel=1e-13)


@pytest.mark.parametrize("radius", [1.0, 1.0 + 1e-9, 2.0])
def test_no_norm_without_stability(radius):
    A, one = np.diag([0.5, radius]), np.eye(2)
    assert spectral_radius(A) == radius
    for norm in (h2_norm, hinf_norm, peak_gain):
        assert norm(A, one, one) == np.inf


@pytest.mark.parametrize("norm", [h2_norm, hinf_norm, peak_gain])
def test_what_is_no_system_is_refused_by_name(norm):
    one, A = np.eye(2), 0.5 * np.eye(2)
    for given, words in (
        ((np.ones((2, 3)), one, one), r"A is \(2, 3\), must be \(2, 2\)"),
        ((np.nan * one, one, one), r"A\[0, 0\] is nan"),
        ((A, np.ones((3, 1)), one), r"B is \(3, 1\), must be \(2, 1\)"),
        ((A, one, one, np.eye(1)), r"D is \(1, 1\), must be \(2, 2\)"),
    ):
        with pytest.raises(ValueError, match=words) as told:
            norm(*given)
        assert type(told.value) is ValueError
    with pytest.raises(ValueError, match="A is"):
        spectral_radius(np.ones((2, 3)))


def test_units_of_the_states_do_not_matter():
    for k, (A, B, C, D) in enumerate(systems(10, 5)):
        unit = 10.0 ** np.random.default_rng(k).uniform(-9, 9, len(A))
        A_, B_, C_ = A * unit[:, None] / unit, B * unit[:, None], C / unit
        assert h2_norm(A_, B_, C_, D) == pytest.approx(h2_norm(A, B, C, D), rel=1e-10)
        assert hinf_norm(A_, B_, C_, D) == pytest.approx(hinf_norm(A, B, C, D), rel=1e-9)
        assert peak_gain(A_, B_, C_, D) == pytest.approx(peak_gain(A, B, C, D), rel=1e-7)


def test_units_of_the_channels_are_factors():
    radian = np.pi / 648000.0
    A, Bw, Bn, L = error_system(attitude_axis(), np.array([[0.08], [-0.0003]]))
    assert h2_norm(A, radian * Bw, L) == pytest.approx(radian * h2_norm(A, Bw, L), rel=1e-12)
    for norm in (hinf_norm, peak_gain):
        assert norm(A, 1e-12 * Bn, L) == pytest.approx(1e-12 * norm(A, Bn, L), rel=1e-10)
        assert norm(A, Bn, 1e12 * L) == pytest.approx(1e12 * norm(A, Bn, L), rel=1e-10)
