"""Flexure: exact steps, stationary statistics, load and tails."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm, solve_continuous_lyapunov

from robins.sim.flexure import Flexure, simulate_flexure, transition
from robins.sim.random import Component, stream

step = jax.jit(transition)
simulated = jax.jit(simulate_flexure, static_argnames=("dt_s", "count"))


def oscillator(tau, zeta):
    wn = 2.146 / tau
    return np.array([[0.0, 1.0], [-(wn**2), -2.0 * zeta * wn]]), wn


@pytest.mark.parametrize(
    ("tau", "zeta", "dt"),
    [(1.0, 1.0, 0.05), (10.0, 0.1, 0.01), (0.1, 0.05, 0.1), (100.0, 1.0, 1e-3)],
)
def test_step_is_the_exponential_and_keeps_the_stationary_covariance(tau, zeta, dt):
    sigma = 3e-3
    A, wn = oscillator(tau, zeta)
    Phi, L = (np.asarray(x) for x in step(sigma, tau, zeta, dt))
    np.testing.assert_allclose(Phi, expm(A * dt), rtol=1e-12, atol=1e-14)
    P = sigma**2 * np.diag([1.0, wn**2])
    q = 4.0 * zeta * wn**3 * sigma**2
    steady = solve_continuous_lyapunov(A, -np.diag([0.0, q]))
    np.testing.assert_allclose(steady, P, rtol=1e-9, atol=1e-12 * P.max())
    np.testing.assert_allclose(Phi @ P @ Phi.T + L @ L.T, P, rtol=1e-12, atol=1e-13 * sigma**2)


def test_noise_of_a_short_step_has_its_power_law():
    # q [[h^3/3, h^2/2], [h^2/2, h]] to the first order in h: where differences would cancel
    sigma, tau, h = 1e-3, 100.0, 1e-3
    L = np.asarray(step(sigma, tau, 1.0, h)[1])
    q = 4.0 * (2.146 / tau) ** 3 * sigma**2
    want = q * np.array([[h**3 / 3, h**2 / 2], [h**2 / 2, h]])
    np.testing.assert_allclose(L @ L.T, want, rtol=2e-4)


def test_correlation_falls_to_one_over_e_at_tau_when_damped_critically():
    Phi = np.asarray(step(1.0, 3.0, 1.0, 3.0)[0])
    np.testing.assert_allclose(Phi[0, 0], np.exp(-1.0), rtol=2e-4)  # of rounding 2.146


@pytest.mark.parametrize("dof", [None, 5.0])
def test_simulated_statistics(dof):
    sigma, tau = np.array([8e-3, 1e-3, 0.0]), np.array([1.0, 2.0, 1.0])
    model = Flexure(sigma, tau, 0.7, dof)
    keys = jax.vmap(lambda k: stream(3, k, Component.FLEXURE))(jnp.arange(2000))
    angle, rate = jax.jit(jax.vmap(lambda key: simulate_flexure(model, key, 0.1, 20)))(keys)
    for k in (0, 20):
        np.testing.assert_allclose(np.std(angle[:, k], axis=0)[:2], sigma[:2], rtol=0.06)
        of_rate = np.std(rate[:, k], axis=0)
        np.testing.assert_allclose(of_rate[:2], sigma[:2] * 2.146 / tau[:2], rtol=0.06)
    assert np.all(np.asarray(angle)[..., 2] == 0.0)
    Phi = np.asarray(step(1.0, 1.0, 0.7, 2.0)[0])
    seen = np.mean(angle[:, 0, 0] * angle[:, 20, 0]) / sigma[0] ** 2
    np.testing.assert_allclose(seen, Phi[0, 0], atol=0.07)
    x = np.stack([angle, rate], -1)[..., 0, :]
    A, _ = oscillator(1.0, 0.7)
    innovation = x[:, 1:] - np.einsum("ij,rkj->rki", expm(A * 0.1), x[:, :-1])
    excess = np.mean(innovation[..., 1] ** 4) / np.mean(innovation[..., 1] ** 2) ** 2
    assert (excess > 4.0) if dof else (abs(excess - 3.0) < 0.2)


def test_bending_follows_the_load():
    model = Flexure(np.zeros(3), np.ones(3), bending_rad_g=np.array([0.0, 2e-3, 0.0]))
    load = jnp.array([1.0, 2.0, 3.0, 3.0])
    angle, rate = simulated(model, jax.random.key(0), 0.5, 3, load)
    np.testing.assert_allclose(angle[:, 1], [0.0, 2e-3, 4e-3, 4e-3], atol=1e-15)
    np.testing.assert_allclose(rate[1, 1], 4e-3, atol=1e-15)


def test_an_angle_is_the_integral_of_its_rate():
    model = Flexure(np.full(3, 5e-3), np.ones(3))
    angle, rate = simulated(model, jax.random.key(2), 1e-3, 500)
    integral = np.cumsum(0.5e-3 * (rate[1:] + rate[:-1]), axis=0)
    np.testing.assert_allclose(angle[1:] - angle[:1], integral, atol=5e-3 * np.std(angle))


def test_bad_input():
    good = Flexure(np.ones(3), np.ones(3))
    for model, steps, load, words in (
        (good, 0, None, "at least one step"),
        (good._replace(tail_dof=2.0), 5, None, "above 2"),
        (good, 5, jnp.ones(5), r"needs? \(6,\)"),
    ):
        with pytest.raises(ValueError, match=words):
            simulate_flexure(model, jax.random.key(0), 0.1, steps, load)
