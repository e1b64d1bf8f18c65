"""Bounds: the nearest state inside by trying every active set, the cut density by sampling."""

import itertools
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from dense_kalman import random_system, simulate
from interpreted import run
from scipy import stats

from robins.filters import Belief, Model, Motion, Sensor, kalman, unscented
from robins.filters.limits.interval import clip, truncate, truncated_moments
from robins.filters.rules.inequality import inequality
from robins.manifold import Angle

C, DRAWS = 4, 60
CLIP = jax.jit(jax.vmap(lambda m, S, D, low, high: clip(Belief(m, S), D, low, high)))
one_clip = jax.jit(clip, static_argnums=4)


def by_enumeration(m, V, D, low, high):
    """The nearest state of all that some set of active bounds gives, or None."""
    best, W = None, np.linalg.inv(V)
    for side in itertools.product((-1, 0, 1), repeat=len(D)):
        on = np.array(side) != 0
        value = np.where(np.array(side) < 0, low, high)[on]
        A = D[on]
        if not np.all(np.isfinite(value)) or np.linalg.matrix_rank(A) < np.sum(on):
            continue
        x = m + V @ A.T @ np.linalg.solve(A @ V @ A.T, value - A @ m) if np.any(on) else m
        if np.all(D @ x >= low - 1e-9) and np.all(D @ x <= high + 1e-9):
            cost = (x - m) @ W @ (x - m)
            if best is None or cost < best[0]:
                best = cost, x
    return None if best is None else best[1]


def problems(n, seed):
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(DRAWS, n, n))
    D = rng.normal(size=(DRAWS, C, n))
    inside = (D @ rng.normal(size=(DRAWS, n, 1)))[..., 0]
    centre = np.where(rng.random((DRAWS, 1)) < 0.7, inside, 2 * rng.normal(size=(DRAWS, C)))
    low = centre - rng.exponential(size=centre.shape) * (rng.random(centre.shape) < 0.7)
    high = centre + rng.exponential(size=centre.shape)
    low = np.where(rng.random(low.shape) < 0.2, -np.inf, low)
    high = np.where(rng.random(low.shape) < 0.2, np.inf, high)
    P = A @ np.swapaxes(A, 1, 2) + 0.01 * np.eye(n)
    return 3 * rng.normal(size=(DRAWS, n)), P, D, low, high


@pytest.mark.parametrize("n", [2, 4])
def test_the_nearest_state_inside(n):
    m, P, D, low, high = problems(n, n)
    S = np.linalg.cholesky(P)
    kept = jax.tree_util.tree_map(np.asarray, CLIP(m, S, D, low, high))
    impossible, moved = 0, 0
    for k in range(DRAWS):
        want = by_enumeration(m[k], P[k], D[k], low[k], high[k])
        assert bool(kept.infeasible[k]) == (want is None)
        impossible += want is None
        want = m[k] if want is None else want
        moved += not np.array_equal(want, m[k])
        np.testing.assert_allclose(kept.belief.mean[k], want, rtol=1e-9, atol=1e-9)
        reading = D[k] @ m[k]
        np.testing.assert_array_equal(kept.outside[k], (reading < low[k]) | (reading > high[k]))
    np.testing.assert_array_equal(kept.belief.factor, S)
    assert moved > DRAWS / 2
    assert impossible > 0 or n == 4  # four bounds on four states can always be met


def test_far_outside_and_known_exactly():
    S = jnp.diag(jnp.array([1e-6, 1.0, 0.0]))
    m = jnp.array([-1.0, 5.0, -2.0])  # a million deviations off; and off without doubt
    bounds = jnp.eye(3), jnp.zeros(3), jnp.array([np.inf, 4.0, np.inf])
    kept = one_clip(Belief(m, S), *bounds)
    np.testing.assert_allclose(kept.belief.mean, [0.0, 4.0, -2.0], atol=1e-12)
    assert bool(kept.infeasible)  # by what is known exactly
    assert not bool(one_clip(Belief(m.at[2].set(0.0), S), *bounds).infeasible)
    again = one_clip(kept.belief, *bounds)
    np.testing.assert_array_equal(again.belief.mean, kept.belief.mean)
    cut = jax.jit(truncate)(Belief(m, S), *bounds)
    assert np.all(np.isfinite(cut.belief.factor))
    want = [0.0, stats.truncnorm(-5.0, -1.0, loc=5.0).mean(), -2.0]
    np.testing.assert_allclose(cut.belief.mean, want, rtol=1e-12, atol=1e-11)


@pytest.mark.parametrize(("metric", "want"), [("covariance", 0.9), ("identity", 0.0)])
def test_the_metric_may_be_another(metric, want):
    belief = Belief.of(np.array([-1.0, 0.0, 0.0]), np.array([[1, 0.9, 0], [0.9, 1, 0], [0, 0, 1]]))
    bounds = jnp.eye(3), jnp.array([0.0, -np.inf, -np.inf]), jnp.full(3, np.inf)
    kept = one_clip(belief, *bounds, metric).belief.mean
    np.testing.assert_allclose(kept, [0.0, want, 0.0], atol=1e-14)


# ------------------------------------------------------------------------------------ truncation

INTERVALS = [(-1.0, 2.0), (0.0, np.inf), (3.0, np.inf), (-np.inf, -2.0), (0.3, 0.31), (-5.0, 30.0)]


def test_moments_of_a_cut_normal_number():
    low, high = np.array(INTERVALS).T
    mean, variance = jax.vmap(truncated_moments)(low, high)
    want = stats.truncnorm(low, high)
    np.testing.assert_allclose(mean, want.mean(), rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(variance, want.var(), rtol=1e-8)  # scipy's, by subtraction
    # far out, from the asymptotic series of the ratio of Mills
    for a in (1e2, 1e4, 1e7):
        mean, variance = truncated_moments(jnp.array(a), jnp.array(jnp.inf))
        assert float(mean) == pytest.approx(a + 1 / a - 2 / a**3 + 10 / a**5, rel=1e-14)
        assert float(variance) == pytest.approx(1 / a**2 - 6 / a**4 + 50 / a**6, rel=1e-9)
        other = truncated_moments(jnp.array(-jnp.inf), jnp.array(-a))
        np.testing.assert_allclose(other, [-float(mean), float(variance)], rtol=1e-14)
    assert [float(x) for x in truncated_moments(jnp.array(2.0), jnp.array(2.0))] == [2.0, 0.0]


def test_one_cut_is_the_density_inside():
    rng = np.random.default_rng(3)
    m, A = np.array([0.4, -0.2, 1.0]), rng.normal(size=(3, 3))
    P, D = A @ A.T, np.array([[1.0, -0.5, 0.3]])
    low, high = D @ m + 0.3, D @ m + 2.5
    cut = truncate(Belief.of(m, P), D, low, high).belief
    x = rng.multivariate_normal(m, P, size=500_000)
    x = x[(x @ D[0] >= low[0]) & (x @ D[0] <= high[0])]
    sigma = np.sqrt(np.diag(P))
    many = np.sqrt(len(x))
    assert np.max(np.abs(cut.mean - x.mean(axis=0)) / sigma) < 5 / many
    assert np.max(np.abs(cut.covariance - np.cov(x.T)) / np.outer(sigma, sigma)) < 10 / many
    s = np.sqrt((D @ P @ D.T)[0, 0])
    want = stats.truncnorm(0.3 / s, 2.5 / s, loc=D @ m, scale=s)
    np.testing.assert_allclose(D @ cut.mean, want.mean(), rtol=1e-10)
    np.testing.assert_allclose(D @ cut.covariance @ D.T, [want.var()], rtol=1e-8)


def test_cuts_that_are_not_correlated_do_not_see_each_other():
    belief = Belief.of(np.array([0.5, -1.0]), np.diag([4.0, 0.25]))
    low, high = np.array([0.0, -np.inf]), np.array([np.inf, -1.5])
    cut = truncate(belief, np.eye(2), low, high).belief
    for i, sigma in enumerate((2.0, 0.5)):
        at = float(belief.mean[i])
        want = stats.truncnorm((low[i] - at) / sigma, (high[i] - at) / sigma, at, sigma)
        assert float(cut.mean[i]) == pytest.approx(want.mean(), rel=1e-11)
        assert float(cut.sigma[i]) == pytest.approx(want.std(), rel=1e-9)


def test_no_cut_makes_a_covariance_grow():
    m, P, D, low, high = problems(3, 9)
    S = np.linalg.cholesky(P)
    one = lambda m, S, D, low, high: truncate(Belief(m, S), D, low, high)  # noqa: E731
    after = np.asarray(jax.jit(jax.vmap(one))(m, S, D, low, high).belief.covariance)
    assert np.all(np.linalg.eigvalsh(P - after)[:, 0] > -1e-12 * np.trace(P, axis1=1, axis2=2))
    assert np.all(np.linalg.eigvalsh(after)[:, 0] >= 0.0)


# --------------------------------------------------------------------------------------- the rule

SYSTEM = random_system(6)
MODEL, START = SYSTEM.model(), SYSTEM.start()
Y = simulate(SYSTEM, 8, 12, 0.2)[1]
Y[5] = np.nan
D = np.array([[1.0, 0.0, 0.5, 0.0]])


@pytest.mark.parametrize(
    ("method", "way", "form"), [("active-set", unscented(), "joseph"), ("truncation", None, "sqrt")]
)
def test_a_rule_keeps_its_bounds(method, way, form):
    rule = inequality(D, [0.2], [0.6], method)
    solution = run(kalman(way, [rule], form), MODEL, START, Y)
    reading = np.asarray(solution.mean) @ D[0]
    assert np.all((reading >= 0.2 - 1e-12) & (reading <= 0.6 + 1e-12))
    notes = solution.steps.info["y"].notes
    assert np.sum(notes["inequality.outside"]) > 3
    assert not np.any(notes["inequality.infeasible"])
    # by the book: update, then the atom's own answer
    m, P = SYSTEM.m0, SYSTEM.P0
    for k, row in enumerate(Y):
        m, P = SYSTEM.F @ m, SYSTEM.F @ P @ SYSTEM.F.T + SYSTEM.Q
        here = np.isfinite(row)
        H, R = SYSTEM.H[here], SYSTEM.R[np.ix_(here, here)]
        K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
        m, P = m + K @ (row[here] - H @ m), P - K @ H @ P
        if method == "active-set":
            m = by_enumeration(m, P, D, np.array([0.2]), np.array([0.6]))
        else:
            mu, s = D[0] @ m, np.sqrt(D[0] @ P @ D[0])
            z = stats.truncnorm((0.2 - mu) / s, (0.6 - mu) / s, mu, s)
            G = P @ D[0] / s**2
            m, P = m + G * (z.mean() - mu), P - np.outer(G, G) * (s**2 - z.var())
        np.testing.assert_allclose(solution.mean[k], m, rtol=1e-7, atol=1e-8)
        np.testing.assert_allclose(solution.covariance[k], P, rtol=1e-6, atol=1e-8)


def test_a_height_on_a_manifold_and_its_gradient():
    def height(x):
        return x["height"] + 0.1 * jnp.cos(x["heading"].rad)

    one = kalman(rules=[inequality(height, [0.0])])
    start = Belief.of({"heading": Angle(3.1), "height": jnp.array([0.3])}, 0.04 * np.eye(2))
    motion = Motion(lambda x, u: x, jnp.full(2, 0.05))
    y = jnp.array([[-0.4], [jnp.nan], [0.2]])

    @jax.jit
    @partial(jax.value_and_grad, has_aux=True)
    def total(sigma):
        model = Model(motion, (Sensor(lambda x, aux: x["height"], sigma[None], 1),))
        solution = run(one, model, start, y)
        return solution.log_likelihood, jax.vmap(height)(solution.mean)

    step = 1e-6
    ((low, _), _), ((_, above), slope), ((high, _), _) = (
        total(0.1 + k * step) for k in (-1.0, 0.0, 1.0)
    )
    assert np.all(np.asarray(above) > -1e-3)  # linearised once
    assert float(slope) == pytest.approx(float(high - low) / (2 * step), rel=1e-5)
