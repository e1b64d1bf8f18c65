"""Nothing known, everything known, exact and repeated measurements: finite, and right in the limit.

Rule R1 and case F21 of the fault list: after every step the state is finite and the covariance
symmetric and positive semidefinite.
"""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from dense_kalman import random_system, simulate
from interpreted import run
from jax.tree_util import Partial
from scipy import stats

from robins.filters import Belief, Code, Model, Motion, Sensor, kalman, unscented

N, M = 4, 3
EKF, UKF = kalman(), kalman(unscented())
FILTERS = pytest.mark.parametrize("one", [EKF, UKF], ids=["taylor", "unscented"])

# H and the factor of R come with each measurement, so that one compilation serves every test.
SENSOR = Sensor(lambda x, aux: aux[0] @ x, lambda x, aux: aux[1], M)
update = {one: jax.jit(one.update) for one in (EKF, UKF)}


def measure(one, start, y, H, W):
    """Update a belief by y = H x + W v."""
    state = one.init(start, {"y": M})
    state, info = update[one](state, SENSOR, jnp.array(y), (jnp.array(H), jnp.array(W)))
    return state.belief, info


def pseudo_inverse_update(m, P, y, H, R):
    """The limit of the update where the innovation covariance is singular."""
    S = H @ P @ H.T + R
    K = P @ H.T @ np.linalg.pinv(S, rcond=1e-13, hermitian=True)
    return m + K @ (y - H @ m), P - K @ S @ K.T


def belief(seed: int, scale: float = 1.0) -> tuple:
    system = random_system(seed)
    return system.m0, scale * system.P0, Belief.of(jnp.array(system.m0), scale * system.P0)


A = np.random.default_rng(0).normal(size=(M, N))
SINGULAR = {
    "nothing seen": np.zeros((M, N)),
    "a row of zeros first": np.array([np.zeros(N), A[1], A[2]]),
    "a row of zeros last": np.array([A[0], A[1], np.zeros(N)]),
    "the same twice": np.array([A[0], A[0], A[1]]),
    "a combination": np.array([A[0], A[1], 2 * A[0] - 3 * A[1]]),
    "the same three times": np.array([A[0], A[0], A[0]]),
    "independent": A,
}


@FILTERS
@pytest.mark.parametrize("H", SINGULAR.values(), ids=SINGULAR)
def test_exact_measurements_have_the_limit_of_a_pseudo_inverse(one, H):
    m, P, start = belief(1)
    y = H @ (m + np.linalg.cholesky(P) @ np.array([0.3, -1.0, 0.5, 0.8]))  # they agree
    after, info = measure(one, start, y, H, np.zeros((M, M)))
    mean, covariance = pseudo_inverse_update(m, P, y, H, np.zeros((M, M)))
    np.testing.assert_allclose(after.mean, mean, rtol=1e-9, atol=1e-10)
    np.testing.assert_allclose(after.covariance, covariance, atol=1e-10 * np.max(P))
    np.testing.assert_allclose(H @ np.asarray(after.mean), y, atol=1e-11)
    assert int(info.dof) == np.linalg.matrix_rank(H)
    assert int(info.code) == Code.DONE


@FILTERS
def test_an_exact_sensor_beside_a_noisy_one(one):
    # The second reading repeats the first and has no noise; the third must not suffer from it.
    m, P, start = belief(2)
    H, W = SINGULAR["the same twice"], np.diag([0.0, 0.0, 0.1])
    y = H @ m + np.array([0.5, 0.5, -1.0])
    after, info = measure(one, start, y, H, W)
    mean, covariance = pseudo_inverse_update(m, P, y, H, W @ W.T)
    np.testing.assert_allclose(after.mean, mean, rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(after.covariance, covariance, atol=1e-10 * np.max(P))
    assert info.used.tolist() == [True, False, True]


@FILTERS
def test_an_exact_measurement_repeated_changes_nothing(one):
    m, _, start = belief(3)
    H = np.array([[1.0, 1.0, 0.0, 0.0], [0.3, -1.0, 2.0, 0.1], [0.0, 0.0, 0.0, 1.0]])
    y = H @ m + 1.0
    once, _ = measure(one, start, y, H, np.zeros((M, M)))
    again = once
    # Agreeing or not, what is known exactly is not learnt again; but what contradicts it cannot be.
    for shift, nis in ((0.0, 0.0), (1e-3, np.inf), (-5.0, np.inf)):
        again, late = measure(one, again, y + shift, H, np.zeros((M, M)))
        assert int(late.dof) == 0
        assert float(late.nis) == -float(late.log_likelihood) == nis
    np.testing.assert_array_equal(again.mean, once.mean)
    np.testing.assert_array_equal(again.factor, once.factor)


@FILTERS
def test_what_is_known_in_part_and_exactly_gets_known_in_full(one):
    # About zero, where nothing but the covariance itself tells what is rounding.
    rng = np.random.default_rng(4)
    after, dof = Belief.of(jnp.zeros(N), np.eye(N)), []
    for _ in range(8):
        H = np.array([rng.normal(size=N), np.zeros(N), np.zeros(N)])
        after, info = measure(one, after, np.zeros(M), H, np.zeros((M, M)))
        dof.append(int(info.dof))
    assert dof == [1, 1, 1, 1, 0, 0, 0, 0]
    np.testing.assert_array_equal(after.factor, np.zeros((N, N)))


@FILTERS
@pytest.mark.parametrize("P0", [1.0, 1e12])
@pytest.mark.parametrize("R", [1e-12, 1.0])
def test_one_sensor_three_times_is_one_of_a_third_of_the_variance(one, P0, R):
    start = Belief.of(jnp.zeros(N), P0 * np.eye(N))
    H = np.tile([[1.0, 0.0, 0.0, 0.0]], (M, 1))
    y = 7.0 + np.array([-0.5, 1.5, -1.0]) * np.sqrt(R)
    after, _ = measure(one, start, y, H, np.sqrt(R) * np.eye(M))
    variance = P0 * (R / 3) / (P0 + R / 3)
    assert float(after.covariance[0, 0]) == pytest.approx(variance, rel=1e-5)
    assert float(after.mean[0]) == pytest.approx(7.0 * P0 / (P0 + R / 3), rel=1e-8)
    np.testing.assert_allclose(after.covariance[1:, 1:], P0 * np.eye(3), atol=1e-15 * P0)


@FILTERS
@pytest.mark.parametrize(("P0", "R"), [(1e12, 1e-12), (1e-12, 1e12), (1e12, 1e12), (1e-12, 1e-12)])
def test_extreme_variances_give_the_closed_form(one, P0, R):
    start = Belief.of(jnp.zeros(N), P0 * np.eye(N))
    H, y = np.eye(M, N), np.array([1.0, -2.0, 3.0]) * np.sqrt(P0 + R)
    after, info = measure(one, start, y, H, np.sqrt(R) * np.eye(M))
    np.testing.assert_allclose(after.mean[:3], y * P0 / (P0 + R), rtol=1e-10, atol=1e-16)
    np.testing.assert_allclose(after.sigma[:3] ** 2, P0 * R / (P0 + R), rtol=1e-9)
    assert float(after.sigma[3] ** 2) == pytest.approx(P0, rel=1e-12)
    assert float(info.nis) == pytest.approx(14.0, rel=1e-12)


@FILTERS
def test_with_everything_known_the_filter_only_propagates(one):
    system = random_system(5)
    known = system._replace(P0=np.zeros((N, N)), G=np.zeros((N, N)))
    _, y = simulate(system, 5, 30, 0.2)
    solution = run(one, known.model(), known.start(), y)
    x = system.m0
    for k in range(30):
        x = system.F @ x
        np.testing.assert_allclose(solution.mean[k], x, rtol=1e-12, atol=1e-13)
    assert not np.any(solution.covariance)
    info = solution.steps.info["y"]
    assert not np.any(info.gain)
    assert np.all((info.code == Code.DONE) | ~np.all(np.isfinite(y), axis=1))


def test_a_joseph_step_on_the_edge_is_right_or_says_so():
    one = kalman(form="joseph")
    joseph = jax.jit(one.update)
    m, P, start = belief(1)
    said = []
    for H in SINGULAR.values():
        for r in (0.0, 1e-12, 1e-6, 1.0):
            aux = (jnp.array(H), jnp.array(r * np.eye(M)))
            y = H @ m + r
            state, info = joseph(one.init(start, {"y": M}), SENSOR, jnp.array(y), aux)
            assert np.all(np.isfinite(state.belief.factor))
            if int(info.code) == Code.DONE and r == 1.0:
                want = pseudo_inverse_update(m, P, y, H, r * r * np.eye(M))
                np.testing.assert_allclose(state.belief.mean, want[0], rtol=1e-9, atol=1e-11)
            else:
                assert int(info.code) in (Code.DONE, Code.INDEFINITE)
            said.append(int(info.code))
    assert Code.INDEFINITE in said
    assert said.count(Code.DONE) >= len(SINGULAR)


# ---------------------------------------------------------------------------------- many steps


@cache
def extremes(seed: int, P0: float, steps: int):
    """A long run whose noise and sensors change from step to step among the worst there are."""
    rng = np.random.default_rng(seed)
    F = np.linalg.qr(rng.normal(size=(N, N)))[0]  # nothing dies out by itself
    sensors = list(SINGULAR.values())
    q = [np.zeros((N, N)), np.outer(A[0], np.eye(N)[0]), 1e-6 * np.eye(N), np.eye(N)]
    r = np.array([0.0, 1e-6, 1.0, 1e3])
    x = np.sqrt(P0) * rng.normal(size=N)
    H = np.array([sensors[i] for i in rng.integers(len(sensors), size=steps)])
    G = np.array([q[i] for i in rng.choice(4, p=[0.9, 0.04, 0.03, 0.03], size=steps)])
    W = r[rng.integers(4, size=(steps, M))][:, :, None] * np.eye(M)
    truth, y = np.empty((steps, N)), np.empty((steps, M))
    for k in range(steps):
        x = F @ x + G[k] @ rng.normal(size=N)
        truth[k] = x
        y[k] = H[k] @ x + W[k] @ rng.normal(size=M)
    y[rng.random(y.shape) < 0.1] = np.nan
    return F, G, H, W, truth, y


def turn(F, x, u):
    return F @ x


def given(x, u):
    return u


@FILTERS
@pytest.mark.parametrize("P0", [0.0, 1e12])
@pytest.mark.parametrize("seed", [1, 6])  # 6 begins with directions that differ by 1e12
@pytest.mark.parametrize("steps", [2_000, 20_000])
def test_many_steps_of_the_worst(one, P0, seed, steps):
    F, G, H, W, truth, y = extremes(seed, P0, steps)
    model = Model(Motion(Partial(turn, jnp.array(F)), given), (SENSOR,))
    start = Belief.of(jnp.zeros(N), P0 * np.eye(N))
    solution = run(one, model, start, y, G, {"y": (H, W)})
    assert np.all(np.isfinite(solution.mean))
    assert not np.any(solution.steps.prediction.code)
    info = solution.steps.info["y"]
    assert set(np.unique(info.code)) == {Code.DONE, Code.MISSING, Code.PARTLY_MISSING}

    P = np.asarray(solution.covariance)
    assert np.all(np.isfinite(P))
    np.testing.assert_array_equal(P, np.swapaxes(P, 1, 2))
    least, greatest = np.linalg.eigvalsh(P)[:, [0, -1]].T
    assert np.all(least >= -1e-15 * greatest)
    # an update never makes anything less certain
    before = np.asarray(solution.steps.prediction.belief.sigma)
    sigma = np.asarray(solution.sigma)
    assert np.all(sigma <= before * (1 + 1e-12) + 1e-14)
    # and the filter is as good as it says: errors and innovations against their covariances
    rounding = 1e-9 * (1.0 + np.max(np.abs(truth)))
    assert np.all(np.abs(np.asarray(solution.mean) - truth) <= 6.0 * sigma + rounding)
    nis, dof = np.asarray(info.nis), np.asarray(info.dof)
    assert 0.3 * y.size < dof.sum() < 0.8 * y.size
    low, high = stats.chi2.ppf([1e-4, 1 - 1e-4], dof.sum())
    assert low < nis.sum() < high
