"""The smoother against the posterior of all states at once."""

from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from dense_kalman import posterior, random_system
from interpreted import run

from robins import manifold
from robins.filters import (
    Belief,
    Code,
    Model,
    Motion,
    Sensor,
    StepWarning,
    kalman,
    rts_smoother,
    unscented,
)
from robins.filters.analysis.consistency import nees
from robins.filters.chi_square import chi2_band
from robins.rotation import Rotation

N, M, T = 4, 2, 12
MODEL = Model(
    Motion(lambda x, u: u[0] @ x, lambda x, u: u[1]),
    (Sensor(lambda x, aux: aux[0] @ x, lambda x, aux: aux[1], M),),
)
EKF, UKF = kalman(), kalman(unscented(1.0, 0.0, 0.0))


def time_varying(seed: int, rank: int = N) -> tuple:
    """Another system at each step, and its measurements, some of them missing."""
    rng = np.random.default_rng(seed)
    systems = [random_system(100 * seed + k, n=N, m=M) for k in range(T)]
    F, G, H, W = (np.stack([s[i] for s in systems]) for i in range(4))
    F = 0.98 * np.linalg.qr(F)[0]  # a state that contracts cannot be traced back without noise
    G = np.where(np.arange(N) < rank, G, 0.0)
    y = np.einsum("kij,j->ki", H, rng.normal(size=N)) + rng.normal(size=(T, M))
    y[rng.random((T, M)) < 0.3] = np.nan
    return F, G, H, W, systems[0].m0, systems[0].P0, y


def both(one, system):
    """The package's smoothed beliefs, and means and covariances of the joint posterior."""
    F, G, H, W, m0, P0, y = system
    solution = run(one, MODEL, Belief.of(jnp.array(m0), P0), y, (F, G), {"y": (H, W)})
    Q, R = (A @ np.swapaxes(A, 1, 2) for A in (G, W))
    return solution, rts_smoother(solution), posterior(F, Q, H, R, m0, P0, y)


def agree(smooth, want, tolerance):
    size = np.sqrt(np.max(np.abs(want[1]), axis=(1, 2)))
    assert np.all(np.abs(smooth.mean - want[0]) <= tolerance * (1 + np.abs(want[0])))
    worst = np.max(np.abs(smooth.covariance - want[1]), axis=(1, 2))
    assert np.all(worst <= tolerance * (size**2 + 1e-2)), worst


@pytest.mark.parametrize("one", [EKF, UKF], ids=["taylor", "unscented"])
def test_the_smoother_finds_the_posterior_of_all_states(one):
    for seed in range(5):
        solution, smooth, want = both(one, time_varying(seed))
        agree(smooth, want, 1e-9)
        last = jax.tree.map(lambda x: x[-1], solution.steps.posterior)
        np.testing.assert_array_equal(smooth.mean[-1], last.mean)
        np.testing.assert_array_equal(smooth.factor[-1], last.factor)
        assert np.all(smooth.sigma <= solution.sigma * (1 + 1e-9))


@pytest.mark.parametrize("one", [EKF, UKF], ids=["taylor", "unscented"])
@pytest.mark.parametrize("rank", [0, 1, 2])
def test_with_less_noise_than_states(one, rank):
    for seed in range(3):
        agree(*both(one, time_varying(seed, rank))[1:], 1e-9)


@pytest.mark.parametrize("rank", [0, 1])
def test_with_part_of_the_start_known_the_prediction_is_singular(rank):
    F, G, H, W, m0, _, y = time_varying(7, rank)
    F[:, :, 0] = np.eye(N)[0]  # a constant that moves nothing else: known for ever
    F[:, 0] = np.eye(N)[0]
    G[:, 0] = 0.0
    P0 = np.diag([0.0, 1.0, 2.0, 0.5])
    _, smooth, want = both(EKF, (F, G, H, W, m0, P0, y))
    agree(smooth, want, 1e-9)
    np.testing.assert_array_equal(smooth.sigma[:, 0], np.zeros(T))
    np.testing.assert_array_equal(smooth.mean[:, 0], np.full(T, m0[0]))


def inverse(rows):
    """Inverse of a matrix of fractions, by elimination."""
    n = len(rows)
    work = [[*row, *(Fraction(int(i == j)) for j in range(n))] for i, row in enumerate(rows)]
    for i in range(n):
        pivot = next(k for k in range(i, n) if work[k][i])
        work[i], work[pivot] = work[pivot], work[i]
        work[i] = [x / work[i][i] for x in work[i]]
        for k in range(n):
            if k != i:
                work[k] = [x - work[k][i] * a for x, a in zip(work[k], work[i], strict=True)]
    return np.array([row[n:] for row in work])


def in_fractions(F, H, m0, P0, y):
    """Posterior of all states where Q = 0 and R = I, by least squares without rounding."""
    exact = np.vectorize(Fraction, otypes=[object])
    F, H, m0, y = exact(F), exact(H), exact(m0), exact(y)
    A, information = exact(np.eye(N)), inverse(exact(P0))
    moved, told = [], information @ m0
    for Fk, Hk, yk in zip(F, H, y, strict=True):
        A = Fk @ A
        moved.append(A)
        seen = Hk @ A
        information, told = information + seen.T @ seen, told + seen.T @ yk
    P = inverse(information)
    m = P @ told
    return tuple(
        np.array([f(a) for a in moved], float) for f in (lambda a: a @ m, lambda a: a @ P @ a.T)
    )


@pytest.mark.parametrize("shrinks", [0.01, 0.05, 0.06, 0.07, 0.3])
def test_a_direction_squeezed_to_rounding_comes_back_from_the_past(shrinks):
    # Without noise the motion makes one direction 1e-14 of the others, so that the predicted
    # covariance holds little else of it than rounding.
    rng = np.random.default_rng(7)
    V = rng.normal(size=(N, N))
    F = np.tile(V @ np.diag([shrinks, 0.9, 1.0, 0.95]) @ np.linalg.inv(V), (T, 1, 1))
    H, y = np.tile(rng.normal(size=(M, N)), (T, 1, 1)), rng.normal(size=(T, M))
    still, unit = np.zeros((T, N, N)), np.tile(np.eye(M), (T, 1, 1))
    m0, P0 = rng.normal(size=N), 4.0 * np.eye(N)
    solution = run(EKF, MODEL, Belief.of(jnp.array(m0), P0), y, (F, still), {"y": (H, unit)})
    smooth = rts_smoother(solution)
    mean, P = in_fractions(F, H, m0, P0, y)
    worst = np.max(np.abs(smooth.covariance - P), axis=(1, 2)) / np.max(np.abs(P), axis=(1, 2))
    assert np.all(worst < 1e-7), worst
    # In units of the posterior's own axes, at the first step, where none is rounding yet.
    axes = np.linalg.inv(np.linalg.cholesky(P[0]))
    assert np.linalg.norm(axes @ (smooth.covariance[0] - P[0]) @ axes.T, 2) < 1e-6
    assert np.linalg.norm(axes @ (smooth.mean[0] - mean[0])) < 1e-6


def test_states_nearly_the_same_are_told_apart_by_what_comes_later():
    # Two states 1e-9 apart, with a sensor of their difference: that is no rounding.
    apart = 1e-9
    S0 = np.array([[1.0, 0, 0, 0], [1.0, apart, 0, 0], [0, 0, 1.0, 0], [0, 0, 0, 1.0]])
    H = np.array([[1.0 / apart, -1.0 / apart, 0, 0], [0, 0, 1.0, 0]])
    data = (np.tile(np.eye(N), (T, 1, 1)), np.zeros((T, N, N)))
    aux = {"y": (np.tile(H, (T, 1, 1)), np.tile(np.eye(M), (T, 1, 1)))}
    start = Belief(jnp.zeros(N), jnp.array(S0))
    smooth = rts_smoother(run(EKF, MODEL, start, np.zeros((T, M)), data, aux))
    difference = smooth.factor[:, 0] - smooth.factor[:, 1]
    variance = np.sum(difference**2, axis=1)
    np.testing.assert_allclose(variance, apart**2 / (1 + T), rtol=1e-5)


def test_a_prediction_that_was_not_taken_holds_the_state():
    F, G, H, W, m0, P0, y = time_varying(3)
    F[5] = np.nan
    with pytest.warns(StepWarning, match="1 of 12 predictions are NOT_FINITE"):
        solution = run(EKF, MODEL, Belief.of(jnp.array(m0), P0), y, (F, G), {"y": (H, W)})
    assert np.flatnonzero(solution.steps.prediction.code).tolist() == [5]
    assert int(solution.steps.prediction.code[5]) == Code.NOT_FINITE
    smooth = rts_smoother(solution)
    np.testing.assert_array_equal(smooth.mean[4], smooth.mean[5])
    interpreted = rts_smoother(solution, machine="vm")
    np.testing.assert_allclose(interpreted.mean, smooth.mean, rtol=1e-11, atol=1e-12)
    np.testing.assert_allclose(interpreted.covariance, smooth.covariance, rtol=1e-11, atol=1e-12)
    # Which is what a step of no motion, no noise and no measurement would be.
    F[5], G[5], y[5] = np.eye(N), 0.0, np.nan
    agree(smooth, both(EKF, (F, G, H, W, m0, P0, y))[2], 1e-9)


def test_smoothing_wants_the_steps():
    F, G, H, W, m0, P0, y = time_varying(3)
    start = Belief.of(jnp.array(m0), P0)
    solution = run(EKF, MODEL, start, y, (F, G), {"y": (H, W)}, keep=lambda step: step.posterior)
    with pytest.raises(ValueError, match="leave `keep` at its default"):
        rts_smoother(solution)


def test_a_smoothed_attitude_is_as_good_as_it_says():
    # A gyro with a bias, and the direction of one known vector: heading comes by smoothing.
    runs, steps, dt = 60, 40, 1.0
    noise = jnp.array([2e-3] * 3 + [1e-4] * 3)
    north, down = jnp.array([1.0, 0.0, 0.0]), jnp.array([0.0, 0.0, 1.0])

    def step(x, rate_b):
        attitude, bias = x
        return attitude @ Rotation.from_rotvec((rate_b - bias) * dt), bias

    def read(x, vector):
        return x[0].inverse().apply(vector)

    model = Model(Motion(step, noise), (Sensor(read, jnp.full(3, 0.01), 3),))
    sigma = jnp.array([0.05] * 3 + [0.01] * 3)
    vectors = jnp.where((jnp.arange(steps) % 8 == 7)[:, None], north[None], down[None])

    def one_run(key):
        keys = jax.random.split(key, 4)
        start = (Rotation.from_euler(0.1, 0.2, 0.5), jnp.zeros(3))
        rates = 0.2 * jax.random.normal(keys[0], (steps, 3))
        x = manifold.retract(start, sigma * jax.random.normal(keys[1], (6,)))

        def move(x, row):
            rate, push, wobble, vector = row
            x = manifold.retract(step(x, rate), noise * push)
            return x, (x, read(x, vector) + 0.01 * wobble)

        pushes = jax.random.normal(keys[2], (steps, 6))
        wobbles = jax.random.normal(keys[3], (steps, 3))
        _, (truth, y) = jax.lax.scan(move, x, (rates, pushes, wobbles, vectors))
        solution = run(EKF, model, Belief(start, jnp.diag(sigma)), y, rates, {"y": vectors})
        filtered, smooth = solution.steps.posterior, rts_smoother(solution)
        error = jax.vmap(manifold.local)(smooth.mean, truth)
        raw = jax.vmap(manifold.local)(filtered.mean, truth)
        return jax.vmap(nees)(smooth, truth), error, raw

    values, error, raw = jax.jit(jax.vmap(one_run))(jax.random.split(jax.random.key(1), runs))
    mean = np.mean(values, axis=0) / 6
    low, high = chi2_band(6, runs, 0.999) / 6
    assert np.all((mean > low) & (mean < high))
    half = slice(0, steps // 2)
    rms, before = (np.sqrt(np.mean(np.asarray(e)[:, half] ** 2, axis=(0, 1))) for e in (error, raw))
    assert np.all(rms[:3] < 0.8 * before[:3])
    assert np.all(rms[3:] < 0.6 * before[3:])
