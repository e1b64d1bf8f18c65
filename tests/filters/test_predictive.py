"""The score of a prediction: against the density written out, whatever rules do."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from dense_kalman import System
from scipy import stats

from robins.filters import Belief, kalman, run
from robins.filters.analysis.predictive import OUTLIERS, WIDER, predicted, scored
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
    """Of a normal density with a share of outliers, by SciPy."""
    zero = np.zeros(len(z))
    parts = [stats.multivariate_normal(zero, k * S).logpdf(z) for k in (1.0, WIDER**2)]
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
