"""Fading by the innovations of a window, and by age, against recursions and least squares."""

import jax.numpy as jnp
import numpy as np
import pytest
from dense_kalman import kalman_filter, random_system, simulate, times
from interpreted import run
from jax.tree_util import Partial
from rule_table import START as PRIOR
from rule_table import seen
from two_sensors import ROWS, by_sensor, split

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
from robins.filters.rules.fading_memory import fading_memory, per_step
from robins.filters.rules.innovation_fading import innovation_fading
from robins.filters.rules.sage_husa import sage_husa
from robins.filters.rules.variational_bayes import variational_bayes

T = 30
SYSTEM = random_system(2)
MODEL, START = SYSTEM.model(), SYSTEM.start()
Y = 2.5 * simulate(SYSTEM, 2, T, 0.2)[1]  # larger than the filter is told


# ----------------------------------------------------------------------------- innovation fading


def dense_innovation_fading(window, limit):
    """Means, covariances and the factor of each sensor, one step fading once at most."""
    m, P = SYSTEM.m0, SYSTEM.P0
    seen: list[list[float]] = [[], [], []]
    means, covariances, factors = [], [], []
    for k in range(T):
        m, P = SYSTEM.F @ m, SYSTEM.F @ P @ SYSTEM.F.T + SYSTEM.Q
        faded, row = False, []
        for part in ROWS.values():
            here = np.flatnonzero(np.isfinite(Y[k, part])) + part.start
            if not len(here):
                row.append(1.0)
                continue
            H, e = SYSTEM.H[here], Y[k, here] - SYSTEM.H[here] @ m
            R = SYSTEM.R[np.ix_(here, here)]
            for i, one, r in zip(here, e, np.diag(R), strict=True):
                seen[i] = [*seen[i], one**2 / r][-window:]
            full = [len(seen[i]) == window for i in here]
            above = sum(np.mean(seen[i]) - 1 for i in here[full])
            explained = np.sum((np.diag(H @ P @ H.T) / np.diag(R))[full])
            factor = above / explained if any(full) else 1.0
            factor = 1.0 if faded else min(max(factor, 1.0), limit)
            faded = faded or factor > 1.0
            P = factor * P
            K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
            m, P = m + K @ e, (np.eye(4) - K @ H) @ P
            row.append(factor)
        means.append(m)
        covariances.append(P)
        factors.append(row)
    return np.array(means), np.array(covariances), np.array(factors)


def test_innovation_fading_is_its_recursion():
    one = kalman(rules=[innovation_fading(4, 3.0)])
    solution = run(one, split(SYSTEM), START, by_sensor(Y))
    means, covariances, factors = dense_innovation_fading(4, 3.0)
    np.testing.assert_allclose(solution.mean, means, rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(solution.covariance, covariances, rtol=1e-8, atol=1e-9)
    for name, factor in zip(ROWS, factors.T, strict=True):
        noted = solution.steps.info[name].notes["innovation_fading.lambda"]
        np.testing.assert_allclose(noted, factor, rtol=1e-8)
        assert {1.0, 3.0} <= set(factor)
        assert np.any((factor > 1.0) & (factor < 3.0))
    assert not np.any(np.all(factors > 1.0, axis=1))


def test_the_factor_by_hand():
    rule = innovation_fading(2, 100.0)
    memory = rule.init(PRIOR, {"y": 2})

    def factor(memory, o):
        memory, prior, o = rule.before(memory, PRIOR, o)
        times_ = np.asarray(prior.factor[0, 0] / PRIOR.factor[0, 0]) ** 2
        noted = float(o.notes["innovation_fading.lambda"])
        assert noted == pytest.approx(times_, rel=1e-14)
        return noted, memory._replace(faded=jnp.array(False))

    # one sample does not fill a window of two
    first, memory = factor(memory, seen([6.0, 4.0]))
    assert first == 1.0
    # the second component is refused: only the first counts, over its two samples
    second, memory = factor(memory, seen([4.0, 1e6], accepted=(True, False)))
    assert second == pytest.approx(((36 + 16) / 2 / 4 - 1) / (5.25 / 4), rel=1e-14)
    assert memory.windows["y"].filled.tolist() == [2, 1]
    # the window of two has forgotten the 6, and what a deficit takes is not the state's
    third, memory = factor(memory, seen([4.0, 4.0], deficit=jnp.array([1.0, 0.0])))
    assert third == pytest.approx((16 / 4 - 1 + 16 / 2 - 1) / (4.25 / 4 + 2 / 2), rel=1e-14)
    # an outlier that a robust weight has made light does not fade
    light = seen([1e3, 0.0])._replace(noise=1e3 * seen([0.0, 0.0]).noise)
    _, memory = factor(memory, light)
    assert factor(memory, light)[0] == 1.0


def test_a_step_is_faded_once():
    rule = innovation_fading(1, 100.0)
    memory = rule.init(PRIOR, {"y": 2})
    memory, faded, o = rule.before(memory, PRIOR, seen([9.0, 9.0]))
    assert float(o.notes["innovation_fading.lambda"]) > 1.0
    memory, again, o = rule.before(memory, faded, seen([9.0, 9.0]))
    assert float(o.notes["innovation_fading.lambda"]) == 1.0
    np.testing.assert_array_equal(again.factor, faded.factor)


# --------------------------------------------------------------------------------- fading memory


def test_fading_memory_weighs_data_by_age():
    # Without process noise the filter solves one least-squares problem, here solved at a stroke.
    alpha, still = 1.1, SYSTEM._replace(G=np.zeros((4, 4)))
    solution = run(kalman(rules=[fading_memory(alpha)]), still.model(), START, Y)
    root = np.linalg.inv(np.linalg.cholesky(SYSTEM.P0))
    rows, right = [alpha**-T * root], [alpha**-T * root @ SYSTEM.m0]
    ahead = np.eye(4)
    for k in range(T):
        ahead = SYSTEM.F @ ahead
        here = np.isfinite(Y[k])
        if np.any(here):
            root = np.linalg.inv(np.linalg.cholesky(SYSTEM.R[np.ix_(here, here)]))
            weight = alpha ** -(T - 1 - k)
            rows.append(weight * root @ SYSTEM.H[here] @ ahead)
            right.append(weight * root @ Y[k, here])
    first = np.linalg.lstsq(np.concatenate(rows), np.concatenate(right), rcond=None)[0]
    np.testing.assert_allclose(solution.mean[-1], ahead @ first, rtol=1e-8, atol=1e-10)
    # and what is smoothed lies on one trajectory, as it must without process noise
    smooth = rts_smoother(solution)
    for k in range(T - 1):
        moved = SYSTEM.F @ np.asarray(smooth.mean[k])
        np.testing.assert_allclose(moved, smooth.mean[k + 1], rtol=1e-7, atol=1e-8)


def test_fading_memory_is_its_recursion():
    one = kalman(unscented(), [fading_memory(1.1)], form="joseph")
    solution = run(one, MODEL, START, Y)
    m, P = SYSTEM.m0, SYSTEM.P0
    for k in range(T):
        step = SYSTEM._replace(m0=m, P0=1.21 * P)
        (m,), (P,), _, _ = kalman_filter(step, Y[k : k + 1])
        np.testing.assert_allclose(solution.mean[k], m, rtol=1e-8, atol=1e-9)
        np.testing.assert_allclose(solution.covariance[k], P, rtol=1e-8, atol=1e-9)
    np.testing.assert_array_equal(
        solution.steps.info["y"].notes["fading_memory.factor"], np.full(T, 1.1)
    )


def test_a_time_constant_is_what_it_says():
    assert per_step(20.0, 0.1) ** (-2 * 200) == pytest.approx(np.exp(-1.0), rel=1e-12)
    assert per_step(np.inf, 0.1) == 1.0


# ------------------------------------------------------------------- everything, against the worst


def test_all_that_adapts_survives_the_worst():
    # Nothing known at first, exact, repeated and missing readings, at times no process noise.
    rng = np.random.default_rng(3)
    steps, n, m = 2000, 4, 3
    F = np.linalg.qr(rng.normal(size=(n, n)))[0]
    A = rng.normal(size=(m, n))
    kinds = [A, np.zeros((m, n)), np.array([A[0], A[0], A[1]]), np.array([A[0], A[1], 0 * A[0]])]
    H = np.array(kinds)[rng.integers(4, size=steps)]
    W = np.array([0.0, 1e-6, 1.0, 1e3])[rng.integers(4, size=(steps, m))][:, :, None] * np.eye(m)
    G = rng.choice([0.0, 1.0], p=[0.9, 0.1], size=steps)[:, None, None] * np.eye(n)
    x, y = 1e6 * rng.normal(size=n), np.empty((steps, m))
    for k in range(steps):
        x = F @ x + G[k] @ rng.normal(size=n)
        y[k] = H[k] @ x + W[k] @ rng.normal(size=m)
    y[rng.random(y.shape) < 0.1] = np.nan
    y[[50, 700]] = [[1e9, 0.0, 1e9], [1e308, -1e308, np.inf]]
    sensor = Sensor(lambda x, aux: aux[0] @ x, lambda x, aux: aux[1], m)
    model = Model(Motion(Partial(times, jnp.array(F)), lambda x, u: u), (sensor,))
    rules = [sage_husa(adapt="QR"), variational_bayes(), innovation_fading(), fading_memory(1.001)]
    start = Belief.of(jnp.zeros(n), 1e12 * np.eye(n))
    with pytest.warns(StepWarning, match="1 of 2000 updates with 'y' are NOT_FINITE"):
        solution = run(kalman(rules=rules), model, start, y, G, {"y": (H, W)})
    P = np.asarray(solution.covariance)
    assert np.all(np.isfinite(solution.mean))
    assert np.all(np.isfinite(P))
    least, greatest = np.linalg.eigvalsh(P)[:, [0, -1]].T
    assert np.all(least >= -1e-15 * greatest)
    codes = np.asarray(solution.steps.info["y"].code)
    assert np.flatnonzero(codes == Code.NOT_FINITE).tolist() == [700]
    assert not np.any(codes == Code.INDEFINITE)
