"""The score of a prediction: against the density written out, whatever rules do."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from dense_kalman import System
from interpreted import run
from scipy import stats

from robins.filters import Belief, kalman
from robins.filters.analysis import predictive
from robins.filters.analysis.predictive import OUTLIERS, WIDER, predicted, scale, scored
from robins.filters.observation import Normalised
from robins.filters.rules import gate, huber

SYSTEM = System(
    F=np.array([[1.0, 0.5], [0.0, 0.9]]),
    G=0.3 * np.eye(2),
    H=np.array([[1.0, 0.0], [0.5, 1.0]]),
    W=np.diag([0.7, 1.3]),
    m0=np.zeros(2),
    P0=np.eye(2),
)


@pytest.fixture
def y():
    """Measurements with a gap, half a gap, and an outlier."""
    y = 2.0 * np.random.default_rng(0).normal(size=(40, 2))
    y[7], y[11, 0], y[20] = np.nan, np.nan, 500.0
    return y


def log_density(z, S):
    """Log density of a normal law with a share of outliers, by SciPy."""
    zero = np.zeros(len(z))
    square = scale(len(z)) ** 2
    parts = [stats.multivariate_normal(zero, k * square * S).logpdf(z) for k in (1.0, WIDER**2)]
    return np.logaddexp(np.log1p(-OUTLIERS) + parts[0], np.log(OUTLIERS) + parts[1])


@pytest.mark.parametrize("rules", [(), (gate(0.99), huber())], ids=["none", "gate and huber"])
def test_the_density_is_that_of_the_belief_before_whatever_rules_do(rules, y):
    filter_, model, start = kalman(rules=rules), SYSTEM.model(), SYSTEM.start()
    found = run(scored(filter_), model, start, y, keep=predicted).steps
    before = jax.tree.map(np.asarray, run(filter_, model, start, y).steps.prediction.belief)
    H, R = SYSTEM.H, SYSTEM.R
    for k, z in enumerate(y):
        there = np.isfinite(z)
        S = (H @ before.factor[k] @ before.factor[k].T @ H.T + R)[np.ix_(there, there)]
        want = log_density((z - H @ before.mean[k])[there], S) if there.any() else 0.0
        assert float(found.log_density[k]) == pytest.approx(want, rel=1e-9)
        assert int(found.components[k]) == there.sum()


@pytest.mark.parametrize("m", [1, 2, 3])
def test_of_normal_innovations_the_right_covariance_scores_best(m):
    # Another quadrature, and the interval of the sigma that scores best in a sample of 200 000.
    t, weight = np.polynomial.hermite_e.hermegauss(80)
    grid = np.stack(np.meshgrid(*[t] * m, indexing="ij"), axis=-1).reshape(-1, m)
    weights = np.prod(np.meshgrid(*[weight] * m, indexing="ij"), axis=0).ravel()
    sample = np.random.default_rng(m).normal(size=(200_000 // m, m))

    @jax.jit
    @jax.vmap
    def slopes(z):
        """First and second slope over the logarithm of sigma."""

        def score(x):
            white = z * jnp.exp(-x)
            factor, used = jnp.exp(x) * jnp.eye(m), jnp.ones(m, bool)
            return predictive.log_density(seen(white, factor, used))

        return jnp.stack([jax.grad(score)(0.0), jax.grad(jax.grad(score))(0.0)])

    exact = weights @ np.asarray(slopes(grid)) / weights.sum()
    assert abs(exact[0] / exact[1]) < 1e-3  # the quadrature's; of the plain mixture 1.3e-2 (m = 1)
    first, second = np.asarray(slopes(sample)).T
    found, sigma = -first.mean() / second.mean(), first.std() / np.sqrt(len(first)) / -second.mean()
    assert abs(found) < 1.96 * sigma
    assert sigma < 2e-3


def seen(white, factor, used):
    """An innovation that has been normalised."""
    return Normalised(factor, used, white, jnp.sum(white**2), jnp.sum(used))


def test_a_scored_filter_says_what_the_filter_says(y):
    filter_ = kalman(rules=[gate()])
    one, other = (run(f, SYSTEM.model(), SYSTEM.start(), y) for f in (filter_, scored(filter_)))
    np.testing.assert_array_equal(one.mean, other.mean)
    assert float(one.log_likelihood) == float(other.log_likelihood)


def test_refusing_does_not_pay(y):
    # What is refused adds nothing to the likelihood of a run; here it costs what it should.
    y[20] = 0.0
    rigid = SYSTEM._replace(G=1e-6 * np.eye(2))
    sure = Belief.of(jnp.zeros(2), 1e-8 * np.eye(2))
    filter_ = scored(kalman(rules=[gate(0.5)]))
    right, wrong = (
        run(filter_, system.model(), start, y, keep=predicted).steps
        for system, start in ((SYSTEM, SYSTEM.start()), (rigid, sure))
    )
    assert float(jnp.sum(right.log_density)) > float(jnp.sum(wrong.log_density)) + 10.0
