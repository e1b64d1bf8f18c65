"""The state of an aided INS over blocks: noise, padding, joins, sensor errors, gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from ins_states import (
    NOISE,
    SIZE,
    WEIGHT,
    block,
    error_dynamics,
    gentle,
    linear,
    padded,
    state,
    violent,
)

from robins import linalg
from robins.ins.increments import Increments
from robins.ins.mechanise import mechanise
from robins.ins.state import InsState, propagate, propagate_linear, step
from robins.manifold import local, retract

moved = jax.jit(propagate)


def test_states_without_scales_are_a_part_of_those_with():
    x = state(1, 80.0)._replace(gyro_scale=jnp.zeros(3), accel_scale=jnp.zeros(3))
    noise = NOISE._replace(gyro_scale_rw=np.zeros(3), accel_scale_rw=np.zeros(3))
    small = x._replace(gyro_scale=None, accel_scale=None)
    _, Phi, L = linear(x, block(violent), noise, 4)
    _, Phi_small, L_small = linear(small, block(violent), noise, 4)
    np.testing.assert_allclose(Phi_small, Phi[:15, :15], rtol=1e-12, atol=1e-18)
    weight = np.outer(SIZE[:15], SIZE[:15])
    Q_small, Q = L_small @ L_small.T / weight, (L @ L.T)[:15, :15] / weight
    np.testing.assert_allclose(Q_small, Q, rtol=1e-9, atol=1e-18)


@jax.jit
def dense(x, motion_id, Qc):
    """Q of a second by the matrix Riccati's linear part in 4000 midpoint steps."""
    count, n = 4000, 21
    h = 1.0 / count

    def at(t):
        return jax.lax.cond(motion_id == 0, lambda: gentle(t, jnp), lambda: violent(t, jnp))

    def body(carry, k):
        x, Q = carry
        t = k * h
        rate, force = at(t + 0.25 * h)
        middle = step(x, Increments(0.5 * h, rate * 0.5 * h, force * 0.5 * h), NOISE)
        rate, force = at(t + 0.5 * h)
        F, G = error_dynamics(middle, force, rate, NOISE)
        A = jnp.eye(n) + h * F + 0.5 * h * h * F @ F
        half = (jnp.eye(n) + 0.5 * h * F) @ G
        Q = A @ Q @ A.T + h * half @ Qc @ half.T
        return (step(x, Increments(h, rate * h, force * h), NOISE), Q), None

    carry = (x, jnp.zeros((n, n)))
    return jax.lax.scan(body, carry, jnp.arange(count).astype(float))[0][1]


EVEN, UNEVEN = np.ones(3), np.array([1.0, 2.0, 0.5])


@pytest.mark.parametrize(
    ("motion_id", "axes", "tolerance"),
    [(0, EVEN, 1e-3), (1, EVEN, 0.02), (0, UNEVEN, 3e-3), (1, UNEVEN, 0.04)],
)
def test_q_against_a_dense_integration(motion_id, axes, tolerance):
    """Within a share of the root of both variances; the sensors' axes may differ."""
    x = InsState.start(state(1, 60.0).nav, scales=True)
    noise = NOISE._replace(gyro_arw=1e-4 * axes, accel_vrw=1e-3 * axes)
    drives = np.repeat([1e-7, 1e-5, 1e-6, 1e-6], 3)
    Qc = np.diag(np.concatenate([noise.gyro_arw, noise.accel_vrw, drives]) ** 2)
    Q = np.asarray(dense(x, motion_id, Qc))
    _, _, L = linear(x, block((gentle, violent)[motion_id]), noise, 4)
    np.testing.assert_array_equal(L, np.tril(L))
    sigma = np.sqrt(np.diag(Q))
    assert (np.abs(L @ L.T - Q) / np.outer(sigma, sigma)).max() < tolerance


def test_q_of_one_sample_against_van_loan():
    x = InsState.start(state(1, 60.0).nav, scales=True)
    rate, force, dt = np.array([0.1, -0.2, 0.3]), np.array([1.0, -2.0, -9.8]), 0.005
    sample = Increments(np.array([dt]), rate[None] * dt, force[None] * dt)
    _, _, L = linear(x, padded(sample), NOISE, 4)
    F, G = jax.jit(error_dynamics)(x, force, rate, NOISE)
    spread = np.repeat([1e-4, 1e-3, 1e-7, 1e-5, 1e-6, 1e-6], 3)
    _, Q = jax.jit(linalg.van_loan)(F, G * spread[None] ** 2 @ G.T, dt)
    sigma = np.sqrt(np.diag(Q))
    assert (np.abs(L @ L.T - Q) / np.outer(sigma, sigma)).max() < 2e-3


HALVES = (slice(50), slice(50, None))


def test_two_halves_make_a_whole():
    x, increments = state(3, 50.0), block(gentle)
    first, second = (padded(jax.tree.map(lambda a, s=s: a[s], increments)) for s in HALVES)
    end, Phi, L = linear(x, increments, NOISE, 4)
    middle, Phi_1, L_1 = linear(x, first, NOISE, 4)
    there, Phi_2, L_2 = linear(middle, second, NOISE, 4)
    # the biases fade between the samples of each half alike
    for a, b in zip(jax.tree.leaves(there), jax.tree.leaves(end), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-13, atol=1e-15)
    assert (np.abs(Phi_2 @ Phi_1 - Phi) * WEIGHT).max() < 1e-12
    Q, joined = L @ L.T, Phi_2 @ L_1 @ L_1.T @ Phi_2.T + L_2 @ L_2.T
    sigma = np.sqrt(np.diag(Q))
    assert (np.abs(joined - Q) / np.outer(sigma, sigma)).max() < 1e-12


# ------------------------------------------------------------------------------- the state itself


def test_sensor_errors_are_undone():
    """Known bias and scale in the raw samples: the path is that of the true ones."""
    x, true = state(2, 30.0), block(gentle)
    raw = true._replace(
        theta=true.theta * (1.0 + x.gyro_scale)[None] + x.gyro_bias[None] * true.dt[:, None],
        dv=true.dv * (1.0 + x.accel_scale)[None] + x.accel_bias[None] * true.dt[:, None],
    )
    end = moved(x, raw)
    last = jax.tree.map(lambda a: a[-1], mechanise(x.nav, true))
    assert float(jnp.abs(local(last, end.nav)).max()) < 1e-7  # dr of raw samples sees the bias turn
    np.testing.assert_array_equal(end.gyro_bias, x.gyro_bias)


def test_blocks_steps_and_zeros_agree():
    x, increments = state(2, 30.0), block(violent, 40)
    end = moved(x, padded(increments), NOISE)
    one = jax.jit(step)
    y = x
    for k in range(40):
        y = one(y, jax.tree.map(lambda a, k=k: a[k], increments), NOISE)
    for a, b in zip(jax.tree.leaves(y), jax.tree.leaves(end), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12)
    ends = linear(x, padded(increments), NOISE, 4)[0], moved(x, increments, NOISE)
    for a, b in zip(*map(jax.tree.leaves, ends), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-14)


def test_a_block_of_zeros_does_nothing():
    x = state(2, 30.0)
    zeros = jax.tree.map(jnp.zeros_like, block(gentle))
    end, Phi, L = linear(x, zeros, NOISE, 4)
    for a, b in zip(jax.tree.leaves(end), jax.tree.leaves(x), strict=True):
        np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(Phi, np.eye(21))
    np.testing.assert_array_equal(L, np.zeros((21, 21)))


def test_biases_decay_with_their_time_constants():
    x = state(2, 30.0)
    end = moved(x, block(gentle, 100), NOISE)
    np.testing.assert_allclose(end.gyro_bias, x.gyro_bias * np.exp(-1.0 / 300.0), rtol=1e-14)
    np.testing.assert_allclose(end.accel_bias, x.accel_bias * np.exp(-1.0 / 200.0), rtol=1e-14)


def test_gradients_are_finite_and_right():
    """Through Phi and L, by the level of the noise, a time constant and the state."""
    x, increments = state(2, 30.0, scales=False), block(gentle, 1, 0.5)
    size = jnp.asarray(SIZE[:15])

    @jax.jit
    @jax.value_and_grad
    def value(p):
        noise = jax.tree.map(lambda a: p[0] * a, NOISE)
        noise = noise._replace(gyro_bias_tau=300.0, accel_bias_tau=200.0 * jnp.exp(p[1]))
        end, Phi, L = propagate_linear(retract(x, size * p[2]), increments, noise)
        P = Phi @ jnp.diag(size**2) @ Phi.T + L @ L.T
        return jnp.log(jnp.diag(P)).sum() + end.v_n[0]

    p = jnp.array([10.0, -0.2, 0.3])
    slope = value(p)[1]
    for k in range(3):
        h = jnp.zeros(3).at[k].set(1e-4)
        expected = float(value(p + h)[0] - value(p - h)[0]) / 2e-4
        assert float(slope[k]) == pytest.approx(expected, rel=1e-5)
    # no noise at all: L is zero, and its slope still a number
    assert np.isfinite(value(p.at[0].set(0.0))[1]).all()
