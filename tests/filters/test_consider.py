"""Schmidt's filter, against its partitioned equations and against many true errors."""

import jax.numpy as jnp
import numpy as np
import pytest
from dense_kalman import kalman_filter, random_system, simulate, times
from interpreted import run
from jax.tree_util import Partial

from robins.filters import Belief, Model, Motion, Sensor, cubature, kalman, taylor
from robins.filters.rules import gate
from robins.filters.rules.consider import consider
from robins.rotation import Rotation

SYSTEM = random_system(7)
T, HELD = 15, [1, 3]
KEPT = [0, 2]
Y = simulate(SYSTEM, 3, T, 0.25)[1]
Y[4] = np.nan
MODEL, START = SYSTEM.model(), SYSTEM.start()


def gains_and_covariances(y):
    """Gain of x alone, and P_xx, P_xp updated, P_pp kept, by blocks (Schmidt 1966)."""
    order = np.array(KEPT + HELD)
    F, H = SYSTEM.F[np.ix_(order, order)], SYSTEM.H[:, order]
    Q, P = SYSTEM.Q[np.ix_(order, order)], SYSTEM.P0[np.ix_(order, order)]
    m, x = SYSTEM.m0[order], slice(0, len(KEPT))
    p = slice(len(KEPT), len(order))
    means, covariances = [], []
    for row in y:
        m, P = F @ m, F @ P @ F.T + Q
        here = np.isfinite(row)
        Hx, Hp = H[here][:, x], H[here][:, p]
        R = SYSTEM.R[np.ix_(here, here)]
        seen = P[x, x] @ Hx.T + P[x, p] @ Hp.T
        W = Hx @ P[x, x] @ Hx.T + Hx @ P[x, p] @ Hp.T + R
        W = W + Hp @ P[p, x] @ Hx.T + Hp @ P[p, p] @ Hp.T
        K = seen @ np.linalg.inv(W)
        P_new = P.copy()
        P_new[x, x] = P[x, x] - K @ seen.T
        P_new[x, p] = P[x, p] - K @ (Hx @ P[x, p] + Hp @ P[p, p])
        P_new[p, x] = P_new[x, p].T
        m = m.copy()
        m[x] = m[x] + K @ (row[here] - Hx @ m[x] - Hp @ m[p])
        P = P_new
        means.append(m)
        covariances.append(P)
    back = np.argsort(order)
    return np.array(means)[:, back], np.array(covariances)[:, back][:, :, back]


@pytest.mark.parametrize(("way", "form"), [(taylor(), "sqrt"), (cubature(), "joseph")])
def test_the_partitioned_equations(way, form):
    solution = run(kalman(way, [consider(HELD)], form), MODEL, START, Y)
    means, covariances = gains_and_covariances(Y)
    np.testing.assert_allclose(solution.mean, means, rtol=1e-9, atol=1e-10)
    np.testing.assert_allclose(solution.covariance, covariances, rtol=1e-9, atol=1e-10)
    gain = np.asarray(solution.steps.info["y"].gain)
    assert not np.any(gain[:, HELD])
    assert np.all(np.any(gain[:, KEPT] != 0.0, axis=(1, 2)) == np.any(np.isfinite(Y), axis=1))
    # neither moved nor known better: exactly as predicted
    predicted = solution.steps.prediction.belief
    np.testing.assert_array_equal(solution.mean[:, HELD], predicted.mean[:, HELD])
    block = np.ix_(range(T), HELD, HELD)
    np.testing.assert_allclose(solution.covariance[block], predicted.covariance[block], rtol=1e-11)
    np.testing.assert_array_equal(solution.steps.posterior.factor[4], predicted.factor[4])


def test_the_covariance_is_that_of_the_errors_and_above_the_best():
    """True errors through the filter's gains, by the sum that holds for any gain."""
    y = np.where(np.isnan(Y), 0.0, Y)
    solution = run(kalman(rules=[consider(HELD)]), MODEL, START, y)
    true = SYSTEM.P0
    for K, P in zip(np.asarray(solution.steps.info["y"].gain), solution.covariance, strict=True):
        left = np.eye(4) - K @ SYSTEM.H
        true = left @ (SYSTEM.F @ true @ SYSTEM.F.T + SYSTEM.Q) @ left.T + K @ SYSTEM.R @ K.T
        np.testing.assert_allclose(P, true, rtol=1e-9, atol=1e-10)
    best = kalman_filter(SYSTEM, y)[1]
    for P, P_best in zip(np.asarray(solution.covariance), best, strict=True):
        assert np.linalg.eigvalsh(P - P_best)[0] > -1e-12 * np.trace(P)
    assert np.trace(P) > 1.05 * np.trace(best[-1])


def test_an_exact_sensor_an_infinite_start_and_another_rule():
    # P0 = 1e12, R = 1e-12: K times S_y must not lose what was put back.
    start = Belief.of(jnp.zeros(3), np.diag([1e12, 1e12, 4.0]))
    H = jnp.array([[1.0, 0.0, 1.0], [1.0, 0.0, 1.0]])
    motion = Motion(lambda x, u: x, jnp.zeros(3))
    for sigma in (1e-6, 0.0):
        sensor = Sensor(Partial(times, H), jnp.full(2, sigma), 2)
        one = kalman(rules=[consider(np.array([False, False, True])), gate()])
        solution = run(one, Model(motion, (sensor,)), start, jnp.full((3, 2), 7.0))
        P = np.asarray(solution.covariance[-1])
        np.testing.assert_allclose(P[2], [-4.0, 0.0, 4.0], rtol=1e-6, atol=1e-6)
        assert P[0, 0] == pytest.approx(4.0, rel=1e-6)
        assert float(solution.mean[-1][0]) == pytest.approx(7.0, rel=1e-9)
        assert float(solution.mean[-1][2]) == 0.0
        assert np.all(np.isfinite(solution.steps.info["y"].notes["consider.withheld"]))


def test_a_considered_bias_beside_a_rotation():
    def read(x, aux):
        return x["attitude"].inverse().apply(jnp.array([0.0, 0.6, 0.8])) + x["bias"]

    motion = Motion(lambda x, u: x, jnp.zeros(6))
    one = kalman(rules=[consider(range(3, 6))])
    mean = {"attitude": Rotation.from_euler(0.05, 0.02, -3.1), "bias": jnp.zeros(3)}
    start = Belief.of(mean, np.diag([0.1] * 3 + [0.02] * 3) ** 2)
    y = jnp.tile(jnp.array([0.03, 0.55, 0.85]), (4, 1)).at[1, 0].set(jnp.nan).at[2].set(jnp.nan)

    model = Model(motion, (Sensor(read, jnp.full(3, 0.01), 3),))
    solution = run(one, model, start, y)
    np.testing.assert_array_equal(solution.mean["bias"], np.zeros((4, 3)))
    np.testing.assert_allclose(solution.sigma[:, 3:], 0.02, rtol=1e-12)
    # More looks at the same stars do not make the attitude better than the bias lets it.
    assert np.all(solution.sigma[-1, :3] > 0.015)
