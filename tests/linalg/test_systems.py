"""Discretisation against other ways to the same numbers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

from robins import linalg

discretise = jax.jit(linalg.van_loan)


def stable(seed: int, n: int, size: float) -> np.ndarray:
    """A random stable matrix of this norm."""
    A = np.random.default_rng(seed).normal(size=(n, n))
    A = A - (np.max(np.linalg.eigvals(A).real) + 0.1) * np.eye(n)
    return A * size / np.linalg.norm(A, 2)


@pytest.mark.parametrize("size", [1e-3, 0.5, 4.0, 40.0, 400.0])
@pytest.mark.parametrize("seed", range(3))
def test_van_loan_against_the_stationary_covariance(size, seed):
    # A X + X A' + Qc = 0 gives Qd = X - Phi X Phi' without any exponential of -A.
    A = stable(seed, 4, size)
    G = np.random.default_rng(seed + 9).normal(size=(4, 2))
    Qc = G @ G.T
    X = scipy.linalg.solve_continuous_lyapunov(A, -Qc)
    Phi = scipy.linalg.expm(0.7 * A)
    got = discretise(jnp.array(A), jnp.array(Qc), 0.7)
    # for a small step X - Phi X Phi' is itself a difference of large numbers
    known = np.max(np.abs(X)) * 1e-14 + 1e-11 * np.max(np.abs(got[1]))
    np.testing.assert_allclose(got[0], Phi, rtol=1e-11, atol=1e-13)
    np.testing.assert_allclose(got[1], X - Phi @ X @ Phi.T, rtol=0, atol=known)
    np.testing.assert_array_equal(got[1], got[1].T)


def test_van_loan_against_quadrature():
    A = np.array([[0.0, 1.0, 0.0], [0.0, -0.2, 1.0], [-1.0, 0.3, 0.1]])  # one mode grows
    Qc = np.diag([0.0, 0.01, 0.5])
    point, weight = np.polynomial.legendre.leggauss(20)
    dt = 1.5
    s = dt * (point + 1) / 2
    want = sum(
        w * dt / 2 * scipy.linalg.expm(A * t) @ Qc @ scipy.linalg.expm(A * t).T
        for t, w in zip(s, weight, strict=True)
    )
    np.testing.assert_allclose(
        discretise(jnp.array(A), jnp.array(Qc), dt)[1], want, rtol=1e-12, atol=1e-13
    )


@pytest.mark.parametrize("dt", [0.01, 8.0])
def test_two_steps_are_one_of_twice_the_length(dt):
    A, Qc = jnp.array(stable(1, 3, 2.0)), jnp.diag(jnp.array([0.0, 1.0, 3.0]))
    Phi, Q = discretise(A, Qc, dt)
    Phi2, Q2 = discretise(A, Qc, 2 * dt)
    np.testing.assert_allclose(Phi2, Phi @ Phi, rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(Q2, Q + Phi @ Q @ Phi.T, rtol=1e-12, atol=1e-14)


def test_van_loan_has_derivatives():
    A, Qc = stable(2, 3, 1.5), np.diag([0.3, 0.0, 1.0])

    @jax.jit
    def total(dt, scale):
        Phi, Q = linalg.van_loan(scale * jnp.array(A), jnp.array(Qc), dt)
        return jnp.sum(Q) + jnp.sum(Phi)

    gradient = jax.jit(jax.grad(total, argnums=(0, 1)))
    h = 1e-6
    for dt in (0.1, 5.0):  # not halved, and halved
        by_dt, by_scale = gradient(dt, 1.0)
        want_dt = (total(dt + h, 1.0) - total(dt - h, 1.0)) / (2 * h)
        want_scale = (total(dt, 1.0 + h) - total(dt, 1.0 - h)) / (2 * h)
        assert float(by_dt) == pytest.approx(float(want_dt), rel=1e-7)
        assert float(by_scale) == pytest.approx(float(want_scale), rel=1e-7)


def test_no_step_adds_nothing():
    Phi, Q = discretise(jnp.array(stable(1, 3, 1.0)), jnp.eye(3), 0.0)
    np.testing.assert_array_equal(Phi, np.eye(3))
    np.testing.assert_array_equal(Q, np.zeros((3, 3)))
